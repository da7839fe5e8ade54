"""`identify`: from records to parameters with intervals, and to warnings. benchmarks/rigs judges it on many rigs."""

import re
from dataclasses import replace

import numpy as np
import pytest

from estimator import Channel, Rig, identify
from estimator.free_run import free_run
from estimator.identification.fit import Hypothesis
from estimator.identification.motions import motions
from estimator.identification.problem import LATEST, Problem, explicable
from estimator.identification.records import clipped, read, records_of
from estimator.models.duffing import KINDS, duffing
from estimator.physical import coefficients_of
from estimator.units import Scales

#: A bench of 0.4 kg at 1 kHz, and a softening oscillator at 100 Hz: truth, step, amplitude, sensor noise, and samples
#: that the input is held for.
BENCH = ({"m": 0.4, "c": 0.6, "a": 2500.0, "b": 4e7}, 1e-3, 6.0, 5e-6, 8)
SOFT = ({"m": 1.0, "c": 0.5, "a": 400.0, "b": -4000.0}, 1e-2, 6.0, 1e-4, 4)


def simulated(case, seed=0, samples=2048, kind="displacement", force=3e-3):
    """Input and output of a record that begins at rest, with the force disturbed by so many parts of the input.

    The plant is the engine's, without what the benchmark's own integrator is for.
    """
    truth, step, amplitude, noise, hold = case
    rng = np.random.default_rng(seed)
    u = amplitude * np.repeat(rng.choice([-1.0, 1.0], samples // hold), hold)
    model = duffing(offsets=True, sensor=kind)
    scales = Scales(step, amplitude, 1e-2, KINDS[kind])
    known = {p: truth.get(p, 0.0) for p in model.physical}
    disturbed = u / amplitude + force * rng.standard_normal(samples)
    y = scales.output * free_run(model, coefficients_of(model, known, scales), disturbed)
    y = np.concatenate([[0.0], y[:-1]])
    sensor = noise if kind == "displacement" else 2e-3 * y.std()
    return u, y + sensor * rng.standard_normal(samples)


def rig_of(case, kind="displacement", **others):
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}[kind]
    return Rig(case[1], input=Channel("N"), output=Channel(unit, kind=kind), **others)


def deviations(result, truth):
    return np.array([(result.parameters[p][0] - truth[p]) / result.parameters[p][1] for p in truth])


@pytest.mark.parametrize(("case", "kind"), [(BENCH, "displacement"), (SOFT, "displacement"), (SOFT, "velocity")])
def test_nothing_but_a_record_and_a_step_is_needed(case, kind):
    result = identify(rig_of(case, kind), simulated(case, kind=kind))
    assert np.abs(deviations(result, case[0])).max() < 4.5
    assert all(std < 0.01 * abs(case[0][name]) for name, (_, std) in list(result.parameters.items())[:4])
    assert result.warnings == ()
    assert result.units["m"] == "kg"
    low, high = result.interval(0.9)["m"]
    mean, std = result.parameters["m"]
    assert (low, high) == pytest.approx((mean - 1.645 * std, mean + 1.645 * std), rel=1e-3)


def test_a_guess_changes_nothing_that_the_record_tells():
    u, y = simulated(BENCH)
    guess = {name: tuple(sorted((0.7 * value, 1.4 * value))) for name, value in BENCH[0].items()}
    guessed, alone = identify(rig_of(BENCH, guess=guess), (u, y)), identify(rig_of(BENCH), (u, y))
    for name in BENCH[0]:  # the guess's own pull is a thousandth of a standard deviation
        mean, std = alone.parameters[name]
        assert guessed.parameters[name] == pytest.approx((mean, std), abs=0.02 * std)


def test_a_force_that_nothing_disturbs_makes_no_interval_too_narrow():
    result = identify(rig_of(BENCH), simulated(BENCH, samples=512, force=0.0))
    assert np.abs(deviations(result, BENCH[0])).max() < 4.5
    assert result.noises["input"][1] > 0.1 * result.noises["input"][0]


def test_motions_that_are_fast_for_the_sampling_are_integrated_in_finer_steps():
    from scipy.integrate import solve_ivp

    rng = np.random.default_rng(0)
    step, u, states = 0.0132, 20.0 * rng.choice([-1.0, 1.0], 800), [np.zeros(2)]  # s, N; 6 samples in a small period
    for force in u[:-1]:
        change = lambda t, s, f=force: (s[1], (f - 0.6 * s[1] - 2500.0 * s[0] - 4e7 * s[0] ** 3) / 0.4)  # noqa: E731
        states.append(solve_ivp(change, (0, step), states[-1], method="DOP853", rtol=1e-10, atol=1e-14).y[:, -1])
    y = np.array(states)[:, 0] + 5e-6 * rng.standard_normal(800)
    result = identify(Rig(step, input=Channel("N"), output=Channel("m")), (u, y))
    assert np.abs(deviations(result, BENCH[0])).max() < 4.5
    assert result.belief.model.substeps > Rig(step).model.substeps


def test_noises_are_found():
    result = identify(rig_of(BENCH), simulated(BENCH))
    for name, truth in (("output", 5e-6), ("input", 3e-3 * 6.0)):
        mean, std = result.noises[name]
        assert abs(mean - truth) < 5 * std + 0.1 * truth


def test_gaps_clipped_samples_and_several_records():
    u, y = simulated(BENCH)
    holes = y.copy()
    holes[300:330] = np.nan
    driven = u.copy()
    driven[1000] = np.nan
    stop = 0.7 * np.abs(y).max()
    result = identify(rig_of(BENCH), [(u, holes), (driven, y), (u, np.clip(y, -stop, stop))])
    assert [one.missing for one in result.records] == [30, 0, 0, 0]
    assert [len(one.y) for one in result.records] == [2048, 1000, 1047, 2048]
    assert [one.name for one in result.records] == ["record 0", "record 1", "record 1, from sample 1001", "record 2"]
    assert result.records[3].clipped == (np.abs(y) >= stop).sum()
    assert [warning.name for warning in result.warnings] == ["clipped"]
    assert np.abs(deviations(result, BENCH[0])).max() < 5


@pytest.mark.parametrize("kind", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("delay", [0, 2])
def test_records_may_begin_in_any_motion(kind, delay):
    u, y = simulated(SOFT, kind=kind)
    told = np.roll(u, -delay)  # recorded so many samples before it acts
    places = np.arange(100, 1900, 150)
    pieces = [(told[k : k + 140], y[k : k + 140]) for k in places]
    result = identify(rig_of(SOFT, kind, delay=delay), pieces)
    assert np.abs(deviations(result, SOFT[0])).max() < 4.5
    assert all(std < 0.02 * abs(SOFT[0][name]) for name, (_, std) in list(result.parameters.items())[:4])
    assert result.warnings == ()


@pytest.mark.parametrize("kind", KINDS)
def test_the_motion_before_each_record_is_found(kind):
    truth, step, amplitude, _, hold = SOFT
    places = np.array([200, 501, 777])
    u = amplitude * np.repeat(np.random.default_rng(3).choice([-1.0, 1.0], 1000 // hold), hold)
    u[places - 1] = 0.0  # a record does not tell what acts while its first output comes about
    shown = {}
    for sensor in ("displacement", "velocity", kind):
        scales = Scales(step, amplitude, 1e-2, KINDS[sensor])
        model = duffing(offsets=True, sensor=sensor)
        known = coefficients_of(model, {p: truth.get(p, 0.0) for p in model.physical}, scales)
        shown[sensor] = np.concatenate([[0.0], free_run(model, known, u / amplitude)[:-1]])
    # Velocities inside are by the sample, of displacements in their own scale.
    unit = Scales(step, amplitude, 1e-2).displacement / scales.displacement
    v = shown["velocity"] * Scales(step, amplitude, 1e-2, 1).displacement / scales.displacement
    rig = rig_of(SOFT, kind)
    pieces = [slice(k, k + 100) for k in places]
    problem = Problem(
        rig, scales, tuple(u[p] / amplitude for p in pieces), tuple(explicable(shown[kind][p], rig) for p in pieces), 4
    )
    assert problem.model.digest == replace(model, substeps=4).digest
    level = 1e-4 * np.abs(shown[kind]).max()
    found = motions(problem, Hypothesis("zero_order", 0, 0.1), known, level)
    size = np.array([np.abs(unit * shown["displacement"]).max(), np.abs(v).max()])
    expected = np.stack([unit * shown["displacement"][places - 1], v[places - 1]], axis=1)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-3)


def test_a_converter_s_levels_are_no_stop():
    _, y = simulated(BENCH)
    level = np.abs(y).max() / 100
    assert not clipped(level * np.round(y / level)).any()
    assert not clipped(np.concatenate([np.full(100, y.min()), y])).any()


def test_a_stop_that_single_samples_meet_is_found():
    rng = np.random.default_rng(0)
    y = np.sin(2.2 * np.arange(500)) + 0.01 * rng.standard_normal(500)
    assert np.array_equal(clipped(np.minimum(y, 0.98)), y >= 0.98)
    assert np.diff(np.flatnonzero(y >= 0.98)).min() > 1
    assert not clipped(y).any()


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda u, y: (np.roll(u, -1), y), "delay"),
        (lambda u, y: (np.convolve(u, [0.5, 0.5])[: len(u)], y), "interpolation"),
        (lambda u, y: (u * (1 + 0.07 * np.random.default_rng(0).standard_normal(len(u))), y), "process_noise"),
    ],
)
def test_faults_are_named(change, name):
    result = identify(rig_of(BENCH), change(*simulated(BENCH)))
    assert name in [warning.name for warning in result.warnings]


