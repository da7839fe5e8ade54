"""The benchmark of rigs: its integrator, its bound, what it writes, and its verdicts."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

from benchmarks.rigs import faults, peer_comparison, sampling_sweep
from benchmarks.rigs.bench_catalogue import BENCHES, DESK_BENCH, Bench
from benchmarks.rigs.calibration import BenchmarkCell, TrialOutcome, binomial_interval, judge_coverage
from benchmarks.rigs.dop853_simulator import SENSITIVITY_DIRECTIONS, SENSOR_KINDS, simulate, state_sensitivities
from benchmarks.rigs.rig_accuracy import print_report
from benchmarks.rigs.simulated_records import SimulatedRecord, draw_guess, simulate_record, write_record, write_rig
from estimator import Rig

ALL = pytest.mark.parametrize("bench", BENCHES.values(), ids=list(BENCHES))


def reference(bench: Bench, made: SimulatedRecord, count: int) -> np.ndarray:
    """The states of the first samples, by SciPy's integrator, sample by sample."""
    m, c, a, b = bench.truth
    step, states = bench.step / bench.decimate, [made.states[0]]
    for k in range(count):

        def change(t: float, s: np.ndarray, k: int = k) -> list[float]:
            x, v = s
            force = made.force[k] + made.slope[k] * t
            return [v, (force - c * v - a * x - b * x**3 - bench.quintic * x**5) / m]

        run = solve_ivp(change, (0, step), states[-1], method="DOP853", rtol=1e-12, atol=1e-15 * bench.scale)
        states.append(run.y[:, -1])
    return np.array(states)


@ALL
def test_it_integrates_as_scipy_does(bench: Bench) -> None:
    made = simulate_record(bench, 1, 100)
    expected = reference(bench, made, 60)
    # Each sample adds at most 1e-9 of the values, which grow no faster than in a period or so.
    assert np.abs((made.states[:61] - expected) / bench.scale).max() < 1e-8


def test_it_integrates_linear_inputs_and_quintic_springs_as_scipy_does() -> None:
    bench = replace(DESK_BENCH, quintic=1e-4)
    made = simulate_record(bench, 1, 100, interpolation="linear")
    assert np.abs((made.states[:61] - reference(bench, made, 60)) / bench.scale).max() < 1e-8
    assert np.abs(made.states[60] - simulate_record(DESK_BENCH, 1, 100, interpolation="linear").states[60]).max() > 1e-3


@ALL
def test_an_input_acts_from_its_sample_to_the_next(bench: Bench) -> None:
    step = bench.step / bench.decimate
    force = np.r_[0.0, 0.0, bench.amplitude, 0.0]
    rest = np.array([bench.rest, 0.0])
    states, ends = simulate(np.array([*bench.truth, 0.0]), force, np.zeros(4), rest, step, bench.scale)
    assert np.abs((states[:3] - rest) / bench.scale).max() < 1e-12
    assert abs(states[3, 0] - bench.rest) > 0
    m, c, a, b = bench.truth
    x, v = states[3]
    assert ends[3] == pytest.approx((bench.amplitude - c * v - a * x - b * x**3) / m)


def test_an_oscillator_that_escapes_is_refused() -> None:
    with pytest.raises(OverflowError, match="escapes at sample"):
        simulate_record(replace(BENCHES["c"], amplitude=200.0), 0, 200)
    with pytest.raises(OverflowError, match="leaves its range"):
        simulate_record(replace(DESK_BENCH, amplitude=200.0), 0, 200)


@pytest.mark.parametrize("name", ["a", "d", "accel", "board-v"])
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    bench = BENCHES[name]
    made = simulate_record(bench, 2, 40)
    base, k = np.array([*bench.truth, 0.0]), 30
    moved = state_sensitivities(base, made.force, made.slope, made.states[:-1], bench.step, bench.scale)[k]
    sizes = {"x": bench.scale[0], "v": bench.scale[1], "w": bench.amplitude}
    for place, direction in enumerate(SENSITIVITY_DIRECTIONS):
        small = 1e-4 * sizes.get(direction, 1.0)
        ends = []
        for sign in (1, -1):
            parameters, initial, force = base.copy(), made.states[k].copy(), made.force[k : k + 1].copy()
            if place < 2:
                initial[place] += sign * small
            elif place == 2:
                force += sign * small
            else:
                parameters[place - 3] *= 1 + sign * small
            ends.append(simulate(parameters, force, np.zeros(1), initial, bench.step, bench.scale)[0][1])
        slope = (ends[0] - ends[1]) / (2 * small)
        size = np.abs(slope / bench.scale).max()
        assert np.abs((moved[place] - slope) / bench.scale).max() < 1e-4 * size


