"""Beliefs of what a search left: the rig's own posterior, how it contracts, and that from a belief near it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.belief import Belief
from estimator.ensemble import matched_gamma
from estimator.identification.fit import Fitter, Hypothesis, Prior
from estimator.identification.motions import motions
from estimator.identification.problem import Problem, explicable
from estimator.identification.search import Found, settle
from estimator.information import follow
from estimator.models.duffing import KINDS
from estimator.parameters import FloatArray
from estimator.rig import Rig
from estimator.rig_prior import about

#: Steps of integration a sample: enough for motions of a third of a period a sample, and always the same, so that a run
#: compiles before it begins.
_SUBSTEPS = 16

#: Factor of the ratio of the noises, either way, within which a search from a belief begins.
_NEAR = 3.0

#: For its history the records are halved so often, and shorter ones are left out; and steps of a fit at most.
_HALVINGS, _SHORTEST, _STEPS = 7, 50, 12

#: Outputs that were used, with the mean and standard deviation of each parameter that they leave.
History = tuple[tuple[int, dict[str, tuple[float, float]]], ...]


def posterior(problem: Problem, found: Found) -> tuple[Belief, dict[str, tuple[float, float]]]:
    """The posterior of the rig's own model, and the noises' standard deviations in its units."""
    rig, scales = problem.rig, problem.scales
    belief = about(rig, scales, *problem.outward(found.mean, found.cov))
    shapes = np.full(len(found.weights), problem.samples / 2)
    gamma, xi = (matched_gamma(found.weights, shapes, shapes * noise**2) for noise in found.noises)
    belief = Belief.of(problem.believed, belief.mean, _with_start(belief, problem), gamma, xi, scales=scales)
    worth = _force(belief), scales.output
    noises = {
        name: (float(found.weights @ values) * unit, _spread(found.weights, values, shapes) * unit)
        for name, values, unit in zip(("input", "output"), found.noises, worth, strict=True)
    }
    return belief, noises


def disturbance(belief: Belief) -> float:
    """Of the force in every sample, as a standard deviation in the unit of the input."""
    return _force(belief) * float(np.sqrt(belief.noises[1] / belief.noises[0]))


def _force(belief: Belief) -> float:
    """The input that moves the velocity, when it is held over a sample, as a process noise of 1 does."""
    gain = dict(zip(belief.model.coefficients, belief.coefficients_mean, strict=True))["gain"]
    return float(belief.scales.input * np.sqrt(3) / abs(gain))


def _with_start(belief: Belief, problem: Problem) -> FloatArray:
    """The covariance, with a state that may be anywhere in the records' motion."""
    cov, n = belief.cov, belief.model.n_states
    cov[:n, :n] = problem.start + (cov[:n, :n] - np.diag(np.diag(cov[:n, :n])))
    if KINDS[problem.rig.output.kind] == 0:
        place = n + list(belief.model.coefficients).index("output_offset")
        cov[0, 0] += cov[place, place]
    return cov


def foreseen(found: Found, belief: Belief, given: int | None = None) -> tuple[FloatArray, ...]:
    """Of each record (T, 2): mean and variance of each output before it was seen, in the rig's units.

    Coefficients and noises are at their means, and a record begins in the motion that was found.

    Args:
        found: the result of the search.
        belief: its posterior.
        given: outputs that are shown to the filter; all where it is None. The others it foresees from the inputs.
    """
    problem, best = found.fitter.problem, found.best
    shown = tuple(y if given is None else np.where(np.arange(len(y)) < given, y, np.nan) for y in problem.y)
    inputs, outputs, spans, places = replace(problem, y=shown).samples_of(*best.path)
    noises = problem.loud(belief.noises[None, 1::2] / belief.noises[None, ::2])
    forecasts = np.empty((*outputs.shape, 2))
    points = np.tile(found.mean, (len(inputs), 1))
    follow(
        problem.model,
        points,
        inputs,
        outputs,
        noises,
        problem.start,
        found.motions,
        spans,
        forecasts,
    )
    size = problem.scales.output
    return tuple(
        np.stack([(one[at, 0, 0] + problem.origin) * size, one[at, 0, 1] * size**2], axis=1)
        for one, at in zip(forecasts, places, strict=True)
    )


def _spread(weights: FloatArray, values: FloatArray, shapes: FloatArray) -> float:
    mean = weights @ values
    return float(np.sqrt(weights @ ((values - mean) ** 2 + values**2 / (4 * shapes))))


def contraction(problem: Problem, found: Found, parameters: dict[str, tuple[float, float]]) -> History:
    """The parameters that the first half of every record leaves, the first quarter, and so on; shortest first.

    Each is a fit of its own from what all samples say, with the noises in the best ratio. One that runs away is left
    out. Last come the ``parameters`` that all leave.
    """
    longest, history = max(len(u) for u in problem.u), []
    for halvings in range(_HALVINGS, 0, -1):
        count = longest >> halvings
        if count < _SHORTEST:
            continue
        short = problem.shortened(count)
        fits = found.fitter.on(short).fit([found.best], found.mean, found.level, _STEPS)
        if fits.free_energy[0] < float("inf"):
            belief = about(problem.rig, problem.scales, *problem.outward(fits.mean[0], fits.cov[0]))
            told = {name: (mean, std) for name, (mean, std, _) in belief.parameters().items()}
            history.append((short.samples, told))
    return (*history, (problem.samples, parameters))


def refit(
    rig: Rig, records: Sequence[tuple[FloatArray, FloatArray]], prior: Belief, near: Belief
) -> tuple[FloatArray, FloatArray]:
    """Fit the coefficients to all records at once, from the belief of an estimator that took every sample once.

    A Gaussian that takes every sample once becomes sure too soon where two coefficients at first show as one, such as
    the cubic stiffness and the sensor's offset of a rig with two wells. All records at once do not.

    Args:
        rig: that they are of.
        records: pairs (u, y) of arrays (T,) in the rig's units, paired by index; each may begin in any motion.
        prior: what is believed before them.
        near: the belief that the search begins at.

    Returns:
        Mean (K,) and covariance (K, K); those of ``near`` where the search leads nowhere.
    """
    start, cov = near.coefficients_mean, near.coefficients_cov
    u = tuple(inputs / near.scales.input for inputs, _ in records)
    y = tuple(explicable(outputs, rig) / near.scales.output for _, outputs in records)
    problem = Problem(rig, near.scales, u, y, substeps=_SUBSTEPS)
    if list(problem.model.coefficients) != list(near.model.coefficients):
        return start, cov
    q, r = near.noises[1] / near.noises[0], near.noises[3] / near.noises[2]
    fitter = Fitter(problem, Prior.of(prior.coefficients_mean, prior.coefficients_cov))
    hypothesis = Hypothesis(rig.interpolation, rig.delay, float(np.sqrt(q / r)), lag=problem.lag)
    level = float(np.sqrt(r))
    hypothesis = replace(hypothesis, motions=motions(problem, hypothesis, start[None], level)[0])
    try:
        found = settle(fitter, hypothesis, start, level, _NEAR)
    except ValueError:
        return start, cov
    return found.mean, found.cov
