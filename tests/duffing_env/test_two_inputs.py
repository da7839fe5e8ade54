"""Several inputs: their limits, one energy of all, what is shown of them, and what refuses them by name.

tests/contract plays `specimens.TWO_FORCES`, whose kernel is used here, with the checkers and in all modes.
"""

import math
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from playing import assert_refused, random_actions
from reference.plants import TWO_MASSES
from specimens import TWO_FORCES

from agents.evaluation.metrics import fisher_information_gain
from agents.evaluation.policy_rollout import run_episodes
from agents.policies import make_policy
from agents.policies.signals import InputLimits, SignalPolicy
from agents.sb3_vec_env import DuffingVecEnv
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.storage.kernel_spec import observation_bounds
from duffing_env.tracks.model_env import ModelEnv, ModelVectorEnv
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters

LARGEST, SLEW = np.array([0.5, 0.2]), np.array([0.6, 0.15])
BUDGET = TWO_FORCES["horizon"] * TWO_FORCES["max_rms"] ** 2
#: With outputs that never end an episode.
WIDE = TWO_FORCES | {"max_output": 1e6}


def limited(asked, last, spent):
    """The inputs (n, 2) that are applied where ``asked`` is asked for, and which rows the energy scales."""
    slewed = np.clip(asked, last - SLEW, last + SLEW)
    energy, left = (slewed**2).sum(axis=1), np.maximum(BUDGET - spent, 0.0)
    factor = np.where(energy > left, np.sqrt(left / np.where(energy > 0, energy, 1.0)), 1.0)
    return factor[:, None] * slewed, energy > left


def test_inputs_keep_their_amplitude_and_slew_and_one_energy_of_all():
    n, steps = 64, TWO_FORCES["horizon"]
    envs = ModelVectorEnv(n, **WIDE)
    envs.reset(seed=0)
    actions = random_actions(steps, n, seed=3, inputs=2)
    actions[:, ::2] = np.sign(actions[:, ::2])  # at the limits
    last, spent, n_scaled = np.zeros((n, 2)), np.zeros(n), 0
    exact = [Fraction(0)] * n
    for action in actions:
        observations, *_ = envs.step(action)
        applied = envs._batch.applied_inputs()
        expected, is_scaled = limited(LARGEST * np.clip(action.astype(float), -1, 1), last, spent)
        # A scaled sample leaves a little of the energy: see duffing_env.kernel_stages.input_limits.
        np.testing.assert_allclose(applied, expected, rtol=1e-12, atol=1e-12 * math.sqrt(BUDGET))
        assert (np.abs(applied - last)[~is_scaled] <= SLEW * (1 + 1e-15)).all()
        n_scaled += is_scaled.sum()
        for row in range(n):
            exact[row] += sum(Fraction(u) ** 2 for u in applied[row].tolist())
        last, spent = applied, envs._batch.row_values("ENERGY_SPENT")
        assert (spent <= BUDGET).all()
        shown = observations[:, [list(observation_bounds(TWO_MASSES)).index(f"last_{name}") for name in ("f1", "f2")]]
        np.testing.assert_array_equal(shown, (applied * (1 / LARGEST)).astype(np.float32))
    assert n_scaled > n
    # Of all samples in exact arithmetic: the sum of the kernel is rounded once for each.
    assert all(energy <= BUDGET * (1 + steps * 2.0**-53) for energy in exact)
    assert max(exact) > 0.999 * BUDGET


def test_inputs_beyond_the_budget_are_scaled_by_one_factor():
    env = ModelEnv(**WIDE | {"max_rms": 0.05, "max_slew": None})
    env.reset(seed=0)
    env.step([0.3, -1.0])  # Σ u² would be 0.0625, and the budget is 0.055
    factor = math.sqrt(0.055 / 0.0625)
    assert env._batch.applied_inputs()[0] == pytest.approx([0.15 * factor, -0.2 * factor], rel=1e-7)
    observation, *_ = env.step([1.0, 1.0])
    assert env._batch.row_values("ENERGY_SPENT")[0] <= env._batch._params.budget
    assert observation[-1] == pytest.approx(0.0, abs=1e-6)


