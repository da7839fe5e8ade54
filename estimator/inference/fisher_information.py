"""Fisher information of a model's coefficients, and Cramér-Rao bounds.

The state is latent, so the information is in the innovations. With the Kalman filter of the model linearised along its
trajectory, ν_t the innovation, S_t its variance and s_t = -∂ν_t/∂(coefficients),

    F = Σ_t s_t s_tᵀ / S_t,

summed over the sensors too. F omits the sensitivities of the gain and of S: their share is the squared ratio of noise
to signal (1e-5 on the tracks), and information from S requires exactly known noises.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from estimator.engine.input_hold import input_degree
from estimator.inference.record_arrays import inputs_by_channel, outputs_by_sensor
from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.model import Model
from estimator.rigs.physical_parameters import physical_jacobian, to_physical
from estimator.rigs.units import VOLT_SCALES, Scales
from estimator.support.argument_checks import MAX_MAGNITUDE, check_number, to_float_array
from estimator.support.array_types import FloatArray


def fisher_information(
    model: Model,
    coefficients: npt.ArrayLike,
    u: npt.ArrayLike,
    process_noise: npt.ArrayLike,
    measurement_noise: npt.ArrayLike,
    *,
    y: npt.ArrayLike | None = None,
    interpolation: str = "zero_order",
    state_std: float = 0.0,
    process_ratios: Mapping[str, npt.ArrayLike] | None = None,
) -> FloatArray:
    """Fisher information of a model's coefficients in its outputs, under given inputs.

    Args:
        model: the equation.
        coefficients: (K,) or (n, K), time counted in samples.
        u: (T,) or (n, T) inputs, or (..., T, inputs) of several or none; the t-th acts over the sample that ends with
            the t-th output. A series ends before its first NaN, so that episodes of different lengths fit into one
            array; before its first sample the input is 0.
        process_noise: standard deviation of the first sensor's output by the process noise of one sample, in its unit,
            0 or more; (n,) of a batch.
        measurement_noise: the sensors' standard deviations, positive: one number, or one for each; (n, p) of a batch.
        y: (T,) or (n, T) outputs, or (..., T, p) of p sensors: the linearisation is then along the filter's trajectory
            on them. None is along the noise-free response, for experiment design.
        interpolation: of the input between samples: ``zero_order``, or ``linear`` for a differential equation.
        state_std: standard deviation of every state about 0 at the start; by default it starts at rest. States of
            `Model.initial_states` start at their coefficients.
        process_ratios: state with independent noise to the factor on its strength, 1 by default; (n,) of a batch.

    Returns:
        (K, K), or (n, K, K) where an argument is a batch. Not finite where the model blows up.

    Raises:
        ValueError: naming the argument, if its shape does not fit or a number is out of range.
    """
    degree = input_degree(Model.require_model(model), interpolation)
    noises = noise_variances(model, process_noise, measurement_noise, process_ratios)
    check_number("state_std", state_std, 0, MAX_MAGNITUDE, "0 is at rest")
    points, inputs = to_float_array("coefficients", coefficients), inputs_by_channel(model, u)
    if points.ndim not in (1, 2) or points.shape[-1] != model.n_coefficients:
        raise ValueError(
            f"coefficients must be {list(model.coefficients)} on the last axis, but have shape {points.shape}"
        )
    outputs = None if y is None else outputs_by_sensor(model, inputs, y)
    try:
        shape = np.broadcast_shapes(points.shape[:-1], inputs.shape[:-2], noises.shape[:-1])
    except ValueError:
        sizes = points.shape[:-1], inputs.shape[:-2], noises.shape[:-1]
        raise ValueError(
            f"coefficients, u and noises must be batches of one size, but have {sizes}; repeat the smaller"
        ) from None
    rows, samples = int(np.prod(shape)), inputs.shape[-2]

    def broadcast(array: FloatArray, *last: int) -> FloatArray:
        return np.broadcast_to(array, (*shape, *last)).reshape(rows, *last).copy()

    covariance = float(state_std) ** 2 * np.eye(model.n_states)
    filtered = record_likelihoods(
        model,
        broadcast(points, model.n_coefficients),
        inputs_by_sample(model, broadcast(inputs, samples, model.n_inputs), degree),
        None if outputs is None else broadcast(outputs, samples, model.n_outputs),
        broadcast(noises, noises.shape[-1]),
        covariance,
    )
    k = model.n_coefficients
    return filtered.information.reshape(*shape, k, k)


def cramer_rao(information: FloatArray, prior_precision: FloatArray | None = None) -> FloatArray:
    """Cramér-Rao bound: lower bound of the error covariance of any estimate of the coefficients.

    Without a prior the bound holds for unbiased estimates of one system. With a prior it is the Bayesian bound (van
    Trees 1968): E[(error)(error)ᵀ] over systems and noise is at least (Λ0 + E[F])⁻¹, for biased estimates too, and for
    feedback inputs, which are functions of past outputs. Pass then the mean of F over systems from the prior. Λ0 =
    E[∇log p ∇log pᵀ] is the inverse covariance of a Gaussian prior.

    Args:
        information: (..., K, K) F, or its mean.
        prior_precision: (K, K) Λ0; None for no prior.

    Returns:
        (..., K, K) the bound.

    Raises:
        ValueError: if Λ0 + F is not finite or not positive definite.
    """
    total = to_float_array("information", information)
    prior = np.zeros((1, 1)) if prior_precision is None else to_float_array("prior_precision", prior_precision)
    for name, matrix in (("information", total), ("prior_precision", prior)):
        if matrix.ndim < 2 or 0 in matrix.shape or matrix.shape[-2] != matrix.shape[-1]:
            raise ValueError(f"{name} must have shape (..., K, K), but has {matrix.shape}")
    if prior_precision is not None and prior.shape != total.shape[-2:]:
        raise ValueError(f"prior_precision must have shape {total.shape[-2:]}, but has {prior.shape}")
    total = total + prior
    if not np.isfinite(total).all():
        raise ValueError("information must be finite, but has entries that are not; leave out systems that diverged")
    # In units with a diagonal of 1: a cubic coefficient has a hundredth of the information of the others.
    scale = np.sqrt(np.diagonal(total, axis1=-2, axis2=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = total / (scale[..., :, None] * scale[..., None, :])
    if not np.isfinite(unit).all() or np.linalg.eigvalsh(unit).min() <= 0:
        raise ValueError("information must be positive definite, but is not; pass more samples or a prior_precision")
    return np.linalg.inv(unit) / (scale[..., :, None] * scale[..., None, :])


def relative_covariance(
    model: Model, coefficients: npt.ArrayLike, covariance: npt.ArrayLike, scales: Scales = VOLT_SCALES
) -> FloatArray:
    """Covariance of the relative errors of the physical parameters, to first order, from the coefficients' covariance.

    Args:
        model: the equation; without physical parameters, the coefficients count as parameters.
        coefficients: (..., K).
        covariance: (..., K, K).
        scales: units of the coefficients.

    Returns:
        (..., p, p); the square roots of the diagonal are coefficients of variation.

    Raises:
        ValueError: for anything but a model, or shapes that do not fit it.
    """
    points, spread = to_float_array("coefficients", coefficients), to_float_array("covariance", covariance)
    k = Model.require_model(model).n_coefficients
    if points.shape[-1:] != (k,) or spread.shape[-2:] != (k, k):
        raise ValueError(
            f"coefficients and covariance must have shapes (..., {k}) and (..., {k}, {k}) for {model.name}, but have "
            f"{points.shape} and {spread.shape}"
        )
    slopes = physical_jacobian(model, points, scales) / to_physical(model, points, scales)[..., :, None]
    relative: FloatArray = slopes @ spread @ np.swapaxes(slopes, -1, -2)
    return relative
