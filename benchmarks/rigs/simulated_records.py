"""Simulated records of the benches, their files, and the Cramér-Rao bound of m, c, a and b.

The bound is of one record with known noises and an unknown initial state. The sensitivities of the outputs along the
true path are whitened by the Kalman filter of the linearised motion. The information in the noises' dependence on the
parameters is left out, because it does not grow as the noises shrink.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from benchmarks.rigs.bench_catalogue import N_SAMPLES, PARAMETERS, Bench
from benchmarks.rigs.dop853_simulator import SENSOR_KINDS, FloatArray, output_derivatives, simulate, state_sensitivities

#: Largest relative error of a guess.
MAX_GUESS_ERROR = 0.3

#: Recorded samples that are cut at either end of a filtered record.
_FILTER_MARGIN = 100

#: Stream of random numbers to its number in the seed.
_RNG_STREAMS = {"input": 0, "noise": 1, "guess": 2, "fault": 3}


@dataclass(frozen=True)
class SimulatedRecord:
    """A record of a bench, and the true motion.

    Attributes:
        bench: the bench.
        u: (T,) recorded inputs.
        y: (T,) recorded outputs.
        states: (N, 2) x and x' at each sample of the integration.
        force: (N - 1,) force at the begin of each interval.
        slope: (N - 1,) its rate of change.
        accelerations: (N,) accelerations; see `benchmarks.rigs.dop853_simulator.simulate`.
    """

    bench: Bench
    u: FloatArray
    y: FloatArray
    states: FloatArray
    force: FloatArray
    slope: FloatArray
    accelerations: FloatArray

    @cached_property
    def cramer_rao_stds(self) -> FloatArray:
        """(4,) Cramér-Rao standard deviations of m, c, a and b, relative, with an unknown offset where there is one.

        With decimation, the bound is of the record before the filter.
        """
        bench = self.bench
        step = bench.step / bench.decimate
        moved = state_sensitivities(bench.parameters, self.force, self.slope, self.states[:-1], step, bench.scale)
        by_state, by_force = output_derivatives(bench.kind, bench.parameters, self.states)
        direct = np.zeros((len(self.states), 5 if bench.offset else 4))
        direct[:, 4:] = 1.0
        if bench.kind == "acceleration":
            m, c, a, b = bench.truth
            x, v = self.states.T
            direct[:, :4] = -np.stack([self.accelerations, c * v / m, a * x / m, b * x**3 / m], axis=1)
            by_force[0] = 0.0
        found = fisher_information(
            moved, by_state, by_force, direct, bench.process_noise**2, bench.sensor_noise**2, bench.scale
        )
        return cramer_rao_stds(found)


@njit(cache=True)
def fisher_information(
    sensitivities, output_by_state, output_by_force, output_by_unknown, process_variance, sensor_variance, initial_std
):
    """Fisher information of P unknowns, with the four parameters first.

    Args:
        sensitivities: (T, 7, 2) sensitivities of `benchmarks.rigs.dop853_simulator.state_sensitivities`.
        output_by_state: (T + 1, 2) derivatives of the outputs by the state.
        output_by_force: (T + 1,) derivatives by the process noise before the output.
        output_by_unknown: (T + 1, P) derivatives by the unknowns, at a given state.
        process_variance: variance of the disturbance that is held over a sample.
        sensor_variance: variance of the sensor's noise.
        initial_std: (2,) standard deviations of the initial state.
    """
    unknowns = output_by_unknown.shape[1]
    fisher = np.zeros((unknowns, unknowns))
    paths = np.zeros((2, unknowns))
    P = np.diag(initial_std**2)
    for k in range(len(output_by_state)):
        h = output_by_state[k]
        force_cov = np.zeros(2)
        variance = sensor_variance
        if k > 0:
            transition = sensitivities[k - 1, :2].T.copy()
            paths = transition @ paths
            paths[:, :4] += sensitivities[k - 1, 3:].T
            P = transition @ P @ transition.T + process_variance * np.outer(
                sensitivities[k - 1, 2], sensitivities[k - 1, 2]
            )
            force_cov = process_variance * output_by_force[k] * sensitivities[k - 1, 2]
            variance += 2 * (h @ force_cov) + process_variance * output_by_force[k] ** 2
        cross_cov = P @ h + force_cov
        variance += h @ P @ h
        innovation_sensitivity = h @ paths + output_by_unknown[k]
        fisher += np.outer(innovation_sensitivity, innovation_sensitivity) / variance
        paths -= np.outer(cross_cov, innovation_sensitivity) / variance
        P = P - np.outer(cross_cov, cross_cov) / variance
        P = 0.5 * (P + P.T)
    return fisher


def cramer_rao_stds(fisher: FloatArray) -> FloatArray:
    """(4,) smallest relative standard deviations of m, c, a and b, with the other unknowns marginalised."""
    scale = np.sqrt(np.diag(fisher))
    if not (scale > 0).all():
        return np.full(4, np.inf)
    variances = np.diag(np.linalg.pinv(fisher / np.outer(scale, scale), hermitian=True, rcond=1e-13))
    return np.asarray(np.sqrt(variances)[:4] / scale[:4])


def rng_stream(bench: Bench, seed: int, stream: str) -> np.random.Generator:
    """Random numbers of a bench, a seed and a stream: input, noise, guess or fault."""
    return np.random.default_rng([seed, _RNG_STREAMS[stream], *bench.name.encode()])


def simulate_record(
    bench: Bench, seed: int, n_samples: int = N_SAMPLES, extra_delay: int = 0, interpolation: str = "zero_order"
) -> SimulatedRecord:
    """Simulate a record from rest.

    Args:
        bench: the bench.
        seed: of input and noises.
        n_samples: recorded samples.
        extra_delay: delay of the acting input after the recorded one [samples].
        interpolation: true interpolation: ``zero_order`` or ``linear``.

    Raises:
        OverflowError: where the oscillator escapes, or leaves the range.
    """
    margin = _FILTER_MARGIN if bench.decimate > 1 else 0
    u = bench.excitation(rng_stream(bench, seed, "input"), n_samples + 2 * margin)
    rng = rng_stream(bench, seed, "noise")
    w, noise = bench.process_noise * rng.standard_normal(len(u) - 1), bench.sensor_noise * rng.standard_normal(len(u))
    step = bench.step / bench.decimate
    acting = np.r_[np.zeros(extra_delay), u[: len(u) - extra_delay]]
    slope = np.diff(acting) / step if interpolation == "linear" else np.zeros(len(u) - 1)
    force = acting[:-1] + w
    states, ends = simulate(bench.parameters, force, slope, np.array([bench.rest, 0.0]), step, bench.scale)
    place = SENSOR_KINDS.index(bench.kind)
    y = (ends if place == 2 else states[:, place]) + bench.offset + noise
    if np.abs(y).max() > bench.output_range:
        raise OverflowError(f"rig {bench.name} leaves its range: {np.abs(y).max():.3g} of {bench.output_range}")
    kept = slice(margin, margin + n_samples)
    if bench.decimate > 1:  # at a sample, a held input is between the previous and the present value
        u = (np.r_[u[0], u[:-1]] + u) / 2
    return SimulatedRecord(
        bench, decimate(u, bench.decimate)[kept], decimate(y, bench.decimate)[kept], states, force, slope, ends
    )


def decimate(series: FloatArray, factor: int) -> FloatArray:
    """Every ``factor``-th sample after an anti-alias filter without delay, of an input or output (docs/rig_beam.md)."""
    if factor == 1:
        return series
    from scipy.signal import firwin, resample_poly

    return np.asarray(
        resample_poly(
            series, 1, factor, window=firwin(2 * _FILTER_MARGIN * factor + 1, 1 / factor, window=("kaiser", 12.0))
        )
    )


def draw_guess(bench: Bench, seed: int) -> dict[str, tuple[float, float]]:
    """Guess: intervals of ±30 % about centers that are off by up to ±30 %."""
    error_factors = 1 + rng_stream(bench, seed, "guess").uniform(-MAX_GUESS_ERROR, MAX_GUESS_ERROR, len(PARAMETERS))
    centers = dict(zip(PARAMETERS, (np.array(bench.truth) * error_factors).tolist(), strict=True))
    return {name: tuple(sorted((0.7 * center, 1.3 * center))) for name, center in centers.items()}


def write_record(path: Path, u: FloatArray, y: FloatArray) -> None:
    """Write a CSV file with a header and 10 digits."""
    np.savetxt(path, np.column_stack([u, y]), fmt="%.10g", delimiter=",", header="u,y", comments="")


def write_rig(path: Path, bench: Bench, intervals: dict[str, tuple[float, float]] | None, **rig_changes: Any) -> None:
    """Write the rig file as a user would; ``rig_changes`` replace step or interpolation."""
    settings: dict[str, Any] = {"step": bench.step, "interpolation": bench.interpolation, "delay": 0} | rig_changes
    lines = [f"{name} = {value!r}" for name, value in settings.items()]
    lines += ["", "[input]", f'unit = "{bench.units[0]}"', f"limit = {bench.limit!r}"]
    lines += ["", "[output]", f'unit = "{bench.units[1]}"', f'kind = "{bench.kind}"', f"range = {bench.output_range!r}"]
    if intervals is not None:
        lines += ["", "[guess]", *(f"{name} = [{low!r}, {high!r}]" for name, (low, high) in intervals.items())]
    path.write_text("\n".join(lines).replace("'", '"') + "\n", encoding="utf-8")
