"""Evaluation: every metric against a slow computation with single environments and hand-written equations."""

from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import rounding
from safetensors.numpy import load_file
from stable_baselines3 import PPO
from tables import table

import agents.evaluation.comparison
import agents.evaluation.metrics
import agents.evaluation.policy_evaluation
from agents import make_policy
from agents.evaluation.comparison import compare_policies, default_policies
from agents.evaluation.oracle import TrackSystems
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.leaderboard import leaderboard_file
from agents.policies.networks.policy_saving import save_policy
from agents.policies.networks.trained_policy import WEIGHTS_FILE, load_policy
from agents.sb3_vec_env import DuffingVecEnv
from duffing_env.batch import spawn_seeds
from duffing_env.plants.silverbox_record import Regime
from estimator import SILVERBOX_SAMPLING_STEP, OnlineEstimator, Rig, difference, silverbox_prior

TRACK = "duffing_env/Amplitude-v0"
CONTINUOUS = "duffing_env/Amplitude-v1"
DRIFT = "duffing_env/Drift-v0"
REPLAY = "duffing_env/SilverboxReplay-v0"
#: As they are compiled for tests/specimens.py, but for the last: no metric depends on the reward.
MEAN_FIELD = {"factorisation": "mean_field", "reward": "free_energy"}
REPLAYED = {"regime": "arrow", "reward": "free_energy"}
ODE = {"noise_range": 1.0, "noise_hypotheses": 1, "reward": "expected_free_energy"}
NLARX = {"noise_range": 1.0, "noise_hypotheses": 1, "estimator": "nlarx"}
SEED = 3
SYSTEMS = 6
HORIZON = 60
QUANTILES = {"coverage_50": 0.6744897501960817, "coverage": 1.6448536269514722, "coverage_95": 1.959963984540054}


@pytest.fixture
def without_record(monkeypatch):
    monkeypatch.setattr(agents.evaluation.policy_evaluation, "record_available", lambda: False)
    monkeypatch.setattr(agents.evaluation.comparison, "record_available", lambda: False)


def true_coefficients(truth):
    """Eq. (3)."""
    eta = SILVERBOX_SAMPLING_STEP**2 / (truth.m + truth.c * SILVERBOX_SAMPLING_STEP)
    ratio = truth.m / (truth.m + truth.c * SILVERBOX_SAMPLING_STEP)
    return np.array([1 + ratio - truth.a * eta, -truth.b * eta, -ratio, eta])


def estimates(coefficients):
    """m, c, a, b by Eq. (4)."""
    theta1, theta2, theta3, eta = coefficients
    step = SILVERBOX_SAMPLING_STEP
    return np.array([-theta3 * step**2 / eta, (1 + theta3) * step / eta, (1 - theta1 - theta3) / eta, -theta2 / eta])


def standard_form(belief):
    """Standard deviations and correlation matrix of the coefficients: their covariance is badly scaled."""
    std = np.sqrt(np.diag(belief.coefficients_cov))
    return std, belief.coefficients_cov / np.outer(std, std)


def entropy(belief):
    std, correlation = standard_form(belief)
    return 2 * np.log(2 * np.pi * np.e) + 0.5 * np.log(np.linalg.det(correlation)) + np.log(std).sum()


def log_density(belief, point):
    std, correlation = standard_form(belief)
    z = (point - belief.coefficients_mean) / std
    spread = 0.5 * np.log(np.linalg.det(correlation)) + np.log(std).sum()
    return -0.5 * z @ np.linalg.inv(correlation) @ z - spread - 2 * np.log(2 * np.pi)


def fisher_gain(coefficients, inputs, outputs, prior):
    """Decrease of ½ log det of the covariance of (θ, η), linearised along a filter with the true parameters."""
    theta1, theta2, theta3, eta = coefficients
    state, known, cov = np.zeros(2), np.zeros((2, 2)), np.zeros((6, 6))
    cov[2:, 2:] = prior.coefficients_cov
    noise = 5e-4**2
    for u, y in zip(inputs, outputs, strict=True):
        x, last_x = state
        jacobian = np.eye(6)
        jacobian[0] = [theta1 + 3 * theta2 * x**2, theta3, x, x**3, last_x, u]
        jacobian[1] = [1, 0, 0, 0, 0, 0]
        transition = jacobian[:2, :2]
        cov = jacobian @ cov @ jacobian.T
        known = transition @ known @ transition.T
        cov[0, 0] += noise
        known[0, 0] += noise
        innovation = y - (theta1 * x + theta2 * x**3 + theta3 * last_x + eta * u)
        state = np.array([y - innovation, x]) + known[:, 0] / (known[0, 0] + noise) * innovation
        cov = cov - np.outer(cov[:, 0], cov[0]) / (cov[0, 0] + noise)
        known = known - np.outer(known[:, 0], known[0]) / (known[0, 0] + noise)
    return 0.5 * (np.linalg.slogdet(prior.coefficients_cov)[1] - np.linalg.slogdet(cov[2:, 2:])[1])