def test_a_wrong_step_and_a_parameter_that_does_nothing_are_named():
    u, y = simulated(BENCH)
    guess = {name: tuple(sorted((0.7 * value, 1.4 * value))) for name, value in BENCH[0].items()}
    for factor in (0.5, 2):
        wrong = Rig(factor * BENCH[1], input=Channel("N"), output=Channel("m"), guess=guess)
        assert "step" in [warning.name for warning in identify(wrong, (u, y)).warnings]
    weak = (BENCH[0], BENCH[1], 0.05, 5e-6, 8)
    for known in (None, guess):
        warnings = identify(rig_of(weak, guess=known), simulated(weak)).warnings
        told = [warning.message for warning in warnings if warning.name == "not_identified"]
        assert [message.split(":")[0] for message in told] == ["b"]
        assert "the spring is linear to" in told[0]


def test_a_bench_s_own_disturbance_is_no_fault_of_a_weak_input():
    weak = (BENCH[0], BENCH[1], 0.05, 5e-6, 8)
    records = simulated(weak, force=0.1)
    for limit, names in ((None, {"not_identified", "process_noise"}), (6.0, {"not_identified"})):
        rig = Rig(BENCH[1], input=Channel("N", limit=limit), output=Channel("m"))
        assert {warning.name for warning in identify(rig, records).warnings} == names