def test_the_costs_of_inputs_add_up():
    free, paid = ModelEnv(**WIDE | {"input_cost": 0.0}), ModelEnv(**WIDE)
    for env in (free, paid):
        env.reset(seed=4)
    for action in random_actions(10, inputs=2)[:, 0]:
        (_, reward, *_), (_, less, *_) = free.step(action), paid.step(action)
        cost = 0.1 * ((paid._batch.applied_inputs()[0] / LARGEST) ** 2).sum()
        assert reward - less == pytest.approx(cost, rel=1e-9)


def test_a_number_or_a_sequence_says_the_same_as_names():
    named = ModelEnv(**WIDE)
    assert named.max_input == {"f1": 0.5, "f2": 0.2}
    assert ModelEnv(**WIDE | {"max_input": (0.5, 0.2)}).experiment == named.experiment
    assert ModelEnv(**WIDE | {"max_input": {"f2": 0.2, "f1": 0.5}}).experiment == named.experiment
    assert ModelEnv(**WIDE | {"max_input": 0.3}).experiment.max_inputs.tolist() == [0.3, 0.3]
    assert SimulatedExperiment(max_input={"u": 0.1}).max_inputs.tolist() == [0.1]


def test_each_sensor_has_a_limit_of_its_own():
    """An episode ends at the first sample that is beyond one of them."""
    limits, ended_by = np.array([0.2, 0.1]), set()
    wide, tight = ModelEnv(**WIDE), ModelEnv(**TWO_FORCES | {"max_output": 0.2, "sensor_limits": (0.1,)})
    for seed in range(20):
        for env in (wide, tight):
            env.reset(seed=seed)
        for action in random_actions(TWO_FORCES["horizon"] - 1, seed=seed, inputs=2)[:, 0]:
            wide.step(action)
            *_, terminated, _, _ = tight.step(action)
            beyond = np.abs(wide._batch.row_matrix(["Y_y1", "Y_y2"])[0]) > limits
            assert terminated == beyond.any()
            if terminated:
                ended_by.add(tuple(beyond.tolist()))
                break
    assert ended_by >= {(True, False), (False, True)}


def test_rewards_and_histories_of_ones_own_have_a_column_for_each_input():
    seen = []

    def reward(before, after, u, y, truth):
        seen.append(u.copy())
        return u.sum(axis=1)

    envs = ModelVectorEnv(3, **WIDE | {"reward": reward, "observation": "history", "history": 2, "input_cost": 0})
    envs.reset(seed=0)
    for action in random_actions(2, 3, inputs=2):
        observations, rewards, *_ = envs.step(action)
    np.testing.assert_array_equal(seen[-1], envs._batch.applied_inputs())
    np.testing.assert_allclose(rewards, seen[-1].sum(axis=1))
    rows = observations[:, :-2].reshape(3, 2, 4)  # two inputs, two outputs
    for shown, applied in zip(rows.swapaxes(0, 1), seen, strict=True):
        np.testing.assert_allclose(shown[:, :2], applied / LARGEST, rtol=1e-6)


# --- Another kernel: inputs that go linearly from one sample to the next ---------------------------------------------


def test_the_plant_is_the_reference_along_lines_between_inputs():
    quiet = WIDE | {"process_noise": 1e-12, "measurement_noise": 1e-12, "sensor_noise": (1e-12,), "max_rms": None}
    env = ModelEnv(**quiet, interpolation="linear")
    env.reset(seed=1)
    k, c, d, g = (env.truth[name] for name in TWO_MASSES.coefficients)
    A = np.array([[0, 1, 0, 0], [-k - c, -d, c, 0], [0, 0, 0, 1], [c, 0, -k - c, -d]])
    B = np.array([[0, 0], [g, 0], [0, 0], [0, g]])
    x, last = np.zeros(4), np.zeros(2)
    for action in random_actions(20, inputs=2)[:, 0]:
        env.step(action)
        u = env._batch.applied_inputs()[0]
        k1 = A @ x + B @ last
        k2 = A @ (x + k1 / 2) + B @ (last + u) / 2
        k3 = A @ (x + k2 / 2) + B @ (last + u) / 2
        k4 = A @ (x + k3) + B @ u
        x, last = x + (k1 + 2 * k2 + 2 * k3 + k4) / 6, u
        outputs = [env._batch.row_values(f"Y_{y}")[0] for y in TWO_MASSES.outputs]
        np.testing.assert_allclose(outputs, x[[0, 2]], rtol=1e-9, atol=1e-10)


