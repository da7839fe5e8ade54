"""Noise hypotheses in an environment: the same mixture as in the online estimator."""

from dataclasses import replace

import numpy as np
import pytest
from playing import assert_refused, random_actions, roll_out
from reference.filters import carried
from reference.mixture import hypotheses, mixed, weighed
from reference.structured import structured_update
from specimens import GUESSED
from twin import TwinContinuousEnv, TwinEnv, assert_env_follows_twin

from duffing_env.env import DuffingEnv
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.tracks.differential_equation_tracks import ContinuousEnv
from duffing_env.tracks.silverbox_replay import ReplayExperiment
from duffing_env.vector_env import DuffingVectorEnv
from estimator import OnlineEstimator, Rig
from estimator.compilation.simd import LANES

#: Nine members each, so that four environments' members share blocks. The kernel of this reward gives the mixture's
#: free energy; the infos of a step give the information gain and the log posterior gain, which are rewards as well.
OPTIONS = {**GUESSED, "reward": "free_energy", "horizon": 256, "max_output": 0.6}


def weighing(twin):
    """A twin with three times as many beliefs as ``noise_hypotheses``."""

    class Weighing(twin):
        def __init__(self, seed, *, noise_hypotheses, **options):
            super().__init__(seed, **options)
            self.first_members = hypotheses(self.first_belief, noise_hypotheses)
            self.first_weights = np.full(len(self.first_members), 1 / len(self.first_members))
            self.first_belief = mixed(self.first_weights, self.first_members)

        def reset(self):
            self.members, self.weights = self.first_members, self.first_weights
            return super().reset()

        def _update(self):
            walk = (self.drift * np.sqrt(np.diag(self.first_belief.cov))) ** 2 * [0, 0, 1, 1, 1, 1]
            shared, updated = self._model_step(self.belief.mean), []
            for member in self.members:
                widened = replace(member, cov=member.cov + np.diag(walk))
                step = carried(shared, member.mean - self.belief.mean)
                updated.append(structured_update(widened, step, self.y, self.iterations))
            self.members, energies = zip(*updated, strict=True)
            self.weights, self.free_energy = weighed(self.weights, energies)
            self.belief = mixed(self.weights, self.members)

    return Weighing


#: Kernels of their own, which are left to the evidence.
EVIDENCE = [pytest.param(r, marks=pytest.mark.slow) for r in ("fisher", "expected_free_energy")]
#: They only read the mixture.
READ = ("information_gain", "log_posterior", "parameter_error")


@pytest.mark.parametrize("reward", ["free_energy", *EVIDENCE, pytest.param("simulation_error", marks=pytest.mark.slow)])
def test_an_environment_that_weighs_hypotheses_follows_its_twin(reward):
    options = GUESSED | {"horizon": 40, "jump": 0.3, "drift": 0.02}
    twin = weighing(TwinEnv)(0, **options)
    assert assert_env_follows_twin(DuffingEnv(reward=reward, **options), twin, reward, 0) == [(False, True)] * 2


@pytest.mark.parametrize("reward", [*READ, *EVIDENCE, pytest.param("free_energy", marks=pytest.mark.slow)])
def test_so_does_one_on_the_differential_equation(reward):
    options = {"noise_hypotheses": 3, "horizon": 20, "process_noise_guess": 1.5e-3}
    env, twin = ContinuousEnv(reward=reward, **options), weighing(TwinContinuousEnv)(0, **options)
    assert assert_env_follows_twin(env, twin, reward, 0, 1) == [(False, True)]


