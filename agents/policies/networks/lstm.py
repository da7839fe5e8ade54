"""An LSTM in NumPy, with torch's tensors, and the check of a network's tensors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from agents.predict_argument_checks import check_state, episode_starts

FloatArray = npt.NDArray[np.float32]
LstmState = tuple[FloatArray, FloatArray]


def checked_tensor(tensors: Mapping[str, FloatArray], name: str, *shape: int | None) -> FloatArray:
    """A tensor of this name; None stands for any length of a side.

    Raises:
        ValueError: for another shape or type, or numbers that are not finite.
    """
    found = tensors[name]
    sides = zip(found.shape, shape, strict=False)
    fits = found.ndim == len(shape) and all(side > 0 and length in (None, side) for side, length in sides)
    wanted = tuple("any" if length is None else length for length in shape)
    must = f"{name} must be finite float32 of shape {wanted}"
    if not fits or found.dtype != np.float32:
        raise ValueError(f"{must}, but is {found.dtype} of {found.shape}")
    if bad := np.count_nonzero(~np.isfinite(found)):
        raise ValueError(f"{must}, but {bad} of its {found.size} numbers are not finite; find what made them so")
    return found


class Lstm:
    """An LSTM of one layer, with torch's tensors: gates in the order input, forget, cell, output."""

    def __init__(self, name: str, tensors: Mapping[str, FloatArray]) -> None:
        self._from_hidden = checked_tensor(tensors, f"{name}.weight_hh_l0", None, None)
        self.units = self._from_hidden.shape[1]
        gates = 4 * self.units
        checked_tensor(tensors, f"{name}.weight_hh_l0", gates, self.units)
        self.from_input = checked_tensor(tensors, f"{name}.weight_ih_l0", gates, None)
        self._bias = checked_tensor(tensors, f"{name}.bias_ih_l0", gates) + checked_tensor(
            tensors, f"{name}.bias_hh_l0", gates
        )

    def update(self, inputs: FloatArray, state: LstmState | None, episode_start: npt.ArrayLike | None) -> LstmState:
        """Hidden and cell values (1, n, units) after inputs (n, features)."""
        zeros = np.zeros((1, len(inputs), self.units), dtype=np.float32)
        if state is not None:
            check_state(state, 2)
        hidden, cell = (zeros, zeros) if state is None else state
        if hidden.shape != zeros.shape or cell.shape != zeros.shape:
            raise ValueError(f"state must be two arrays of shape {zeros.shape}, but has {hidden.shape}, {cell.shape}")
        if episode_start is not None:
            goes_on = ~episode_starts(episode_start, len(inputs))[:, None]
            hidden, cell = hidden * goes_on, cell * goes_on
        gates = inputs @ self.from_input.T + hidden[0] @ self._from_hidden.T + self._bias
        input_gate, forget_gate, candidate, output_gate = np.split(gates, 4, axis=-1)
        cell = _sigmoid(forget_gate) * cell[0] + _sigmoid(input_gate) * np.tanh(candidate)
        hidden = _sigmoid(output_gate) * np.tanh(cell)
        return hidden[None].astype(np.float32), cell[None].astype(np.float32)


def _sigmoid(x: FloatArray) -> FloatArray:
    return np.float32(0.5) * (np.float32(1) + np.tanh(np.float32(0.5) * x))
