"""Runs on simulated plants: sessions, beliefs, designs, the record, and the command."""

import csv
import json
import math
import re
import signal
from contextlib import nullcontext
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from loopback import RIG, RIG_FILE, TRUTH
from scipy.stats import binomtest
from tables import table

import duffing_env  # noqa: F401
from agents import make_policy
from agents.commands import main
from agents.hardware.clock import JumpingClock
from agents.hardware.env_view import EnvView
from agents.hardware.experiment_run import RunSettings, run_experiment
from agents.hardware.plant_interface import load_plant
from agents.hardware.run_estimator import RunEstimator
from agents.hardware.safety_session import SafetyStop, Session
from agents.hardware.simulated_plant import SimulatedPlant
from agents.planning.open_loop.posterior_samples import MonteCarloSystems
from agents.policies.signals import hold_for_resonance
from estimator import Channel, OnlineEstimator, Rig, identify
from estimator.identification.fitting.posterior_belief import refit_coefficients
from estimator.inference.free_run import free_run
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT


class Bench(SimulatedPlant):
    """A simulated plant that records its calls, and can be made to fail."""

    def __init__(self, **options):
        super().__init__(RIG, TRUTH, **{"clock": JumpingClock(), **options})
        self.calls, self.reads, self.fault = [], 0, None

    def arm(self, watchdog):
        self.calls.append(("arm", watchdog))
        super().arm(watchdog)

    def apply(self, u):
        self.calls.append(("apply", u))
        return super().apply(u)

    def read(self):
        self.reads += 1
        value = super().read()
        return value if self.fault is None else self.fault(self.reads, value)

    def disarm(self):
        self.calls.append(("disarm",))
        super().disarm()


def nothing(*arguments, **details):
    pass


def play(folder, plant=None, rig=RIG, **plan):
    plant = plant or Bench()
    return run_experiment(
        rig, plant, folder, RunSettings(**{"policy": "prbs", "samples": 40, **plan}), clock=plant.clock
    )


def rows(folder):
    with (folder / "samples.csv").open() as file:
        return list(csv.DictReader(file))


def events(folder):
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


# --- sessions


def test_a_session_clamps_and_returns_the_applied_input():
    plant = Bench()
    with Session(plant, RIG, nothing, 2.0) as session:
        assert session.apply(1.0) == 0.0, "it starts disarmed"
        session.arm()
        assert session.apply(100.0) == 4.0
        assert session.apply(-100.0) == -4.0
        with pytest.raises(ValueError, match="input must be finite"):
            session.apply(math.nan)
    assert plant.calls[1] == ("arm", 2.0)
    assert plant.calls[-1] == ("disarm",)
    assert plant.applied == 0.0