def act(name, options):
    """A function of time, row and observation that acts as the policy does in a batch."""
    if name.startswith("/"):
        return act_as_network(name, options)
    # Signals do not look at observations, so that the whole batch is known before the first step.
    with_limits = SimpleNamespace(unwrapped=SimpleNamespace(max_input=options.get("max_input", 0.15), horizon=HORIZON))
    policy, state, played = make_policy(name, with_limits, seed=SEED), None, []
    for _ in range(HORIZON):
        actions, state = policy.predict(np.zeros((SYSTEMS, 22)), state)
        played.append(actions)
    return lambda t, row, observation: played[t][row]


def act_as_network(name, options):
    """Act as `act` does, on the whole batch: the rounding of a matrix product depends on its size."""
    policy, weights, envs = (
        load_policy(name),
        load_file(Path(name) / WEIGHTS_FILE),
        make_track_batch(TRACK, SYSTEMS, TEST_OPTIONS | options),
    )
    observations, played = envs.reset(seed=SEED)[0], []
    for _ in range(HORIZON):
        played.append(policy.predict(observations, deterministic=True)[0])
        observations = envs.step(played[-1])[0]

    def choose(t, row, observation):
        alone, _ = policy.predict(observation, deterministic=True)
        bound, _ = rounding.play(weights, policy.card["network"], observation[None])
        assert np.abs(alone - played[t][row]) <= bound
        return played[t][row]

    return choose