def whole_output(bench: Bench, u: np.ndarray, w: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
    """Outputs without noise of the sensor, of the logarithms' changes, the start in its scale and the offset."""
    parameters = np.array([*bench.truth, 0.0])
    parameters[:4] *= np.exp(unknowns[:4])
    initial = np.array([bench.rest, 0.0]) + bench.scale * unknowns[4:6]
    states, ends = simulate(parameters, u[:-1] + w, np.zeros(len(w)), initial, bench.step, bench.scale)
    place = SENSOR_KINDS.index(bench.kind)
    return np.asarray((ends if place == 2 else states[:, place]) + unknowns[6])


@pytest.mark.parametrize("name", ["a", "a+", "d", "e", "accel", "board-v"])
def test_the_bound_is_that_of_finite_differences_of_whole_records(name: str) -> None:
    bench, samples = BENCHES[name], 80
    made = simulate_record(bench, 3, samples)
    u, w = made.u, made.force - made.u[:-1]
    slopes = np.empty((samples, 7))
    for i in range(7):
        change = 1e-5 * np.eye(7)[i]
        slopes[:, i] = (whole_output(bench, u, w, change) - whole_output(bench, u, w, -change)) / 2e-5
    kicks, small = np.empty((samples, samples - 1)), 1e-4 * bench.amplitude
    for k in range(samples - 1):
        kick = small * np.eye(samples - 1)[k]
        kicks[:, k] = whole_output(bench, u, w + kick, np.zeros(7)) - whole_output(bench, u, w - kick, np.zeros(7))
    kicks /= 2 * small
    noise = bench.process_noise**2 * kicks @ kicks.T + bench.sensor_noise**2 * np.eye(samples)
    unknowns = slopes if bench.offset else slopes[:, :6]
    prior = block_diag(np.zeros((4, 4)), np.eye(2), np.zeros((unknowns.shape[1] - 6,) * 2))
    found = unknowns.T @ np.linalg.solve(noise, unknowns) + prior
    expected = np.sqrt(np.diag(np.linalg.inv(found)))[:4]
    assert made.cramer_rao_stds == pytest.approx(expected, rel=1e-3)


def test_records_repeat_and_differ_by_seed() -> None:
    first, again, other = (simulate_record(DESK_BENCH, seed, 200) for seed in (5, 5, 6))
    assert np.array_equal(first.y, again.y)
    assert not np.array_equal(first.u, other.u)
    assert draw_guess(DESK_BENCH, 5) == draw_guess(DESK_BENCH, 5) != draw_guess(DESK_BENCH, 6)


@ALL
def test_guesses_are_off_by_at_most_30_percent(bench: Bench) -> None:
    off = [np.mean(draw_guess(bench, seed)[name]) / truth - 1
           for seed in range(50) for name, truth in zip("mcab", bench.truth, strict=True)]  # fmt: skip
    assert 0.25 < np.abs(off).max() < 0.3
    assert all(low < high for low, high in draw_guess(bench, 0).values())


def test_files_hold_what_a_user_would_write(tmp_path) -> None:
    bench = BENCHES["wells"]
    made = simulate_record(bench, 0, 50)
    write_record(tmp_path / "data.csv", made.u, made.y)
    write_rig(tmp_path / "rig.toml", bench, draw_guess(bench, 0), interpolation="linear")
    assert np.loadtxt(tmp_path / "data.csv", delimiter=",", skiprows=1) == pytest.approx(
        np.column_stack([made.u, made.y]), rel=1e-9
    )
    rig = tomllib.loads((tmp_path / "rig.toml").read_text())
    assert (rig["step"], rig["interpolation"], rig["output"]["kind"]) == (1e-3, "linear", "displacement")
    assert rig["guess"]["a"] == list(draw_guess(bench, 0)["a"])


def test_the_beam_is_filtered_before_it_is_decimated() -> None:
    bench = BENCHES["beam"]
    made = simulate_record(bench, 0, 300)
    clean = simulate_record(replace(bench, sensor_noise=0.0), 0, 300)
    noise = (made.y - clean.y).std()
    assert noise == pytest.approx(bench.sensor_noise / np.sqrt(bench.decimate), rel=0.15)
    inner = made.states[:: bench.decimate, 0][100 : 100 + 300]
    assert np.abs(clean.y - inner).max() < 2e-3 * np.abs(inner).max()


@pytest.mark.parametrize("name", ["a", "e"])
def test_faulty_records_have_the_named_fault(name: str) -> None:
    good, _ = faults.make_faulty_record("none", name, 0)
    late, _ = faults.make_faulty_record("one sample late", name, 0)
    clipped, _ = faults.make_faulty_record("output clipped", name, 0)
    noisy, _ = faults.make_faulty_record("input noise of 5 %", name, 0)
    bench = good.bench
    quiet = replace(bench, process_noise=0.0, sensor_noise=0.0)
    assert simulate_record(quiet, 0, extra_delay=1).y[1:] == pytest.approx(
        simulate_record(quiet, 0).y[:-1], abs=1e-6 * bench.output_range
    )
    assert np.array_equal(late.u, good.u)
    assert (np.abs(clipped.y) == np.abs(clipped.y).max()).sum() > 5
    assert (noisy.u - good.u).std() == pytest.approx(0.05 * good.u.std(), rel=0.1)
    stiff, _ = faults.make_faulty_record("quintic stiffness", name, 0)
    peak = np.abs(good.states[:, 0]).max()
    assert stiff.bench.quintic * peak**5 == pytest.approx(0.2 * bench.truth[3] * peak**3)
    assert faults.make_faulty_record("step twice too long", name, 0)[1] == {"step": 2 * bench.step}
    weak = np.array([faults.make_faulty_record("b not excited", name, seed)[0].cramer_rao_stds for seed in range(20)])
    assert weak[:, 3].min() > 0.5
    assert weak[:, :3].max() < 0.2


def outcome(error: float = 0.001, inside: bool = True, bound: float = 0.001, **warnings: str) -> TrialOutcome:
    return TrialOutcome([error] * 4, [bound] * 4, [inside] * 4, [bound] * 4, warnings)


def test_the_verdict_of_accuracy(capsys: pytest.CaptureFixture[str]) -> None:
    def verdict(errors: float, covered: int, bound: float = 0.001) -> dict[str, object]:
        return print_report(
            [BenchmarkCell(DESK_BENCH, "guess", [outcome(errors, i < covered, bound) for i in range(200)])]
        )

    assert verdict(0.0029, 180) == {"accurate": True, "calibrated": True, "pooled coverage": 0.9, "cells outside": 0}
    assert not verdict(0.0031, 180)["accurate"]
    assert verdict(0.0119, 180, bound=0.01)["accurate"]
    assert not verdict(0.0121, 180, bound=0.01)["accurate"]
    assert not verdict(0.001, 172)["calibrated"]
    assert not verdict(0.001, 188)["calibrated"]
    assert "MISS: median errors" in capsys.readouterr().out


def test_binomial_intervals() -> None:
    low, high = binomial_interval(0, 100)
    assert low == 0
    assert high == pytest.approx(1 - 0.0005**0.01)  # no success with this probability at a chance of 0.0005
    # Of one cell, .80 of 200 may still be .85; .75 may not.
    assert judge_coverage([160, 200, 150], [200, 200, 200])[1] == [True, False, False]


def test_the_verdicts_of_faults() -> None:
    records = [outcome(delay="")] * 95 + [outcome()] * 5
    assert faults.passes_bar("one sample late", faults.detection_rate("one sample late", records))
    assert not faults.passes_bar("one sample late", faults.detection_rate("one sample late", [*records, outcome()]))
    assert faults.passes_bar("none", faults.detection_rate("none", [outcome()] * 95 + [outcome(offset="")] * 5))
    assert not faults.passes_bar("none", faults.detection_rate("none", records))


def test_the_sweep_reads_the_verdict_on_each_parameter() -> None:
    left = "not identified by this input; the records leave more than a third of it open"
    trial = outcome(bound=2.0, not_identified=f"c, b: {left}")
    assert sampling_sweep.is_said_open([trial]) == ([False, True, False, True], [])
    wrong = outcome(bound=0.01, not_identified=f"b: {left}")
    assert sampling_sweep.is_said_open([wrong]) == ([], [False, False, False, True])


def test_the_sweep_spans_its_rates() -> None:
    for rate in (6, 800):
        assert sampling_sweep.bench_with_sampling(rate, 0.5).samples_per_period == pytest.approx(rate)


def test_ratios_are_geometric_means() -> None:
    assert peer_comparison.error_ratio([[1.0, 4.0]], [[2.0, 2.0]]) == pytest.approx((1.0, 1.0))
    assert peer_comparison.error_ratio([[1.0, 4.0]], [[np.nan, 2.0]]) == pytest.approx((2.0, 1.0))
    assert np.isnan(peer_comparison.error_ratio([[1.0]], [[np.nan]])).all()
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        mean, factor = peer_comparison.error_ratio(*rng.lognormal([[[0.1]], [[0.0]]], 0.5, (2, 100, 4)))
        inside += mean / factor < np.exp(0.1) < mean * factor
    assert 0.89 * 200 < inside < 200


def test_user_code_for_identify_is_short() -> None:
    assert peer_comparison.count_statements(peer_comparison.ours) == 2


@pytest.mark.parametrize(
    ("name", "shipped"),
    [
        ("board", "electronic-duffing"),
        ("board-v", "electronic-duffing-velocity"),
        ("wells", "electronic-duffing-two-wells"),
        ("beam", "beam"),
    ],
)
def test_it_simulates_the_rigs_that_ship(name: str, shipped: str) -> None:
    bench, rig = BENCHES[name], Rig.shipped(shipped)
    assert (rig.step, rig.interpolation, rig.input.limit) == (bench.step, bench.interpolation, bench.limit)
    assert (rig.input.unit, rig.output.unit, rig.output.kind) == (*bench.units, bench.kind)
    assert rig.output.range is not None
    assert rig.output.range >= bench.output_range
    assert rig.guess is not None
    for parameter, truth in zip("mcab", bench.truth, strict=True):
        low, high = rig.guess[parameter]
        assert low < truth < high