@table("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_the_input_is_zero_after_any_exit(error):
    plant = Bench()

    def fails():
        with Session(plant, RIG, nothing, 2.0) as session:
            session.arm()
            session.apply(3.0)
            assert plant.applied == 3.0
            raise error

    with pytest.raises(error):
        fails()
    assert plant.applied == 0.0
    assert not plant._armed


def test_disarming_goes_on_where_zeroing_fails():
    plant, noted = Bench(), []
    plant.zero = lambda: 1 / 0
    plant.disarm = lambda: noted.append("disarm")
    with Session(plant, RIG, lambda event, **details: noted.append((event, details)), None) as session:
        session.arm()
    assert "disarm" in noted
    assert "NOBODY DID" in noted[-1][1]["message"]


@pytest.mark.parametrize("method", ["zero", "disarm"])
@table("ended", ["zero", "range", "error"])
def test_an_input_that_could_not_be_zeroed_is_reported_on_stderr(method, ended, tmp_path, capsys):
    plant = Bench()
    plant.fault = lambda k, y: 0.09 if k == 20 and ended == "range" else y
    setattr(plant, method, lambda: 1 / 0)
    plan = RunSettings(policy="prbs", samples=16, no_watchdog=True)
    options = {"on_progress": lambda samples: {}["a bug"]} if ended == "error" else {}
    with pytest.raises(KeyError) if options else nullcontext():
        result = run_experiment(RIG, plant, tmp_path / "run", plan, clock=plant.clock, **options)
        assert (result.outcome, result.exit_status) == (ended, 1)
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["how"] == ended
    for said in (capsys.readouterr().err, manifest["message"]):
        assert f"could not be zeroed at the end: {method} failed: ZeroDivisionError" in said
        assert "NOBODY DID: switch it off by hand" in said


def test_trips():
    plant = Bench()
    with Session(plant, RIG, nothing, 2.0, max_stale=5) as session:
        session.check_outputs(np.array([0.08, -0.08]))
        with pytest.raises(SafetyStop, match="beyond its range") as tripped:
            session.check_outputs(np.array([0.01, np.nan, -0.081]))
        assert tripped.value.reason == "range"
        session.check_outputs(np.full(4, np.nan))
        session.check_outputs(np.array([0.01, 0.01, 0.01, 0.01, 0.01]))
        with pytest.raises(SafetyStop, match="again") as tripped:
            session.check_outputs(np.array([0.01, np.nan]))
        assert tripped.value.reason == "stale"
        with (
            pytest.raises(SafetyStop, match=r"^5 outputs in a row were missing$"),
            Session(plant, RIG, nothing, 2.0, max_stale=5) as other,
        ):
            other.check_outputs(np.full(5, np.nan))
        plant.apply = lambda u: 4.1
        with pytest.raises(SafetyStop, match=r"applied 4\.1") as tripped:
            session.apply(1.0)
        assert tripped.value.reason == "input"


@table(
    ("rig", "message"),
    [
        (replace(RIG, input=replace(RIG.input, limit=None)), "rig must have a limit"),
        (replace(RIG, output=replace(RIG.output, range=None)), "rig must have a range"),
        (replace(RIG, guess=None), "rig must have a guess"),
        (replace(RIG, interpolation="linear"), "interpolation must be 'zero_order'"),
        (replace(RIG, delay=-1), "delay must be 0 or more"),
    ],
)
def test_rigs_that_cannot_be_run(rig, message, tmp_path):
    plant = Bench()
    with pytest.raises(ValueError, match=message):
        play(tmp_path / "run", plant, rig)
    assert plant.calls == []
    assert not (tmp_path / "run").exists()


# --- the belief, and the observation of a policy


class Stepped:
    """The plant of an environment."""

    def __init__(self):
        self.x = self.last = 0.0

    def reset(self):
        self.x = self.last = 0.0

    def step(self, u):
        self.x, self.last = 1.9 * self.x - 0.95 * self.last + 1e-3 * u, self.x
        return self.x


def test_a_policy_sees_what_the_environment_shows():
    env = gym.make("duffing_env/Rig-v0", rig=RIG, plant=Stepped(), horizon=40).unwrapped
    env.reset()
    estimator, plant = OnlineEstimator(rig=replace(RIG, delay=-1)), Stepped()
    observed = EnvView(RIG, estimator.belief, 40)
    rng = np.random.default_rng(0)
    for k in range(40):
        action = np.float32(rng.uniform(-1, 1))
        seen, *_ = env.step([action])
        u = 4.0 * float(action)
        y = plant.step(u)
        estimator.update(u, y)
        observed.belief = estimator.belief
        mine = observed.observation(u / 4.0, y / 0.08, k + 1)
        assert mine.dtype == seen.dtype
        np.testing.assert_allclose(mine, seen, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["displacement", "velocity", "acceleration"])
def test_a_missing_output_is_shown_as_what_the_model_expects_of_the_sensor(kind):
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}[kind]
    rig = replace(RIG, output=Channel(unit, range=2.0, kind=kind))
    follower = RunEstimator(rig)
    follower.update([0.0, 3.0, -2.0, 1.0], [0.01, -0.02, 0.05, 0.03])
    observed = EnvView(rig, follower.belief, 40)
    observed.belief, u = follower.predict_ahead(0.5), 0.5
    c = dict(zip(observed.belief.names, observed.belief.coefficients_mean, strict=True))
    x, v = observed.belief.state_mean
    spring = c["gain"] * u + c["force"] - c["damping"] * v - c["stiffness"] * x - c["cubic"] * x**3
    expected = {"displacement": x, "velocity": v + c["output_offset"], "acceleration": spring + c["output_offset"]}
    shown = observed.observation(u, math.nan, 4)
    np.testing.assert_allclose(shown[-3], np.float32(expected[kind]), rtol=1e-6)
    np.testing.assert_array_equal(shown, observed.observation(u, float(expected[kind]), 4))


