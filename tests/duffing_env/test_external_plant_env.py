"""A rig around its plant: the plant gets the documented inputs, and the estimator gets the plant's outputs."""

import threading
from contextlib import nullcontext
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import SyncVectorEnv
from playing import assert_refused, random_actions
from specimens import VOLTS, Difference, around

from agents import make_policy
from duffing_env.env import DuffingEnv
from duffing_env.rewards.named_rewards import REWARDS
from duffing_env.tracks.rig_env import RigEnv
from estimator import Channel, OnlineEstimator, Rig
from estimator.belief import Belief
from estimator.models.difference_equation import difference
from estimator.models.pendulum import PENDULUM
from estimator.priors import silverbox_prior, weak_prior
from estimator.rigs.rig_prior import reset_state, rig_prior

GUESS = {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)}


class Scripted:
    """A plant that returns the outputs of a list in turn, and raises the exceptions in it."""

    def __init__(self, outputs):
        self.outputs = outputs

    def reset(self):
        self.left = list(self.outputs)

    def step(self, u):
        output = self.left.pop(0)
        if isinstance(output, Exception):
            raise output
        return output


def test_a_plant_that_gives_the_simulated_outputs_gives_the_same_episode_to_the_bit():
    simulated = DuffingEnv(max_output=0.25)
    given, outputs, played = [simulated.reset(seed=3)], [], random_actions(256)[:, 0]
    for action in played:
        given.append(simulated.step(action))
        outputs.append(simulated._batch.row_values("Y_y")[0])
        if given[-1][2]:
            break
    assert given[-1][2]
    env = around(Scripted(outputs), max_output=0.25)
    np.testing.assert_array_equal(env.reset(seed=99)[0], given[0][0])
    for action, expected in zip(played, given[1:], strict=False):
        observation, _, terminated, truncated, info = env.step(action)
        np.testing.assert_array_equal(observation, expected[0])
        assert (terminated, truncated) == expected[2:4]
        assert info["information_gain"] == expected[4]["information_gain"]
    np.testing.assert_array_equal(env.belief.record, simulated.belief.record)
    assert sorted(info) == ["diverged", "information_gain"]


def test_the_plant_gets_the_clipped_float32_action_in_volts():
    plant = Difference()
    env = around(plant, max_input=0.07, max_output=1.0)
    env.reset()
    assert (plant.resets, plant.inputs) == (1, [])
    asked = [0.1, -1.0, 1 + 1e-6, 7.0, -1e300, np.float64(np.pi / 10)]
    for action in asked:
        observation, *_ = env.step([action])
        assert observation[18] == np.float32(plant.inputs[-1] / 0.07)
    assert plant.inputs == [0.07 * float(np.float32(min(max(action, -1), 1))) for action in asked]
    assert all(type(u) is float for u in plant.inputs)


def test_a_second_thread_does_not_reset_the_plant_in_the_middle_of_a_step():
    plant, refused = Difference(), []
    env = around(plant)
    env.reset()

    def reset_from_another_thread():
        with pytest.raises(RuntimeError, match="must wait until the last call"):
            env.reset()
        refused.append(True)

    move = plant.step

    def slow(u):
        thread = threading.Thread(target=reset_from_another_thread)
        thread.start()
        thread.join()
        return move(u)

    plant.step = slow
    env.step([0.5])
    assert (plant.resets, refused) == (1, [True])
    plant.step = move
    env.step([0.5])  # the episode goes on


@pytest.mark.parametrize("output", [np.nan, np.inf, -np.inf, 1e200, "volts", "0.1", None, [0.1, 0.2], OSError("cable")])
def test_a_plant_that_fails_ends_the_episode_flagged_with_the_belief_before(output):
    env = around(Scripted([0.01, -0.02, output]))
    first, _ = env.reset(seed=0)
    env.step([0.5])
    _, _, terminated, _, info = env.step([0.5])
    assert not terminated
    assert not info["diverged"]
    before = env.belief
    is_bug = not isinstance(output, float)
    with pytest.warns(UserWarning, match=r"plant\.step failed, which ends") if is_bug else nullcontext():
        observation, reward, terminated, truncated, info = env.step([0.5])
    assert (reward, terminated, truncated, info["diverged"], info["information_gain"]) == (0.0, True, False, True, 0.0)
    assert observation in env.observation_space
    np.testing.assert_array_equal(env.belief.record, before.record)
    message = f"TypeError: step must give one number, but gave {output!r}" if is_bug else None
    assert env.plant_error == ("OSError: cable" if isinstance(output, OSError) else message)
    with pytest.raises(ResetNeeded):
        env.step([0.5])
    np.testing.assert_array_equal(env.reset()[0], first)
    assert env.plant_error is None


