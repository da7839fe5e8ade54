"""The vector environment in Gymnasium's registration, limits, specification and wrappers."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import (
    ClipReward,
    DictInfoToList,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
)
from playing import assert_same, random_actions, roll_out

from duffing_env.batch import spawn_seeds
from duffing_env.vector_env import DuffingVectorEnv
from estimator.belief import Belief

TRACK = "duffing_env/Amplitude-v0"
# Random inputs end about half of such episodes at the limit, the others at the horizon.
BOTH_ENDS = {"horizon": 20, "max_output": 0.17}
PARAMETERS = ("m", "c", "a", "b")


def test_gymnasium_makes_it_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = gym.make_vec(TRACK, num_envs=3, vectorization_mode="vector_entry_point", reward="log_posterior")
        assert type(gym.make_vec(TRACK, num_envs=3)) is DuffingVectorEnv
    assert type(envs) is DuffingVectorEnv
    assert (envs.num_envs, envs.horizon, envs.max_input, envs.experiment.reward) == (3, 256, 0.15, "log_posterior")
    again = gym.make_vec(envs.spec)
    assert (again.num_envs, again.experiment) == (3, envs.experiment)
    singles = gym.make_vec(TRACK, num_envs=3, vectorization_mode="sync", reward="log_posterior")
    actions = random_actions(20, 3)
    ours, theirs = roll_out(envs, actions, 2), roll_out(singles, actions, spawn_seeds(2, 3))
    assert_same([given[:-1] for given in ours], [given[:-1] for given in theirs])


@pytest.mark.parametrize("limit", [9, 20, 400, -1])
def test_a_limit_of_steps_truncates_as_gymnasium_does(limit):
    ours = gym.make_vec(TRACK, num_envs=5, max_episode_steps=limit, **BOTH_ENDS)
    theirs = gym.make_vec(TRACK, num_envs=5, max_episode_steps=limit, vectorization_mode="sync", **BOTH_ENDS)
    actions = random_actions(100, 5)
    given, expected = roll_out(ours, actions, 7), roll_out(theirs, actions, spawn_seeds(7, 5))
    assert_same([each[:-1] for each in given], [each[:-1] for each in expected])
    assert np.sum([each[3] for each in given if len(each) == 5]) > 0
    assert gym.make(TRACK, max_episode_steps=9).spec.max_episode_steps == 9


def test_the_specification_states_the_limit_and_cuts_no_longer_horizon():
    for horizon in (256, 400):
        env = gym.make(TRACK, horizon=horizon, max_input=1e-3)
        assert env.spec.max_episode_steps == gym.make_vec(TRACK, num_envs=2, horizon=horizon).spec.max_episode_steps
        aware = gym.wrappers.TimeAwareObservation(env, flatten=False)
        assert aware.max_timesteps == horizon
        aware.reset(seed=0)
        steps = [aware.step([0.0]) for _ in range(horizon)]
        assert [step[3] for step in steps] == [False] * (horizon - 1) + [True]
        assert gym.make(env.spec).unwrapped.experiment == env.unwrapped.experiment


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_episode_statistics_of_gymnasium(mode):
    envs = RecordEpisodeStatistics(DuffingVectorEnv(4, autoreset_mode=mode, **BOTH_ENDS))
    reference = DuffingVectorEnv(4, autoreset_mode=mode, **BOTH_ENDS)
    actions = random_actions(100, 4)
    returns, lengths, being_reset, ended = np.zeros(4), np.zeros(4, dtype=int), np.zeros(4, dtype=bool), 0
    for infos, (_, rewards, terminated, truncated, _) in zip(
        roll_out(envs, actions)[1:], roll_out(reference, actions)[1:], strict=True
    ):
        returns, lengths = returns + rewards, lengths + ~being_reset
        finished = terminated | truncated
        if finished.any():
            episode = infos[-1]["episode"]
            np.testing.assert_allclose(episode["r"][finished], returns[finished], rtol=1e-12)
            np.testing.assert_array_equal(episode["l"][finished], lengths[finished])
        returns, lengths = np.where(finished, 0, returns), np.where(finished, 0, lengths)
        being_reset = finished & (mode == AutoresetMode.NEXT_STEP)
        ended += finished.sum()
    assert ended > 10


def test_wrappers_of_gymnasium_compose():
    envs = gym.make_vec(TRACK, num_envs=6, vectorization_mode="vector_entry_point", **BOTH_ENDS)
    envs = NormalizeObservation(ClipReward(NormalizeReward(RecordEpisodeStatistics(envs)), -5.0, 5.0))
    envs = DictInfoToList(envs)
    envs.reset(seed=0)
    episodes, beliefs = 0, 0
    for action in random_actions(120, 6):
        observations, rewards, terminated, truncated, infos = envs.step(action)
        assert observations.shape == (6, 22)
        assert np.isfinite(observations).all()
        assert np.abs(rewards).max() <= 5.0
        assert isinstance(infos, list)
        finished = terminated | truncated
        assert ["belief" in info for info in infos] == finished.tolist()
        assert ["episode" in info for info in infos] == finished.tolist()
        episodes += sum("episode" in info for info in infos)
        beliefs += sum(isinstance(info.get("belief"), Belief) for info in infos)
    assert episodes == beliefs > 20


def test_final_infos_as_a_list():
    envs = DictInfoToList(DuffingVectorEnv(4, autoreset_mode="SameStep", **BOTH_ENDS))
    endings = []
    for *_, terminated, truncated, infos in roll_out(envs, random_actions(60, 4))[1:]:
        finished = (terminated | truncated).tolist()
        assert ["final_obs" in info for info in infos] == ["final_info" in info for info in infos] == finished
        assert all("information_gain" in info for info in infos)
        endings += [sorted(info["final_info"]) for info in infos if "final_info" in info]
    assert len(endings) > 10
    assert endings == [["belief", "diverged", "information_gain", "log_posterior_gain", "truth"]] * len(endings)