def test_the_predicted_belief_equals_an_update_with_a_missing_output():
    follower, reference = RunEstimator(RIG), OnlineEstimator(rig=replace(RIG, delay=-1))
    u, y = np.array([0.0, 1.0, -2.0]), np.array([1e-4, 2e-4, 1e-3])
    follower.update(u, y)
    before = follower.belief
    ahead = follower.predict_ahead(3.0)
    assert follower.belief == before
    reference.run(u, y)
    reference.run([3.0], [math.nan], missing=True)
    assert ahead == reference.belief


def test_a_delay_is_predicted_over():
    rig = replace(RIG, delay=2)
    follower = RunEstimator(rig)
    follower.update([0.0, 1.0], [0.0, 0.0])
    assert abs(follower.predict_ahead(0.0).state_mean[0]) > 0, "the input of 1 N, which is on its way, has begun to act"


def test_a_pause_forgets_the_phase_and_keeps_the_rest():
    follower, plant = RunEstimator(RIG), Bench()
    plant.arm(None)
    rng = np.random.default_rng(0)
    u, y = plant.play(np.repeat(rng.choice([-3.0, 3.0], 10), 8))
    follower.update(np.concatenate([[0.0], u[:-1]]), y)
    before = follower.belief
    follower.start_pause(float(u[-1]))
    after = follower.belief
    np.testing.assert_allclose(after.coefficients_mean, before.coefficients_mean)
    np.testing.assert_allclose(after.coefficients_cov, before.coefficients_cov)
    np.testing.assert_array_equal(after.noises, before.noises)
    assert np.diag(after.state_cov)[0] > 100 * np.diag(before.state_cov)[0]
    assert np.sqrt(np.diag(after.state_cov)[0]) < np.abs(y).max() / RIG.scales.output


def two_blocks(follower, plant, seed=0):
    """Inputs and outputs of two blocks after a silent one; the estimator has processed them one by one."""
    rng, played = np.random.default_rng(seed), []
    for size in (0.0, 3.0, 3.0):
        u, y = plant.play(size * np.repeat(rng.choice([-1.0, 1.0], 16), 8))
        follower.update_block(u, y)
        follower.start_pause(float(u[-1]))
        played.append((u, y))
    return played


def test_blocks_together_give_the_coefficients_of_identify():
    follower, plant = RunEstimator(RIG), Bench()
    plant.arm(None)
    played = two_blocks(follower, plant)
    belief, whole = follower.belief, identify(RIG, played).belief
    std = np.sqrt(np.diag(whole.coefficients_cov))
    # identify leaves out the first three outputs of each block, in case the input comes later than is thought.
    np.testing.assert_allclose(belief.coefficients_mean / std, whole.coefficients_mean / std, rtol=0.0, atol=0.3)
    np.testing.assert_allclose(np.sqrt(np.diag(belief.coefficients_cov)), std, rtol=0.05)
    for name, (mean, deviation, _) in belief.parameters().items():
        assert abs(mean - TRUTH.get(name, 0.0)) < 4 * deviation, name


def test_where_a_fit_of_all_blocks_begins_does_not_matter():
    follower, plant = RunEstimator(RIG), Bench()
    plant.arm(None)
    played, prior = two_blocks(follower, plant), RunEstimator(RIG).belief
    first, second = (
        refit_coefficients(RIG, played, prior, near) for near in (follower.belief, identify(RIG, played).belief)
    )
    std = np.sqrt(np.diag(first[1]))
    np.testing.assert_allclose(first[0] / std, second[0] / std, atol=0.05)
    np.testing.assert_allclose(first[1] / np.outer(std, std), second[1] / np.outer(std, std), atol=0.05)


# --- designs


def test_signals_are_as_slow_as_the_rig():
    follower = RunEstimator(RIG)
    hold = hold_for_resonance(follower.belief, 256)
    assert hold in (2, 3), "1.9 Hz at 50 Hz are 27 samples a period; the Silverbox has 9"
    policy = make_policy("prbs", EnvView(RIG, follower.belief, 256), seed=0)
    actions, state = [], None
    for _ in range(hold * 6):
        action, state = policy.predict(np.zeros(1), state)
        actions.append(float(action[0]))
    held = np.reshape(actions, (6, hold))
    assert set(np.unique(held)) == {-1.0, 1.0}
    assert (held == held[:, :1]).all()