def test_an_output_may_be_an_array_of_one_number():
    seen = []
    for wrap in (float, *(lambda y, shape=shape: np.full(shape, y) for shape in ((), (1,), (1, 1)))):
        env = around(Scripted([wrap(0.01), wrap(-0.02)]))
        env.reset(seed=0)
        seen.append([env.step([0.5])[0] for _ in range(2)])
        assert env.plant_error is None
        np.testing.assert_array_equal(seen[-1], seen[0])


def test_a_plant_that_cannot_be_reset_begins_no_episode():
    class Broken(Difference):
        def reset(self):
            super().reset()
            if self.resets == 2:
                raise OSError("no answer")

    env = around(Broken())
    env.reset()
    with pytest.raises(OSError, match="no answer"):
        env.reset()
    with pytest.raises(ResetNeeded):
        env.step([0.0])
    env.reset()
    assert not env.step([0.0])[2]


def test_refused_actions_do_not_reach_the_plant():
    plant = Difference()
    env = around(plant)
    with pytest.raises(ResetNeeded):
        env.step([0.0])
    env.reset()
    with pytest.raises(ValueError, match="action must be"):
        env.step([np.nan])
    assert plant.inputs == []


def test_policies_find_their_limits():
    env = around(Difference(), horizon=30, max_input=0.05, max_output=1.0)
    observation, _ = env.reset()
    policy, state, ended = make_policy("prbs", env), None, []
    while not any(ended[-1:]):
        action, state = policy.predict(observation, state)
        observation, _, _, truncated, _ = env.step(action)
        ended.append(truncated)
    assert len(ended) == 30
    assert set(map(abs, env.unwrapped.plant.inputs)) == {0.05}


def test_nobody_knows_the_truth():
    env = around(Difference())
    with pytest.raises(AttributeError, match="true parameters of a real plant are unknown"):
        _ = env.truth
    assert not hasattr(env, "truth")
    for reward in set(REWARDS) - {"information_gain", "expected_free_energy", "free_energy"}:
        with pytest.raises(ValueError, match=f"not be '{reward}'.*use 'information_gain'"):
            around(Difference(), reward=reward)


def test_bad_arguments_are_refused_with_a_remedy():
    cases = [
        (object(), {}, "methods reset() and step(u), but <object"),
        (object(), {}, " has no reset()"),
        (type("Half", (), {"reset": print})(), {}, "has no step()"),
        (Difference, {}, "object with reset and step, but is the class Difference; pass Difference()"),
        (Difference(), {"prior": "flat"}, "prior must be an estimator.Belief or None, but is 'flat'"),
        (Difference(), {"prior": weak_prior(PENDULUM, np.ones(3), np.eye(3))}, "of a model with one sensor"),
        (Difference(), {"horizon": 0}, "horizon must be a whole number"),
        (Difference(), {"spread": 0.1}, "unexpected keyword argument 'spread'"),
        (Difference(), {"max_input": 1.5}, "max_input must be at most 1, the rig's own limit"),
        (
            Difference(),
            {"prior": rig_prior(replace(VOLTS, step=1.0, guess=GUESS))},
            "prior must have the scales of the rig, but was saved with step ",
        ),
        (Difference(), {"prior": None}, "rig must have guess to be played, but has none"),
    ]
    assert_refused(
        (lambda plant=plant, options=options: around(plant, **options), message) for plant, options, message in cases
    )


def test_a_prior_of_ones_own_is_where_episodes_start():
    twin = silverbox_prior()
    prior = weak_prior(twin.model, twin.coefficients_mean, twin.coefficients_cov / 9, state_std=0.2)
    env = around(Difference(), prior=prior)
    env.reset()
    np.testing.assert_array_equal(env.belief.coefficients_cov, prior.coefficients_cov)
    env.step([1.0])
    assert env.belief.entropy() < around(Difference(), prior=prior).belief.entropy()


