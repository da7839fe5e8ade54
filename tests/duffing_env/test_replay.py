"""The record through the environment: what the estimator gets is what it gets from the record itself."""

import copy
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.vector import SyncVectorEnv
from rounding import U32
from twin import ITERATIONS, Moments, difference_step, mean_field_update, structured_update

from agents.policies import make_policy
from duffing_env.replay import SilverboxReplayEnv
from duffing_env.silverbox import RecordNotFound
from duffing_env.vector_env import SilverboxReplayVectorEnv
from estimator import SILVERBOX_TWIN

TRACK = "duffing_env/SilverboxReplay-v0"
SAMPLES = 2000


class OnTheRecord(SilverboxReplayEnv):
    """Plays the recorded input whatever the action, for the checkers, which act at random."""

    def step(self, action):
        assert action in self.action_space
        played = int(self._batch.quantity("ELAPSED")[0])
        return super().step(self.recorded_input[played] / self.max_input)


def play(env, policy, samples):
    """Let the policy play; gives the steps."""
    observation, _ = env.reset(seed=0)
    state, steps = None, []
    for _ in range(samples):
        action, state = policy.predict(observation, state)
        steps.append(env.step(action))
        observation = steps[-1][0]
    return steps


def recorded_actions(env, samples):
    return (env.recorded_input[:samples] / env.max_input).astype(np.float32)[:, None]