@table("name", ["silverbox-multisine", "multilevel-prbs", "multisine", "chirp-log", "uniform"])
def test_signals_reach_the_rigs_limit_and_no_more(name, tmp_path):
    result = play(tmp_path / "run", policy=name, samples=64)
    assert result.outcome == "complete"
    asked = np.array([float(row["commanded"]) for row in rows(tmp_path / "run")])
    share = next(event["share"] for event in events(tmp_path / "run") if event["event"] == "design")
    assert 0.05 * 4.0 < np.abs(asked).max() / share <= 4.0 * (1 + 1e-6)


def listened(rig, truth, seed):
    follower, plant = RunEstimator(rig), SimulatedPlant(rig, truth, seed=seed, clock=JumpingClock())
    _, y = plant.play(np.zeros(16))
    follower.update(np.zeros(16), y)
    plant.arm(None)
    return follower, plant


def test_the_probability_of_leaving_grows_with_the_input():
    follower, _ = listened(RIG, TRUTH, 0)
    rng = np.random.default_rng(0)
    futures = MonteCarloSystems(follower.online.model, follower.draw_systems(rng), 1.0, rng)
    u = np.repeat([1.0, -1.0], 16)
    found = [futures.violation_probability(share * u) for share in (0.0, 1.0, 5.0, 30.0)]
    assert found[0] < 0.01
    assert found == sorted(found)
    assert found[-1] > 0.9
    share, probability = futures.safe_scale(30.0 * u, 0.05)
    assert 0.01 < share < 0.5
    assert probability < 0.05


def test_the_draws_that_leave_are_those_whose_outputs_do():
    follower, _ = listened(RIG, TRUTH, 0)
    rng = np.random.default_rng(0)
    futures = MonteCarloSystems(follower.online.model, follower.draw_systems(rng), 1.0, rng)
    u = 3.0 * np.repeat([1.0, -1.0], 16)
    process, sensor = futures.disturbances(len(u))
    draws = zip(futures.coefficients, process, futures.states, strict=True)
    outputs = np.array([free_run(futures.model, c, u + w, x) for c, w, x in draws])
    leaving = np.flatnonzero(~(np.abs(outputs + sensor) <= 1.0).all(axis=1)).tolist()  # NaN has run away
    assert 20 < len(leaving) < 280
    assert futures.violating_draws(u, 1000) == leaving
    assert futures.violating_draws(u, 7) == leaving[:7]
    most = binomtest(len(leaving), len(outputs), alternative="less").proportion_ci(0.95).high
    assert futures.violation_probability(u) == futures.probability_bound(len(leaving)) == pytest.approx(most, rel=1e-9)
    assert futures.violating_draws(u, 1000, planned=leaving[:9]) == leaving[9:]
    assert futures.probability_bound(0, n_planned=200) == pytest.approx(
        1 - 0.05 ** (1 / (len(outputs) - 200)), rel=1e-9
    )
    for bound in (0.003, 0.01, 0.0125, 0.05, 0.5):
        enough = futures.min_violations_for(bound)
        assert futures.probability_bound(enough) >= bound > futures.probability_bound(enough - 1) or enough == 1
        assert (futures.violation_probability(u, bound) < bound) == (futures.probability_bound(len(leaving)) < bound)


def test_a_belief_that_cannot_be_safe_is_not_played(tmp_path):
    plant = Bench()
    guess = {"m": (0.8, 1.25), "c": (-3.0, 0.5), "a": (-50.0, 180.0), "b": (-1e6, 1e5)}
    result = play(tmp_path / "run", plant, replace(RIG, guess=guess), samples=400)
    assert (result.outcome, result.exit_status) == ("design", 1)
    assert not any(call[0] == "arm" for call in plant.calls)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["prbs", "efe"])