def run_single(name, options):
    """What happens to every system under a policy: a list of one namespace each."""
    choose = act(name, options)
    for row, seed in enumerate(spawn_seeds(SEED, SYSTEMS)):
        env = gym.make(TRACK, branch="test", **options)
        observation, _ = env.reset(seed=seed)
        beliefs, inputs, outputs, done, truth = [env.unwrapped.belief], [], [], False, env.unwrapped.truth
        while not done:
            action = choose(len(inputs), row, observation)
            observation, _, terminated, truncated, _ = env.step(action)
            beliefs.append(env.unwrapped.belief)
            inputs.append(options.get("max_input", 0.15) * float(np.clip(action[0], -1, 1)))
            outputs.append(env.unwrapped._batch.row_values("Y_y")[0])
            done = terminated or truncated
        yield SimpleNamespace(truth=truth, beliefs=beliefs, inputs=inputs, outputs=outputs, terminated=terminated)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A learned policy that nobody trained; its actions are small, and sampled ones would not be."""
    folder = tmp_path_factory.mktemp("runs") / "untrained"
    envs = DuffingVecEnv(TRACK, 2)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    save_policy(folder, model, {})
    return str(folder)


@pytest.mark.parametrize(
    ("name", "options", "share_ended"),
    [
        ("uniform", {"horizon": HORIZON}, "none"),
        ("uniform", {"horizon": HORIZON, "max_output": 0.35}, "some"),
        ("prbs", {"horizon": HORIZON, "max_output": 0.05}, "all"),
        ("silverbox-arrow", MEAN_FIELD | {"horizon": HORIZON, "max_input": 0.1}, "none"),
        ("run_folder", {"horizon": HORIZON, "spread": 0.1}, "none"),
    ],
)
def test_metrics_are_those_of_single_environments(name, options, share_ended, run_folder, without_record):
    # Inputs and outputs are read from observations in float32: less than ten roundings, with the sums of squares.
    slack = 16 * rounding.U32
    name = run_folder if name == "run_folder" else name
    (evaluation,) = evaluate_policies([name], systems=SYSTEMS, seed=SEED, options=options)
    assert evaluation.policy == name
    assert evaluation.gain_curve.shape == (HORIZON + 1, SYSTEMS)
    assert evaluation.inputs.shape == evaluation.outputs.shape == (HORIZON, SYSTEMS)
    metrics = {key: values.tolist() for key, values in evaluation.metrics.items()}
    ended_early = 0
    for row, single in enumerate(run_single(name, options)):
        prior, posterior, length = single.beliefs[0], single.beliefs[-1], len(single.inputs)
        coefficients = true_coefficients(single.truth)
        measured = {key: values[row] for key, values in metrics.items()}
        assert measured.pop("information_gain") == pytest.approx(entropy(prior) - entropy(posterior), abs=slack)
        gains = [log_density(belief, coefficients) - log_density(prior, coefficients) for belief in single.beliefs]
        assert measured.pop("log_posterior_gain") == pytest.approx(gains[-1], abs=slack)
        np.testing.assert_allclose(evaluation.gain_curve[: length + 1, row], gains, rtol=0, atol=slack)
        np.testing.assert_allclose(evaluation.gain_curve[length:, row], gains[-1], rtol=0, atol=slack)
        true = [single.truth.m, single.truth.c, single.truth.a, single.truth.b]
        for parameter, estimate, value in zip("mcab", estimates(posterior.coefficients_mean), true, strict=True):
            assert measured.pop(f"error_{parameter}") == pytest.approx(abs(estimate - value) / value, abs=0.01 * slack)
        std = np.sqrt(np.diag(posterior.coefficients_cov))
        deviation = posterior.coefficients_mean - coefficients
        for metric, quantile in QUANTILES.items():
            assert measured.pop(metric) == np.count_nonzero(np.abs(deviation) < quantile * std) / 4
        correlation = posterior.coefficients_cov / np.outer(std, std)
        nees = (deviation / std) @ np.linalg.inv(correlation) @ (deviation / std) / 4
        assert measured.pop("nees") == pytest.approx(nees, rel=100 * slack)
        power, peak = np.mean(np.square(single.inputs)), np.abs(single.inputs).max()
        assert measured.pop("input_power") == pytest.approx(power, rel=slack)
        assert measured.pop("input_peak") == pytest.approx(peak, rel=slack)
        assert measured.pop("crest_factor") == pytest.approx(peak / np.sqrt(power), rel=slack)
        assert measured.pop("decision_time") > 0
        full_prior = silverbox_prior(spread=options.get("spread", 0.3))  # mean field leaves out its cross-covariances
        gain = fisher_gain(coefficients, single.inputs, single.outputs, full_prior)
        assert measured.pop("fisher_gain") == pytest.approx(gain, abs=1e-3)
        assert measured.pop("ended_early") == single.terminated
        assert measured == {}
        np.testing.assert_allclose(evaluation.inputs[:length, row], single.inputs, rtol=slack)
        # Outputs are read off observations, which show no more than twice the limit.
        shown = np.clip(single.outputs, *(2 * options.get("max_output", 0.6) * np.array([-1, 1])))
        np.testing.assert_allclose(evaluation.outputs[:length, row], shown, rtol=slack)
        assert np.isnan(evaluation.inputs[length:, row]).all()
        assert np.isnan(evaluation.outputs[length:, row]).all()
        ended_early += single.terminated
    assert ended_early in {"none": [0], "some": range(1, SYSTEMS), "all": [SYSTEMS]}[share_ended]


def test_what_a_jump_of_the_truth_takes_away_is_counted(monkeypatch):
    monkeypatch.setattr(agents.evaluation.policy_evaluation, "record_available", lambda: True)
    (evaluation,) = evaluate_policies(["prbs"], DRIFT, SYSTEMS, SEED, options={"horizon": HORIZON})
    choose, steepest = act("prbs", {"horizon": HORIZON}), []
    for row, seed in enumerate(spawn_seeds(SEED, SYSTEMS)):
        env = gym.make(DRIFT, horizon=HORIZON, branch="test").unwrapped
        env.reset(seed=seed)
        mass, gains, ended = env.truth.m, [log_density(env.belief, true_coefficients(env.truth))], False
        while not ended:
            _, _, terminated, truncated, _ = env.step(choose(len(gains) - 1, row, None))
            gains.append(log_density(env.belief, true_coefficients(env.truth)))
            ended = terminated or truncated
        assert terminated or env.truth.m != mass
        expected = np.subtract(gains, gains[0])
        np.testing.assert_allclose(evaluation.gain_curve[: len(gains), row], expected, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(evaluation.gain_curve[len(gains) :, row], expected[-1], rtol=1e-6, atol=1e-6)
        assert evaluation.metrics["log_posterior_gain"][row] == evaluation.gain_curve[-1, row]
        steepest.append(np.diff(gains).min())
    assert min(steepest) < -100  # a jump that the belief does not know of
    assert "simulation_rmse" in evaluation.metrics
    # These are of one oscillator; here there are two.
    assert not {"fisher_gain", "efficiency", "silverbox_equivalent", "full_peak_equivalent", "arrow_rmse"} & set(
        evaluation.metrics
    )
    assert evaluation.estimator_metrics == {}


def test_sample_efficiency_is_one_for_the_regime_and_more_for_a_better_policy(record):
    prbs, regime = evaluate_policies(["prbs", "silverbox-multisine"], systems=24)
    found = {
        (evaluation.policy, name): np.median(evaluation.metrics[name] / (~np.isnan(evaluation.inputs)).sum(axis=0))
        for evaluation in (prbs, regime)
        for name in ("silverbox_equivalent", "full_peak_equivalent")
    }
    assert 0.5 < found["silverbox-multisine", "silverbox_equivalent"] < 2
    assert found["prbs", "silverbox_equivalent"] > 20
    # At the limit of 0.15 V instead of its own peak of some 0.12 V, the regime tells more.
    assert 1 < found["prbs", "silverbox_equivalent"] / found["prbs", "full_peak_equivalent"] < 6
    # No input has more power than the budget.
    (limited,) = evaluate_policies(["uniform"], "duffing_env/Power-v0", 2)
    assert "full_peak_equivalent" not in limited.metrics


def test_all_policies_meet_the_same_systems_and_the_same_noise(without_record):
    uniform, prbs = evaluate_policies(["uniform", "prbs"], systems=SYSTEMS, seed=SEED, options={"horizon": HORIZON})
    assert np.all(np.abs(uniform.inputs[0] - prbs.inputs[0]) > 1e-3)
    truths = [single.truth for single in run_single("prbs", {"horizon": 1})]
    gains = np.array([true_coefficients(truth)[3] for truth in truths])
    # At rest, y_1 = η u_0 + noise.
    noise = uniform.outputs[0] - gains * uniform.inputs[0]
    # Each of these is read off an observation, and has been rounded to float32 twice.
    sizes = sum(np.abs(e.outputs[0]) + np.abs(gains * e.inputs[0]) for e in (uniform, prbs))
    assert (np.abs(prbs.outputs[0] - gains * prbs.inputs[0] - noise) <= 2 * rounding.U32 * sizes).all()
    assert np.all((np.abs(noise) > 1e-6) & (np.abs(noise) < 5 * np.sqrt(2) * 5e-4))
    assert len(np.unique(noise)) == SYSTEMS


def test_the_same_seed_gives_the_same_and_another_does_not(without_record):
    first, again = (
        evaluate_policies(["uniform"], systems=5, seed=1, options={"horizon": HORIZON})[0] for _ in range(2)
    )
    (fewer,) = evaluate_policies(["uniform"], systems=3, seed=1, options={"horizon": HORIZON})
    (other,) = evaluate_policies(["uniform"], systems=5, seed=2, options={"horizon": HORIZON})
    for name, values in first.metrics.items():
        if name != "decision_time":
            np.testing.assert_array_equal(values, again.metrics[name])
            np.testing.assert_array_equal(values[:3], fewer.metrics[name])
    np.testing.assert_array_equal(first.outputs, again.outputs)
    for name in ("log_posterior_gain", "error_m", "error_b", "input_power"):
        assert not set(first.metrics[name]) & set(other.metrics[name])


def test_policies_are_reported_in_turn_and_options_stay_unchanged(without_record):
    reported, options = [], {"horizon": 5}
    evaluations = evaluate_policies(
        ["prbs", "uniform", "gaussian"], systems=2, options=options, on_policy=reported.append
    )
    assert reported == [evaluation.policy for evaluation in evaluations] == ["prbs", "uniform", "gaussian"]
    assert options == {"horizon": 5}
    (alone,) = evaluate_policies(["gaussian"], systems=2, options=options)
    np.testing.assert_array_equal(evaluations[2].gain_curve, alone.gain_curve)


BY_THE_RECORD = {"silverbox_equivalent", "full_peak_equivalent", "simulation_rmse", "arrow_rmse"}


def test_what_the_record_measures_is_left_out_without_it_and_it_is_said(without_record, tmp_path, capsys):
    (evaluation,) = compare_policies(["uniform"], TRACK, 2, {"horizon": 5}, tmp_path)
    assert not BY_THE_RECORD & set(evaluation.metrics)
    assert "the Silverbox record is not on this machine" in " ".join(capsys.readouterr().out.split())


def test_errors_of_free_runs_are_those_over_the_arrow_s_input(record):
    (evaluation,) = evaluate_policies(["uniform"], systems=SYSTEMS, seed=SEED, options={"horizon": HORIZON})
    assert set(evaluation.metrics) >= BY_THE_RECORD
    for row, single in enumerate(run_single("uniform", {"horizon": HORIZON})):
        both = single.beliefs[-1].coefficients_mean, true_coefficients(single.truth)
        believed, true = (free_run(c, record.arrow.u[-8192:], np.zeros(2)) for c in both)
        error = np.sqrt(np.mean((believed - true) ** 2))
        assert evaluation.metrics["simulation_rmse"][row] == pytest.approx(error, rel=1e-3)


def identified_twins(name, options):
    """The coefficients that single environments identify on the twin of the circuit."""
    options = {**options, "plant_spread": 0.0}
    return [single.beliefs[-1].coefficients_mean for single in run_single(name, options)]


def free_run(coefficients, u, y):
    """Eq. (2) without noise over a record, started by its first two outputs."""
    theta1, theta2, theta3, eta = coefficients.tolist()
    x = y[:2].tolist()
    for u_before in u[1:-1].tolist():
        x.append(theta1 * x[-1] + theta2 * x[-1] ** 3 + theta3 * x[-2] + eta * u_before)
    return np.array(x)


def test_the_arrow_error_is_that_of_free_runs_over_the_record(record):
    options = {"horizon": HORIZON}
    (evaluation,) = evaluate_policies(["prbs"], systems=SYSTEMS, seed=SEED, options=options)
    u, y = record.arrow.u, record.arrow.y
    for coefficients, error in zip(identified_twins("prbs", options), evaluation.metrics["arrow_rmse"], strict=True):
        deviation = free_run(coefficients, u, y)[2:] - y[2:]
        assert error == pytest.approx(np.sqrt(np.mean(deviation**2)), rel=1e-6)
        assert 1e-3 < error < 0.05  # the signal itself has 54 mV


@table(("scale", "diverges"), [(0.1, False), (1e3, True)])
def test_a_free_run_that_diverges_counts_as_infinite(monkeypatch, scale, diverges):
    rng = np.random.default_rng(0)
    arrow = Regime("arrow", scale * rng.uniform(-1, 1, 80), 0.01 * rng.normal(size=80))
    monkeypatch.setattr(agents.evaluation.policy_evaluation, "record_available", lambda: True)
    monkeypatch.setattr(agents.evaluation.metrics, "load_record", lambda: SimpleNamespace(arrow=arrow))
    options = {"horizon": HORIZON, "max_output": 2.0}
    (evaluation,) = evaluate_policies(["uniform"], systems=SYSTEMS, seed=SEED, options=options)
    if diverges:
        assert np.all(evaluation.metrics["arrow_rmse"] == np.inf)
        return
    expected = [
        np.sqrt(np.mean((free_run(coefficients, arrow.u, arrow.y) - arrow.y)[2:] ** 2))
        for coefficients in identified_twins("uniform", options)
    ]
    np.testing.assert_allclose(evaluation.metrics["arrow_rmse"], expected, rtol=1e-9)


def test_others_identify_from_the_same_inputs_and_outputs(without_record):
    (evaluation,) = evaluate_policies(["uniform"], systems=40, seed=SEED)
    own, others = evaluation.metrics, evaluation.estimator_metrics
    assert list(others) == ["structured", "mean_field", "auditor"]
    for name, values in others["structured"].items():  # the environment's own, but for the float32 of its inputs
        np.testing.assert_allclose(values, own[name], rtol=1e-2, atol=1e-6)
    assert np.median(others["auditor"]["error_b"]) < 1.2 * np.median(own["error_b"])
    assert others["mean_field"]["error_m"].mean() > 1.1 * others["auditor"]["error_m"].mean()
    assert 0.3 < others["auditor"]["nees"].mean() < 2


def test_the_replay_environment_is_evaluated(record):
    limit = 0.05
    evaluations = evaluate_policies(
        ["silverbox-arrow", "uniform"], REPLAY, systems=2, options=REPLAYED | {"max_output": limit}
    )
    on_record, off_record = evaluations
    u, y = record.arrow.u, record.arrow.y
    samples = int(np.argmax(np.abs(y[1:]) > limit)) + 1  # the episode ends when y, one sample later, is beyond
    assert samples > 1000
    estimator = OnlineEstimator(difference(), silverbox_prior(), Rig.silverbox("zero_order"))
    before = entropy(estimator.belief)
    estimator.run(u[:samples], y[1 : samples + 1])
    np.testing.assert_allclose(on_record.metrics["information_gain"], before - entropy(estimator.belief), rtol=1e-9)
    np.testing.assert_allclose(on_record.inputs[:samples, 0], u[:samples], rtol=0, atol=1e-8)
    assert np.isnan(on_record.inputs[samples:]).all()
    assert on_record.metrics["ended_early"].tolist() == [1, 1]
    assert on_record.gain_curve[-1] == pytest.approx(on_record.gain_curve[samples])
    # A record answers only its own input: the episode ends, and nothing was learned.
    assert np.isfinite(off_record.inputs).sum(axis=0).tolist() == [1, 1]
    assert off_record.metrics["information_gain"].tolist() == [0, 0]
    assert off_record.metrics["ended_early"].tolist() == [1, 1]
    for evaluation in evaluations:
        assert "arrow_rmse" not in evaluation.metrics


def test_the_continuous_track_is_evaluated_in_its_own_coefficients(without_record):
    options = {"horizon": HORIZON, **ODE}
    (evaluation,) = evaluate_policies(["uniform"], CONTINUOUS, systems=SYSTEMS, seed=SEED, options=options)
    policy, state = make_policy("uniform", gym.make(CONTINUOUS, **options), seed=SEED), None
    actions = []
    for _ in range(HORIZON):
        action, state = policy.predict(np.zeros((SYSTEMS, 22)), state)
        actions.append(action)
    for row, seed in enumerate(spawn_seeds(SEED, SYSTEMS)):
        env = gym.make(CONTINUOUS, branch="test", **options)
        env.reset(seed=seed)
        for t in range(HORIZON):
            env.step(actions[t][row])
        belief, truth = env.unwrapped.belief, env.unwrapped.truth
        stiffness, cubic, damping, gain = belief.coefficients_mean
        per_sample = SILVERBOX_SAMPLING_STEP**2 / truth.m
        true = [truth.a * per_sample, truth.b * per_sample, truth.c / truth.m * SILVERBOX_SAMPLING_STEP, per_sample]
        inside = np.abs(belief.coefficients_mean - true) < QUANTILES["coverage"] * np.sqrt(
            np.diag(belief.coefficients_cov)
        )
        expected = {
            "coverage": np.count_nonzero(inside) / 4,
            "error_m": abs(SILVERBOX_SAMPLING_STEP**2 / gain / truth.m - 1),
            "error_c": abs(SILVERBOX_SAMPLING_STEP * damping / gain / truth.c - 1),
            "error_a": abs(stiffness / gain / truth.a - 1),
            "error_b": abs(cubic / gain / truth.b - 1),
        }
        assert {name: evaluation.metrics[name][row] for name in expected} == pytest.approx(expected, abs=1e-6)
        for name in expected:  # the environment's own estimator, but for the float32 of its inputs
            assert evaluation.estimator_metrics["ode"][name][row] == pytest.approx(
                evaluation.metrics[name][row], abs=2e-3
            )
    assert "arrow_rmse" not in evaluation.metrics


def test_metrics_use_the_true_noises_where_noises_are_drawn(without_record):
    (evaluation,) = evaluate_policies(["uniform"], CONTINUOUS, systems=60, seed=SEED)
    assert list(evaluation.estimator_metrics) == ["ode_alone", "nlarx_structured", "nlarx_mean_field", "auditor"]
    assert evaluation.metrics["fisher_gain"].mean() == pytest.approx(
        evaluation.metrics["information_gain"].mean(), abs=0.4
    )
    assert 0.7 < evaluation.estimator_metrics["auditor"]["nees"].mean() < 1.3
    systems = TrackSystems.of(CONTINUOUS, 2)
    assert len(np.unique(systems.variances)) == 4
    u = 0.03 * np.ones((2, systems.samples))
    values, _ = systems.criterion_and_peak(u)
    expected = np.linalg.slogdet(systems.precision + systems.information(u))[1] / 2
    np.testing.assert_allclose(values, expected, rtol=1e-6)


def test_on_the_continuous_track_others_identify_too(without_record):
    by_ode, by_paper = (
        evaluate_policies(["uniform"], CONTINUOUS, systems=40, seed=SEED, options={"horizon": 200, **options})[0]
        for options in (ODE, NLARX)
    )
    for evaluation, own in ((by_ode, "ode"), (by_paper, "nlarx_structured")):
        assert list(evaluation.estimator_metrics) == ["ode", "nlarx_structured", "nlarx_mean_field", "auditor"]
        assert np.median(evaluation.estimator_metrics[own]["error_m"]) == pytest.approx(
            np.median(evaluation.metrics["error_m"]), rel=1e-2
        )
        errors = {name: np.median(values["error_m"]) for name, values in evaluation.estimator_metrics.items()}
        assert max(errors["ode"], errors["auditor"]) < 0.02 < 0.1 < errors["nlarx_structured"]  # misspecified
        assert 0.8 < evaluation.estimator_metrics["auditor"]["coverage"].mean() < 0.98
        assert 0.6 < evaluation.estimator_metrics["auditor"]["nees"].mean() < 1.4
        # The efficient estimator gains as much as the well-specified one, and no estimator raises that gain.
        assert evaluation.metrics["fisher_gain"].mean() == pytest.approx(
            by_ode.metrics["information_gain"].mean(), abs=0.3
        )
    assert by_paper.metrics["coverage"].mean() < 0.4


def test_the_auditor_is_not_led_astray_by_a_wide_guess(without_record):
    """From the prior's mean alone, three of these fits end far from the truth, with a nees of millions."""
    guess = {"m": (0.3, 0.5), "c": (0.1, 2.0), "a": (1e3, 5e3), "b": (0.0, 1e8)}
    rig = {"step": 1e-3, "input": {"unit": "N", "limit": 10.0}, "output": {"unit": "m", "range": 0.02}, "guess": guess}
    (found,) = evaluate_policies(["prbs"], "duffing_env/Rig-v0", 32, options={"rig": rig, "noise_hypotheses": 3})
    assert 0.5 < found.estimator_metrics["auditor"]["nees"].mean() < 2.0
    assert found.estimator_metrics["auditor"]["nees"].max() < 6.0