def test_an_episode_does_not_begin_where_the_record_of_its_prior_ended():
    prior = rig_prior(replace(VOLTS, guess=GUESS))
    mean, cov = prior.mean, prior.cov
    mean[:2], cov[:2], cov[:, :2] = (0.4, -0.2), 0.0, 0.0
    cov[0, 0] = cov[1, 1] = 1e-8
    ended = Belief.of(prior.model, mean, cov, prior.noises[:2], prior.noises[2:], scales=prior.scales)
    np.testing.assert_allclose(reset_state(ended).record, prior.record, rtol=1e-9, atol=1e-15)
    # As tests/specimens.py has it: with hypotheses.
    env = around(Difference(), prior=ended, reward="information_gain", noise_hypotheses=3)
    env.reset()
    np.testing.assert_allclose(env.belief.state_mean, prior.state_mean)
    np.testing.assert_allclose(env.belief.state_cov, prior.state_cov)
    outputs = silverbox_prior(difference())
    assert reset_state(outputs) is outputs, "its states are outputs"


def test_the_noises_are_as_likely_at_first_as_to_the_estimator_of_the_rig():
    rig = Rig(1e-3, input=Channel("N", limit=6), output=Channel("m", range=0.03), guess=GUESS)
    env = RigEnv(rig=rig, plant=Scripted([1e-4, 2e-4, 5e-4]))
    env.reset()
    weights = env.mixture()[1]
    np.testing.assert_allclose(weights, OnlineEstimator(rig=rig).arrays()["weights"], rtol=1e-12)
    assert np.ptp(weights) > 0.01


def test_a_model_without_the_cubic_term_recovers_from_a_plant_that_fails():
    # Mean field keeps rows of a θ2 that the model does not have: they must not stay NaN.
    prior = silverbox_prior(difference("linear")).with_factorisation("mean_field")
    env = around(Scripted([0.01, 1e200]), "mean_field", prior=prior, max_output=1.0)
    results = []
    for _ in range(2):
        env.reset()
        results.append([env.step([0.5])[0], env.step([0.5])[4]["diverged"]])
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert results[0][1]
    assert results[1][1]
    assert not np.array_equal(results[1][0], env.reset()[0])


def test_several_plants_are_several_environments():
    plants = [Difference(), Difference()]
    with pytest.raises(ValueError, match="SyncVectorEnv"):
        gym.make_vec("duffing_env/Rig-v0", num_envs=2, rig=VOLTS, plant=plants[0])
    envs = SyncVectorEnv([lambda plant=plant: around(plant) for plant in plants])
    envs.reset()
    envs.step(np.array([[1.0], [-1.0]], dtype=np.float32))
    assert [plant.inputs for plant in plants] == [[0.15], [-0.15]]


def test_one_plant_is_not_driven_by_two_environments():
    plant = Difference()
    options = {"prior": silverbox_prior(), "noise_hypotheses": 1, "max_input": 0.15, "reward": "free_energy"}
    envs = gym.make_vec("duffing_env/Rig-v0", num_envs=2, rig=VOLTS, plant=plant, vectorization_mode="sync", **options)
    envs.reset()
    with pytest.raises(ResetNeeded, match=r"plant must not be shared.*one plant is one environment; for several use"):
        envs.step(np.ones((2, 1), dtype=np.float32))
    assert plant.inputs == []


def test_an_environment_is_made_anew_around_a_plant_of_another():
    plant = Difference()
    first, second = around(plant), around(plant)
    for env in (first, second, first):  # the last to reset the plant has it
        env.reset()
        env.step([1.0])
    assert plant.inputs == [0.15] * 3
    with pytest.raises(ResetNeeded, match="plant must not be shared"):
        second.step([1.0])
    del first, env
    second.reset()
    second.step([1.0])


def test_it_is_drawn():
    env = around(Difference(), render_mode="rgb_array")
    env.reset()
    blank = env.render()
    env.step([1.0])
    assert (env.render() != blank).any()