def test_blocks_leave_the_range_as_rarely_as_asked(policy):
    """Of 200 systems drawn from the guess, at the first and boldest design: more than 19 for 5 % are a 1 in 1000."""
    from agents.hardware.block_loop import block_designer

    rig = replace(RIG, input=replace(RIG.input, limit=40.0))
    left, promised, rng = 0, [], np.random.default_rng(5)
    for k in range(200):
        middle = {name: (low + high) / 2 for name, (low, high) in rig.guess.items()}
        half = {name: (high - low) / 2 / STDS_PER_90_PERCENT for name, (low, high) in rig.guess.items()}
        truth = {name: middle[name] + half[name] * rng.standard_normal() for name in middle}
        low, high = rig.guess["m"]
        truth["m"] = float(
            np.exp(np.log(low * high) / 2 + np.log(high / low) / 2 / STDS_PER_90_PERCENT * rng.standard_normal())
        )
        follower, plant = listened(rig, truth, k)
        observed = EnvView(rig, follower.belief, 64)
        futures = MonteCarloSystems(follower.online.model, follower.draw_systems(rng), 1.0, rng)
        u, _, probability = block_designer(make_policy(policy, observed, seed=k), observed).block(64, futures, 0.05)
        _, y = plant.play(40.0 * u)
        left += bool((np.abs(y) > 0.08).any())
        promised.append(probability)
    assert np.mean(promised) < 0.05
    assert left <= 19


# --- runs


def test_a_run_finds_the_parameters_and_its_record_does_too(tmp_path):
    plant = Bench()
    result = play(tmp_path / "run", plant, samples=128)
    assert (result.outcome, result.late_ticks, result.exit_status, plant.applied) == ("complete", 0, 0, 0.0)
    found = identify(RIG, tmp_path / "run" / "samples.csv")
    for parameters in (result.parameters, found.parameters):
        assert all(abs(parameters[name][0] - TRUTH[name]) < 4.5 * parameters[name][1] for name in TRUTH)
    written = json.loads((tmp_path / "run" / "parameters.json").read_text())
    assert written["m"]["unit"] == "kg"
    assert (written["a"]["low"], written["a"]["high"]) == result.interval(0.9)["a"]
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["rig"] == RIG.to_dict()
    assert (manifest["plan"]["seed"], manifest["how"], manifest["late"]) == (0, "complete", 0)
    assert {"numpy", "python", "duffing-env"} <= set(manifest["versions"])


def test_the_record_says_what_was_applied_at_which_tick(tmp_path):
    plant = Bench()
    play(tmp_path / "run", plant, samples=20, listen=8)
    found = rows(tmp_path / "run")
    assert [int(row["sample"]) for row in found] == list(range(29)), "8 silent, 20 inputs, and the last response"
    assert [float(row["u"]) for row in found[:8]] == [0.0] * 8
    applied = [u for kind, *u in plant.calls if kind == "apply"]
    assert [[float(row["u"])] for row in found[8:]] == applied
    assert float(found[-1]["u"]) == 0.0


@pytest.mark.parametrize("options", [{}, {"block": 16}])
def test_the_same_seed_gives_the_same_run(options, tmp_path):
    ended = [play(tmp_path / name, **options).outcome for name in "ab"]
    texts = [[{**row, "clock": ""} for row in rows(tmp_path / name)] for name in "ab"]
    assert ended == ["complete"] * 2
    assert texts[0] == texts[1]


def test_a_trained_or_answering_policy_runs_by_samples_only(tmp_path):
    assert play(tmp_path / "run", policy="velocity-sign").outcome == "complete"
    with pytest.raises(ValueError, match="policy must be a signal or the planner efe"):
        play(tmp_path / "other", policy="velocity-sign", block=16)


@table(
    ("fault", "ended"),
    [
        (lambda k, y: 0.09 if k == 30 else y, "range"),
        (lambda k, y: 0.001 if k >= 20 else y, "stale"),
        (lambda k, y: math.nan if k >= 20 else y, "stale"),
        (lambda k, y: 1 / 0 if k == 30 else y, "plant"),
    ],
)
def test_sensors_that_fail_end_the_run_and_everything_measured_is_kept(fault, ended, tmp_path):
    plant = Bench()
    plant.fault = fault
    result = play(tmp_path / "run", plant, samples=100)
    assert (result.outcome, result.exit_status, plant.applied) == (ended, 1, 0.0)
    assert plant.calls[-1] == ("disarm",)
    measured = plant.reads - (ended == "plant")
    assert len(rows(tmp_path / "run")) == measured
    assert events(tmp_path / "run")[-1]["how"] == ended


