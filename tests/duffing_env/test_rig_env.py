"""Rig-v0: a rig of one's own as the environment, simulated and around its plant."""

import json

import gymnasium as gym
import numpy as np
import pytest
from playing import assert_refused
from specimens import RIG, Bench

from agents import make_policy
from duffing_env.tracks.rig_env import RigExperiment
from estimator import OnlineEstimator, Rig
from estimator.rigs.physical_parameters import coefficients_of

GUESS = RIG.guess
ID = "duffing_env/Rig-v0"


def make_vec(envs, rig=RIG, **options):
    return gym.make_vec(ID, num_envs=envs, vectorization_mode="vector_entry_point", rig=rig, **options)


def played(envs, steps=256, seed=1):
    """Endings (belief, truth, terminated) of one episode of each, under a binary input that is held for six samples."""
    rng, n = np.random.default_rng(0), envs.num_envs
    envs.reset(seed=seed)
    endings = [None] * n
    for t in range(steps):
        if t % 6 == 0:
            actions = rng.choice([-1.0, 1.0], (n, 1)).astype(np.float32)
        _, _, terminated, truncated, infos = envs.step(actions)
        for row in np.flatnonzero(terminated | truncated):
            endings[row] = endings[row] or (infos["belief"][row], infos["truth"][row], bool(terminated[row]))
    return endings


def test_a_rig_may_be_json():
    env = gym.make(ID, rig=json.loads(json.dumps(RIG.to_dict())))
    assert gym.make(gym.spec(ID), rig=RIG.to_dict()).unwrapped.experiment == env.unwrapped.experiment
    assert env.unwrapped.experiment == gym.make(ID, rig=RIG).unwrapped.experiment


def test_truth_is_drawn_from_the_guess_in_the_rig_s_units():
    endings = played(make_vec(256, horizon=1), steps=1)
    truths = {name: np.array([truth[name] for _, truth, _ in endings]) for name in "mcab"}
    for name, (low, high) in GUESS.items():
        inside = ((truths[name] > low) & (truths[name] < high)).mean()
        assert abs(inside - 0.9) < 4 * np.sqrt(0.09 / 256)
        assert (truths[name] > 0).all()
    noises = np.array([endings[k][1]["measurement_noise"] for k in range(256)])
    assert 5e-6 / np.sqrt(10) <= noises.min() < 2.5e-6
    assert 1e-5 < noises.max() <= 5e-6 * np.sqrt(10)


def test_intervals_hold_the_truth_with_noises_unknown():
    endings = played(make_vec(256))
    assert not any(terminated for *_, terminated in endings)
    scaled = np.array(
        [
            (belief.coefficients_mean - coefficients_of(belief.model, truth, belief.scales))
            / np.sqrt(np.diag(belief.coefficients_cov))
            for belief, truth, _ in endings
        ]
    )
    # The pooled share of six dependent coefficients is as uncertain as the share of one.
    assert abs((np.abs(scaled) < 1.645).mean() - 0.9) < 4 * np.sqrt(0.09 / 256)
    errors = [abs(belief.parameters()["m"][0] / truth.m - 1) for belief, truth, _ in endings]
    assert np.median(errors) < 0.003


def test_around_the_plant_inputs_and_outputs_are_in_its_units():
    bench = Bench()
    env = gym.make(ID, rig=RIG, plant=bench, horizon=60).unwrapped
    env.reset(seed=0)
    actions = np.repeat(np.random.default_rng(3).choice([-1.0, 1.0], 10), 6)
    for action in actions:
        observation, _, terminated, truncated, _ = env.step([action])
    assert truncated
    assert not terminated
    assert set(np.abs(bench.inputs)) == {6.0}
    np.testing.assert_allclose(observation[32], bench.outputs[-1] / 0.03, rtol=1e-6)
    mean, std, unit = env.belief.parameters()["m"]
    assert abs(mean - bench.truth["m"]) < 5 * std < 0.2
    assert unit == "kg"
    # The estimator of the same rig has the environment's beliefs after the same pairs.
    estimator = OnlineEstimator(rig=Rig.from_dict(RIG.to_dict() | {"delay": -1}))
    estimator.run(bench.inputs, bench.outputs)
    np.testing.assert_allclose(env.belief.coefficients_mean, estimator.belief.coefficients_mean, rtol=1e-6, atol=1e-9)


@pytest.mark.slow  # compiles the planner's kernels of a third model; fast tests cover two
def test_the_planner_plays_it():
    envs = make_vec(2, horizon=8)
    observations, _ = envs.reset(seed=0)
    actions, _ = make_policy("efe", envs).predict(observations, deterministic=True)
    assert np.abs(actions).max() > 0.5


def test_an_input_that_is_smooth_goes_linearly_from_one_action_to_the_next():
    for interpolation in ("linear", "look_ahead", "spline"):
        assert RigExperiment(rig={**RIG.to_dict(), "interpolation": interpolation}).degree == 1


def test_errors_name_the_option():
    far = {**RIG.to_dict()["output"], "offset": 0.6 * RIG.output.range}
    cases = [
        ({}, "rig must be a Rig, a dictionary or a file name, but is None"),
        ({"rig": Rig(1.0, guess=GUESS)}, "rig must have input.limit to be played, but has none"),
        ({"rig": {**RIG.to_dict(), "delay": 1}}, "rig must have no delay for an environment, but has 1"),
        (
            {"rig": {**RIG.to_dict(), "output": far}},
            "output.offset must be within half of the range, by which the motion is guessed, but is",
        ),
        ({"rig": RIG, "max_input": 1.5}, "max_input must be at most 1, the rig's own limit, but is 1.5"),
        ({"rig": RIG, "spread": 0.2}, "spread must be left out for a rig"),
        ({"rig": RIG, "factorisation": "mean_field"}, "factorisation must be 'structured' for a rig"),
    ]
    assert_refused((lambda options=options: RigExperiment(**options), message) for options, message in cases)
