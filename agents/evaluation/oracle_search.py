"""The search for D-optimal inputs at the true parameters, which are stored.

    python -m agents.evaluation.oracle_search --env duffing_env/Amplitude-v0 --systems 64

takes many ways through the map of each system's states (`agents.planner.search`), polishes each to a summit of
½ log det(Λ0 + F(u)) under the track's limits (`agents.planner.polish`), and keeps what is better than what is stored. F
is the Fisher information at the true coefficients along the response without noise, Λ0 the inverse of the prior's
covariance of the coefficients. What is stored is a start. A search ends after so many starts, but goes on, to eight
times as many, until three that began anew have come to the highest summit.

With `--check` nothing is stored: a search from fresh starts, twice as long, says for each system what it gains over
what is stored, and by how much its best three starts differ.

System i is row i of a batch that is reset with seed 0 in the branch ``test``, as `agents.evaluation.policy_evaluation.evaluate_policies`
does it by default; it does not depend on the number of systems.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from agents.cli import JsonOptions, iterate_with_progress, run_script
from agents.console_output import print_texts_and_tables
from agents.evaluation.oracle import LEVELS, Oracle, Systems, as_stored
from agents.planner import search as planning
from agents.planner.ascent import Limits, climber
from agents.planner.imagination import Terms
from agents.planner.motion import View, swing_of
from agents.planner.polish import polish
from agents.planner.pursuit import pursuit
from estimator.belief import Belief
from estimator.checks import MOST_SEED, whole
from estimator.extras import need
from estimator.parameters import FloatArray

#: Starts of a search at least; it goes on to so many times as many, until so many that began anew agree within [nats].
_TRIES, _LONGER, _AGREED, _SAME = 24, 8, 3, 0.002

#: Cells of the map along each axis, and the spread of the factors by which starts change the rate of information that
#: they expect: one of each is drawn for every start.
_CELLS, _DOUBTS = (24, 32, 48, 64, 96), (0.1, 0.3, 0.8)

#: Systems and starts of a command at most.
_MOST = 100_000

#: Share of the limits of signal and energy that is aimed at, because what is stored is rounded.
_AIM = 1.0 - 1e-4


def search(
    systems: Systems, row: int, given: FloatArray, rng: np.random.Generator, tries: int = _TRIES
) -> tuple[FloatArray, float, float]:
    """Search the best input of one system.

    A start is the best way through the map of the states, whose criterion expects of the rest of the way the rate of
    information that the best input so far has brought, each coefficient's changed at random; every second one keeps the
    start of the best input. Under a limit of energy a start is a burst that pushes as the system moves.

    Args:
        systems: of a track.
        row: the system.
        given: (k, samples) inputs to start from besides [V].
        rng: of the starts.
        tries: starts besides those given, at least.

    Returns:
        The best input (samples,) [V] that keeps all limits also as it is stored; its worth [nats], -inf if none; and by
        how much that is above the third best of the starts that began anew [nats], infinite if there are fewer.
    """
    one, model = systems.rows(row, row + 1), systems.plant.model
    exact = systems.limits
    limits = exact._replace(aim=_AIM * exact.output, energy=_AIM * exact.energy)
    sizes = swing_of(View(model, systems.degree), one.theta[0], limits.amplitude, limits.output).scales
    words = rng.integers(0, 2**64, 4, dtype=np.uint64)
    best, best_value, anew = np.zeros(systems.samples), -np.inf, np.full(_AGREED, -np.inf)
    for k in range(len(given) + _LONGER * tries):
        if k >= len(given) + tries and anew[0] > best_value - _SAME:
            break
        keeps = k % 2 == 1 and bool(np.isfinite(best_value)) and not np.isfinite(limits.energy)
        if k < len(given):
            start = given[k]
        elif np.isfinite(limits.energy):
            start = _burst(one, limits, words)
        else:
            start = _way(one, limits, sizes, best, keeps, rng, words)
        start = as_stored(np.clip(start / limits.amplitude, -1.0, 1.0)) * limits.amplitude
        goal, unit = best_value - _SAME, limits.amplitude / LEVELS
        u, _ = polish(model, systems.degree, one.known(0), limits, sizes, start, unit, goal=goal)
        u = as_stored(u / limits.amplitude) * limits.amplitude
        value, peak = (float(found[0]) for found in one.worth(u[None]))
        if not (peak <= exact.output and u @ u <= exact.energy):
            continue
        if k >= len(given) and not keeps:
            anew = np.sort([*anew[1:], max(value, anew[0])])
        if value > best_value:
            best, best_value = u, value
    return best, best_value, best_value - anew[0] if np.isfinite(anew[0]) else np.inf


def _way(
    one: Systems, limits: Limits, sizes: FloatArray, best: FloatArray, keeps: bool, rng: np.random.Generator,
    words: np.ndarray,
) -> FloatArray:  # fmt: skip
    """The best way through the map of the states; ``keeps`` says that it begins as the best input so far."""
    model = one.plant.model
    n, size = model.n_states, len(model.names)
    mean, cov = np.zeros(size), np.zeros((size, size))
    mean[n:], cov[n:, n:] = one.theta[0], np.linalg.inv(one.precision)
    noises = [(1.0, variance) for variance in one.variances[0]]
    record = Belief.of(model, mean, cov, noises[0], noises[1:]).record.copy()
    told = one.information(best[None])[0]
    doubts = np.exp(rng.choice(_DOUBTS) * rng.standard_normal(len(told)))
    rate = told * np.outer(doubts, doubts) / one.samples
    u = best.copy()
    first = int(rng.integers(one.samples // 16, one.samples * 7 // 8)) if keeps else 0
    terms = Terms(limits.amplitude, np.inf, limits.aim, 0.0, np.zeros(model.n_coefficients), sizes)
    view = View(model, one.degree)
    planning.search(*view).through(record, first, int(rng.choice(_CELLS)), terms, rate, words, u)
    return u


def _burst(one: Systems, limits: Limits, words: np.ndarray) -> FloatArray:
    """A burst that pushes as the system moves, improved by its gradient."""
    u = np.empty((1, one.samples))
    pursuit(one.plant.model, one.degree).swings(one.known(0), limits.output, limits.energy, u, words)
    climber(one.plant.model, one.degree).improve(one.known(0), limits, 0.3, 100, u, np.empty(1))
    return u[0]


def begun(systems: Systems) -> Oracle:
    """The stored oracle, with systems that it lacks at rest and worth -inf."""
    n = len(systems.theta)
    inputs, values, bounds = np.zeros((n, systems.samples)), np.full(n, -np.inf), np.full(n, np.nan)
    count = Oracle.stored(systems)
    if count:
        stored = Oracle.of(systems)
        inputs[:count], values[:count], bounds[:count] = stored.inputs, stored.values, stored.bounds
    return Oracle(systems, inputs, values, bounds)


def check(oracle: Oracle, first: int, tries: int, seed: int) -> Iterator[str]:
    """What searches from fresh starts, twice as long, gain over what is stored: a line for each system, and for all."""
    none, found = np.empty((0, oracle.systems.samples)), []
    for row in iterate_with_progress((f"system {row}", row) for row in range(first, len(oracle.values))):
        rng = np.random.default_rng([seed, row, 1])  # not [seed, row, 0], which is the same as [seed, row]
        _, value, apart = search(oracle.systems, row, none, rng, 2 * tries)
        gained = max(value - oracle.values[row], 0.0)
        found.append((gained, apart))
        yield f"system {row}: gained {gained:.4f} nats, the best three fresh starts differ by {apart:.4f}"
    (gained, apart), (most, widest) = np.mean(found, axis=0), np.max(found, axis=0)
    yield (
        f"{len(found)} systems; means and maxima in nats:\n"
        f"the best three fresh starts differ by {apart:.4f}, {widest:.4f};\n"
        f"searches twice as long gain {gained:.4f}, {most:.4f} over what is stored"
    )


@dataclass(frozen=True)
class Config:
    """Search D-optimal inputs at the true parameters, and store what is better than what is stored."""

    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 256
    """Number of systems: the first rows of a batch that is reset with seed 0."""
    first: int = 0
    """The first of them that is searched, or checked; those before stay as they are stored."""
    tries: int = _TRIES
    """Starts of a search."""
    seed: int = 0
    """Of the search."""
    check: bool = False
    """Search anew and compare, and store nothing."""

    def __post_init__(self) -> None:
        whole("systems", self.systems, _MOST)
        whole("tries", self.tries, _MOST)
        whole("seed", self.seed, MOST_SEED, 0)
        whole("first (below systems)", self.first, self.systems - 1, 0)


def main(config: Config) -> None:
    """Search, store, and say how far it is."""
    need("highspy")
    systems = Systems.of(config.env, config.systems, config.options)
    began = time.perf_counter()
    if config.check:
        for line in check(Oracle.of(systems), config.first, config.tries, config.seed):
            print_texts_and_tables(line)
            sys.stdout.flush()  # at once: a check that is cut short leaves what it found
        print_texts_and_tables(f"{time.perf_counter() - began:.0f} s")
        return
    count = max(config.systems, Oracle.stored(systems))
    oracle = begun(Systems.of(config.env, count, config.options))
    for row in iterate_with_progress((f"system {row}", row) for row in range(config.first, config.systems)):
        starts = oracle.inputs[row : row + 1] if np.isfinite(oracle.values[row]) else oracle.inputs[:0]
        rng = np.random.default_rng([config.seed, row])
        found, value, _ = search(oracle.systems, row, starts, rng, config.tries)
        if value > oracle.values[row]:
            oracle.inputs[row], oracle.values[row] = found, value
        if row + 1 == config.systems or row % 8 == 7:  # a search that is cut short leaves what it found
            path = oracle.first(int(np.isfinite(oracle.values).sum())).save()
    gained = oracle.values - 0.5 * np.linalg.slogdet(oracle.systems.precision)[1]
    seconds = time.perf_counter() - began
    print_texts_and_tables(
        f"{config.systems - config.first} systems in {seconds:.0f} s; mean gain of {count}: {gained.mean():.3f} nats"
    )
    print_texts_and_tables(f"stored in {path}")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
