"""Named numbers, such as the physical parameters of a plant, with access by key and by attribute."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np


class Parameters(Mapping[str, Any]):
    """Named numbers, or arrays of one shape for a batch; ``p["rate"]`` and ``p.rate`` are the same.

    Args:
        values: name to value, or pairs of both.
        named: further names and values.

    Example:
        >>> Parameters(m=6.0e-6, c=3.0e-4, a=1.2, b=3.5).a
        1.2
    """

    def __init__(self, values: Mapping[str, Any] | Iterable[tuple[str, Any]] = (), /, **named: Any) -> None:
        try:
            self._values: dict[str, Any] = dict(values, **named)
        except (TypeError, ValueError) as error:
            raise TypeError(f"values must be a mapping from names to numbers, or pairs of both: {error}") from error

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
