"""The physical equation in four parameters: the circuit's values, the prior and the belief.

    x'' = gain u - damping x' - stiffness x - cubic x³,        stiffness = a/m, cubic = b/m, damping = c/m, gain = 1/m,

which is Eq. (1). Its estimator (`estimator.inference.continuous`) counts time in samples of δ = 1.6384 ms, so that all
quantities are of the order of one. Vectors order the coefficients as (stiffness, cubic, damping, gain).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.belief import RecordBelief
from estimator.parameters import CONTINUOUS_TWIN, SAMPLING_STEP, FloatArray, PhysicalParameters
from estimator.record import RECORD, RECORD_SIZE

#: Coefficients with their physical units, in the order of the record's rows t1, t2, t3, e.
COEFFICIENTS = {"stiffness": "s⁻²", "cubic": "V⁻² s⁻²", "damping": "s⁻¹", "gain": "s⁻²"}

#: Factors from units per sample to physical ones.
_SCALES = SAMPLING_STEP ** np.array([-2.0, -2.0, -1.0, -2.0])


def continuous_prior(
    center: PhysicalParameters = CONTINUOUS_TWIN,
    spread: float = 0.3,
    process_noise: float = 5e-4,
    measurement_noise: float = 5e-4,
    noise_shape: float = 2.0,
    state_std: float = 1e-3,
) -> ContinuousBelief:
    """The prior that has the moments of an oscillator known only up to a factor.

    Args:
        center: the oscillator in the middle of the range.
        spread: m, c, a and b are log-uniform on center * [1 - spread, 1 + spread]; in (0, 1).
        process_noise: what the process noise of a sample does to x: standard deviation [V] at which γ is centred.
        measurement_noise: standard deviation of v [V] at which ξ is centred.
        noise_shape: shape of both Gamma priors.
        state_std: standard deviation of x [V], and of x' [V per sample], about rest.

    Raises:
        ValueError: for a value out of its range.
    """
    if not 0 < spread < 1:
        raise ValueError(f"spread must be above 0 and below 1, but is {spread}; pass the range's relative half width")
    values = {
        "process_noise": process_noise, "measurement_noise": measurement_noise, "noise_shape": noise_shape,
        "state_std": state_std,
    }  # fmt: skip
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite, but is {value}; pass a value above 0")
    # With t = artanh(spread), X / center = sqrt(1 - spread²) exp(t U) and center / X = exp(t U) / sqrt(1 - spread²)
    # for U uniform on [-1, 1].
    t = np.arctanh(spread)
    mean_factor = np.sinh(t) / t
    var_factor = np.sinh(t) / t**2 * (t * np.cosh(t) - np.sinh(t))
    narrowed = 1 - spread**2
    forces = _per_sample(np.array([center.a, center.b, center.c, 1.0]) / center.m)
    force_mean = forces * [*(3 * [np.sqrt(narrowed) * mean_factor]), 1.0]
    force_var = forces**2 * [*(3 * [narrowed * var_factor]), 0.0]
    mass_mean, mass_var = mean_factor / np.sqrt(narrowed), var_factor / narrowed
    record = dict.fromkeys(RECORD, 0.0)
    record |= dict(zip(("t1", "t2", "t3", "e"), force_mean * mass_mean, strict=True))
    cov = mass_var * np.outer(force_mean, force_mean) + (mass_var + mass_mean**2) * np.diag(force_var)
    for i, first in enumerate(("t1", "t2", "t3", "e")):
        record |= {f"P_{first}_{second}": cov[i, j] for j, second in enumerate(("t1", "t2", "t3", "e")) if j >= i}
    record["P_x0_x0"] = record["P_x1_x1"] = state_std**2
    record |= {"g_shape": noise_shape, "g_rate": noise_shape * process_noise**2}
    record |= {"n_shape": noise_shape, "n_rate": noise_shape * measurement_noise**2}
    assert len(record) == RECORD_SIZE
    return ContinuousBelief(np.array(list(record.values())))


@dataclass(frozen=True, eq=False)
class ContinuousBelief(RecordBelief):
    """A prior or posterior: q(x, x', stiffness, cubic, damping, gain) Gaussian, q(γ) and q(ξ) Gamma.

    Moments, densities and entropy are those of time counted in samples; `parameters` tells the coefficients in
    physical units, `physical` as m, c, a and b. γ is the precision of what the process noise of a sample does to x.

    Attributes:
        record: (RECORD_SIZE,) the flat record.
    """

    names = tuple(COEFFICIENTS)

    @staticmethod
    def propagate(coefficients_mean: FloatArray, coefficients_cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments (..., 4) and (..., 4, 4) of (m, c, a, b) from those of the coefficients, to first order.

        m = δ²/gain, c = δ damping/gain, a = stiffness/gain, b = cubic/gain.
        """
        numerators = np.stack(
            [
                np.full_like(coefficients_mean[..., 3], SAMPLING_STEP**2),
                SAMPLING_STEP * coefficients_mean[..., 2],
                coefficients_mean[..., 0],
                coefficients_mean[..., 1],
            ],
            axis=-1,
        )
        gain = coefficients_mean[..., 3:]
        physical = numerators / gain
        slopes = np.zeros((*physical.shape, 4))
        slopes[..., 1, 2] = SAMPLING_STEP
        slopes[..., 2, 0] = slopes[..., 3, 1] = 1.0
        slopes[..., 3] = -physical
        jacobian = slopes / gain[..., None]
        return physical, jacobian @ coefficients_cov @ np.swapaxes(jacobian, -1, -2)

    @staticmethod
    def coefficients_of(parameters: PhysicalParameters) -> FloatArray:
        """(..., 4) stiffness, cubic stiffness, damping and gain per sample of one oscillator or a batch."""
        m = parameters.m
        return _per_sample(np.stack([parameters.a / m, parameters.b / m, parameters.c / m, 1 / m], axis=-1))

    def parameters(self) -> dict[str, tuple[float, float, str]]:
        """Mean, standard deviation and unit of each coefficient in physical units, by name."""
        means = self.coefficients_mean * _SCALES
        stds = np.sqrt(np.diag(self.coefficients_cov)) * _SCALES
        rows = zip(COEFFICIENTS, means, stds, COEFFICIENTS.values(), strict=True)
        return {name: (float(mean), float(std), unit) for name, mean, std, unit in rows}


def _per_sample(coefficients: FloatArray) -> FloatArray:
    """Coefficients (..., 4) in physical units, per sample."""
    return coefficients / _SCALES
