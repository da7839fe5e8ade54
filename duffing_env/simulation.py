"""The reward ``simulation_error``: how far the believed oscillator runs from the true one, on its own.

Both are put at rest and given the same test input, without noise; what they do is compared:

    misfit = min(sqrt(Σ (x_believed - x_true)² / Σ x_true²), 1).

The believed one has the posterior's means for its coefficients. One that runs away, or is NaN, has a misfit of 1.

The test input is a Schroeder multisine of `SAMPLES` samples: the first 20 multiples of 9.5 Hz, so up to 191 Hz as the
Silverbox's, all of one size. Its peak is half of ``max_input``, with which oscillators of the standard tracks come to
0.35 V at most. Physical oscillators are integrated in two Runge-Kutta steps per sample, and compared after each.
"""

from __future__ import annotations

import numpy as np

from duffing_env.layout import LAYOUT
from estimator.inference.continuous import runge_kutta
from estimator.lanes import jit, lanewise
from estimator.parameters import FloatArray
from estimator.record import MEAN_FIELD_SCRATCH

#: Length of the test input: 105 ms.
SAMPLES = 64

_HARMONICS, _PEAK, _SUBSTEPS = 20, 0.5, 2


def _schroeder() -> FloatArray:
    """The test input (SAMPLES,), in parts of ``max_input``."""
    harmonics = np.arange(1, _HARMONICS + 1)
    phases = -np.pi * harmonics * (harmonics - 1) / _HARMONICS
    times = np.arange(SAMPLES)[:, None] / SAMPLES
    waves: FloatArray = np.cos(2 * np.pi * harmonics * times + phases).sum(axis=1)
    return _PEAK * waves / np.abs(waves).max()


TEST_INPUT = _schroeder()

# Both oscillators' two states and the two sums, in rows that lie idle but during a mean-field update.
_SUMS = ("model_x", "model_v", "twin_x", "twin_v", "deviation", "power")
_LAYOUT = {**LAYOUT, **{name: LAYOUT[row] for name, row in zip(_SUMS, MEAN_FIELD_SCRATCH, strict=False)}}


@lanewise(_LAYOUT, " ".join(_SUMS))
def _rest():
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@lanewise(_LAYOUT, " ".join(_SUMS), uniform="played")
def _move_by_difference(
    model_x, model_v, twin_x, twin_v, deviation, power, t1, t2, t3, e, true_t1, true_t2, true_t3, true_e, played
):  # fmt: skip
    """Eq. (2) over one sample; the second state is x_{t-1}."""
    model = t1 * model_x + t2 * model_x * model_x * model_x + t3 * model_v + e * played
    twin = true_t1 * twin_x + true_t2 * twin_x * twin_x * twin_x + true_t3 * twin_v + true_e * played
    return model, model_x, twin, twin_x, deviation + (model - twin) * (model - twin), power + twin * twin


@lanewise(_LAYOUT, " ".join(_SUMS), uniform="u0 u1 u2 length")
def _integrate(
    model_x, model_v, twin_x, twin_v, deviation, power, t1, t2, t3, e, true_t1, true_t2, true_t3, true_e,
    u0, u1, u2, length,
):  # fmt: skip
    """Eq. (1) over ``length`` of a sample; the second state is x'."""
    model, model_v, _, _, _, _, _, _ = runge_kutta(model_x, model_v, t1, t2, t3, e, u0, u1, u2, length)
    twin, twin_v, _, _, _, _, _, _ = runge_kutta(twin_x, twin_v, true_t1, true_t2, true_t3, true_e, u0, u1, u2, length)
    return model, model_v, twin, twin_v, deviation + (model - twin) * (model - twin), power + twin * twin


@lanewise(_LAYOUT, "misfit")
def _conclude(deviation, power):
    """The misfit; whatever is no number, or above 1, counts as 1."""
    misfit = np.sqrt(deviation / power)
    return misfit if misfit < 1.0 else 1.0


@jit
def compare(W, max_input, continuous):
    """Write the misfits of a block's beliefs to its rows ``misfit``."""
    _rest(W)
    for t in range(SAMPLES):
        u = max_input * TEST_INPUT[t]
        if continuous != 0.0:
            begin = max_input * TEST_INPUT[t - 1] if t > 0 else 0.0
            rise = (u - begin) / (2 * _SUBSTEPS)
            for s in range(_SUBSTEPS):
                at = begin + 2 * s * rise
                _integrate(W, at, at + rise, at + 2 * rise, 1.0 / _SUBSTEPS)
        else:
            _move_by_difference(W, u)
    _conclude(W)