@table(
    ("method", "given", "message"),
    [
        ("read", lambda y: None, "read must give one number, but gave None"),
        ("read", lambda y: "1.2 mm", "read must give one number, but gave '1.2 mm'"),
        ("read", lambda y: [y], r"read must give one number, but gave \["),
        ("apply", lambda u: None, "apply must give one number, but gave None"),
        ("play", lambda block: block[1], r"play must give two arrays of \(16,\), inputs as applied and outputs, "),
        ("play", lambda block: None, r"play must give two arrays of \(16,\), .* but gave None"),
        ("play", lambda block: (block[0], "abc"), r"play must give two arrays of \(16,\), .* but gave \("),
    ],
)
def test_a_plant_that_gives_something_else_ends_the_run_by_name(method, given, message, tmp_path):
    plant, calls = Bench(), []
    right = getattr(plant, method)

    def wrong(*arguments):
        calls.append(method)
        return given(right(*arguments)) if len(calls) > (1 if method == "play" else 20) else right(*arguments)

    setattr(plant, method, wrong)
    result = play(tmp_path / "run", plant, block=16 if method == "play" else None)
    assert (result.outcome, result.exit_status, plant.applied) == ("plant", 1, 0.0)
    assert re.match(message, result.message)
    assert len(rows(tmp_path / "run")) >= 16
    assert {"parameters.json", "estimator.npz"} <= {path.name for path in (tmp_path / "run").iterdir()}


def test_a_plant_may_give_arrays_of_one_number(tmp_path):
    plant = Bench()
    read = plant.read
    plant.read = lambda: np.array([read()])
    assert play(tmp_path / "run", plant, samples=8).outcome == "complete"


def test_an_output_out_of_range_before_arming_arms_nothing(tmp_path):
    plant = Bench()
    plant.fault = lambda k, y: 0.1
    assert play(tmp_path / "run", plant).outcome == "range"
    assert [kind for kind, *_ in plant.calls] == ["disarm"]


@pytest.mark.parametrize("options", [{}, {"block": 8}])
def test_an_error_in_a_run_zeroes_the_input_and_is_reported(options, tmp_path):
    plant = Bench()

    def broken(samples):
        if samples >= 8:
            raise KeyError("a bug")

    with pytest.raises(KeyError):
        run_experiment(
            RIG, plant, tmp_path / "run", RunSettings(policy="prbs", **options), clock=plant.clock, on_progress=broken
        )
    assert plant.applied == 0.0
    assert not plant._armed
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["how"] == "error"


def test_late_inputs_count_with_their_effective_value(tmp_path):
    """The plant takes 0.8 sampling steps to apply an input, and the input changes in the middle of that time."""
    plant = Bench()
    apply = plant.apply

    def slow(u):
        plant.clock.wait(plant.clock.now() + 0.4 * RIG.step)
        applied = apply(u)
        plant.clock.wait(plant.clock.now() + 0.4 * RIG.step)
        return applied

    plant.apply = slow
    result = play(tmp_path / "run", plant, samples=200)
    assert result.outcome == "complete"
    assert result.late_ticks == 201, "all of them, and the zero at the end"
    late = [row for row in rows(tmp_path / "run") if row["late"] == "1"]
    applied = np.array([float(row["commanded"]) for row in late])
    np.testing.assert_allclose([float(row["u"]) for row in late[1:]], 0.6 * applied[1:] + 0.4 * applied[:-1])
    # The mean is right to first order of the lateness: 0.4² / 2 is left.
    assert all(abs(result.parameters[name][0] / TRUTH[name] - 1) < 0.08 for name in TRUTH)


def slow_to_read(steps, after=0):
    """A plant whose reads after the first ones take ``steps`` sampling steps."""
    plant = Bench()
    read = plant.read

    def slow():
        value = read()
        plant.clock.wait(plant.clock.now() + (steps * RIG.step if plant.reads > after else 0.0))
        return value

    plant.read = slow
    return plant


@pytest.mark.parametrize("steps", [0.4, 5])
def test_a_read_that_is_too_slow_is_reported_before_anything_is_armed(steps, tmp_path):
    plant = slow_to_read(steps)
    result = play(tmp_path / "run", plant)
    assert (result.outcome, result.exit_status) == ("late", 1)
    assert f"came too late: read() took {20 * steps:g} ms and apply() 0 ms of a step of 20 ms; play" in result.message
    assert result.late_ticks == len(rows(tmp_path / "run")) >= 16
    assert not any(call[0] == "arm" for call in plant.calls)
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["message"] == result.message


def test_a_read_that_hangs_while_listening_counts_as_late(tmp_path):
    result = play(tmp_path / "run", slow_to_read(400, after=3))
    assert (result.outcome, result.late_ticks) == ("late", 400)


