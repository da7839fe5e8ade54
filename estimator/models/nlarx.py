"""Predictions and free runs of Eq. (2) with given coefficients, for `agents.metrics`.

x_t = θ1 x_{t-1} + θ2 x_{t-1}³ + θ3 x_{t-2} + η u_{t-d},   y_t = x_t + v_t
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.lanes import kernel
from estimator.parameters import FloatArray


@dataclass(frozen=True)
class NLARX:
    """Eq. (2) with an input delay d of 0 or 1 samples, where u and y are paired by array index."""

    input_delay: int = 1

    def delayed(self, u: FloatArray) -> FloatArray:
        """The inputs (T,) that act on the outputs of the same index; before the first sample the input was 0."""
        return u if self.input_delay == 0 else np.concatenate(([0.0], u[:-1]))

    def predict(self, coefficients: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions (T,) of y from its last two values; the first two entries repeat y."""
        t1, t2, t3, e = coefficients
        predicted = y.copy()
        predicted[2:] = t1 * y[1:-1] + t2 * y[1:-1] ** 3 + t3 * y[:-2] + e * self.delayed(u)[2:]
        return predicted

    def simulate(self, coefficients: FloatArray, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run (T,) over u, started by the given first outputs; inf or NaN from where it diverges."""
        x = np.empty(len(u))
        x[: len(y_init)] = y_init
        _simulate(coefficients, self.delayed(u), x, len(y_init))
        return x


@kernel
def _simulate(coefficients, u, x, start):
    """Continue the recursion in place from sample ``start`` on."""
    t1, t2, t3, e = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    for t in range(start, len(x)):
        last = x[t - 1]
        x[t] = t1 * last + t2 * last * last * last + t3 * x[t - 2] + e * u[t]
