"""Chance-constrained optimisation of a block of inputs, fixed before any of its outputs is observed.

A block is optimised for systems sampled from the belief, not for its means. It ascends their expected D-optimality

    J(u) = mean_k [½ log det(Λ + F_k(u)) - ρ Σ_t max(0, |x_k(t)| / soft limit - 1)²]

by the gradient (`agents.planning.open_loop.expected_d_optimality`); each system k has its own coefficients, state and
process noise. Several hundred further draws decide whether a block is safe: whether the probability of leaving the
limit is below a bound with a confidence of 95 % (`agents.planning.open_loop.posterior_samples`). While it is not, some
of the draws that leave the limit join the systems that are optimised for, and no longer count; and the *soft limit*
falls, each time by more. Once the block is safe, soft limits between the last two are tried. J has many local maxima,
so several guesses ascend, among them the plan for the belief's means; the best safe block is taken.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Lock
from typing import Any

import numpy as np

from agents.planning.d_optimality import NominalSystem, compile_d_optimality
from agents.planning.model_probe import ModelView
from agents.planning.open_loop.expected_d_optimality import SampledSystems, compile_expected_d_optimality
from agents.planning.open_loop.posterior_samples import MonteCarloSystems
from agents.planning.projected_gradient import DesignLimits, project_input
from estimator.belief import Belief
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import kernel
from estimator.engine.noise_free_step import with_coarse_substeps
from estimator.models.model import Model
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: Sampled systems that a block is optimised for.
N_SYSTEMS = 32

#: Gradient steps of the first ascent, besides one per sample.
_N_STEPS = 600

#: Gradient steps of the first ascent, at most.
_MAX_STEPS = 1024

#: Gradient steps after every change of the soft limit.
_N_STEPS_AFTER_TIGHTENING = 200

#: Length of the first step in parts of the radius (`agents.planning.projected_gradient`).
_STEP_FRACTION = 0.05

#: Part of a step that is added to the next.
_MOMENTUM = 0.8

#: Length of the last step in parts of the first.
_FINAL_STEP_FRACTION = 0.05

#: First soft limit in parts of the limit.
_SOFT_LIMIT_FRACTION = 0.998

#: Falls of the soft limit, at most.
_MAX_TIGHTENINGS = 16

#: Draws beyond the limit that join the systems at each fall.
_N_SYSTEMS_ADDED = 8

#: Part of the soft limit by which it falls first.
_FIRST_TIGHTENING = 0.005

#: Ratio of successive falls.
_TIGHTENING_GROWTH = 1.5

#: Part of the soft limit by which it falls, at most.
_MAX_TIGHTENING = 0.05

#: Part of a guess's time that is left after its first ascent, and part of the rest after each later one.
_REMAINING_TIME_FRACTION = 0.6

#: Bisections of the last fall once a block is safe.
_N_BISECTIONS = 2

#: Draws that a block is optimised for, at most.
MAX_PLANNED_DRAWS = N_SYSTEMS + _MAX_TIGHTENINGS * _N_SYSTEMS_ADDED

#: Penalty [nats] beyond the soft limit: the information of other systems must not pay for one that leaves it far.
_EXCESS_PENALTY = 3e4


def sampled_systems(
    view: ModelView, belief: Belief, monte_carlo: MonteCarloSystems, n_samples: int, previous_input: float = 0.0
) -> SampledSystems:
    """The first of the draws, as systems before a block of ``n_samples``; ``previous_input`` is the input before it.

    The covariance of their states is the belief's.
    """
    d_optimality, n = compile_d_optimality(view.model, view.degree), view.model.n_states
    precision = np.asarray(np.linalg.inv(belief.coefficients_cov), dtype=np.float64)
    Z = belief.cov[:n, n:] @ precision
    V = belief.state_cov - Z @ belief.cov[n:, :n]
    starts = np.zeros((N_SYSTEMS, d_optimality.start_size))
    starts[:, :n] = monte_carlo.states[:N_SYSTEMS]
    starts[:, n : d_optimality.n_path] = np.concatenate([V[np.triu_indices(n)], Z.ravel()])
    starts[:, d_optimality.n_path : d_optimality.n_path + 1] = previous_input
    input_disturbances = np.ascontiguousarray(monte_carlo.disturbances(n_samples)[0][:N_SYSTEMS])
    coefficients = np.ascontiguousarray(monte_carlo.coefficients[:N_SYSTEMS])
    return SampledSystems(coefficients, starts, monte_carlo.noises[:N_SYSTEMS] ** 2, input_disturbances, precision)


def _extend_systems(systems: SampledSystems, monte_carlo: MonteCarloSystems, added_draws: list[int]) -> SampledSystems:
    """The systems with further draws."""
    starts = np.repeat(systems.path_starts[:1], len(added_draws), axis=0)
    starts[:, : monte_carlo.model.n_states] = monte_carlo.states[added_draws]
    return SampledSystems(
        np.concatenate([systems.coefficients, monte_carlo.coefficients[added_draws]]),
        np.concatenate([systems.path_starts, starts]),
        np.concatenate([systems.noises, monte_carlo.noises[added_draws] ** 2]),
        np.concatenate(
            [systems.input_disturbances, monte_carlo.disturbances(systems.input_disturbances.shape[1])[0][added_draws]]
        ),
        systems.precision,
    )


@cache
def _compile_momentum_ascent(model: Model, degree: int) -> Any:
    """``ascend(systems, limits, iterations, u)`` overwrites u (T,) by the best input of an ascent; returns its J."""
    workspace_for, criterion_and_gradient = compile_expected_d_optimality(model, degree)

    @kernel(variant=f"{model.name}_{model.digest}_{degree}")
    def ascend(systems, limits, iterations, u):
        T, workspace = len(u), workspace_for(len(u))
        gradient, best, momentum = workspace.gradient, np.empty(T), np.zeros(T)
        copy(best, 0, u, T)
        best_value = -np.inf
        radius = min(np.sqrt(limits.energy), limits.amplitude * np.sqrt(T))
        for i in range(iterations + 1):
            value = criterion_and_gradient(systems, limits.soft_limit, _EXCESS_PENALTY, u, workspace)
            if value > best_value:
                best_value = value
                copy(best, 0, u, T)
            squared_norm = 0.0
            for t in range(T):
                if abs(u[t]) >= limits.amplitude and u[t] * gradient[t] > 0.0:
                    gradient[t] = 0.0  # held by the amplitude limit
                squared_norm += gradient[t] * gradient[t]
            if i == iterations or not squared_norm > 0.0:
                break
            step_length = (
                _STEP_FRACTION * (1.0 - (1.0 - _FINAL_STEP_FRACTION) * i / iterations) * radius / np.sqrt(squared_norm)
            )
            for t in range(T):
                momentum[t] = _MOMENTUM * momentum[t] + step_length * gradient[t]
                u[t] += momentum[t]
            project_input(u, limits.amplitude, limits.energy)
        copy(u, 0, best, T)
        return best_value

    return ascend


def optimise_block(
    view: ModelView, systems: SampledSystems, monte_carlo: MonteCarloSystems, candidates: FloatArray, amplitude: float,
    max_probability: float, n_safe_samples: int | None = None, tell: ProgressCallback = ignore_progress,
) -> tuple[FloatArray, float, float]:  # fmt: skip
    """The block with the largest expected information among the safe blocks that the candidates lead to.

    Args:
        view: of the model.
        systems: that it is optimised for.
        monte_carlo: draws that decide whether it is safe.
        candidates: (n, T) initial guesses.
        amplitude: limit of the input.
        max_probability: of leaving the limit.
        n_safe_samples: first samples that must be safe; all where None.
        tell: called with the fraction that is done.

    Returns:
        Inputs (T,) in the belief's scale; their scale relative to the optimised block
        (`MonteCarloSystems.safe_scale`); and `MonteCarloSystems.probability_bound` of leaving the limit.
    """
    monte_carlo.disturbances(candidates.shape[1])  # drawn before the threads start
    progress, lock = np.zeros(len(candidates)), Lock()

    def climb(k: int) -> tuple[FloatArray, float, float]:
        def advance(fraction: float) -> None:
            with lock:
                progress[k] = fraction
                tell(float(progress.mean()))

        found = _climb_candidate(
            view, systems, monte_carlo, amplitude, max_probability, n_safe_samples, candidates[k], advance
        )
        advance(1.0)
        return found

    with ThreadPoolExecutor() as pool:
        found = list(pool.map(climb, range(len(candidates))))
    information = [expected_information(view, systems, monte_carlo.limit, u)[0] for u, *_ in found]
    return found[int(np.argmax(information))]


def _climb_candidate(
    view: ModelView, systems: SampledSystems, monte_carlo: MonteCarloSystems, amplitude: float, max_probability: float,
    n_safe_samples: int | None, u: FloatArray, tell: ProgressCallback,
) -> tuple[FloatArray, float, float]:  # fmt: skip
    """As `optimise_block`, from one candidate u (T,)."""
    # The optimisation takes coarse steps; safety is checked with all of them.
    ascend = _compile_momentum_ascent(with_coarse_substeps(view.model), view.degree)
    planned = set(range(N_SYSTEMS))

    def ascended(u: FloatArray, aim: float, iterations: int) -> FloatArray:
        u = u.copy()
        ascend(systems, DesignLimits(monte_carlo.limit, aim, amplitude, np.inf), iterations, u)
        return u

    def safety_of(u: FloatArray) -> tuple[list[int], float]:
        max_count = monte_carlo.min_violations_for(max_probability, len(planned))
        leaving = monte_carlo.violating_draws(u[:n_safe_samples], max(_N_SYSTEMS_ADDED, max_count), planned)
        return leaving, monte_carlo.probability_bound(len(leaving), len(planned))

    unsafe_limit = soft_limit = _SOFT_LIMIT_FRACTION * monte_carlo.limit
    u = ascended(u, soft_limit, min(_MAX_STEPS, _N_STEPS + len(u)))
    for k in range(_MAX_TIGHTENINGS):
        tell(1 - _REMAINING_TIME_FRACTION ** (k + 1))
        leaving, probability = safety_of(u)
        if probability < max_probability:
            for _ in range(_N_BISECTIONS if k else 0):
                middle = (soft_limit + unsafe_limit) / 2
                tried = ascended(u, middle, _N_STEPS_AFTER_TIGHTENING)
                chance = safety_of(tried)[1]
                if chance < max_probability:
                    u, probability, soft_limit = tried, chance, middle
                else:
                    unsafe_limit = middle
            return u, 1.0, probability
        planned.update(leaving[:_N_SYSTEMS_ADDED])
        systems = _extend_systems(systems, monte_carlo, leaving[:_N_SYSTEMS_ADDED])
        unsafe_limit, soft_limit = (
            soft_limit,
            soft_limit * (1 - min(_FIRST_TIGHTENING * _TIGHTENING_GROWTH**k, _MAX_TIGHTENING)),
        )
        u = ascended(u, soft_limit, _N_STEPS_AFTER_TIGHTENING)
    share, probability = monte_carlo.safe_scale(u[:n_safe_samples], max_probability)
    return share * u, share, probability


def expected_information(
    view: ModelView, systems: SampledSystems, limit: float, u: FloatArray
) -> tuple[float, FloatArray]:
    """Expected information of inputs (T,): the mean of ½ log det(Λ + F) [nats], and (S, K, K) covariances after them.

    Args:
        view: of the model.
        systems: sampled from the belief.
        limit: of the first sensor's signal; samples after a signal far beyond it do not count.
        u: the inputs.
    """
    d_optimality = compile_d_optimality(view.model, view.degree)
    workspace, values, covs = d_optimality.workspace(len(u)), [], []
    for c, start, noises, disturbance in zip(*systems[:4], strict=True):
        nominal = NominalSystem(c, systems.precision, tuple(noises.tolist()))
        values.append(d_optimality.criterion(nominal, limit, 0.0, start, u + disturbance[: len(u)], workspace)[0])
        factor = np.linalg.inv(np.tril(workspace.F))
        covs.append(factor.T @ factor)
    return float(np.mean(values)), np.array(covs)