# --- Policies ------------------------------------------------------------------------------------------------------


def test_a_signal_plays_an_independent_sequence_on_each_input():
    envs = ModelVectorEnv(4, **TWO_FORCES | {"max_rms": None})
    policy, state = make_policy("prbs", envs, seed=5), None
    played = []
    for _ in range(22):
        actions, state = policy.predict(np.zeros((4, 27)), state)
        assert (actions.shape, actions.dtype) == ((4, 2), np.float32)
        played.append(actions)
    played = np.array(played)
    assert set(np.unique(played)) == {-1.0, 1.0}
    first, second = played[..., 0], played[..., 1]
    assert not np.array_equal(first, second)
    assert len({tuple(row) for row in np.concatenate([first.T, second.T]).tolist()}) == 8
    single = make_policy("prbs", ModelEnv(**TWO_FORCES | {"max_rms": None}), seed=5)
    action, _ = single.predict(np.zeros(27))
    np.testing.assert_array_equal(action, played[0, 0])  # for any number of rows


def test_a_power_budget_sums_over_the_inputs():
    limits = InputLimits((2.0, 0.5), max_rms=0.3)
    volts = np.random.default_rng(0).uniform(-2, 2, (500, 2))
    actions = limits.to_actions(volts)
    power = ((np.array([2.0, 0.5]) * actions) ** 2).sum(axis=1).mean()
    assert math.sqrt(power) == pytest.approx(0.3, rel=1e-5)
    assert math.sqrt(power) <= 0.3
    clipped = np.clip(volts / [2.0, 0.5], -1, 1)
    np.testing.assert_allclose(actions, clipped * (actions[0, 0] / clipped[0, 0]), rtol=1e-12)


def test_a_law_plays_all_systems_within_the_budget():
    options = TWO_FORCES | {"max_output": 2.0}
    played = run_episodes("multilevel-prbs", "duffing_env/WienerHammerstein-v0", 4, 0, options)
    evaluation = played.evaluation
    assert evaluation.inputs.shape == evaluation.outputs.shape == (22, 4, 2)
    assert ((evaluation.inputs**2).sum(axis=(0, 2)) <= BUDGET * (1 + 1e-6)).all()
    np.testing.assert_allclose(
        evaluation.metrics["input_power"], (evaluation.inputs**2).sum(axis=2).mean(axis=0), rtol=1e-12
    )
    assert (evaluation.metrics["information_gain"] > 1).all()
    gains = fisher_information_gain(evaluation.inputs, played.truth, played.experiment, evaluation.outputs)
    for i, gain in enumerate(gains):
        one = Parameters({name: values[i : i + 1] for name, values in played.truth.items()})
        series = (array[:, i : i + 1] for array in (evaluation.inputs, evaluation.outputs))
        alone = fisher_information_gain(next(series), one, played.experiment, next(series))
        assert gain == pytest.approx(alone.item(), rel=1e-9)
    assert (np.abs(gains - evaluation.metrics["information_gain"]) < 3).all()


def test_a_function_gives_an_action_for_each_input():
    env = ModelEnv(**TWO_FORCES)
    policy = make_policy(lambda observations: np.tile([0.5, -2.0], (len(observations), 1)), env)
    assert policy.predict(np.zeros(27))[0].tolist() == [0.5, -1.0]
    assert policy.predict(np.zeros((3, 27)))[0].shape == (3, 2)
    with pytest.raises(ValueError, match="must give 2 finite inputs for each of 1 observations"):
        make_policy(lambda observations: np.zeros(len(observations)), env).predict(np.zeros(27))