@pytest.mark.parametrize("track", ["Pendulum", "WienerHammerstein"])
def test_tracks_of_other_models_are_evaluated_and_shown(track, tmp_path):
    env_id, options = f"duffing_env/{track}-v0", {"horizon": 128}
    if track == "Pendulum":
        (evaluation,) = compare_policies(["uniform"], env_id, 6, options, tmp_path, seed=SEED, as_report=True)
        assert (tmp_path / "report.html").is_file()
    else:
        (evaluation,) = evaluate_policies(["uniform"], env_id, 6, SEED, options)
    assert list(evaluation.estimator_metrics) == ["ode", "auditor"]
    for name in [name for name in evaluation.metrics if name.startswith("error_")]:
        # The environment's own estimator, but for the float32 of its inputs and outputs, which some errors amplify.
        own = np.median(evaluation.metrics[name])
        assert np.median(evaluation.estimator_metrics["ode"][name]) == pytest.approx(own, rel=0.05), name
    assert evaluation.metrics["fisher_gain"].mean() == pytest.approx(
        evaluation.metrics["information_gain"].mean(), abs=1.0
    )


def test_policies_of_several_seeds_are_one_entry(tmp_path, without_record):
    names = [f"run-{seed}" for seed in (2, 0, 1)]
    for seed, name in enumerate(names):
        model = PPO("MlpPolicy", DuffingVecEnv(TRACK, 2), n_steps=8, batch_size=16, seed=seed, device="cpu")
        save_policy(tmp_path / name, model, {})
    (tmp_path / "run-3").mkdir()  # a training that is not finished
    reported, options = [], {"horizon": 20}
    arguments = {"systems": 3, "seed": SEED, "options": options}
    group, alone = evaluate_policies([f"ppo={tmp_path}/run-*", "uniform"], on_policy=reported.append, **arguments)
    each = evaluate_policies(sorted(str(tmp_path / name) for name in names), **arguments)
    assert (group.policy, group.seeds, group.title, alone.title) == ("ppo", 3, "ppo (3 seeds)", "uniform")
    assert reported == [*(evaluation.policy for evaluation in each), "uniform"]
    for name, values in group.metrics.items():
        if name != "decision_time":
            np.testing.assert_array_equal(values.reshape(3, 3), [evaluation.metrics[name] for evaluation in each])
    for i, evaluation in enumerate(each):
        np.testing.assert_array_equal(group.inputs[:, 3 * i : 3 * i + 3], evaluation.inputs)
        np.testing.assert_array_equal(group.gain_curve[:, 3 * i : 3 * i + 3], evaluation.gain_curve)
        audited = evaluation.estimator_metrics["auditor"]["error_b"]
        np.testing.assert_array_equal(group.estimator_metrics["auditor"]["error_b"][3 * i : 3 * i + 3], audited)
    with pytest.raises(ValueError, match=r"two policy folders or more match, but 'ppo=.*run-1' matches"):
        evaluate_policies([f"ppo={tmp_path}/run-1"], systems=2)