def close(first, second):
    """Whether two beliefs are equal to rounding."""
    std = np.sqrt(np.diag(second.coefficients_cov))
    np.testing.assert_allclose(first.coefficients_mean / std, second.coefficients_mean / std, rtol=0, atol=1e-9)
    scale = np.outer(std, std)
    np.testing.assert_allclose(first.coefficients_cov / scale, second.coefficients_cov / scale, rtol=0, atol=1e-9)
    np.testing.assert_allclose(first.state_mean, second.state_mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(first.noises, second.noises, rtol=1e-9)


ESTIMATED = {
    "continuous": (ContinuousEnv, Rig.silverbox("zero_order", -1)),  # an action acts before the sample that it brings
    "difference": (DuffingEnv, Rig.silverbox("zero_order", 0)),
}


@pytest.mark.parametrize("case", ["difference", pytest.param("continuous", marks=pytest.mark.slow)])
def test_the_belief_is_that_of_the_online_estimator(case):
    make, rig = ESTIMATED[case]
    env = make(**OPTIONS)
    env.reset(seed=0)
    prior = env.experiment.prior_belief
    estimator = OnlineEstimator(prior.model, prior, rig, noise_hypotheses=3)
    close(env.belief, estimator.belief)
    u, y, rewards = np.empty((3, 256))
    for t, action in enumerate(random_actions(256)[:, 0]):
        rewards[t] = env.step(action)[1]
        u[t], y[t] = env._batch.row_values("INPUT_u")[0], env._batch.row_values("Y_y")[0]
    energies = estimator.run(u, y)
    np.testing.assert_allclose(-rewards, energies[:, -1], rtol=1e-9, atol=1e-9)
    close(env.belief, estimator.belief)


def test_blocks_that_more_members_share_with_their_neighbours():
    # Fifteen members each, of 70 environments: no environment's numbers depend on its neighbours.
    options = OPTIONS | {"noise_hypotheses": 5, "horizon": 25, "max_output": 0.2}
    actions = random_actions(30, 70)
    envs = DuffingVectorEnv(70, **options)
    envs.reset(seed=list(range(70)))
    together = [envs.step(action) for action in actions]
    few = DuffingVectorEnv(5, **options)
    few.reset(seed=list(range(31, 36)))
    for step, action in zip(together, actions[:, 31:36], strict=True):
        for one, other in zip(step[:4], few.step(action)[:4], strict=True):
            np.testing.assert_array_equal(one[31:36], other)


def test_an_overflowed_member_has_no_weight():
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


@pytest.mark.parametrize("size", [1, 3])
def test_members_stay_as_an_episode_left_them_that_ended_within_a_hold(size):
    options = OPTIONS | {"horizon": 6, "max_input": 0.01}
    held = DuffingVectorEnv(size, hold=4, autoreset_mode="Disabled", **options)
    held.reset(seed=[3] * size)
    for _ in range(2):
        *_, truncated, _ = held.step(np.full((size, 1), 0.5, dtype=np.float32))
    assert truncated.all()
    sampled = DuffingEnv(**options)
    sampled.reset(seed=3)
    for _ in range(6):
        sampled.step([0.5])
    for index in range(size):
        for of_held, of_sampled in zip(held.mixture(index), sampled.mixture(), strict=True):
            np.testing.assert_array_equal(of_held, of_sampled)


def test_estimators_without_noise_hypotheses_are_refused():
    numbers = [0, -1, 2.0, True, None, "3", 100]
    message = "noise_hypotheses must be a whole number from 1 to 99, but is"
    assert_refused((lambda n=n: SimulatedExperiment(noise_hypotheses=n), message) for n in numbers)
    cases = [
        (DuffingEnv, {"factorisation": "mean_field"}),
        (ContinuousEnv, {"factorisation": "mean_field", "estimator": "nlarx"}),
    ]
    assert_refused(
        (
            lambda make=make, options=options: make(noise_hypotheses=3, **options),
            ", but is 3; use factorisation='structured'",
        )
        for make, options in cases
    )


@pytest.mark.usefixtures("record")
def test_a_record_is_weighed_by_the_same_hypotheses():
    replayed, simulated = ReplayExperiment(noise_hypotheses=3), SimulatedExperiment(noise_hypotheses=3)
    assert replayed.kernel_spec == simulated.kernel_spec._replace(plant_model=None)
    alone = ReplayExperiment()
    assert not alone.kernel_spec.has_noise_hypotheses
    # Nine members about the record's own prior.
    np.testing.assert_allclose(replayed.kernel_params.hypothesis_priors[4, :4], alone.prior_belief.noises, rtol=1e-12)
    np.testing.assert_allclose(replayed.kernel_params.prior[:-4], alone.kernel_params.prior[:-4], rtol=1e-13)


def test_one_hypothesis_is_the_prior_itself():
    one, many = SimulatedExperiment(), SimulatedExperiment(noise_hypotheses=9)
    assert not one.kernel_spec.has_noise_hypotheses
    assert one.kernel_params.hypothesis_priors.shape == (0, 5)
    np.testing.assert_array_equal(one.kernel_params.prior, one.prior_belief.record)
    assert many.kernel_params.hypothesis_priors.shape == (27, 5)
    assert (
        many.kernel_spec == SimulatedExperiment(noise_hypotheses=4).kernel_spec
    )  # a kernel does not know how many there are
    assert many.prior_belief == one.prior_belief
    np.testing.assert_allclose(many.kernel_params.prior[:-4], one.kernel_params.prior[:-4], rtol=1e-13)
