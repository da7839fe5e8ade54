"""The next experiment as a signal: within the limits, as informative as stated, and readable again."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from loopback import RIG, RIG_FILE, TRUTH
from tables import table

from agents.commands import main
from agents.hardware.clock import JumpingClock
from agents.hardware.experiment_run import run_experiment
from agents.hardware.next_experiment import design_experiment
from agents.hardware.run_settings import RunSettings
from agents.hardware.simulated_plant import SimulatedPlant
from agents.hardware.simulated_plant import plant as simulated
from agents.planning.open_loop.posterior_samples import equilibria
from estimator import OnlineEstimator, identify, load_estimator, save_estimator
from estimator.identification.data.text_tables import read_table
from estimator.identification.fitting.posterior_belief import disturbance_std
from estimator.models.duffing import duffing


@pytest.fixture(scope="module")
def designed():
    """Policy to its design of 64 samples; the planner refines 4 noise candidates instead of 14."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.hardware.next_experiment._MAX_NOISE_STARTS", 4)
        return {
            policy: design_experiment(RIG, policy=policy, samples=64) for policy in ("prbs", "efe", "velocity-sign")
        }


@pytest.mark.parametrize("policy", ["prbs", "efe", "velocity-sign"])
def test_deviations_after_an_experiment_equal_the_expected_ones(policy, designed):
    found = designed[policy]
    assert np.abs(found.u).max() <= RIG.input.limit
    assert found.exit_probability < 0.05
    plant = SimulatedPlant(RIG, TRUTH, seed=1, clock=JumpingClock())
    plant.arm(None)
    _, y = plant.play(found.u)
    assert np.abs(y).max() < RIG.output.range
    low, median, high = found.output_quantiles
    assert (low < median).all()
    assert (median < high).all()
    assert max(-low.min(), high.max()) < RIG.output.range
    assert 0.6 < np.mean((low < y) & (y < high)) < 1.0
    parameters = identify(RIG, (found.u, y)).parameters
    for name in "mcab":
        # The drawn systems differ by some tens of percent in the information about each parameter.
        assert 0.4 < parameters[name][1] / found.expected_stds[name] < 2.5


def test_the_planner_expects_more_of_its_signal(designed):
    assert designed["efe"].information_gain > designed["prbs"].information_gain


@pytest.mark.parametrize("block", [None, 16])
def test_a_run_of_the_planner_is_that_of_its_seed(block, tmp_path):
    """Here, where the planner is compiled for the rig anyway."""

    def played(name):
        clock = JumpingClock()
        plant = SimulatedPlant(RIG, TRUTH, clock=clock)
        plan = RunSettings(policy="efe", samples=24, block=block)
        assert run_experiment(RIG, plant, tmp_path / name, plan, clock=clock).outcome == "complete"
        with (tmp_path / name / "samples.csv").open() as file:
            return [{**row, "clock": ""} for row in csv.DictReader(file)]

    one = played("one")
    assert one == played("two")
    assert np.ptp([float(row["u"]) for row in one if row["u"]]) > 0


def test_an_oscillator_rests_where_its_forces_are_in_balance():
    model = duffing(offsets=True)
    names = list(model.coefficients)

    def at(**values):
        return sorted(equilibria(model, np.array([values.get(name, 0.0) for name in names])))

    assert at(stiffness=0.1, cubic=1.0) == [0.0]
    np.testing.assert_allclose(at(stiffness=-0.1, cubic=0.4, force=-0.02, output_offset=0.2), [-0.3, 0.7])
    (x,) = at(stiffness=0.1, cubic=1.0, force=0.02, output_offset=0.1)
    assert 0.1 * x + (x - 0.1) ** 3 == pytest.approx(0.02)
    (x,) = at(stiffness=0.1, cubic=-1.0)  # softening: beyond the hilltops it does not rest
    assert x == 0.0


def write_bench(folder):
    """A rig file and a record in a folder."""
    (folder / "rig.toml").write_text(RIG_FILE)
    plant = SimulatedPlant(RIG, TRUTH, clock=JumpingClock())
    plant.arm(None)
    u, y = plant.play(np.repeat(np.random.default_rng(0).choice([-3.0, 3.0], 16), 8))
    np.savetxt(folder / "record.csv", np.column_stack([u, y]), delimiter=",", header="u,y", comments="")