@table("systems", [1, 0, -3])
def test_one_system_is_too_few(systems):
    with pytest.raises(ValueError, match=f"systems must be a whole number from 2 to 100000, but is {systems}"):
        evaluate_policies(["uniform"], systems=systems)


def test_senseless_arguments_are_refused():
    with pytest.raises(ValueError, match=r"policies must be a list of policies, but is .prbs.; pass"):
        evaluate_policies("prbs")
    with pytest.raises(ValueError, match="policies must name at least one"):
        evaluate_policies([], systems=2)
    with pytest.raises(ValueError, match=r"policies must differ by their names, but are called .*; give each a name"):
        evaluate_policies(["prbs", "prbs"], systems=2)
    played = []
    for name, words in (
        ("unifrom", "did you mean 'uniform'"),
        ("ppo/short", "ppo/short: env must be of the model that the"),
    ):
        with pytest.raises(ValueError, match=words):
            evaluate_policies(["prbs", name], "duffing_env/Pendulum-v0", systems=2, on_policy=played.append)
    assert not played, "all are made before the first one plays"
    with pytest.raises(ValueError, match="did you mean 'horizon'"):
        evaluate_policies(["uniform"], systems=2, options={"horizn": 3})
    with pytest.raises(gym.error.NameNotFound):
        evaluate_policies(["uniform"], "duffing_env/Ampltude-v0", systems=2)