@pytest.mark.parametrize("steps", [0.4, 3])
def test_a_read_that_becomes_slow_ends_the_run_as_a_dead_sensor_does(steps, tmp_path):
    plant = slow_to_read(steps, after=16)
    result = play(tmp_path / "run", plant, samples=128)
    assert (result.outcome, result.exit_status, plant.applied) == ("late", 1, 0.0)
    assert result.message.startswith("32 outputs in a row came too late")


def test_a_run_that_left_its_range_reports_its_missed_ticks(tmp_path):
    plant = slow_to_read(3, after=16)
    plant.fault = lambda k, y: 0.09 if k == 24 else y
    result = play(tmp_path / "run", plant, samples=128, stale=0)
    assert (result.outcome, plant.applied) == ("range", 0.0)
    assert result.late_ticks > 0
    assert f"beyond its range of ±0.08; {result.late_ticks} ticks of the clock were missed before" in result.message


def test_a_simulated_plant_has_some_noise_where_its_rig_states_none():
    quiet = replace(RIG, input=replace(RIG.input, noise=None), output=replace(RIG.output, noise=None))
    _, shown = SimulatedPlant(quiet, TRUTH, clock=JumpingClock()).play(np.zeros(400))
    assert 0.5e-4 * RIG.output.range < np.std(shown) < 0.5 * RIG.output.range


def test_a_complete_run_that_lost_many_outputs_warns(tmp_path):
    result = play(tmp_path / "run", slow_to_read(3, after=16), samples=128, stale=0)
    assert (result.outcome, result.exit_status, result.late_ticks) == ("complete", 0, 132)
    assert result.message.startswith(
        "132 of 148 outputs came too late to be used: intervals may be too narrow; play blocks"
    )
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["message"] == result.message
    assert play(tmp_path / "other").message == ""


@pytest.mark.parametrize("ended", ["complete", "SIGINT", "plant"])
def test_every_warning_is_printed_whatever_ended_the_run(ended, tmp_path):
    known = Bench()
    known.arm(None)
    believed = identify(RIG, known.play(np.repeat(np.random.default_rng(0).choice([-3.0, 3.0], 32), 8))).belief
    plant = slow_to_read(1.5, after=120)
    plant.truth |= {"a": 1.1 * TRUTH["a"]}
    plant.fault = lambda k, y: 1 / 0 if k == 140 and ended == "plant" else y

    def on_progress(samples):
        if samples > 150 and ended == "SIGINT":
            signal.raise_signal(signal.SIGINT)

    plan = RunSettings(policy="prbs", samples=160, stale=0)
    result = run_experiment(
        RIG, plant, tmp_path / "run", plan, prior=believed, clock=plant.clock, on_progress=on_progress
    )
    assert result.outcome == ended
    assert "outputs came too late to be used: intervals may be too narrow" in result.message
    assert "the prior is wrong: identify" in result.message
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["message"] == result.message


def test_a_run_without_any_output_ends_in_order(tmp_path):
    plant = Bench()
    plant.fault = lambda k, y: 1 / 0
    result = play(tmp_path / "run", plant)
    assert (result.outcome, result.message) == ("plant", "read failed: ZeroDivisionError: division by zero")
    plant = Bench()
    plant.fault = lambda k, y: math.nan
    assert play(tmp_path / "other", plant, samples=100, stale=0).outcome == "complete"


def test_the_folder_of_another_run_is_left_alone(tmp_path):
    play(tmp_path / "run", samples=8)
    before = (tmp_path / "run" / "samples.csv").read_bytes()
    with pytest.raises(ValueError, match="out must be a new or empty folder"):
        play(tmp_path / "run")
    assert (tmp_path / "run" / "samples.csv").read_bytes() == before
    for place in ("run/samples.csv", "run/samples.csv/next"):
        with pytest.raises(NotADirectoryError, match=r"out must be a folder, but .*samples\.csv is a file; "):
            play(tmp_path / place)


