"""The posterior belief of a search: moments in the rig's model, forecasts, contraction history, and a refit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from estimator.belief import Belief
from estimator.identification.fitting.noise_ratio_fit import fit_noise_ratio
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.fit_hypothesis import CoefficientPrior, FitHypothesis
from estimator.identification.likelihood.initial_states import find_initial_states
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.problem_signals import mask_unexplained_outputs
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.inference.noise_grid import moment_matched_gamma
from estimator.inference.record_filter import record_likelihoods
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import belief_from_moments
from estimator.support.array_types import FloatArray

#: Integration steps per sample in a refit: enough for motions of a third of a period per sample, and constant, so that
#: a run compiles before it begins.
_REFIT_SUBSTEPS = 16

#: Factor of the noise ratio, either way, that the first grid of a refit spans.
_REFIT_RATIO_REACH = 3.0

#: Times that the records are halved for the history, at most.
_MAX_HALVINGS = 7

#: Samples of the longest record in a fit of the history, at least.
_MIN_HISTORY_SAMPLES = 50

#: Steps of a fit of the history, at most.
_MAX_HISTORY_FIT_STEPS = 12


class ContractionStep(NamedTuple):
    """The parameters after the first outputs of the records.

    Attributes:
        n_outputs: number of outputs.
        parameters: parameter to mean and standard deviation.
    """

    n_outputs: int
    parameters: dict[str, tuple[float, float]]


ContractionHistory: TypeAlias = tuple[ContractionStep, ...]


def posterior_belief(
    problem: ScaledRecords, search_result: SearchResult
) -> tuple[Belief, dict[str, tuple[float, float]]]:
    """The posterior of the rig's model, and ``input`` and ``output`` to mean and standard deviation of the noise.

    Args:
        problem: the records.
        search_result: the result of the search.
    """
    rig, scales = problem.rig, problem.scales
    belief = belief_from_moments(rig, scales, *problem.moments_about_zero(search_result.mean, search_result.cov))
    shapes = np.full(len(search_result.weights), problem.n_observed_outputs / 2)
    gamma, xi = (
        moment_matched_gamma(search_result.weights, shapes, shapes * noise**2) for noise in search_result.noises
    )
    belief = Belief.of(
        problem.belief_model, belief.mean, _with_initial_state_cov(belief, problem), gamma, xi, scales=scales
    )
    units = _unit_noise_force(belief), scales.output
    noises = {
        name: (float(search_result.weights @ values) * unit, _mixture_std(search_result.weights, values, shapes) * unit)
        for name, values, unit in zip(("input", "output"), search_result.noises, units, strict=True)
    }
    return belief, noises


def disturbance_std(belief: Belief) -> float:
    """Standard deviation of the disturbance of the force in every sample, in the unit of the input."""
    return _unit_noise_force(belief) * float(np.sqrt(belief.noises[1] / belief.noises[0]))


def _unit_noise_force(belief: Belief) -> float:
    """The input that, held over a sample, changes the velocity as much as a process noise of 1."""
    gain = dict(zip(belief.model.coefficients, belief.coefficients_mean, strict=True))["gain"]
    return float(belief.scales.input * np.sqrt(3) / abs(gain))


def _with_initial_state_cov(belief: Belief, problem: ScaledRecords) -> FloatArray:
    """The covariance with an unknown state, anywhere in the motion of the records."""
    cov, n = belief.cov, belief.model.n_states
    cov[:n, :n] = problem.initial_state_cov + (cov[:n, :n] - np.diag(np.diag(cov[:n, :n])))
    if DERIVATIVE_ORDER_OF_SENSOR[problem.rig.output.kind] == 0:
        place = n + list(belief.model.coefficients).index("output_offset")
        cov[0, 0] += cov[place, place]
    return cov


def one_step_forecasts(
    search_result: SearchResult, belief: Belief, n_observed: int | None = None
) -> tuple[FloatArray, ...]:
    """Per record, (T, 2) mean and variance of each output, one sample ahead, in the rig's units.

    Coefficients and noises are at their means, and each record begins in its most probable state.

    Args:
        search_result: the result of the search.
        belief: its posterior.
        n_observed: outputs that the filter observes, from which on it predicts by the inputs alone; None: all.
    """
    problem, best = search_result.fitter.problem, search_result.best
    observed = tuple(
        y if n_observed is None else np.where(np.arange(len(y)) < n_observed, y, np.nan) for y in problem.y
    )
    inputs, outputs, spans, places = replace(problem, y=observed).filter_samples(*best.input_path)
    noises = problem.noises_of_records(belief.noises[None, 1::2] / belief.noises[None, ::2])
    forecasts = np.empty((*outputs.shape, 2))
    points = np.tile(search_result.mean, (len(inputs), 1))
    record_likelihoods(
        problem.model,
        points,
        inputs,
        outputs,
        noises,
        problem.initial_state_cov,
        search_result.initial_states,
        spans,
        forecasts,
    )
    size = problem.scales.output
    return tuple(
        np.stack([(one[at, 0, 0] + problem.origin) * size, one[at, 0, 1] * size**2], axis=1)
        for one, at in zip(forecasts, places, strict=True)
    )


def _mixture_std(weights: FloatArray, values: FloatArray, shapes: FloatArray) -> float:
    """Standard deviation of a noise over a mixture of Gamma posteriors with given shapes."""
    mean = weights @ values
    return float(np.sqrt(weights @ ((values - mean) ** 2 + values**2 / (4 * shapes))))


def contraction_history(
    problem: ScaledRecords, search_result: SearchResult, parameters: dict[str, tuple[float, float]]
) -> ContractionHistory:
    """The parameters after growing first parts of every record: halves of halves, a quarter, a half, and all.

    Each is a fit that starts from the result of all samples, at its noise ratio. A fit that diverges is left out.

    Args:
        problem: the records.
        search_result: the result of the search.
        parameters: the parameters after all samples, which come last.
    """
    longest, history = max(len(u) for u in problem.u), []
    for halvings in range(_MAX_HALVINGS, 0, -1):
        count = longest >> halvings
        if count < _MIN_HISTORY_SAMPLES:
            continue
        short = problem.truncated(count)
        fits = search_result.fitter.for_problem(short).fit(
            [search_result.best], search_result.mean, search_result.sensor_std, _MAX_HISTORY_FIT_STEPS
        )
        if fits.free_energy[0] < float("inf"):
            belief = belief_from_moments(
                problem.rig, problem.scales, *problem.moments_about_zero(fits.mean[0], fits.cov[0])
            )
            moments = {name: (mean, std) for name, (mean, std, _) in belief.parameters().items()}
            history.append(ContractionStep(short.n_observed_outputs, moments))
    return (*history, ContractionStep(problem.n_observed_outputs, parameters))


def refit_coefficients(
    rig: Rig, records: Sequence[tuple[FloatArray, FloatArray]], prior: Belief, initial_belief: Belief
) -> tuple[FloatArray, FloatArray]:
    """Fit the coefficients to all records at once, starting from the belief of an online estimator.

    An online Gaussian filter becomes overconfident where two coefficients are hard to distinguish at first, such as the
    cubic stiffness and the sensor's offset of a rig with two wells. A fit to all records does not.

    Args:
        rig: the rig of the records.
        records: pairs (u, y) of arrays (T,) in the rig's units, paired by index; each may begin in any motion.
        prior: the belief before the records.
        initial_belief: the belief that the search starts from.

    Returns:
        Mean (K,) and covariance (K, K); the moments of ``initial_belief`` where the search fails.
    """
    start, cov = initial_belief.coefficients_mean, initial_belief.coefficients_cov
    u = tuple(inputs / initial_belief.scales.input for inputs, _ in records)
    y = tuple(mask_unexplained_outputs(outputs, rig) / initial_belief.scales.output for _, outputs in records)
    problem = ScaledRecords(rig, initial_belief.scales, u, y, substeps=_REFIT_SUBSTEPS)
    if list(problem.model.coefficients) != list(initial_belief.model.coefficients):
        return start, cov
    q, r = initial_belief.noises[1] / initial_belief.noises[0], initial_belief.noises[3] / initial_belief.noises[2]
    fitter = LaplaceFitter(problem, CoefficientPrior.of(prior.coefficients_mean, prior.coefficients_cov))
    hypothesis = FitHypothesis(rig.interpolation, rig.delay, float(np.sqrt(q / r)), lag=problem.lag)
    level = float(np.sqrt(r))
    hypothesis = replace(hypothesis, initial_states=find_initial_states(problem, hypothesis, start[None], level)[0])
    try:
        search_result = fit_noise_ratio(fitter, hypothesis, start, level, _REFIT_RATIO_REACH)
    except ValueError:
        return start, cov
    return search_result.mean, search_result.cov
