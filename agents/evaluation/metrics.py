"""Metrics of experiments, system by system: errors, coverage, NEES, Fisher information, and power of the input."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from agents.evaluation.plant_model import plant_model_of
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.plants.silverbox_record import load_record, regime_input
from duffing_env.storage.kernel_spec import parameter_names
from estimator.inference.fisher_information import fisher_information
from estimator.inference.free_run import free_run
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters
from estimator.rigs.physical_parameters import coefficients_of, to_physical
from estimator.rigs.units import Scales
from estimator.support.array_types import FloatArray

#: Metric of coverage to the nominal level of its credible intervals.
CREDIBLE_LEVELS = {"coverage_50": 0.50, "coverage": 0.90, "coverage_95": 0.95}

#: Samples of the arrow's input, its last ones, in a free run of the twin.
_TWIN_ARROW_SAMPLES = 8_192

#: Lengths of the segments of the Silverbox regime with which inputs are compared [samples].
_SEGMENT_LENGTHS = np.unique(np.round(2 ** np.arange(4, 15.6, 0.5)).astype(int))


def posterior_metrics(
    means: FloatArray, covs: FloatArray, truth: Parameters, model: Model, scales: Scales
) -> dict[str, FloatArray]:
    """Errors, coverage and NEES of posteriors of the coefficients.

    Args:
        means: (n, K) posterior means.
        covs: (n, K, K) posterior covariances.
        truth: true parameters (n,).
        model: of the coefficients.
        scales: from the coefficients' units to the parameters' units.

    Returns:
        Relative errors ``error_<parameter>``; the proportion of coefficients within their intervals, at each of
        `CREDIBLE_LEVELS`; and ``nees``, the normalised estimation error squared dᵀ C⁻¹ d per coefficient, whose mean
        is 1 for a calibrated posterior.
    """
    true_parameters = {name: truth[name] for name in parameter_names(model)}
    errors = np.abs(to_physical(model, means, scales) / np.stack(list(true_parameters.values()), axis=-1) - 1)
    # A coefficient that is known, such as θ2 = 0, has no variance.
    free_coefficients = np.flatnonzero(np.diagonal(covs, axis1=1, axis2=2).all(axis=0))
    deviations = (means - coefficients_of(model, true_parameters, scales))[:, free_coefficients]
    covs = covs[:, free_coefficients][:, :, free_coefficients]
    stds = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    correlations = covs / (stds[:, :, None] * stds[:, None, :])  # better conditioned than covariances
    scaled = deviations / stds
    nees = np.einsum("ni,ni->n", scaled, np.linalg.solve(correlations, scaled[:, :, None])[:, :, 0]) / len(
        free_coefficients
    )
    return {
        **{f"error_{name}": errors[:, i] for i, name in enumerate(true_parameters)},
        **{
            name: (np.abs(scaled) <= stats.norm.ppf(0.5 + level / 2)).mean(axis=1)
            for name, level in CREDIBLE_LEVELS.items()
        },
        "nees": nees,
    }


def input_metrics(inputs: FloatArray) -> dict[str, FloatArray]:
    """Power, peak and crest factor (peak over RMS) of inputs (T, n), NaN after the end of an episode.

    Of several inputs (T, n, inputs), each in its own unit, the power is the sum, and the peak the largest of
    sqrt(Σ u²).
    """
    squares = inputs**2 if inputs.ndim == 2 else (inputs**2).sum(axis=2)
    power = np.nanmean(squares, axis=0)
    peak = np.nanmax(np.abs(inputs) if inputs.ndim == 2 else np.sqrt(squares), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        crest = np.where(power > 0, peak / np.sqrt(power), np.nan)
    return {"input_power": power, "input_peak": peak, "crest_factor": crest}


def fisher_information_gain(
    inputs: FloatArray, truth: Parameters, experiment: SimulatedExperiment, outputs: FloatArray | None = None
) -> FloatArray:
    """Information gain (n,) of an efficient estimator: ½ log det(Λ0 + F) - ½ log det Λ0 [nats].

    Inputs are (T, n), or (T, n, inputs) of several. F is the Fisher information at the true coefficients of the plant's
    equation, along the measured outputs (T, n) or (T, n, sensors), or along the response without noise; Λ0 is the
    inverse covariance of the prior from which the plants are drawn.
    """
    plant = plant_model_of(experiment, truth)
    F = fisher_information(
        plant.model, plant.coefficients_of(truth), np.swapaxes(inputs, 0, 1), plant.process_noise, plant.sensor_noises,
        interpolation=plant.interpolation, y=None if outputs is None else np.swapaxes(outputs, 0, 1),
    )  # fmt: skip
    cov = plant.prior.coefficients_cov
    std = np.sqrt(np.diag(cov))
    prior = np.linalg.inv(cov / np.outer(std, std))
    return 0.5 * (np.linalg.slogdet(prior + F * np.outer(std, std))[1] - np.linalg.slogdet(prior)[1])


def d_efficiency_metrics(
    inputs: FloatArray, outputs: FloatArray, env_id: str, options: dict[str, Any]
) -> dict[str, FloatArray]:
    """D-efficiency of the systems in the track's stored `Oracle`; empty without an oracle.

    ``efficiency`` is relative to the best known input, ``certified`` to an upper bound, for systems that have one.
    """
    from agents.evaluation.oracle import Oracle, TrackSystems

    try:
        oracle = Oracle.of(TrackSystems.of(env_id, inputs.shape[1], options))
    except FileNotFoundError:
        return {}
    n = len(oracle.values)
    efficiencies, lower_bounds = oracle.efficiency(inputs.T[:n], np.swapaxes(outputs, 0, 1)[:n])
    certified = lower_bounds[np.isfinite(lower_bounds)]
    return {"efficiency": efficiencies} | ({"certified": certified} if len(certified) else {})


def silverbox_segment_information(
    truth: Parameters, experiment: SimulatedExperiment, seed: int, scale: float = 1.0
) -> FloatArray:
    """Information (lengths, n) of segments of the Silverbox multisine regime, times ``scale``, on each system [nats].

    Segments start at random in the regime and continue at its start, so that every part of it has the same weight:
    most information on b is in rare peaks of the displacement, which some parts have more of than others.
    """
    rng = np.random.default_rng(seed)
    regime = regime_input("multisine", rng)
    starts = rng.integers(len(regime), size=np.size(truth.m))
    inputs = scale * np.take(regime, np.arange(_SEGMENT_LENGTHS[-1])[:, None] + starts, mode="wrap")
    return np.array([fisher_information_gain(inputs[:length], truth, experiment) for length in _SEGMENT_LENGTHS])


def silverbox_information_by_metric(
    truth: Parameters, experiment: SimulatedExperiment, seed: int
) -> dict[str, FloatArray]:
    """Metric to `silverbox_segment_information`: of the regime as recorded, and scaled up to the limit of the input.

    Where the input's power is limited, the scaled regime is left out, because it would exceed the power.
    """
    scales = {"silverbox_equivalent": 1.0}
    if experiment.max_rms is None:
        peak = np.abs(regime_input("multisine", np.random.default_rng(seed))).max()
        scales["full_peak_equivalent"] = float(experiment.max_input / peak)
    return {name: silverbox_segment_information(truth, experiment, seed, scale) for name, scale in scales.items()}


def equivalent_segment_lengths(gains: FloatArray, segment_information: FloatArray) -> FloatArray:
    """Number of samples (n,) of the regime with as much information as an input.

    It is interpolated between powers of √2, and inf where the longest segment, 46,341 samples, has less information.

    Args:
        gains: (n,) `fisher_information_gain` of the input.
        segment_information: (lengths, n) `silverbox_segment_information`.
    """
    lengths = np.empty(len(gains))
    for i, gain in enumerate(gains):
        curve = np.maximum.accumulate(segment_information[:, i])
        lengths[i] = np.exp(np.interp(gain, curve, np.log(_SEGMENT_LENGTHS))) if gain <= curve[-1] else np.inf
    return lengths


def twin_simulation_rmse(means: FloatArray, truth: Parameters) -> FloatArray:
    """RMSE (n,) [V] between free runs of Eq. (2) with estimated and with true coefficients, for the arrow's input."""
    u = regime_input("arrow", np.random.default_rng(0))[-_TWIN_ARROW_SAMPLES:][1:-1]
    true = coefficients_of(difference(), truth)
    runs = [[free_run(difference(), c, u) for c in pair] for pair in zip(means, true, strict=True)]
    at_rest = np.zeros(2)  # the first two outputs, which are given
    return np.array([_rmse(np.append(at_rest, believed), np.append(at_rest, exact)) for believed, exact in runs])


def arrow_simulation_rmse(means: FloatArray) -> FloatArray:
    """RMSE (n,) [V] of free runs over the recorded arrow; inf where a run diverges."""
    arrow = load_record().arrow
    start = arrow.y[1::-1]
    return np.array([_rmse(free_run(difference(), mean, arrow.u[1:-1], start), arrow.y[2:]) for mean in means])


def _rmse(simulated: FloatArray, measured: FloatArray) -> float:
    with np.errstate(invalid="ignore", over="ignore"):
        error = float(np.sqrt(np.mean((simulated - measured) ** 2)))
    return error if np.isfinite(error) else np.inf
