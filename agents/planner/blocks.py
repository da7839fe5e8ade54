"""Whole blocks of inputs, chosen on a belief before any of their outputs is seen.

A block is planned for systems that are drawn from the belief, not for its means: it climbs the mean of what they tell,

    J(u) = mean_k [½ log det(Λ + F_k(u)) - ρ Σ_t max(0, |x_k(t)| / aim - 1)²],

by the gradient (`agents.planner.design`), each system k with coefficients, state and process noise of its own. Several
hundred further draws tell whether a block is safe: whether so few of them leave the limit that the probability is below
a bound, with a confidence of 95 % (`agents.planner.futures`). Until then, some of those that leave join the systems
that are planned for, and no longer count; and the *aim* falls, each time by more. Once the block is safe, aims
between the last two are tried. There are many summits. So several candidates climb, among them the planner's own plan
for the belief's means; the best of what is safe is taken.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Lock
from typing import Any

import numpy as np

from agents.planner.ascent import Limits, project
from agents.planner.design import Known, designer
from agents.planner.futures import Futures
from agents.planner.mean_design import Systems, mean_designer
from agents.planner.motion import View
from agents.planner.policy import Planner
from agents.planner.search import search
from estimator.arrays import copy
from estimator.belief import Belief
from estimator.engine.motion import coarsened
from estimator.lanes import kernel
from estimator.models.model import Model
from estimator.parameters import FloatArray
from estimator.progress import Tell, untold

#: Systems that a block is planned for.
SYSTEMS = 32

#: Steps of the gradient for a candidate, besides one for each sample and up to so many in all; and after every change
#: of the aim.
_STEPS, _MOST_STEPS, _MORE = 600, 1024, 200

#: The first step (`agents.planner.ascent`), the part of a step that goes into the next, and the last step in parts of
#: the first.
_RATE, _KEPT, _LAST = 0.05, 0.8, 0.05

#: The aim in parts of the limit, and how often it falls: by this part of it at first, then by more and more, up to the
#: last number. Each time so many systems that leave the limit are added to those that are planned for.
_AIM, _AIMS, _ADDED = 0.998, 16, 8
_FALL, _FASTER, _FASTEST = 0.005, 1.5, 0.05

#: Of a candidate's time, about so much is left after it was climbed first, and of that after every change of the aim.
_LEFT = 0.6

#: How often the last fall is halved, once a block is safe: it was too far by half of it on average.
_HALVINGS = 2

#: Draws that a block is planned for, at most.
MOST_PLANNED = SYSTEMS + _AIMS * _ADDED

#: Penalty [nats] of what goes beyond the aim: one system of all must not leave it far for what the others tell.
_PENALTY = 3e4

#: The second candidate in parts of the first, and the standard deviation of candidates of noise in parts of the limit.
_WEAKER, _WEAK = 0.6, 0.3


def systems_of(view: View, belief: Belief, futures: Futures, samples: int, last: float = 0.0) -> Systems:
    """The first of drawn systems, before a block of so many samples; ``last`` is the input before it.

    What is not known of a state is what the belief does not know of it.
    """
    found, n = designer(view.model, view.degree), view.model.n_states
    precision = np.asarray(np.linalg.inv(belief.coefficients_cov), dtype=np.float64)
    Z = belief.cov[:n, n:] @ precision
    V = belief.state_cov - Z @ belief.cov[n:, :n]
    starts = np.zeros((SYSTEMS, found.start_size))
    starts[:, :n] = futures.states[:SYSTEMS]
    starts[:, n : found.n_path] = np.concatenate([V[np.triu_indices(n)], Z.ravel()])
    starts[:, found.n_path : found.n_path + 1] = last
    shakes = np.ascontiguousarray(futures.disturbances(samples)[0][:SYSTEMS])
    coefficients = np.ascontiguousarray(futures.coefficients[:SYSTEMS])
    return Systems(coefficients, starts, futures.noises[:SYSTEMS] ** 2, shakes, precision)


def _joined(systems: Systems, futures: Futures, more: list[int]) -> Systems:
    """The systems, and more of the draws."""
    starts = np.repeat(systems.starts[:1], len(more), axis=0)
    starts[:, : futures.model.n_states] = futures.states[more]
    return Systems(
        np.concatenate([systems.coefficients, futures.coefficients[more]]),
        np.concatenate([systems.starts, starts]),
        np.concatenate([systems.noises, futures.noises[more] ** 2]),
        np.concatenate([systems.shakes, futures.disturbances(systems.shakes.shape[1])[0][more]]),
        systems.precision,
    )


@cache
def _climber(model: Model, degree: int) -> Any:
    """``ascend(systems, limits, iterations, u)``: climb from u (T,); the best met overwrites it. Gives its J."""
    memory_for, climb = mean_designer(model, degree)

    @kernel(kind=f"{model.name}_{model.digest}_{degree}")
    def ascend(systems, limits, iterations, u):
        T, memory = len(u), memory_for(len(u))
        gradient, best, moving = memory.gradient, np.empty(T), np.zeros(T)
        copy(best, 0, u, T)
        most = -np.inf
        radius = min(np.sqrt(limits.energy), limits.amplitude * np.sqrt(T))
        for i in range(iterations + 1):
            value = climb(systems, limits.aim, _PENALTY, u, memory)
            if value > most:
                most = value
                copy(best, 0, u, T)
            power = 0.0
            for t in range(T):
                if abs(u[t]) >= limits.amplitude and u[t] * gradient[t] > 0.0:
                    gradient[t] = 0.0  # the limit holds it where it is
                power += gradient[t] * gradient[t]
            if i == iterations or not power > 0.0:
                break
            stride = _RATE * (1.0 - (1.0 - _LAST) * i / iterations) * radius / np.sqrt(power)
            for t in range(T):
                moving[t] = _KEPT * moving[t] + stride * gradient[t]
                u[t] += moving[t]
            project(u, limits.amplitude, limits.energy)
        copy(u, 0, best, T)
        return most

    return ascend


def best_block(
    view: View, systems: Systems, futures: Futures, candidates: FloatArray, amplitude: float, bound: float,
    played: int | None = None, tell: Tell = untold,
) -> tuple[FloatArray, float, float]:  # fmt: skip
    """The best input that is safe enough: what tells most on average, of the summits that candidates lead to.

    Args:
        view: of the model.
        systems: that it is planned for.
        futures: that tell how safe it is.
        candidates: (n, T) to begin from.
        amplitude: limit of the input.
        bound: of the probability.
        played: samples that are asked to be safe; all where None.
        tell: is told the share that is done.

    Returns:
        Inputs (T,) in the belief's scale; the share of what was planned that they are, as `Futures.share`; and
        `Futures.chance` of leaving the limit.
    """
    futures.disturbances(candidates.shape[1])  # drawn before the threads share them
    parts, lock = np.zeros(len(candidates)), Lock()

    def climb(k: int) -> tuple[FloatArray, float, float]:
        def advance(part: float) -> None:
            with lock:
                parts[k] = part
                tell(float(parts.mean()))

        found = _summit(view, systems, futures, amplitude, bound, played, candidates[k], advance)
        advance(1.0)
        return found

    with ThreadPoolExecutor() as pool:
        found = list(pool.map(climb, range(len(candidates))))
    told = [expected(view, systems, futures.limit, u)[0] for u, *_ in found]
    return found[int(np.argmax(told))]


def _summit(
    view: View, systems: Systems, futures: Futures, amplitude: float, bound: float, played: int | None, u: FloatArray,
    tell: Tell,
) -> tuple[FloatArray, float, float]:  # fmt: skip
    """As `best_block`, from one candidate (T,)."""
    ascend = _climber(coarsened(view.model), view.degree)  # how safe a block is, is judged with all steps
    planned = set(range(SYSTEMS))

    def climbed(u: FloatArray, aim: float, iterations: int) -> FloatArray:
        u = u.copy()
        ascend(systems, Limits(futures.limit, aim, amplitude, np.inf), iterations, u)
        return u

    def judged(u: FloatArray) -> tuple[list[int], float]:
        enough = futures.enough(bound, len(planned))
        leaving = futures.leaving(u[:played], max(_ADDED, enough), planned)
        return leaving, futures.chance(len(leaving), len(planned))

    too_high = aim = _AIM * futures.limit
    u = climbed(u, aim, min(_MOST_STEPS, _STEPS + len(u)))
    for k in range(_AIMS):
        tell(1 - _LEFT ** (k + 1))
        leaving, probability = judged(u)
        if probability < bound:
            for _ in range(_HALVINGS if k else 0):
                middle = (aim + too_high) / 2
                tried = climbed(u, middle, _MORE)
                chance = judged(tried)[1]
                if chance < bound:
                    u, probability, aim = tried, chance, middle
                else:
                    too_high = middle
            return u, 1.0, probability
        planned.update(leaving[:_ADDED])
        systems = _joined(systems, futures, leaving[:_ADDED])
        too_high, aim = aim, aim * (1 - min(_FALL * _FASTER**k, _FASTEST))
        u = climbed(u, aim, _MORE)
    share, probability = futures.share(u[:played], bound)
    return share * u, share, probability


def drafts(planner: Planner, record: FloatArray, samples: int, seed: int, noises: int = 2) -> FloatArray:
    """(2 + noises, samples) to begin from: the planner's plan, were the belief's means true, a weaker one, and noise.

    The plan's margin is the least of an episode's, and no output is answered: the limits that a block must keep are
    `best_block`'s.
    """
    plan = np.zeros(samples)
    terms = planner.terms._replace(margin=float(np.min(planner.terms.margin)), reach=0.0)
    words = np.random.SFC64(seed).state["state"]["state"]
    horizon = min(planner.horizon, samples)
    search(*planner.view).play(record.copy(), 0, horizon, planner.rounds, terms, plan, words)
    moves = np.random.default_rng(seed).standard_normal((noises, math.ceil(samples / terms.pace)))
    noise = _WEAK * terms.amplitude * np.repeat(moves, terms.pace, axis=1)[:, :samples]
    return np.clip(np.stack([plan, _WEAKER * plan, *noise]), -terms.amplitude, terms.amplitude)


def expected(view: View, systems: Systems, limit: float, u: FloatArray) -> tuple[float, FloatArray]:
    """What inputs (T,) are expected to tell: the mean of ½ log det(Λ + F) [nats], and (S, K, K) covariances after them.

    Args:
        view: of the model.
        systems: that are believed in.
        limit: of the first sensor's signal; what comes after it was left far does not count.
        u: the inputs.
    """
    found = designer(view.model, view.degree)
    memory, values, covs = found.memory(len(u)), [], []
    for c, start, noises, shake in zip(*systems[:4], strict=True):
        known = Known(c, systems.precision, tuple(noises.tolist()))
        values.append(found.worth(known, limit, 0.0, start, u + shake[: len(u)], memory)[0])
        factor = np.linalg.inv(np.tril(memory.F))
        covs.append(factor.T @ factor)
    return float(np.mean(values)), np.array(covs)
