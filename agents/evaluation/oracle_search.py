"""The search for D-optimal inputs at the true parameters, which are stored.

    python -m agents.evaluation.oracle_search --env duffing_env/Amplitude-v0 --systems 64

climbs ½ log det(Λ0 + F(u)) of each system from many starts, under the track's limits, and keeps what is better than
what is stored. F is the Fisher information at the true coefficients along the response without noise, Λ0 the inverse of
the prior's covariance of the coefficients. With `--policies NAME ...` the search starts from those policies' inputs
too.

System i is row i of a batch that is reset with seed 0 in the branch ``test``, as `agents.evaluation.rollout.evaluate`
does it by default; it does not depend on the number of systems.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from agents.cli import JsonOptions, run_script
from agents.evaluation.oracle import Oracle, as_stored
from agents.evaluation.rollout import evaluate
from agents.evaluation.systems import Systems
from agents.planner import search as planning
from agents.planner.ascent import climber
from agents.planner.imagination import Terms
from agents.planner.motion import View, scales
from agents.planner.pursuit import pursuit
from estimator.belief import Belief
from estimator.models.difference import difference
from estimator.parameters import FloatArray

#: Steps of the gradient, random starts, and changed copies in a round.
_ITERATIONS, _STARTS, _COPIES = 100, 24, 16


def search(
    systems: Systems, row: int, given: FloatArray, rng: np.random.Generator, rounds: int = 8
) -> tuple[FloatArray, float]:
    """Search the best input of one system.

    Gradient ascent from many starts, then in rounds from changed copies of the best one (iterated local search). Where
    only amplitudes are limited and the plant is the paper's equation, copies are planned anew from a random sample on,
    which finds more than the gradient.

    Args:
        systems: of a track.
        row: the system.
        given: (k, samples) inputs to start from besides [V].
        rng: of the random starts and changes.
        rounds: of changed copies, `_COPIES` in each.

    Returns:
        The best input (samples,) [V] that keeps all limits also as it is stored, and its worth [nats]; -inf if none.
    """
    rows = np.full(len(given) + _STARTS, row)
    one = replace(systems, theta=systems.theta[rows], variances=systems.variances[rows])
    model, limits = systems.plant.model, systems.limits
    is_frugal = bool(np.isfinite(limits.energy))
    is_planned = not is_frugal and model == difference()
    best, best_value = np.zeros(systems.samples), -np.inf
    words = rng.integers(0, 2**64, 4, dtype=np.uint64)
    if is_frugal:
        pool = np.empty((_STARTS, systems.samples))
        pursuit(model, systems.degree).swings(one.known(0), limits.output, limits.energy, pool, words)
    else:
        pool = _signals(_STARTS, systems.samples, limits.amplitude, rng)
    pool = np.concatenate([given, pool])
    for k in range(rounds + 1):
        if k == 0 or not is_planned:
            _climb(one, pool, 0.3 if k == 0 else 0.1)
        # What is stored is rounded; only what keeps the limits as stored counts.
        pool = limits.amplitude * as_stored(pool / limits.amplitude).astype(np.float64)
        values, peaks = one.worth(pool)
        values[~(peaks <= limits.output)] = -np.inf
        if values.max() > best_value:
            best, best_value = pool[values.argmax()].copy(), float(values.max())
        if is_planned:
            pool = np.stack([_planned(best, one, rng, words) for _ in range(_COPIES)])
        else:
            pool = np.stack([_changed(best, rng) for _ in range(_COPIES)])
    return best, best_value


def _climb(one: Systems, pool: FloatArray, rate: float) -> None:
    """Gradient ascent from every input of a pool (k, samples), in place."""
    improve = climber(one.plant.model, one.degree).improve
    improve(one.known(0), one.limits, rate, _ITERATIONS, pool, np.empty(len(pool)))


def _planned(u: FloatArray, one: Systems, rng: np.random.Generator, words: npt.NDArray[np.uint64]) -> FloatArray:
    """A copy that the planner, who knows the system, plans anew from a random sample on."""
    planned = u.copy()
    model, limits = one.plant.model, one.limits
    n = model.n_states
    mean, cov = np.zeros(len(model.names)), np.zeros((len(model.names), len(model.names)))
    mean[n:], cov[n:, n:] = one.theta[0], np.linalg.inv(one.precision)
    noises = [(1.0, variance) for variance in one.variances[0]]
    record = Belief.of(model, mean, cov, noises[0], noises[1:]).record.copy()
    first = int(rng.integers(-one.samples // 8, one.samples - 1))
    horizon, rounds = int(rng.integers(8, 25)), int(rng.integers(1, 9))
    limit = 0.9999 * limits.output  # leaves room for the rounding of what is stored
    view = View(model, one.degree)
    sizes = scales(view, one.theta[0], limits.amplitude, limit)
    terms = Terms(limits.amplitude, np.inf, limit, 0.0, np.zeros(model.n_coefficients), sizes)
    planning.search(*view).play(record, first, horizon, rounds, terms, planned, words)
    return planned


def _signals(count: int, samples: int, amplitude: float, rng: np.random.Generator) -> FloatArray:
    """(count, samples) random binary signals of several holds, and square waves about resonance."""
    signals = np.empty((count, samples))
    t = np.arange(samples)
    for i in range(count):
        if i % 2:
            half_period = rng.uniform(2.5, 6.0)  # of 610 Hz: 50 to 120 Hz
            signals[i] = np.where(((t + rng.uniform(0, 12)) // half_period) % 2 == 0, 1.0, -1.0)
        else:
            hold = rng.integers(1, 9)
            signals[i] = np.repeat(rng.choice([-1.0, 1.0], -(-samples // hold)), hold)[:samples]
        # Weak ones too, because strong ones may begin far beyond the displacement limit.
        signals[i] *= amplitude * rng.choice([0.3, 0.6, 1.0])
    return signals


def _changed(u: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A copy with a stretch turned over, shifted, or drawn anew."""
    changed = u.copy()
    length = int(rng.integers(4, max(5, len(u) // 4)))
    first = int(rng.integers(0, len(u) - length + 1))
    stretch = slice(first, first + length)
    kind = rng.integers(3)
    if kind == 0:
        changed[stretch] = -changed[stretch]
    elif kind == 1:
        changed[stretch] = np.roll(changed[stretch], rng.integers(1, length))
    else:
        changed[stretch] = np.abs(changed[stretch]) * rng.choice([-1.0, 1.0], length)
    return changed


def design(
    systems: Systems,
    given: FloatArray,
    *,
    rounds: int = 8,
    seed: int = 0,
    on_row: Callable[[int, float], None] | None = None,
) -> Oracle:
    """Search all systems; what is stored is a start, so the result is never worse.

    Args:
        systems: of a track.
        given: (k, n, samples) inputs to start from besides [V].
        rounds: see `search`.
        seed: of the search.
        on_row: called with each row and its value.
    """
    n = len(systems.theta)
    inputs, values = np.zeros((n, systems.samples)), np.full(n, -np.inf)
    try:
        stored = Oracle.of(systems)
        inputs[: len(stored.values)], values[: len(stored.values)] = stored.inputs, stored.values
    except FileNotFoundError:
        pass
    for row in range(n):
        starts = given[:, row]
        if np.isfinite(values[row]):
            starts = np.concatenate([starts, inputs[row : row + 1]])
        rng = np.random.default_rng([seed, row])
        found, value = search(systems, row, np.nan_to_num(starts), rng, rounds=rounds)
        if value > values[row]:
            inputs[row], values[row] = found, value
        if on_row is not None:
            on_row(row, values[row])
    return Oracle(systems, inputs, values)


@dataclass(frozen=True)
class Config:
    """Search D-optimal inputs at the true parameters, and store what is better than what is stored."""

    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 256
    """Number of systems: the first rows of a batch that is reset with seed 0."""
    policies: tuple[str, ...] = ("efe",)
    """Policies whose inputs to start from besides."""
    rounds: int = 8
    """Rounds of changed copies of the best input."""
    seed: int = 0
    """Of the search."""


def main(config: Config) -> None:
    """Search, store, and say how far it is."""
    systems = Systems.of(config.env, config.systems, config.options)
    given = np.empty((0, config.systems, systems.samples))
    if config.policies:
        played = evaluate(config.policies, config.env, config.systems, options=config.options)
        given = np.stack([evaluation.inputs.T for evaluation in played])
    began = time.perf_counter()
    oracle = design(systems, given, rounds=config.rounds, seed=config.seed)
    path = oracle.save()
    gained = oracle.values - 0.5 * np.linalg.slogdet(systems.precision)[1]
    print(f"{len(oracle.values)} systems in {time.perf_counter() - began:.0f} s: mean gain {gained.mean():.3f} nats")
    print(f"stored in {path}")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
