"""The record through the environment: the estimator gets the same samples as from the record itself."""

import gymnasium as gym
import numpy as np
import pytest
from playing import overwrite
from reference.filters import difference_step
from reference.mean_field import mean_field_step
from reference.structured import structured_update
from rounding import U32
from twin import ITERATIONS, Moments

from agents.policies import make_policy
from duffing_env.plants.silverbox_record import RecordNotFound
from duffing_env.tracks.silverbox_replay import SilverboxReplayEnv, SilverboxReplayVectorEnv
from estimator import SILVERBOX_TWIN

TRACK = "duffing_env/SilverboxReplay-v0"
SAMPLES = 1000
#: As it is compiled for tests/specimens.py.
OPTIONS = {"reward": "free_energy"}


def play(env, policy, samples):
    """Let the policy play; return the steps."""
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
        env = gym.make(TRACK, regime=regime, **OPTIONS)
        part = getattr(record, regime)
        steps = play(env, make_policy(f"silverbox-{regime}", env=env), SAMPLES)
        for t, (observation, _, terminated, truncated, info) in enumerate(steps):
            assert [terminated, truncated, info["off_record"], info["diverged"]] == [False] * 4
            assert observation in env.observation_space
            np.testing.assert_allclose(observation[18], part.u[t] / 0.15, rtol=3 * U32)
            np.testing.assert_allclose(observation[19], part.y[t + 1] / 0.6, rtol=3 * U32)
        assert sorted(steps[-1][4]) == ["diverged", "information_gain", "log_posterior_gain", "off_record"]

    @pytest.mark.parametrize(
        ("delay", "options"),
        [
            (0, {}),
            (1, {}),
            (1, {"factorisation": "mean_field", "nonlinear": False}),
            (0, {"factorisation": "mean_field", "nonlinear": False, "as_published": True, "prior": "published_run"}),
            (1, {"factorisation": "mean_field", "as_published": True, "prior": "published_run"}),
            pytest.param(
                0, {"prior": "paper_text", "nonlinear": False, "iterations": 5}, marks=pytest.mark.slow
            ),  # a kernel of its own
        ],
        ids=str,
    )  # fmt: skip
    def test_the_belief_is_that_of_the_estimator_on_the_same_samples(self, options, delay, record):
        env = SilverboxReplayEnv(input_delay=delay, **OPTIONS, **options)
        env.reset()
        steps = [env.step(action) for action in recorded_actions(env, SAMPLES)]

        factorisation, nonlinear = options.get("factorisation", "structured"), options.get("nonlinear", True)
        iterations = options.get("iterations", ITERATIONS[factorisation])
        first = env.experiment.prior_belief
        kept = slice(None) if nonlinear else [0, 1, 2, 4, 5]  # without θ2
        mean, cov = np.zeros(6), np.zeros((6, 6))
        mean[kept] = first.mean
        cov[np.ix_(np.arange(6)[kept], np.arange(6)[kept])] = first.cov
        belief = Moments(mean, cov, tuple(first.noises[:2]), tuple(first.noises[2:]))
        for t in range(SAMPLES):
            u, y = record.multisine.u[t], record.multisine.y[t + delay]
            if factorisation == "mean_field":
                published = options.get("as_published", False)
                belief, energies = mean_field_step(belief, u, y, iterations, published, nonlinear, evaluated=1)
                energy = energies[-1]
            else:
                belief, energy = structured_update(belief, difference_step(belief.mean, u), y, iterations)
            np.testing.assert_allclose(steps[t][1], -energy, rtol=1e-6, atol=1e-6)

        mean, cov = belief.mean[kept][2:], belief.cov[kept][:, kept][2:, 2:]
        std = np.sqrt(np.diag(cov))
        np.testing.assert_allclose((env.belief.coefficients_mean - mean) / std, 0.0, rtol=0, atol=1e-6)
        scale = np.outer(std, std)
        np.testing.assert_allclose(env.belief.coefficients_cov / scale, cov / scale, atol=1e-6)
        np.testing.assert_allclose(env.belief.noises, [*belief.gamma, *belief.xi], rtol=1e-8)
        assert env.observation_space.shape == ((22,) if nonlinear else (17,))

    @pytest.mark.parametrize("deviation", [1e-6, -0.5])
    def test_an_action_off_the_record_ends_the_episode(self, deviation):
        env = SilverboxReplayEnv(**OPTIONS)
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

    @pytest.mark.parametrize("delay", [0, 1])
    def test_the_regime_ends_by_truncation(self, record, delay):
        envs = SilverboxReplayVectorEnv(1, regime="arrow", input_delay=delay, **OPTIONS)
        envs.reset()
        # The belief has no say in when it ends, and 39,000 samples of it take seconds: the clock is put forward.
        left = 1000
        assert envs.horizon == len(record.arrow.u) - delay
        np.testing.assert_array_equal(envs.recorded_input, record.arrow.u)
        overwrite(envs, "ELAPSED_SAMPLES", float(envs.horizon - left))
        actions = recorded_actions(envs, envs.horizon)[-left:]
        *steps, last = (envs.step(action[None]) for action in actions)
        assert not any(step[2].any() or step[3].any() or step[4]["off_record"].any() for step in steps)
        assert (last[2].tolist(), last[3].tolist()) == ([False], [True])
        np.testing.assert_allclose(last[0][0, 19], record.arrow.y[-1] / 0.6, rtol=1e-6)
        assert last[0][0, 20] == 0.0

    def test_a_record_is_cut_off_by_a_limit_of_steps(self):
        envs = gym.make_vec(TRACK, num_envs=2, max_episode_steps=10, **OPTIONS)
        envs.reset(seed=0)
        flags = [envs.step(np.tile(action, (2, 1)))[3] for action in recorded_actions(envs, 10)]
        np.testing.assert_array_equal(flags, np.arange(10)[:, None].repeat(2, 1) == 9)


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