def test_the_result_goes_on(tmp_path):
    u, y = simulated(BENCH)
    result = identify(rig_of(BENCH), (u, y))
    run = result.simulate(u, y[:20])
    assert np.abs(run - y)[:200].max() < 0.02 * np.abs(y).max()
    forecast = result.forecasts[0]
    inside = np.abs(y - forecast[:, 0])[5:] < 1.645 * np.sqrt(forecast[5:, 1])
    assert 0.87 < inside.mean() < 0.93
    counts, told = zip(*result.history, strict=True)
    assert counts == tuple(count - LATEST for count in (64, 128, 256, 512, 1024, 2048))
    assert told[-1] == result.parameters
    for name in BENCH[0]:
        stds = np.array([one[name][1] for one in told])
        assert (stds[1:] < stds[:-1]).all()
        away = np.array([one[name][0] for one in told]) - BENCH[0][name]
        assert (np.abs(away) < 4.5 * stds).all()
    before = result.parameters["m"][1]
    estimator = result.estimator
    estimator.run(*simulated(BENCH, seed=1))
    assert estimator.belief.parameters()["m"][1] < before
    page = result.report(tmp_path / "folder" / "page.html", ["made <by> this"]).read_text()
    assert "made &lt;by&gt; this" in page
    assert "2048 samples in 2.048 s; the first 1500 are shown." in page
    assert page.count("<svg") == 3
    assert "No check speaks against" in page
    assert "http" not in page.replace("http://www.w3.org", "").replace("https://matplotlib.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")


