"""Regressors of a difference equation, as a declared list, and the joint filter over their coefficients.

    x_t = Σ_k c_k x_{t-1}^{a_k} x_{t-2}^{b_k} u_{t-d_k},     y_t = x_t + v_t

Each term is one coefficient times powers of the two lags, and possibly an input tap. With an offset and the taps
u_t, u_{t-1}, u_{t-2} the model takes up what the hold of a single tap leaves out of a band-limited input.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.inference import joint, sigma_points
from estimator.lanes import jit, kernel

N_STATES = 2

#: Input taps reach back this far.
LONGEST_DELAY = 2


class Term(NamedTuple):
    """One regressor.

    Attributes:
        lag1: power of x_{t-1}.
        lag2: power of x_{t-2}.
        tap: delay of the input that multiplies it, 0 to 2; None for no input.
    """

    lag1: int = 0
    lag2: int = 0
    tap: int | None = None

    @property
    def name(self) -> str:
        """Such as ``x1``, ``x1^3``, ``x1^2 x2``, ``u1``, or ``1`` for the offset."""
        factors = [f"{x}^{n}" if n > 1 else x for x, n in (("x1", self.lag1), ("x2", self.lag2)) if n]
        factors += [] if self.tap is None else [f"u{self.tap}"]
        return " ".join(factors) or "1"

    @property
    def unit(self) -> str:
        """Of its coefficient, with x and u in volts."""
        power = 1 - self.lag1 - self.lag2 - (self.tap is not None)
        return {0: "1", 1: "V"}.get(power, f"V^{power}")


_PAPER = (Term(1), Term(3), Term(0, 1))
_TAPS = (Term(tap=0), Term(tap=1), Term(tap=2))

#: Presets by name. ``paper`` has the regressors of Eq. (2), in its order.
PRESETS: dict[str, tuple[Term, ...]] = {
    "paper": (*_PAPER, Term(tap=1)),
    "offset": (*_PAPER, Term(tap=1), Term()),
    "three-tap": (*_PAPER, *_TAPS, Term()),
    "cubic": (*_PAPER, *_TAPS, Term(), Term(2), Term(2, 1), Term(1, 2), Term(0, 3)),
}


def as_arrays(terms: tuple[Term, ...]) -> npt.NDArray[np.int64]:
    """(K, 3) powers of the lags, and tap or -1, as the kernels take them."""
    return np.array([(t.lag1, t.lag2, -1 if t.tap is None else t.tap) for t in terms], dtype=np.int64)


@jit
def _power(x, n):
    result = 1.0
    for _ in range(n):
        result *= x
    return result


@jit
def _step(x1, x2, u, t, c, terms, regressors):
    """x_t and its derivatives by x_{t-1} and x_{t-2}; ``regressors`` (K,) receives the derivatives by c."""
    moved, by_x1, by_x2 = 0.0, 0.0, 0.0
    for k in range(len(terms)):
        a, b, tap = terms[k, 0], terms[k, 1], terms[k, 2]
        drive = 1.0
        if tap >= 0:
            drive = u[t - tap] if t >= tap else 0.0
        rest = _power(x2, b) * drive
        regressors[k] = _power(x1, a) * rest
        moved += c[k] * regressors[k]
        if a > 0:
            by_x1 += c[k] * a * _power(x1, a - 1) * rest
        if b > 0:
            by_x2 += c[k] * b * _power(x1, a) * _power(x2, b - 1) * drive
    return moved, by_x1, by_x2


@kernel
def run_regressors(mean, cov, noises, walk, terms, u, start, y, free_energies, forecasts, memory):
    """Update a joint belief in (x_t, x_{t-1}, c) with T samples.

    Args:
        mean: (2 + K,); overwritten, as ``cov`` and ``noises``.
        cov: (2 + K, 2 + K).
        noises: (4,) shapes and rates of q(γ) and q(ξ).
        walk: (K,) variances of the coefficients' random walk per sample.
        terms: (K, 3), see `as_arrays`.
        u: (start + T,) inputs [V]; those before the first sample first.
        start: number of inputs before the first sample.
        y: (T,) outputs [V]; NaN where missing.
        free_energies: (T, iterations) receives the free energies [nats].
        forecasts: (T, 2) receives mean [V] and variance [V²] of each output before it was seen.
        memory: of `sigma_points.memory`, for expectations by sigma points; None for expectations to first order.
    """
    n = len(mean)
    moved = np.empty(N_STATES)
    jacobian = np.zeros((N_STATES, n))
    jacobian[1, 0] = 1.0
    rows = np.empty((N_STATES, n))
    gain = np.empty(n)
    readout = np.zeros(n)
    readout[0] = 1.0
    direction = np.array([1.0, 0.0])
    for t in range(len(y)):
        if memory is None:
            moved[1] = mean[0]
            moved[0], jacobian[0, 0], jacobian[0, 1] = _step(
                mean[0], mean[1], u, start + t, mean[N_STATES:], terms, jacobian[0, N_STATES:]
            )  # fmt: skip
            joint.predict(mean, cov, moved, jacobian, walk, rows)
        else:
            columns, points = memory
            pairs = sigma_points.spread(mean, cov, columns, points)
            for i in range(2 * pairs):
                x1, x2, c = points[0, i], points[1, i], points[N_STATES:, i]
                points[0, i], points[1, i] = _step(x1, x2, u, start + t, c, terms, jacobian[0, N_STATES:])[0], x1
            sigma_points.predict(mean, cov, points[:N_STATES], columns, pairs, walk)
        forecasts[t, 0] = mean[0]
        forecasts[t, 1] = joint.correct(
            mean, cov, readout, direction, y[t] - mean[0], noises, free_energies.shape[1], free_energies[t], gain
        )  # fmt: skip


@kernel
def simulate_regressors(c, terms, u, x, start):
    """Continue the free run ``x`` (T,) from sample ``start`` on."""
    regressors = np.empty(len(c))
    for t in range(start, len(x)):
        x[t] = _step(x[t - 1], x[t - 2], u, t, c, terms, regressors)[0]
