"""Parameters of a plant by name, for models other than the oscillator's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np


class Parameters(Mapping[str, Any]):
    """Named numbers, or arrays of one shape for a batch; ``p["rate"]`` and ``p.rate`` are the same.

    Args:
        values: name to value.

    Example:
        >>> Parameters({"rate": 0.5}).rate
        0.5
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self._values:
            raise AttributeError(f"there is no parameter {name!r}")
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Parameters) or list(self) != list(other):
            return NotImplemented
        return all(np.array_equal(self[name], other[name]) for name in self)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Parameters({self._values})"
