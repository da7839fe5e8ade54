"""Maximum a posteriori: what a whole record says of the coefficients, to one who knows the noises and has time.

An auditor for the online estimators, and for whoever chooses their inputs: it shares neither their updates nor their
beliefs. With the Kalman filter's innovations ν_t and their variances S_t at (θ, η) = ψ it minimises

    L(ψ) = ½ Σ_t (ν_t² / S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0)

by Gauss-Newton steps (Λ0 + F)⁻¹, damped after Levenberg and Marquardt, with the sensitivities and the information F of
`estimator.fisher`. The inverse of Λ0 + F at the minimum is the posterior's covariance by Laplace's approximation. The
same for Eq. (1) with ψ = (stiffness, cubic stiffness, damping, gain), by `estimator.continuous_likelihood`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator import continuous_likelihood
from estimator.continuous import ContinuousBelief
from estimator.fisher import regress, spread
from estimator.lanes import kernel
from estimator.parameters import FloatArray
from estimator.prior import Prior

#: Steps at most, and the step at which the search ends, in standard deviations of the posterior.
_STEPS, _SMALL = 60, 1e-6
#: Damping at the start, its change after a step that fails or succeeds, and where a system is given up.
_DAMPING, _UP, _DOWN, _STUCK = 1e-4, 10.0, 0.1, 1e12


@dataclass(frozen=True)
class Fit:
    """The posterior's mode and curvature, for n records.

    Attributes:
        mean: (n, 4) the most probable (θ1, θ2, θ3, η); or stiffness, cubic stiffness, damping and gain per sample.
        cov: (n, 4, 4) inverse of Λ0 + F there.
        converged: (n,) whether the last step was small; where not, ``mean`` is the best point that was seen.
    """

    mean: FloatArray
    cov: FloatArray
    converged: npt.NDArray[np.bool_]


def maximum_a_posteriori(
    u: npt.ArrayLike,
    y: npt.ArrayLike,
    prior: Prior | ContinuousBelief,
    process_noise: float,
    measurement_noise: float,
) -> Fit:
    """Fit the coefficients to whole records, each from rest.

    Args:
        u: (n, T) inputs [V]; the t-th acts on the displacement of the sample before, or is by Eq. (1) the input at the
            sample. A record ends before its first NaN, so that episodes of different lengths fit into one array.
        y: (n, T) the outputs that followed them [V].
        prior: of the coefficients: a `Prior` of (θ, η), or a `ContinuousBelief`. Its belief in the noises is not used.
        process_noise: standard deviation of w̃ [V], or by Eq. (1) of what a sample's noise does to x; positive.
        measurement_noise: standard deviation of v [V], positive.

    Raises:
        ValueError: for shapes that are not (n, T), or a noise that is not positive.
    """
    inputs, outputs = np.array(u, dtype=np.float64), np.array(y, dtype=np.float64)
    if inputs.ndim != 2 or inputs.shape != outputs.shape:
        raise ValueError(f"u and y must have one shape (n, T), but have {inputs.shape} and {outputs.shape}")
    for name, value in (("process_noise", process_noise), ("measurement_noise", measurement_noise)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite, but is {value}; pass a standard deviation in V")
    center, cov, accumulate = _problem(prior)
    scale = np.sqrt(np.diag(cov))  # all is solved in units of the prior, for its condition's sake
    precision = np.linalg.inv(cov / np.outer(scale, scale))
    variances = (process_noise**2, measurement_noise**2, float(prior.state_cov[0, 0]))

    def appraise(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        loss, slope, information = np.zeros(len(points)), np.zeros((len(points), 4)), np.zeros((len(points), 4, 4))
        accumulate(center + scale * points, inputs, outputs, *variances, loss, slope, information)
        pull = points @ precision
        loss += 0.5 * (points * pull).sum(axis=1)
        return loss, scale * slope + pull, information * np.outer(scale, scale) + precision

    points = np.zeros((len(inputs), 4))
    loss, slope, curvature = appraise(points)
    damping = np.full(len(inputs), _DAMPING)
    converged = np.zeros(len(inputs), dtype=np.bool_)
    for _ in range(_STEPS):
        damped = curvature + damping[:, None, None] * curvature * np.eye(4)
        step = -np.linalg.solve(damped, slope[:, :, None])[:, :, 0]
        step[converged | (damping > _STUCK)] = 0.0
        new_loss, new_slope, new_curvature = appraise(points + step)
        better = new_loss <= loss  # False for what is not finite
        points[better] += step[better]
        loss, slope = np.where(better, new_loss, loss), np.where(better[:, None], new_slope, slope)
        curvature = np.where(better[:, None, None], new_curvature, curvature)
        damping = np.where(better, np.maximum(_DOWN * damping, 1e-12), np.minimum(_UP * damping, 10 * _STUCK))
        size = np.sqrt(np.einsum("ni,nij,nj->n", step, curvature, step))
        converged |= better & (size < _SMALL)
        if (converged | (damping > _STUCK)).all():
            break
    return Fit(center + scale * points, np.linalg.inv(curvature) * np.outer(scale, scale), converged)


def _problem(prior: Prior | ContinuousBelief) -> tuple[FloatArray, FloatArray, Callable[..., None]]:
    """Mean and covariance of the coefficients before, and the likelihood of their equation."""
    if isinstance(prior, ContinuousBelief):
        return prior.coefficients_mean, prior.coefficients_cov, continuous_likelihood.accumulate
    assert prior.coefficients_cov is not None
    return np.append(prior.theta_mean, prior.eta_mean), prior.coefficients_cov, _accumulate


@kernel
def _accumulate(psi, u, y, q, r, state_variance, loss, slope, information):
    """L without its prior (n,), its gradient (n, 4) and its Gauss-Newton curvature F (n, 4, 4) at (n, 4) points."""
    s, last_s, moved = np.empty(4), np.empty(4), np.empty(4)
    for i in range(len(u)):
        t1, t2, t3, e = psi[i]
        x, last_x, p00, p01, p11 = 0.0, 0.0, state_variance, 0.0, state_variance
        s[:] = 0.0
        last_s[:] = 0.0
        for t in range(u.shape[1]):
            if u[i, t] != u[i, t]:
                break
            a = t1 + 3.0 * t2 * x * x
            predicted = t1 * x + t2 * x * x * x + t3 * last_x + e * u[i, t]
            c0, _, variance = spread(a, t3, p00, p01, p11, q)
            weight = 1.0 / (variance + r)
            innovation = y[i, t] - predicted
            regress(a, t3, s, last_s, x, last_x, u[i, t], moved)
            loss[i] += 0.5 * (innovation * innovation * weight - np.log(weight))
            for j in range(4):
                slope[i, j] -= weight * moved[j] * innovation
                for k in range(4):
                    information[i, j, k] += weight * moved[j] * moved[k]
                last_s[j] = s[j] - c0 * weight * moved[j]
                s[j] = r * weight * moved[j]
            last_x = x + c0 * weight * innovation
            x = predicted + variance * weight * innovation
            p00, p01, p11 = r * weight * variance, r * weight * c0, p00 - c0 * c0 * weight
