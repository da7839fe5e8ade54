"""What an experiment was worth, system by system: errors, calibration, information, and what the input was like."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from agents.evaluation.plant_model import plant_model_of
from duffing_env.plants.silverbox_record import load_record, regime_input
from duffing_env.storage.kernel_spec import parameter_names
from estimator.inference.fisher_information import fisher_information
from estimator.inference.free_run import free_run
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.rigs.physical_parameters import coefficients_of, to_physical
from estimator.rigs.units import Scales
from estimator.support.array_types import FloatArray

#: Nominal levels of the intervals whose coverage is reported, by their metric.
CREDIBLE_LEVELS = {"coverage_50": 0.50, "coverage": 0.90, "coverage_95": 0.95}

_TWIN_ARROW_SAMPLES = 8_192

#: Lengths of the stretches of the Silverbox regime that inputs are compared with.
_SEGMENT_LENGTHS = np.unique(np.round(2 ** np.arange(4, 15.6, 0.5)).astype(int))


def posterior_metrics(
    means: FloatArray, covs: FloatArray, truth: Any, model: Model, scales: Scales
) -> dict[str, FloatArray]:
    """Posteriors of coefficients beside the truth.

    Args:
        means: (n, K).
        covs: (n, K, K).
        truth: the systems.
        model: whose coefficients they are.
        scales: what one inside is worth outside.

    Returns:
        Relative errors ``error_<parameter>``; the share of the coefficients that their intervals hold, at each of
        `CREDIBLE_LEVELS`; ``nees``, the normalised estimation error squared dᵀ C⁻¹ d per coefficient, whose mean is 1 where the
        posterior is calibrated.
    """
    true_parameters = {name: truth[name] for name in parameter_names(model)}
    errors = np.abs(to_physical(model, means, scales) / np.stack(list(true_parameters.values()), axis=-1) - 1)
    free_coefficients = np.flatnonzero(
        np.diagonal(covs, axis1=1, axis2=2).all(axis=0)
    )  # without those that are known, as θ2 = 0
    deviations, covs = (
        (means - coefficients_of(model, true_parameters, scales))[:, free_coefficients],
        covs[:, free_coefficients][:, :, free_coefficients],
    )
    stds = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    correlations = covs / (stds[:, :, None] * stds[:, None, :])  # better conditioned than the covariances themselves
    scaled = deviations / stds
    nees = np.einsum("ni,ni->n", scaled, np.linalg.solve(correlations, scaled[:, :, None])[:, :, 0]) / len(
        free_coefficients
    )
    return {
        **{f"error_{name}": errors[:, i] for i, name in enumerate(true_parameters)},
        **{
            name: (np.abs(scaled) <= stats.norm.ppf(0.5 + level / 2)).mean(axis=1) for name, level in CREDIBLE_LEVELS.items()
        },
        "nees": nees,
    }  # fmt: skip


def input_metrics(inputs: FloatArray) -> dict[str, FloatArray]:
    """Mean square, largest value, and crest factor (that over the RMS) of inputs (T, n), NaN where ended."""
    power, peak = np.nanmean(inputs**2, axis=0), np.nanmax(np.abs(inputs), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        crest = np.where(power > 0, peak / np.sqrt(power), np.nan)
    return {"input_power": power, "input_peak": peak, "crest_factor": crest}


def fisher_information_gain(
    inputs: FloatArray, truth: Any, experiment: Any, outputs: FloatArray | None = None
) -> FloatArray:
    """(n,) ½ log det(Λ0 + F) - ½ log det Λ0 [nats] of inputs (T, n): what an efficient estimator gains from them.

    F is the Fisher information at the true coefficients of the plant's equation, along the outputs (T, n) or
    (T, n, sensors) that were seen, or along the response without noise; Λ0 is the inverse covariance of the prior of
    plants so drawn.
    """
    plant = plant_model_of(experiment, truth)
    F = fisher_information(
        plant.model, plant.coefficients_of(truth), inputs.T, plant.process_noise, plant.sensor_noises,
        interpolation=plant.interpolation, y=None if outputs is None else np.swapaxes(outputs, 0, 1),
    )  # fmt: skip
    cov = plant.prior.coefficients_cov
    std = np.sqrt(np.diag(cov))
    prior = np.linalg.inv(cov / np.outer(std, std))
    return 0.5 * (np.linalg.slogdet(prior + F * np.outer(std, std))[1] - np.linalg.slogdet(prior)[1])


def d_efficiency_metrics(evaluation: Any, env_id: str, options: dict[str, Any]) -> dict[str, FloatArray]:
    """D-efficiency of the systems that the track's stored `Oracle` has, and what is certain of those with a bound.

    The latter, ``certified``, is at least so much of what is possible. Without an oracle there is neither.
    """
    from agents.evaluation.oracle import Oracle, TrackSystems

    try:
        oracle = Oracle.of(TrackSystems.of(env_id, evaluation.inputs.shape[1], options))
    except FileNotFoundError:
        return {}
    n = len(oracle.values)
    efficiencies, lower_bounds = oracle.efficiency(evaluation.inputs.T[:n], np.swapaxes(evaluation.outputs, 0, 1)[:n])
    certified = lower_bounds[np.isfinite(lower_bounds)]
    return {"efficiency": efficiencies} | ({"certified": certified} if len(certified) else {})


def silverbox_segment_information(truth: Any, experiment: Any, seed: int, scale: float = 1.0) -> FloatArray:
    """(lengths, n) what stretches of the Silverbox multisine regime, times ``scale``, tell of each system [nats].

    They start anywhere in the regime and go on at its start where it ends, so that every part of it counts alike: rare
    peaks of the displacement tell most of what is known of b, and some parts have more of them.
    """
    rng = np.random.default_rng(seed)
    regime = regime_input("multisine", rng)
    starts = rng.integers(len(regime), size=np.size(truth.m))
    inputs = scale * np.take(regime, np.arange(_SEGMENT_LENGTHS[-1])[:, None] + starts, mode="wrap")
    return np.array([fisher_information_gain(inputs[:length], truth, experiment) for length in _SEGMENT_LENGTHS])


def silverbox_information_by_metric(truth: Any, experiment: Any, seed: int) -> dict[str, FloatArray]:
    """`silverbox_segment_information` by metric: of the regime as recorded, and scaled up to the limit of the input.

    Where the input's power is limited, there is no regime at the limit: it would have more than the budget.
    """
    scales = {"silverbox_equivalent": 1.0}
    if experiment.max_rms is None:
        peak = np.abs(regime_input("multisine", np.random.default_rng(seed))).max()
        scales["full_peak_equivalent"] = float(experiment.max_input / peak)
    return {name: silverbox_segment_information(truth, experiment, seed, scale) for name, scale in scales.items()}


def equivalent_segment_lengths(gains: FloatArray, segment_information: FloatArray) -> FloatArray:
    """(n,) samples of a regime that tell as much as ``gains`` (n,) of `fisher_information_gain`, with ``segment_information`` of it (lengths, n).

    Interpolated between powers of √2; inf where even the longest stretch, 46,341 samples, tells less.
    """
    lengths = np.empty(len(gains))
    for i, gain in enumerate(gains):
        curve = np.maximum.accumulate(segment_information[:, i])
        lengths[i] = np.exp(np.interp(gain, curve, np.log(_SEGMENT_LENGTHS))) if gain <= curve[-1] else np.inf
    return lengths


def twin_simulation_rmse(means: FloatArray, truth: Any) -> FloatArray:
    """(n,) RMSE [V] of free runs of Eq. (2) with estimated coefficients beside the true ones, for the arrow input."""
    u = regime_input("arrow", np.random.default_rng(0))[-_TWIN_ARROW_SAMPLES:][1:-1]
    true = coefficients_of(difference(), truth)
    runs = [[free_run(difference(), c, u) for c in pair] for pair in zip(means, true, strict=True)]
    at_rest = np.zeros(2)  # as a record's first two outputs, which are given
    return np.array([_rmse(np.append(at_rest, believed), np.append(at_rest, exact)) for believed, exact in runs])


def arrow_simulation_rmse(means: FloatArray) -> FloatArray:
    """(n,) RMSE [V] of free runs over the real arrow record; inf where a run diverges."""
    arrow = load_record().arrow
    start = arrow.y[1::-1]
    return np.array([_rmse(free_run(difference(), mean, arrow.u[1:-1], start), arrow.y[2:]) for mean in means])


def _rmse(simulated: FloatArray, measured: FloatArray) -> float:
    with np.errstate(invalid="ignore", over="ignore"):
        error = float(np.sqrt(np.mean((simulated - measured) ** 2)))
    return error if np.isfinite(error) else np.inf