@pytest.mark.usefixtures("record")
class TestWithTheRecord:
    """Everything that needs the record; skipped where it is absent."""

    @pytest.mark.parametrize("regime", ["multisine", "arrow"])
    def test_the_reference_policy_stays_on_the_record(self, regime, record):
        env = gym.make(TRACK, regime=regime)
        part = getattr(record, regime)
        steps = play(env, make_policy(f"silverbox-{regime}", env=env), SAMPLES)
        for t, (observation, _, terminated, truncated, info) in enumerate(steps):
            assert [terminated, truncated, info["off_record"], info["diverged"]] == [False] * 4
            assert observation in env.observation_space
            np.testing.assert_allclose(observation[18], part.u[t] / 0.15, rtol=3 * U32)
            np.testing.assert_allclose(observation[19], part.y[t + 1] / 0.6, rtol=3 * U32)
        assert sorted(steps[-1][4]) == ["diverged", "information_gain", "log_posterior_gain", "off_record"]

    @pytest.mark.parametrize("delay", [0, 1])
    @pytest.mark.parametrize(
        "options",
        [
            {},
            {"factorisation": "mean_field"},
            {"factorisation": "mean_field", "as_published": True, "prior": "published_run"},
            pytest.param({"prior": "paper_text", "nonlinear": False, "iterations": 5}, marks=pytest.mark.slow),
        ],
        ids=str,
    )
    def test_the_belief_is_that_of_the_estimator_on_the_same_samples(self, options, delay, record):
        env = SilverboxReplayEnv(input_delay=delay, reward="free_energy", **options)
        env.reset()
        steps = [env.step(action) for action in recorded_actions(env, SAMPLES)]

        factorisation = options.get("factorisation", "structured")
        iterations = options.get("iterations", ITERATIONS[factorisation])
        first = env.experiment.believed
        belief, kept = Moments(first.mean, first.cov, tuple(first.noises[:2]), tuple(first.noises[2:])), slice(None)
        if not options.get("nonlinear", True):
            kept = [0, 1, 2, 4, 5]  # without θ2
        for t in range(SAMPLES):
            u, y = record.multisine.u[t], record.multisine.y[t + delay]
            if factorisation == "mean_field":
                belief, told = mean_field_update(belief, u, y, iterations, options.get("as_published", False))
            else:
                whole = np.zeros(6)
                whole[kept] = belief.mean
                moved, jacobian, noise = difference_step(whole, u)
                step = moved, jacobian[kept][:, kept], noise
                belief, told = structured_update(belief, step, y, iterations)
            np.testing.assert_allclose(steps[t][1], -told, rtol=1e-6, atol=1e-6)

        (mean, cov), std = belief.coefficients, np.sqrt(np.diag(belief.cov))[2:]
        np.testing.assert_allclose((env.belief.coefficients_mean - mean) / std, 0.0, rtol=0, atol=1e-6)
        np.testing.assert_allclose(
            env.belief.coefficients_cov / np.outer(std, std), cov / np.outer(std, std), atol=1e-6
        )
        np.testing.assert_allclose(env.belief.noises, [*belief.gamma, *belief.xi], rtol=1e-8)
        assert env.observation_space.shape == ((22,) if options.get("nonlinear", True) else (17,))

    @pytest.mark.parametrize("deviation", [1e-6, -0.5])
    def test_an_action_off_the_record_ends_the_episode(self, deviation):
        env = SilverboxReplayEnv(reward="log_posterior")
        env.reset(seed=0)
        actions = recorded_actions(env, 51)
        for action in actions[:50]:
            env.step(action)
        before = env.belief
        observation, reward, terminated, truncated, info = env.step(actions[50] + deviation)
        assert (terminated, truncated, info["off_record"], info["diverged"]) == (True, False, True, False)
        assert reward == info["information_gain"] == info["log_posterior_gain"] == 0.0
        assert observation in env.observation_space
        np.testing.assert_array_equal(env.belief.record, before.record)
        assert env.truth == SILVERBOX_TWIN

    def test_the_regime_ends_by_truncation(self, record):
        for delay in (0, 1):
            env = SilverboxReplayEnv(regime="arrow", input_delay=delay)
            env.reset()
            *steps, last = (env.step(action) for action in recorded_actions(env, env.horizon))
            assert env.horizon == len(record.arrow.u) - delay
            assert not any(step[2] or step[3] for step in steps)
            assert (last[2], last[3]) == (False, True)
            np.testing.assert_allclose(last[0][19], record.arrow.y[-1] / 0.6, rtol=1e-6)
            assert last[0][20] == 0.0

    @pytest.mark.parametrize("factorisation", ["structured", "mean_field"])
    def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(self, factorisation):
        from stable_baselines3.common.env_checker import check_env as sb3_check

        for check in (partial(gymnasium_check, skip_render_check=True), sb3_check):
            env = OnTheRecord(factorisation=factorisation)
            env.spec = gym.spec(TRACK)
            check(env)

    def test_vector_rows_are_single_environments(self):
        envs = SilverboxReplayVectorEnv(3)
        singles = SyncVectorEnv([SilverboxReplayEnv] * 3)
        np.testing.assert_array_equal(envs.recorded_input, singles.envs[0].recorded_input)
        recorded = recorded_actions(envs, 60)
        elapsed, ended, waited = np.zeros(3, dtype=int), 0, np.zeros(3, dtype=bool)
        for each in (envs, singles):
            each.reset(seed=[0, 1, 2])
        rng = np.random.default_rng(0)
        for _ in range(200):
            actions = recorded[elapsed]
            actions[rng.uniform(size=3) < 0.05] += 0.1
            ours, theirs = envs.step(actions), singles.step(actions)
            for told, expected in zip(ours[:-1], theirs[:-1], strict=True):
                np.testing.assert_array_equal(told, expected)
            for name, expected in theirs[-1].items():
                if not name.startswith("_"):
                    np.testing.assert_array_equal(ours[-1][name], expected)
            finished = ours[2] | ours[3]
            np.testing.assert_array_equal(finished, ours[-1]["off_record"])
            elapsed = np.where(finished | waited, 0, elapsed + 1)
            waited = finished
            ended += finished.sum()
        assert ended > 10

    def test_a_record_is_cut_off_by_a_limit_of_steps(self):
        envs = gym.make_vec(TRACK, num_envs=2, max_episode_steps=10)
        envs.reset(seed=0)
        flags = [envs.step(np.tile(action, (2, 1)))[3] for action in recorded_actions(envs, 10)]
        np.testing.assert_array_equal(flags, np.arange(10)[:, None].repeat(2, 1) == 9)

    @pytest.mark.parametrize(
        "copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"]
    )
    def test_copies_continue(self, copied):
        env = SilverboxReplayEnv()
        env.reset()
        actions = recorded_actions(env, 40)
        for action in actions[:20]:
            env.step(action)
        twin = copied(env)
        for action in actions[20:]:
            np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])


def test_without_the_record_it_says_where_to_get_it(monkeypatch, tmp_path):
    monkeypatch.delenv("SILVERBOX_DATA", raising=False)
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "LOCALAPPDATA", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path))
    with pytest.raises(RecordNotFound, match=r"pip install nonlinear_benchmarks.*SILVERBOX_DATA"):
        gym.make(TRACK)
    with pytest.raises(RecordNotFound, match=r"pip install nonlinear_benchmarks.*SILVERBOX_DATA"):
        gym.make_vec(TRACK, num_envs=2)
    with pytest.raises(RecordNotFound, match="path is"):
        gym.make(TRACK, data=str(tmp_path))
