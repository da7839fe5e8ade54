"""Hypotheses about the noises in an environment: the mixture that the online estimator has, whoever lies beside it."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from scipy.special import logsumexp
from test_rig_env import RIG
from test_vector_env import assert_same, random_actions, roll_out
from twin import Moments, TwinContinuousEnv, TwinEnv, assert_env_follows_twin, structured_update

from duffing_env.batch import spawn_seeds
from duffing_env.continuous import ContinuousEnv
from duffing_env.env import DuffingEnv
from duffing_env.experiment import SimulatedExperiment
from duffing_env.model_env import ModelEnv
from duffing_env.replay import SilverboxReplayEnv
from duffing_env.rewards import REWARDS
from duffing_env.tracks import TRACKS
from duffing_env.vector_env import DuffingVectorEnv
from estimator import OnlineEstimator, Rig, silverbox_prior
from estimator.lanes import LANES

#: Nine members each: of four environments they share a block with others'.
OPTIONS = {"noise_hypotheses": 3, "process_noise_guess": 1.5e-3, "noise_range": 10.0}


# --- The mixture ---------------------------------------------------------------------------------------------------


def mixed(weights, members):
    """The moments of a mixture; of the noises those of their variances, by the relative variance 1/shape."""
    mean = sum(w * m.mean for w, m in zip(weights, members, strict=True))
    cov = sum(w * (m.cov + np.outer(m.mean - mean, m.mean - mean)) for w, m in zip(weights, members, strict=True))
    noises = []
    for name in ("gamma", "xi"):
        shapes, rates = np.array([getattr(m, name) for m in members]).T
        variances = rates / shapes
        average = weights @ variances
        shape = average**2 / (weights @ (variances**2 / shapes + variances**2) - average**2)
        noises.append((shape, shape * average))
    return Moments(mean, cov, *noises)


def weighed(twin):
    """A twin with as many beliefs as three times ``noise_hypotheses``, from the words of `estimator.ensemble`."""

    class Weighed(twin):
        def __init__(self, seed, *, noise_hypotheses, **options):
            super().__init__(seed, **options)
            prior = self.first_belief
            (g, g_rate), (n, n_rate) = prior.gamma, prior.xi
            total, ratio = g_rate / g + n_rate / n, np.sqrt(g_rate / g / (n_rate / n))
            self.first_members = []
            for level in (1 / 3, 1, 3):
                for factor in np.geomspace(1 / 30, 30, noise_hypotheses):
                    share = (ratio * factor) ** 2 / (1 + (ratio * factor) ** 2)
                    q, r = level**2 * total * share, level**2 * total * (1 - share)
                    self.first_members.append(Moments(prior.mean, prior.cov, (g, g * q), (n, n * r)))
            self.first_weights = np.full(len(self.first_members), 1 / len(self.first_members))
            self.first_belief = mixed(self.first_weights, self.first_members)

        def reset(self):
            self.members, self.weights = self.first_members, self.first_weights
            return super().reset()

        def _update(self):
            walk = (self.drift * np.sqrt(np.diag(self.first_belief.cov))) ** 2 * [0, 0, 1, 1, 1, 1]
            updated = []
            for member in self.members:
                widened = Moments(member.mean, member.cov + np.diag(walk), member.gamma, member.xi)
                updated.append(structured_update(widened, self._model_step(member.mean), self.y, self.iterations))
            self.members, energies = zip(*updated, strict=True)
            before = np.log((1 - 1e-6) * self.weights + 1e-6 / len(self.weights))
            self.free_energy = -logsumexp(before - energies)
            self.weights = np.exp(before - energies + self.free_energy)
            self.belief = mixed(self.weights, self.members)

    return Weighed


#: Seconds of compilation each; the others only read the mixture.
KERNELS = ("free_energy", "fisher", "expected_free_energy", "simulation_error")


@pytest.mark.parametrize("reward", [pytest.param(r, marks=[pytest.mark.slow] * (r in KERNELS)) for r in REWARDS])
def test_an_environment_that_weighs_hypotheses_follows_its_twin(reward):
    options = OPTIONS | {"horizon": 60}
    twin = weighed(TwinEnv)(0, **options)
    assert assert_env_follows_twin(DuffingEnv(reward=reward, **options), twin, reward, 0) == [(False, True)] * 2


@pytest.mark.parametrize(
    "reward",
    [
        "information_gain",
        *(pytest.param(r, marks=pytest.mark.slow) for r in ("free_energy", "fisher", "expected_free_energy")),
    ],
)
def test_so_does_one_on_the_differential_equation(reward):
    options = {"noise_hypotheses": 3, "horizon": 30, "process_noise_guess": 1.5e-3}
    env, twin = ContinuousEnv(reward=reward, **options), weighed(TwinContinuousEnv)(0, **options)
    assert_env_follows_twin(env, twin, reward, 0)


@pytest.mark.slow  # a kernel of its own
def test_drift_widens_every_member():
    options = {"noise_hypotheses": 2, "horizon": 60, "drift": 0.02, "jump": 0.3, "iterations": 2}
    assert_env_follows_twin(DuffingEnv(**options), weighed(TwinEnv)(0, **options), "information_gain", 0)


def close(first, second):
    """Two beliefs that are the same to rounding."""
    std = np.sqrt(np.diag(second.coefficients_cov))
    np.testing.assert_allclose(first.coefficients_mean / std, second.coefficients_mean / std, rtol=0, atol=1e-9)
    scale = np.outer(std, std)
    np.testing.assert_allclose(first.coefficients_cov / scale, second.coefficients_cov / scale, rtol=0, atol=1e-9)
    np.testing.assert_allclose(first.state_mean, second.state_mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(first.noises, second.noises, rtol=1e-9)


ESTIMATED = {
    "difference": (DuffingEnv, Rig.silverbox("zero_order", 0)),
    "continuous": (ContinuousEnv, Rig.silverbox("zero_order", -1)),  # an action acts before the sample that it brings
}


@pytest.mark.parametrize("case", ["difference", pytest.param("continuous", marks=pytest.mark.slow)])
def test_the_belief_is_that_of_the_online_estimator(case):
    make, rig = ESTIMATED[case]
    env = make(**OPTIONS, reward="free_energy")
    env.reset(seed=0)
    prior = env.experiment.believed
    estimator = OnlineEstimator(prior.model, prior, rig, noise_hypotheses=3)
    close(env.belief, estimator.belief)
    u, y, rewards = np.empty((3, 256))
    for t, action in enumerate(random_actions(256, 1)[:, 0]):
        rewards[t] = env.step(action)[1]
        u[t], y[t] = env._batch.quantity("INPUT")[0], env._batch.quantity("Y_y")[0]
    energies = estimator.run(u, y)
    np.testing.assert_allclose(-rewards, energies[:, -1], rtol=1e-9, atol=1e-9)
    close(env.belief, estimator.belief)


class Recorded:
    """A plant that gives what another environment saw."""

    def __init__(self, outputs):
        self.outputs = outputs

    def reset(self):
        self.left = iter(self.outputs)

    def step(self, u):
        return next(self.left)


def test_a_plant_that_gives_no_number_leaves_the_belief():
    env = gym.make("duffing_env/Rig-v0", rig=RIG, plant=Recorded([1e-4, np.nan])).unwrapped
    env.reset()
    env.step([0.5])
    before = env.belief
    observation, reward, terminated, _, info = env.step([0.5])
    assert (terminated, info["diverged"], reward) == (True, True, 0)
    assert env.belief == before
    assert np.isfinite(observation).all()


def test_a_record_is_believed_alike(record):
    env = SilverboxReplayEnv(noise_hypotheses=3)
    env.reset()
    for u in env.recorded_input[:300]:
        _, _, terminated, _, _ = env.step([u / 0.15])
        assert not terminated
    estimator = OnlineEstimator(None, silverbox_prior(), Rig.silverbox("zero_order", 0), noise_hypotheses=3)
    estimator.run(record.multisine.u[:300], record.multisine.y[1:301])
    close(env.belief, estimator.belief)


# --- Whoever lies beside it ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_row_is_a_single_environment_to_the_bit(mode):
    options = OPTIONS | {"horizon": 25, "max_output": 0.2, "noise_hypotheses": 5}
    actions, seeds = random_actions(60, 70), spawn_seeds(3, 70)
    whole = DuffingVectorEnv(70, autoreset_mode=mode, **options)
    told = roll_out(whole, actions, 3)
    threaded = DuffingVectorEnv(70, autoreset_mode=mode, threads=2, **options)
    assert_same(roll_out(threaded, actions, 3), told)
    for rows in (range(1), range(31, 38), range(69, 70)):
        few = DuffingVectorEnv(len(rows), autoreset_mode=mode, **options)
        few.reset(seed=[seeds[row] for row in rows])
        again = roll_out(few, actions[:, rows], [seeds[row] for row in rows])
        if mode == "Disabled":  # rows are reset together, where any has finished
            continue
        for step, expected in zip(again, told, strict=True):
            np.testing.assert_array_equal(step[0], expected[0][rows])
            for k in range(1, len(step) - 1):
                np.testing.assert_array_equal(step[k], expected[k][rows])
        np.testing.assert_array_equal(few.records, whole.records[rows])


def test_a_single_environment_is_a_row_to_the_bit():
    options = OPTIONS | {"horizon": 20, "max_output": 0.2}
    actions = random_actions(60, 5)
    envs = DuffingVectorEnv(5, autoreset_mode="SameStep", **options)
    told = roll_out(envs, actions, 0)
    for row, seed in enumerate(spawn_seeds(0, 5)):
        env = DuffingEnv(**options)
        env.reset(seed=seed)
        for t, action in enumerate(actions[:, row]):
            observation, reward, terminated, truncated, _ = env.step(action)
            observations, rewards, *_, infos = told[t + 1]
            assert reward == rewards[row]
            if terminated or truncated:
                np.testing.assert_array_equal(observation, infos["final_obs"][row])
                assert env.belief == infos["final_info"]["belief"][row]
                observation, _ = env.reset()
            np.testing.assert_array_equal(observation, observations[row])


def test_an_action_that_is_held_is_repeated():
    options = OPTIONS | {"horizon": 10}
    held, plain = DuffingVectorEnv(40, hold=4, **options), DuffingVectorEnv(40, **options)
    held.reset(seed=0)
    plain.reset(seed=0)
    rewards = np.zeros(40)
    for action in random_actions(2, 40):
        _, received, *_ = held.step(action)
        for _ in range(4):
            rewards += plain.step(action)[1]
        np.testing.assert_allclose(received, rewards, rtol=0, atol=1e-12)
        rewards[:] = 0
    np.testing.assert_array_equal(held.records, plain.records)


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda envs: pickle.loads(pickle.dumps(envs))], ids=["copy", "pickle"]
)
def test_copies_continue_alike_and_apart(copied):
    envs = DuffingVectorEnv(5, horizon=20, **OPTIONS)
    actions = random_actions(60, 5)
    roll_out(envs, actions[:30])
    twin, witness = copied(envs), copied(envs)
    expected = [envs.step(action) for action in actions[30:]]
    assert_same([twin.step(action) for action in actions[30:]], expected)
    assert_same([witness.step(action) for action in actions[30:]], expected)


def test_a_member_that_overflowed_has_no_say():
    envs, plain = (DuffingVectorEnv(6, **OPTIONS) for _ in range(2))
    actions = random_actions(40, 6)
    roll_out(envs, actions[:10])
    roll_out(plain, actions[:10])
    # The member of environment 4 that its own block of lanes begins with.
    lane = 4 * 9
    assert lane // LANES == 1
    envs._batch._members[1].reshape(-1, LANES)[0, lane % LANES] = np.nan
    for action in actions[10:]:
        envs.step(action)
        plain.step(action)
    assert np.isfinite(envs.records).all()
    assert not np.array_equal(envs.records[4], plain.records[4])
    np.testing.assert_array_equal(np.delete(envs.records, 4, 0), np.delete(plain.records, 4, 0))


# --- Options -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", ["Amplitude-v0", "Amplitude-v1"])
def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(track, recwarn):
    from stable_baselines3.common.env_checker import check_env as sb3_check

    env = gym.make(f"duffing_env/{track}", noise_hypotheses=3, noise_range=10.0, horizon=30)
    gymnasium_check(env.unwrapped)
    sb3_check(env.unwrapped, warn=True)
    told = [str(warning.message) for warning in recwarn]
    assert not [text for text in told if "Overwriting" not in text]


@pytest.mark.parametrize("value", [0, -1, 2.0, True, None, "3", 100])
def test_a_bad_number_is_named(value):
    with pytest.raises(ValueError, match=r"^noise_hypotheses must be a whole number from 1 to 99, but is"):
        SimulatedExperiment(noise_hypotheses=value)


@pytest.mark.parametrize(
    ("make", "options", "remedy"),
    [
        (DuffingEnv, {"factorisation": "mean_field"}, "use factorisation='structured'"),
        (ContinuousEnv, {"factorisation": "mean_field", "estimator": "nlarx"}, "use factorisation='structured'"),
        (ModelEnv, TRACKS["duffing_env/Pendulum-v0"]["kwargs"], "centre the priors of its noises with care"),
    ],
)
def test_what_cannot_weigh_hypotheses_says_so(make, options, remedy):
    with pytest.raises(ValueError, match=f"^noise_hypotheses must be 1 for .*, but is 3; {remedy}"):
        make(noise_hypotheses=3, **options)


def test_one_hypothesis_is_the_prior_itself():
    one, many = SimulatedExperiment(), SimulatedExperiment(noise_hypotheses=9)
    assert not one.kind.weighs
    assert one.setup.hypotheses.shape == (0, 5)
    np.testing.assert_array_equal(one.setup.prior, one.believed.record)
    assert many.setup.hypotheses.shape == (27, 5)
    assert many.kind == SimulatedExperiment(noise_hypotheses=4).kind  # a kernel does not know how many there are
    assert many.believed == one.believed
    np.testing.assert_allclose(many.setup.prior[:-4], one.setup.prior[:-4], rtol=1e-13)