def test_files(tmp_path):
    u, y = simulated(SOFT, samples=400)
    lines = [f"{k * 0.01:.6f},{a},{b}" for k, (a, b) in enumerate(zip(u, y, strict=True))]
    plain, named = tmp_path / "plain.csv", tmp_path / "named.csv"
    plain.write_text("\n".join(lines))
    lines[7] = lines[7].rsplit(",", 1)[0] + ","
    named.write_text("# a comment\nTime [s],Force [N],Displacement [m]\n" + "\n".join(lines) + "\n")
    one, other = records_of([plain, str(named)], 0.01)
    np.testing.assert_array_equal(one.u, u)
    assert (one.missing, other.missing) == (0, 1)
    from scipy.io import savemat

    savemat(tmp_path / "r.mat", {"u": u, "y": y})
    np.testing.assert_array_equal(records_of(tmp_path / "r.mat", 0.01)[0].y, y)
    whole = bytearray((tmp_path / "r.mat").read_bytes())
    whole[176] ^= 1  # an unknown kind of number, of which SciPy's reader dies
    (tmp_path / "r.mat").write_bytes(whole)
    with pytest.raises(ValueError, match=r"r\.mat must be a sound MAT file .*, but is not: the reader died"):
        records_of(tmp_path / "r.mat", 0.01)
    (tmp_path / "r.mat").write_bytes(b"none")
    with pytest.raises(ValueError, match=r"r\.mat must be a sound MAT file"):
        records_of(tmp_path / "r.mat", 0.01)


@pytest.mark.parametrize(
    "text",
    [
        "u;y\n0,5;1\n1,5;-2e-1\n;3\n",
        "\ufeffu\ty\n0.5\t1\n\n1.5\t-0.2\n\t3\n",
        "# written by a tool, with; signs\n0.5 1\n  1.5   -0.2 \nnan 3\n",
        "response [mm], time [ms], force [N]\n1, 10, 0.5\n-0.2, 20, 1.5\n3, 30, \n",
    ],
)
def test_tables_as_programs_write_them(tmp_path, text):
    (tmp_path / "r.csv").write_text(text, encoding="utf-8")
    u, y = read(tmp_path / "r.csv", 0.01)
    np.testing.assert_array_equal(u, [0.5, 1.5, np.nan])
    np.testing.assert_array_equal(y, [1.0, -0.2, 3.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("u,y\n1,2\n3", "line 3: must have 2 columns, but has 1"),
        ("u,y\n1,2\n3,x4", "line 3: 'x4' must be a number"),
        ("a_column,b_column\n1,2", "must have one column of inputs and one of outputs"),
        ("1,2,3,4\n1,2,3,4", "must have two columns, u and y"),
        ("t,u,y\n0,1,2\n0.5,1,3\n1.0,2,3\n", "times are 0.5 s apart, but the rig's step is 0.01 s"),
        ("t,u,y\n0,1,2\n0.01,1,3\n0.5,2,3\n", "samples must be evenly spaced"),
        ("t [days],u,y\n0,1,2\n1,1,3\n", "times must be in one of s, ms, us,"),
        ("", "must hold numbers, but holds none"),
    ],
)
def test_errors_of_files_name_the_line(tmp_path, text, message):
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        records_of(tmp_path / "r.csv", 0.01)
    assert "r.csv" in str(error.value)


@pytest.mark.parametrize(
    ("records", "message"),
    [
        ([], "records must hold at least one pair"),
        (3, "records must be a list of pairs"),
        ([3], "record 0 must be a pair (u, y) or a file name, but is 3"),
        ([(np.ones(100), np.ones(99))], "u and y of record 0 must have one length, but have 100 and 99"),
        ([(np.ones(20), np.arange(20.0))], "records must have at least 50 outputs"),
        ([(np.ones(100), np.arange(100.0))], "u must vary, but is constant"),
        ([(np.full(100, np.inf), np.arange(100.0))], "u of record 0 must be finite"),
    ],
)
def test_errors_name_the_record(records, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        identify(rig_of(BENCH), records)