def test_a_file_in_place_of_the_folder_is_found_before_the_work(tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(NotADirectoryError, match=r"output must be a folder, but .*file is a file; name another folder"):
        compare_policies(["prbs"], "duffing_env/Short-v0", 2, {}, tmp_path / "file" / "below")
    assert (tmp_path / "file").read_text() == "kept"


def test_a_place_that_cannot_be_written_is_found_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "board.jsonl").touch()
    (tmp_path / "board.jsonl").chmod(0o444)
    with pytest.raises(
        PermissionError, match=r"read-only; allow to write there, or name another place: '.*board.jsonl'"
    ):
        leaderboard_file.check_new_entry(tmp_path / "board.jsonl", "mine")

    def refuse(dir):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    monkeypatch.setattr(
        "agents.evaluation.comparison.evaluate_policies", lambda *_: pytest.fail("it was measured first")
    )
    with pytest.raises(PermissionError, match=r"allow to write there, or name another place: '.*out'"):
        compare_policies(["prbs"], "duffing_env/Short-v0", 2, {}, tmp_path / "out")
    with pytest.raises(PermissionError, match=r"allow to write there, or name another place: '.*'"):
        leaderboard_file.check_new_entry(tmp_path / "new.jsonl", "mine")


@table("shown", [{"observation": "history"}, {"observation": "history", "history": 1}])
def test_what_is_shown_changes_nothing_of_what_is_measured(shown):
    usual, other = (
        evaluate_policies(["uniform"], TRACK, 3, SEED, {"horizon": 12} | options)[0] for options in ({}, shown)
    )
    np.testing.assert_array_equal(other.inputs, usual.inputs)
    np.testing.assert_array_equal(other.outputs, usual.outputs)
    np.testing.assert_array_equal(other.metrics["fisher_gain"], usual.metrics["fisher_gain"])


def test_without_the_posterior_as_observation_only_signals_are_compared():
    assert default_policies(TRACK, {"observation": "history"}) == ("prbs", "uniform")
    assert default_policies(TRACK, {"hold": 4}) == ("ppo/amplitude", "prbs", "uniform")
    assert {"efe", "shield", "ppo/amplitude"} < set(default_policies(TRACK, {"observation": "posterior"}))


def test_a_function_as_an_observation_is_not_compared_on():
    options = {"horizon": 12, "observation": lambda beliefs: beliefs.coefficients_mean}
    with pytest.raises(ValueError, match="observation must not be a function where policies are compared"):
        evaluate_policies(["uniform"], TRACK, 3, SEED, options)
