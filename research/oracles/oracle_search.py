"""Search of D-optimal inputs at the true parameters, for the oracles stored in the package.

    python -m research.oracles.oracle_search --env duffing_env/Amplitude-v0 --systems 64

makes many starts by beam search on a grid of each system's states (`agents.planning.grid_beam_search`), refines each to
a local maximum of ½ log det(Λ0 + F(u)) under the track's limits (`research.oracles.slp_refinement`), and stores what is
better than the stored input. F is the Fisher information at the true coefficients along the response without noise, Λ0
the inverse of the prior's covariance of the coefficients. The stored input is one of the starts. A search continues, up
to eight times its starts, until three fresh ones have reached the highest maximum.

With `--check` nothing is stored: a search from fresh starts, twice as long, reports for each system its gain over the
stored input, and the difference between its best three starts.

System i is row i of a batch that is reset with seed 0 in the branch ``test``, as
`agents.evaluation.policy_evaluation.evaluate_policies` does by default; it does not depend on the number of systems.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from agents.cli import run_script
from agents.console_output import print_texts_and_tables
from agents.evaluation.oracle import QUANTISATION_LEVELS, Oracle, TrackSystems, quantise
from agents.json_options import JsonOptions
from agents.planning.energy_limited_plan import compile_energy_limited_plan
from agents.planning.model_probe import ModelView
from agents.planning.plan_objective import PlanObjective
from agents.planning.projected_gradient import DesignLimits, compile_projected_gradient
from agents.planning.time_scales import probe_time_scales
from estimator.belief import Belief
from estimator.support.argument_checks import MAX_SEED, check_integer
from estimator.support.array_types import FloatArray
from estimator.support.progress import iterate_with_progress
from research.oracles.beam_start import compile_beam_start
from research.oracles.linear_programme import import_highspy
from research.oracles.slp_refinement import refine_input

#: Smallest number of starts of a search.
_MIN_STARTS = 24

#: Ratio of the largest number of starts to the smallest.
_MAX_START_FACTOR = 8

#: Fresh starts that must agree for a search to end.
_N_AGREEING = 3

#: Difference [nats] within which starts agree.
_AGREEMENT = 0.002

#: Numbers of grid cells along each axis; every start draws one of them.
_CELL_COUNTS = (24, 32, 48, 64, 96)

#: Standard deviations of the logarithms of factors on the expected information rate; every start draws one of them.
_RATE_SPREADS = (0.1, 0.3, 0.8)

#: Largest numbers of systems and of starts of a command.
_MAX_COUNT = 100_000

#: Fraction of the limits of signal and energy that searches use, because stored inputs are rounded.
_LIMIT_FRACTION = 1.0 - 1e-4


def search_best_input(
    systems: TrackSystems, row: int, initial_inputs: FloatArray, rng: np.random.Generator, n_starts: int = _MIN_STARTS
) -> tuple[FloatArray, float, float]:
    """Search the best input of one system.

    A start is the best path through the grid of the states. Its criterion assumes for the rest of the path the
    information rate of the best input so far, with a random factor per coefficient. Every second start keeps the
    beginning of the best input. Under an energy limit a start is a burst in the direction of the velocity.

    Args:
        systems: systems of a track.
        row: index of the system.
        initial_inputs: (k, samples) further inputs to start from [V].
        rng: random generator of the starts.
        n_starts: smallest number of starts besides ``initial_inputs``.

    Returns:
        The best input (samples,) [V] that keeps all limits after rounding for storage; its criterion [nats], -inf
        without one; and the difference to the third best fresh start [nats], infinite with fewer than three.
    """
    one, model = systems.rows(row, row + 1), systems.plant.model
    exact = systems.limits
    limits = exact._replace(soft_limit=_LIMIT_FRACTION * exact.output, energy=_LIMIT_FRACTION * exact.energy)
    state_scales = probe_time_scales(
        ModelView(model, systems.degree), one.theta[0], limits.amplitude, limits.output
    ).scales
    rng_state = rng.integers(0, 2**64, 4, dtype=np.uint64)
    best, best_value, fresh_values = np.zeros(systems.samples), -np.inf, np.full(_N_AGREEING, -np.inf)
    for k in range(len(initial_inputs) + _MAX_START_FACTOR * n_starts):
        if k >= len(initial_inputs) + n_starts and fresh_values[0] > best_value - _AGREEMENT:
            break
        keeps_beginning = k % 2 == 1 and bool(np.isfinite(best_value)) and not np.isfinite(limits.energy)
        if k < len(initial_inputs):
            start = initial_inputs[k]
        elif np.isfinite(limits.energy):
            start = _burst_start(one, limits, rng_state)
        else:
            start = _beam_search_start(one, limits, state_scales, best, keeps_beginning, rng, rng_state)
        start = quantise(np.clip(start / limits.amplitude, -1.0, 1.0)) * limits.amplitude
        goal, unit = best_value - _AGREEMENT, limits.amplitude / QUANTISATION_LEVELS
        u, _ = refine_input(
            model, systems.degree, one.nominal_system(0), limits, state_scales, start, unit, target_value=goal
        )
        u = quantise(u / limits.amplitude) * limits.amplitude
        value, peak = (float(found[0]) for found in one.criterion_and_peak(u[None]))
        if not (peak <= exact.output and u @ u <= exact.energy):
            continue
        if k >= len(initial_inputs) and not keeps_beginning:
            fresh_values = np.sort([*fresh_values[1:], max(value, fresh_values[0])])
        if value > best_value:
            best, best_value = u, value
    return best, best_value, best_value - fresh_values[0] if np.isfinite(fresh_values[0]) else np.inf


def _beam_search_start(
    one: TrackSystems, limits: DesignLimits, state_scales: FloatArray, best: FloatArray, keeps_beginning: bool,
    rng: np.random.Generator, rng_state: np.ndarray,
) -> FloatArray:  # fmt: skip
    """The plan of a beam search; with ``keeps_beginning`` it begins like the best input so far."""
    model = one.plant.model
    n, size = model.n_states, len(model.names)
    mean, cov = np.zeros(size), np.zeros((size, size))
    mean[n:], cov[n:, n:] = one.theta[0], np.linalg.inv(one.precision)
    noises = [(1.0, variance) for variance in one.variances[0]]
    record = Belief.of(model, mean, cov, noises[0], noises[1:]).record.copy()
    information = one.information(best[None])[0]
    rate_factors = np.exp(rng.choice(_RATE_SPREADS) * rng.standard_normal(len(information)))
    information_rate = information * np.outer(rate_factors, rate_factors) / one.samples
    u = best.copy()
    first = int(rng.integers(one.samples // 16, one.samples * 7 // 8)) if keeps_beginning else 0
    objective = PlanObjective(
        limits.amplitude, np.inf, limits.soft_limit, 0.0, np.zeros(model.n_coefficients), state_scales
    )
    compile_beam_start(model, one.degree)(
        record, first, int(rng.choice(_CELL_COUNTS)), objective, information_rate, rng_state, u
    )
    return u


def _burst_start(one: TrackSystems, limits: DesignLimits, rng_state: np.ndarray) -> FloatArray:
    """A burst in the direction of the velocity, improved by its gradient."""
    u = np.empty((1, one.samples))
    compile_energy_limited_plan(one.plant.model, one.degree).resonant_bursts(
        one.nominal_system(0), limits.output, limits.energy, u, rng_state
    )
    compile_projected_gradient(one.plant.model, one.degree).ascend_batch(
        one.nominal_system(0), limits, 0.3, 100, u, np.empty(1)
    )
    return u[0]


def oracle_to_improve(systems: TrackSystems) -> Oracle:
    """The stored oracle; systems without a stored input get zero input and criterion -inf."""
    n = len(systems.theta)
    inputs, values, bounds = np.zeros((n, systems.samples)), np.full(n, -np.inf), np.full(n, np.nan)
    count = Oracle.count_stored(systems)
    if count:
        stored = Oracle.of(systems)
        inputs[:count], values[:count], bounds[:count] = stored.inputs, stored.values, stored.bounds
    return Oracle(systems, inputs, values, bounds)


def compare_with_stored(oracle: Oracle, first: int, n_starts: int, seed: int) -> Iterator[str]:
    """The gain of fresh searches, twice as long, over the stored inputs: a line for each system, and a line for all."""
    none, found = np.empty((0, oracle.systems.samples)), []
    for row in iterate_with_progress((f"system {row}", row) for row in range(first, len(oracle.values))):
        rng = np.random.default_rng([seed, row, 1])  # not [seed, row, 0], which is the same as [seed, row]
        _, value, disagreement = search_best_input(oracle.systems, row, none, rng, 2 * n_starts)
        gain = max(value - oracle.values[row], 0.0)
        found.append((gain, disagreement))
        yield f"system {row}: gained {gain:.4f} nats, the best three fresh starts differ by {disagreement:.4f}"
    (gain, disagreement), (most, widest) = np.mean(found, axis=0), np.max(found, axis=0)
    yield (
        f"{len(found)} systems; means and maxima in nats:\n"
        f"the best three fresh starts differ by {disagreement:.4f}, {widest:.4f};\n"
        f"searches twice as long gain {gain:.4f}, {most:.4f} over what is stored"
    )


@dataclass(frozen=True)
class Config:
    """Search D-optimal inputs at the true parameters, and store those that are better than the stored ones."""

    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 256
    """Number of systems: the first rows of a batch that is reset with seed 0."""
    first: int = 0
    """First system to search or check; earlier ones stay as they are stored."""
    tries: int = _MIN_STARTS
    """Starts of a search."""
    seed: int = 0
    """Of the search."""
    check: bool = False
    """Search anew and compare, and store nothing."""

    def __post_init__(self) -> None:
        check_integer("systems", self.systems, _MAX_COUNT)
        check_integer("tries", self.tries, _MAX_COUNT)
        check_integer("seed", self.seed, MAX_SEED, 0)
        check_integer("first (below systems)", self.first, self.systems - 1, 0)


def main(config: Config) -> None:
    """Search, store, and print progress."""
    import_highspy()
    systems = TrackSystems.of(config.env, config.systems, config.options)
    began = time.perf_counter()
    if config.check:
        for line in compare_with_stored(Oracle.of(systems), config.first, config.tries, config.seed):
            print_texts_and_tables(line)
            sys.stdout.flush()  # at once, so that an interrupted check leaves its results
        print_texts_and_tables(f"{time.perf_counter() - began:.0f} s")
        return
    count = max(config.systems, Oracle.count_stored(systems))
    oracle = oracle_to_improve(TrackSystems.of(config.env, count, config.options))
    for row in iterate_with_progress((f"system {row}", row) for row in range(config.first, config.systems)):
        starts = oracle.inputs[row : row + 1] if np.isfinite(oracle.values[row]) else oracle.inputs[:0]
        rng = np.random.default_rng([config.seed, row])
        found, value, _ = search_best_input(oracle.systems, row, starts, rng, config.tries)
        if value > oracle.values[row]:
            oracle.inputs[row], oracle.values[row] = found, value
        if row + 1 == config.systems or row % 8 == 7:  # an interrupted search leaves its results
            path = oracle.head(int(np.isfinite(oracle.values).sum())).save()
    gained = oracle.values - 0.5 * np.linalg.slogdet(oracle.systems.precision)[1]
    seconds = time.perf_counter() - began
    print_texts_and_tables(
        f"{config.systems - config.first} systems in {seconds:.0f} s; mean gain of {count}: {gained.mean():.3f} nats"
    )
    print_texts_and_tables(f"stored in {path}")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