@table(
    ("plan", "message"),
    [
        ({"samples": 0}, "samples must be"),
        ({"block": 4}, "block must be"),
        ({"bound": np.ones(2)}, "bound must be a number"),
        ({"bound": 0.0}, "bound must be"),
        ({"watchdog": -1.0}, "watchdog must be"),
        ({"policy": "prsb"}, "did you mean 'prbs'"),
    ],
)
def test_plans_that_make_no_sense(plan, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        play(tmp_path / "run", **plan)


def test_a_block_of_a_simulated_plant_takes_no_time_of_the_clock():
    found = []
    for passed in (0.0, 0.3):
        clock = JumpingClock()
        plant = SimulatedPlant(RIG, TRUTH, clock=clock)
        plant.arm(None)
        clock.wait(passed * RIG.step)
        applied, y = plant.play(np.repeat([4.0, -4.0], 100))
        np.testing.assert_array_equal(applied, np.repeat([4.0, -4.0], 100))
        assert clock.now() == passed * RIG.step
        found.append(y)
    np.testing.assert_allclose(*found, atol=2e-3)  # the clock moved a little before the block, and drew other noises


def test_a_simulated_plant_does_not_catch_up_with_what_went_by_before_it_was_driven():
    """The time to load and to plan does not make the first ticks late."""
    clock = JumpingClock()
    plant = SimulatedPlant(RIG, TRUTH, clock=clock)
    moved, move = [], plant._rk4_step
    plant._rk4_step = lambda h: (moved.append(h), move(h))
    clock.wait(5.0)
    plant.read()
    assert not moved
    for call in (plant.read, lambda: plant.arm(None), lambda: plant.apply(4.0)):
        clock.wait(clock.now() + 5.0)
        call()
        assert sum(moved) == pytest.approx(20 * RIG.step)
        moved.clear()
    clock.wait(clock.now() + 100 * RIG.step)
    plant.read()
    assert sum(moved) == pytest.approx(100 * RIG.step)


# --- the command


@pytest.fixture
def folder(tmp_path, monkeypatch, jumping_clock):
    (tmp_path / "rig.toml").write_text(RIG_FILE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(*words):
    with pytest.raises(SystemExit) as ended:
        main(["run", "rig.toml", *words])
    return ended.value.code


def test_the_command(folder, capsys):
    (folder / "lab_of_tests.py").write_text(
        "from agents.hardware.simulated_plant import SimulatedPlant\n"
        "def plant(rig, seed=0):\n    return SimulatedPlant(rig, seed=seed)\n"
    )
    # As an editor on Windows writes it, with a mark of byte order.
    (folder / "rig.toml").write_text(RIG_FILE + "\n[instrument]\nseed = 3\n", encoding="utf-8-sig")
    words = ["--plant", "lab_of_tests:plant", "--policy", "prbs", "--samples", "64", "--block", "32", "--out", "run"]
    assert command(*words) == 0
    printed = capsys.readouterr().out
    assert "90 % interval" in printed
    assert "kg" in printed
    assert Rig.from_file("rig.toml") == RIG
    assert command(*words) == 2
    assert "holds something" in capsys.readouterr().err


def test_the_command_fails_where_the_input_could_not_be_zeroed(folder, capsys):
    (folder / "stuck_of_tests.py").write_text(
        "from agents.hardware.simulated_plant import SimulatedPlant\n"
        "class Stuck(SimulatedPlant):\n    def zero(self):\n        raise OSError('the converter does not answer')\n"
        "    def disarm(self):\n        self._armed = False\n"
        "plant = Stuck\n"
    )
    words = ["--plant", "stuck_of_tests:plant", "--policy", "prbs", "--samples", "8", "--out", "run"]
    assert command(*words) == 1
    streams = capsys.readouterr()
    assert "kg" in streams.out
    assert "duffing-env: complete, but the input could not be zeroed at the end" in streams.err
    assert "the watchdog has to" in streams.err


@table(
    ("plant", "message"),
    [
        ("lab", "module:name"),
        ("no_such_module:plant", "no module"),
        ("agents.hardware.simulated_plant:plan", "has no 'plan'"),
        ("builtins:repr", "plant must have"),
        ("agents.hardware.visa_instrument:plant", "must be a table of the rig file"),
        ("operator:neg", r"made by operator:neg\(rig, \*\*instrument\), .* but that failed: TypeError: bad operand"),
        ("builtins:divmod", r"the table \[instrument\] of the rig file, but that failed: TypeError: divmod expected 2"),
    ],
)
def test_invalid_plants_are_refused(folder, plant, message):
    with pytest.raises(ValueError, match=message):
        load_plant(plant, RIG)