def test_the_command_goes_on_from_what_identify_saved(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_bench(tmp_path)
    main(["identify", "rig.toml", "record.csv", "--save", "posterior.npz"])
    capsys.readouterr()
    main(
        [
            "design",
            "rig.toml",
            "posterior.npz",
            "--policy",
            "prbs",
            "--samples",
            "64",
            "-o",
            "next.csv",
            "--figure",
            "next.png",
        ]
    )
    printed = capsys.readouterr().out
    assert "narrower" in printed
    assert "kg" in printed
    assert "The picture is next.png" in printed
    assert (tmp_path / "next.png").read_bytes().startswith(b"\x89PNG")
    found = design_experiment(RIG, load_estimator("posterior.npz").belief, "prbs", 64)
    written = np.loadtxt("next.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(written[:, 1], found.u, rtol=1e-9)
    lines = (tmp_path / "next.csv").read_text().splitlines()
    ends = [",displacement [m]", *(",0.001" for _ in lines[1:])]
    (tmp_path / "answer.csv").write_text("\n".join(line + end for line, end in zip(lines, ends, strict=True)))
    table = read_table(tmp_path / "answer.csv")
    assert (table.step(), table.unit(table.input_column)) == (pytest.approx(RIG.step), "N")
    np.testing.assert_allclose(table.columns[table.input_column], found.u, rtol=1e-9)


@table(
    ("words", "message"),
    [
        (["design", "rig.toml", "-o", "rig.toml"], "output must be a separate file, but is rig.toml, and it is read"),
        (
            ["design", "rig.toml", "-o", "a.png", "--figure", "./a.png"],
            "figure must be .* and so is output; name another",
        ),
        (
            ["design", "rig.toml", "-o", "timed.csv"],
            "-o/--output must be a new file, but there is timed.csv; name another",
        ),
        (["design", "rig.toml", "--figure", "timed.csv"], "--figure must be a new file, but there is timed.csv"),
        (["export", "prbs", "-o", "timed.csv"], "-o/--output must be a new file, but there is timed.csv; name another"),
        (["design", "rig.toml", "--figure", "a.pdf"], "figure must be a PNG file, but is a.pdf"),
        (["design", "rig.toml", "--policy", "efe-block-16"], "policy must be 'efe' here, but is 'efe-block-16'"),
        (
            ["identify", "rig.toml", "record.csv", "--save", "record.csv"],
            "save must be .* is record.csv, and it is read",
        ),
        (["identify", "rig.toml", "record.csv", "--save", "a", "--report", "a"], "report must be .* and so is save"),
        (
            ["rig", "init", "new.toml", "--from", "timed.csv", "--step", "0.1"],
            "timed.csv: times are 0.02 s apart, but the step is 0.1",
        ),
    ],
)
def test_no_file_is_lost(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    write_bench(tmp_path)
    times = "".join(f"{0.02 * k:.2f},1,2\n" for k in range(9))
    (tmp_path / "timed.csv").write_text(f"time [s],u,y\n{times}")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == 2
    assert re.search(message, capsys.readouterr().err)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_column_that_the_rig_names_has_its_unit(tmp_path):
    rig = replace(RIG, input=replace(RIG.input, column="Kraft"))
    path = tmp_path / "next.csv"
    design_experiment(rig, policy="prbs", samples=16).write(path)
    head, *rows = path.read_text().splitlines()
    assert head == "time [s],Kraft [N]"
    path.write_text("\n".join([f"{head},displacement [m]", *(f"{row},0" for row in rows)]))
    table = read_table(path, "Kraft")
    assert table.unit(table.input_column) == "N"


def test_a_constant_signal_is_reported(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text(RIG_FILE)
    for policy in ("prbs-8", "prbs"):
        main(["design", str(tmp_path / "rig.toml"), "--policy", policy, "--samples", "16"])
        assert ("every input is the same: prbs-8 holds" in capsys.readouterr().err) == (policy == "prbs-8")


def test_too_few_samples_in_a_period_are_reported(tmp_path, capsys):
    (tmp_path / "fast.toml").write_text(RIG_FILE)
    (tmp_path / "slow.toml").write_text(RIG_FILE.replace("step = 0.02", "step = 0.3"))
    for name in ("fast", "slow"):
        main(["design", str(tmp_path / f"{name}.toml"), "--policy", "prbs", "--samples", "16"])
        messages = capsys.readouterr().err
        assert ("has 1.7 samples in a period; sample faster" in messages) == (name == "slow")
    # a = 110 to 180 N/m on about 1 kg: a period of 0.5 s.
    assert design_experiment(RIG, policy="prbs", samples=16).samples_per_period == pytest.approx(26, abs=1)


@table("step", [1.0, 3.0])
def test_a_step_that_is_too_long_for_the_motion_is_refused(step):
    with pytest.raises(ValueError, match=r"step must be at most 1/5 of a period, .* sample faster, 6 at least"):
        design_experiment(replace(RIG, step=step), policy="prbs", samples=64)


def test_what_identify_saves_outlives_a_pipe_that_closes_early(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_bench(tmp_path)

    def show(result):
        raise BrokenPipeError

    monkeypatch.setattr("agents.commands.identify_command.print_identification", show)
    with pytest.raises((BrokenPipeError, SystemExit)):
        main(["identify", "rig.toml", "record.csv", "--save", "posterior.npz"])
    mean, std, _ = load_estimator("posterior.npz").belief.parameters()["m"]
    assert abs(mean - TRUTH["m"]) < 5 * std


def test_a_run_goes_on_from_a_posterior(tmp_path, monkeypatch, jumping_clock):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(RIG_FILE.partition("[guess]")[0])
    plant = SimulatedPlant(RIG, TRUTH, clock=JumpingClock())
    plant.arm(None)
    u, y = plant.play(np.repeat(np.random.default_rng(0).choice([-3.0, 3.0], 16), 8))
    known = identify(RIG, (u, y))
    save_estimator(OnlineEstimator(known.belief.model, known.belief, RIG), tmp_path / "posterior.npz")
    factory = "from loopback import RIG, TRUTH\nfrom agents.hardware.simulated_plant import SimulatedPlant\n"
    (tmp_path / "lab.py").write_text(factory + "def plant(rig, **_):\n    return SimulatedPlant(rig, TRUTH, seed=1)\n")
    monkeypatch.syspath_prepend(tmp_path)
    arguments = ["--plant", "lab:plant", "--policy", "prbs", "--samples", "48", "--block", "24", "--out", "next"]
    with pytest.raises(SystemExit) as left:
        main(["run", "rig.toml", "posterior.npz", *arguments])
    assert left.value.code == 0
    parameters = json.loads((tmp_path / "next" / "parameters.json").read_text())
    assert json.loads((tmp_path / "next" / "manifest.json").read_text())["message"] == ""
    assert parameters["m"]["std"] < 0.9 * known.parameters["m"][1]
    assert abs(parameters["m"]["mean"] - TRUTH["m"]) < 4 * parameters["m"]["std"]


@pytest.mark.parametrize("block", [None, 64])
def test_a_run_goes_on_from_one_that_ended_in_motion(tmp_path, block):
    """The estimator of a run by samples knows the state to a thousandth; nobody knows what it became since."""

    def played(name, samples, **more):
        clock = JumpingClock()
        plant = SimulatedPlant(RIG, TRUTH, seed=samples, clock=clock)
        settings = RunSettings(policy="prbs", samples=samples, **more.pop("plan", {}))
        return run_experiment(RIG, plant, tmp_path / name, settings, clock=clock, **more)

    first = played("first", 200)
    known = load_estimator(first.folder / "estimator.npz").belief
    assert np.abs(known.state_mean[0]) > 10 * np.sqrt(known.state_cov[0, 0]), "as where an input drove it"
    last = played("next", 128, prior=known, plan={"block": block})
    assert (last.outcome, last.message) == ("complete", "")
    assert 0.5 < disturbance_std(last.belief) / RIG.input.noise < 2.0
    for name, (mean, std) in last.parameters.items():
        assert std < 1.02 * first.parameters[name][1], name
        assert abs(mean - TRUTH.get(name, 0.0)) < 4 * std, name


@pytest.mark.parametrize("block", [None, 64])
def test_a_posterior_that_the_plant_contradicts_is_reported(tmp_path, block):
    plant = SimulatedPlant(RIG, TRUTH, clock=JumpingClock())
    plant.arm(None)
    u, y = plant.play(np.repeat(np.random.default_rng(0).choice([-3.0, 3.0], 32), 8))
    known, said = identify(RIG, (u, y)).belief, {}
    for stiffness in (TRUTH["a"], 1.1 * TRUTH["a"]):
        clock = JumpingClock()
        plant = SimulatedPlant(RIG, TRUTH | {"a": stiffness}, clock=clock)
        plan = RunSettings(policy="prbs", samples=128, block=block)
        said[stiffness] = run_experiment(RIG, plant, tmp_path / f"{stiffness}", plan, prior=known, clock=clock).message
    right, wrong = said.values()
    assert right == ""
    assert "the prior is wrong: identify" in wrong


def test_the_instruments_table_gives_the_true_parameters(tmp_path):
    assert simulated(replace(RIG, guess=None), truth=TRUTH).truth == TRUTH
    with pytest.raises(ValueError, match="truth must give m, c, a and b"):
        simulated(RIG, truth={"a": 1.0})
    with pytest.raises(ValueError, match=r"add one, or truth = \{ m"):
        simulated(replace(RIG, guess=None))


@table(
    ("given", "message"),
    [
        ({"samples": 4}, "samples must be"),
        ({"bound": 1.0}, "bound must be"),
        ({"policy": "prsb"}, "did you mean 'prbs'"),
        ({"rig": replace(RIG, guess=None)}, "rig must have a guess"),
        ({"rig": replace(RIG, input=replace(RIG.input, limit=None))}, "rig must have input.limit"),
        ({"rig": replace(RIG, output=replace(RIG.output, range=1e-5))}, "even without input"),
    ],
)
def test_impossible_experiments_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        design_experiment(**{"rig": RIG, "policy": "prbs", **given})