def test_levels_of_stable_baselines3_are_chosen_for_each_input():
    envs = DuffingVecEnv("duffing_env/WienerHammerstein-v0", 3, seed=0, levels=3, **TWO_FORCES | {"max_slew": None})
    assert envs.action_space == gym.spaces.MultiDiscrete([3, 3])
    envs.reset()
    envs.step(np.array([[0, 2], [1, 1], [2, 0]]))
    applied = envs.envs.unwrapped._batch.applied_inputs()
    np.testing.assert_allclose(applied, LARGEST * [[-1, 1], [0, 0], [1, -1]])


# --- Refusals ------------------------------------------------------------------------------------------------------


def test_what_takes_one_input_refuses_several_by_name():
    env = ModelEnv(**TWO_FORCES)
    cases = [
        (lambda name=name: make_policy(name, env), "but 'two_masses' has 2, ['f1', 'f2']; choose a signal such as prbs")
        for name in ("efe", "efe-myopic", "efe-block-16", "shield", "velocity-sign", "square-believed")
    ]
    cases.append((lambda: make_policy("ppo/amplitude", env), "model must have one input for a trained policy"))
    assert_refused(cases)


def test_wrong_numbers_of_inputs_are_named():
    env, envs = ModelEnv(**TWO_FORCES), ModelVectorEnv(3, **TWO_FORCES)
    env.reset(seed=0)
    envs.reset(seed=0)
    before = env._batch.memory["blocks"].copy()
    cases = [
        (lambda action=action: env.step(action), "action must be 2 finite numbers")
        for action in (0.5, [0.5], [0.1, 0.2, 0.3], [[0.1, 0.2]], [0.1, np.nan], ["a", "b"], None)
    ]
    cases += [
        (lambda: envs.step(np.zeros((3, 1), np.float32)), "actions must have shape (3, 2)"),
        (lambda: envs.step(np.array([[0, 0], [0, np.inf], [0, 0]], np.float32)), "row 1 is inf"),
        (
            lambda: ModelEnv(**TWO_FORCES | {"max_input": (0.5,)}),
            "max_input must be a number, or give one for each of the inputs ['f1', 'f2']",
        ),
        (
            lambda: ModelEnv(**TWO_FORCES | {"max_input": {"f1": 0.5}}),
            "max_input must be a number, or give one for each of the inputs ['f1', 'f2']",
        ),
        (
            lambda: ModelEnv(**TWO_FORCES | {"max_slew": {"f1": 1, "f3": 1}}),
            "max_slew must be a number, or give one for each",
        ),
        (lambda: ModelEnv(**TWO_FORCES | {"max_slew": {"f1": 1, "f2": -1}}), "max_slew of f2 must be"),
        (
            lambda: ModelEnv(**TWO_FORCES | {"sensor_limits": (1.0, 1.0)}),
            "sensor_limits must be for the sensors ['y2']",
        ),
        (lambda: ModelEnv(**TWO_FORCES | {"sensor_limits": (0,)}), "sensor_limits must be"),
        (lambda: InputLimits((0.1, -0.1)), "max_input must be positive"),
        (lambda: SignalPolicy("one", [lambda rng, n: np.zeros(n)], max_input=(0.1, 0.2)), "draw must be one for each"),
    ]
    assert_refused(cases)
    np.testing.assert_array_equal(env._batch.memory["blocks"], before)


def test_an_environment_of_a_model_without_inputs_is_refused():
    fading = Model("fading", {"x": "V"}, {"rate": "1"}, inputs={}, noise=("1",), outputs={"y": "x"}, rates=("-rate*x",))
    with pytest.raises(
        ValueError, match=r"model must have an input for an environment, .* 'fading' has none; name one"
    ):
        ModelEnv(system=fading, mean={"rate": 0.1})


def test_names_of_inputs_make_another_kernel():
    assert replace(TWO_MASSES, name="two_masses").digest == TWO_MASSES.digest
    renamed = [text.replace("f1", "f3") for text in TWO_MASSES.rates]
    assert replace(TWO_MASSES, inputs={"f3": "N", "f2": "N"}, rates=tuple(renamed)) != TWO_MASSES


def test_stand_ins_with_a_number_still_do():
    assert make_policy("prbs", SimpleNamespace(unwrapped=SimpleNamespace(max_input=0.1, horizon=5))).max_input == 0.1
