"""Parameters of a plant by name, and those of the Silverbox circuit.

Displacement and input of the circuit are both in volts, as in its record.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]

#: Time between two samples of the Silverbox record [s]: 610.35 Hz.
SILVERBOX_SAMPLING_STEP = 2**14 / 1e7


class Parameters(Mapping[str, Any]):
    """Named numbers, or arrays of one shape for a batch; ``p["rate"]`` and ``p.rate`` are the same.

    Args:
        values: name to value, or pairs of both.
        named: further ones.

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


#: The Silverbox circuit as the difference equation sees it, m [s²], c [s], a [1] and b [V⁻²] of Eq. (1)
#: (``python -m duffing_env.plants.silverbox_twin`` identifies it).
SILVERBOX_TWIN = Parameters(m=6.4568e-6, c=2.5717e-4, a=1.1747, b=3.7672)

_SILVERBOX_GAIN = 186_015.0  # s⁻²

#: The same as the differential equation sees it.
SILVERBOX_ODE_TWIN = Parameters(
    m=1 / _SILVERBOX_GAIN, c=41.8992 / _SILVERBOX_GAIN, a=184_255.0 / _SILVERBOX_GAIN, b=730_155.0 / _SILVERBOX_GAIN
)
