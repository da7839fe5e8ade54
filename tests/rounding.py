"""How far two programs that compute the same network in float32 can differ: a bound that follows from the arithmetic.

Both sides round every operation, in an order that depends on the processor and on the library. So neither is the
other's reference, and the bound holds for any two of them: each differs from the exact value by at most

- a sum of n products, in any order, with or without fused multiply-adds: n u Σ |products|, up to terms in u²
  (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1), where u = 2⁻²⁴ is the unit of rounding;
- tanh and the exponential: 4 units in the last place, which is what the vector libraries promise at their coarsest,
  8 u of the value;
- the difference of the inputs, times the largest slope between them.

The network is played in float64 with the weights at hand, and the bound is carried along beside the values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

#: Unit of rounding of float32: half the distance from 1 to the next number.
U32 = 2.0**-24
#: The same of float64.
U64 = 2.0**-53
#: Error of an elementary function, in parts of its value.
ELEMENTARY = 8 * U32


@dataclass(frozen=True)
class Rounded:
    """Exact values, and how far a float32 program can be from them."""

    value: npt.NDArray[np.float64]
    error: npt.NDArray[np.float64]

    @classmethod
    def exact(cls, value: npt.ArrayLike) -> Rounded:
        value = np.asarray(value, dtype=np.float64)
        return cls(value, np.zeros_like(value))

    def __add__(self, other: Rounded) -> Rounded:
        value = self.value + other.value
        return Rounded(value, self.error + other.error + U32 * np.abs(value))

    def __mul__(self, other: Rounded) -> Rounded:
        value = self.value * other.value
        carried = np.abs(self.value) * other.error + np.abs(other.value) * self.error + self.error * other.error
        return Rounded(value, carried + U32 * np.abs(value))

    def affine(self, weight: npt.ArrayLike, bias: npt.ArrayLike) -> Rounded:
        """Weight (out, in) times the values, and the bias added: a sum of in + 1 products."""
        weight, bias = np.asarray(weight, dtype=np.float64), np.asarray(bias, dtype=np.float64)
        terms = (np.abs(self.value) + self.error) @ np.abs(weight).T + np.abs(bias)
        return Rounded(
            self.value @ weight.T + bias, self.error @ np.abs(weight).T + (weight.shape[1] + 1) * U32 * terms
        )

    def tanh(self) -> Rounded:
        # The slope falls with the distance from 0: the largest is at the end that is nearer to it.
        nearest = np.maximum(np.abs(self.value) - self.error, 0.0)
        value = np.tanh(self.value)
        return Rounded(
            value, np.minimum(self.error / np.cosh(np.minimum(nearest, 300.0)) ** 2, 2.0) + ELEMENTARY * np.abs(value)
        )

    def sigmoid(self) -> Rounded:
        """½ (1 + tanh x/2), or 1 / (1 + exp -x): an elementary function, and at most three roundings of parts of 1."""
        half = Rounded(0.5 * self.value, 0.5 * self.error).tanh()
        return Rounded(0.5 * (1 + half.value), 0.5 * half.error + ELEMENTARY + 3 * U32)


#: Hidden and cell values (n, units) of a memory.
State = tuple[Rounded, Rounded]


def play(
    tensors: dict[str, Any], network: dict[str, Any], observations: npt.ArrayLike, state: State | None = None
) -> tuple[npt.NDArray[np.float64], State | None]:
    """How far two float32 programs can differ in the deterministic actions (n, 1) of a policy folder's network.

    Args:
        tensors: of the folder's weights.
        network: as its card describes it.
        observations: (n, features), the same for both.
        state: hidden and cell values (n, units) of a network with a memory, and how far they are from exact.

    Returns:
        The bound, and the next state.
    """
    hidden = Rounded.exact(observations)
    if network["memory"] is not None:
        hidden, state = _remember(tensors, network["memory"], hidden, state)
    *before, last = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in network["layers"]]
    for weight, bias in before:
        hidden = hidden.affine(weight, bias)
        if network["activation"] == "tanh":
            hidden = hidden.tanh()
        else:  # of slope 1 and exact
            hidden = Rounded(np.maximum(hidden.value, 0.0), hidden.error)
    action = hidden.affine(*last)
    # Clipping has slope 1 and is exact. A squashed action goes from [-1, 1] to the limits and back: four roundings.
    error = action.tanh().error + 4 * U32 if network["squashed"] else action.error
    return 2 * error, state


def _remember(
    tensors: dict[str, Any], name: str, inputs: Rounded, state: State | None
) -> tuple[Rounded, State]:  # fmt: skip
    """The LSTM's output, and its hidden and cell values."""
    from_input, from_hidden = tensors[f"{name}.weight_ih_l0"], tensors[f"{name}.weight_hh_l0"]
    units = from_hidden.shape[1]
    zeros = Rounded.exact(np.zeros((len(inputs.value), units)))
    hidden, cell = state or (zeros, zeros)
    # The two biases are weights of an input of one, so that the sizes of both count.
    ones = np.ones((len(inputs.value), 2))
    together = Rounded(
        np.concatenate([inputs.value, hidden.value, ones], axis=1),
        np.concatenate([inputs.error, hidden.error, 0 * ones], axis=1),
    )
    biases = np.stack([tensors[f"{name}.bias_ih_l0"], tensors[f"{name}.bias_hh_l0"]], axis=1)
    gates = together.affine(np.concatenate([from_input, from_hidden, biases], axis=1), np.zeros(4 * units))
    admit, keep, candidate, show = (
        Rounded(value, error)
        for value, error in zip(np.split(gates.value, 4, axis=1), np.split(gates.error, 4, axis=1), strict=True)
    )
    cell = keep.sigmoid() * cell + admit.sigmoid() * candidate.tanh()
    hidden = show.sigmoid() * cell.tanh()
    return hidden, (hidden, cell)
