"""Rewards and endings against plain linear algebra."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from twin import to_coefficients, to_parameters

from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.plant_stages import pay_reward
from duffing_env.rewards.named_rewards import REWARDS, check_reward
from duffing_env.storage.kernel_spec import block_layout
from estimator import SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN, Parameters
from estimator.belief import Belief
from estimator.compilation.simd import LANES, lanewise
from estimator.engine.storage_layout import belief_rows
from estimator.models.difference_equation import difference
from estimator.priors import silverbox_prior

PARAMETERS = ("m", "c", "a", "b")
COEFFICIENTS = ("theta1", "theta2", "theta3", "eta")
TWIN = np.array([getattr(SILVERBOX_TWIN, name) for name in PARAMETERS])
HORIZON, MAX_OUTPUT = 10, 0.6
ACTIVE = {True: [0, 1, 2, 3], False: [0, 2, 3]}
WORKED = ("free_energy", "fisher", "expected_free_energy", "simulation_error")  # their hooks store a level


@cache
def payer(kind):
    """`pay` in a block of a kind."""
    return lanewise(
        block_layout(kind), "REWARD EPISODE_RETURN", uniform="terminal has_terminated_return terminated_return"
    )(pay_reward)


class Lanes:
    """A block in which every lane has the prior as belief and the twin as truth."""

    def __init__(self, nonlinear=True, reward="information_gain"):
        self.model = difference("paper" if nonlinear else "linear")
        # A linear belief comes from a replayed record, whose truth has the model's own parameters.
        self.kernel_spec = SimulatedExperiment(reward=reward).kernel_spec._replace(belief_model=self.model)
        if not nonlinear:
            self.kernel_spec = self.kernel_spec._replace(plant_model=None)
        self.reward = reward
        self.active, self.nonlinear = ACTIVE[nonlinear], nonlinear
        self.place, self.code = block_layout(self.kernel_spec), generated_functions(self.kernel_spec)
        self.rows = np.zeros((max(self.place.values()) + 1, LANES))
        self.prior = silverbox_prior(self.model)
        self.rows[: len(self.prior.record)] = self.prior.record[:, None]
        self.set_truth(SILVERBOX_TWIN)
        self.appraise()

    def __getitem__(self, name):
        return self.rows[self.place[name]]

    def set_truth(self, truth):
        self.truth = to_coefficients(truth)[self.active]
        for name in self.model.physical:
            self[f"PARAM_{name}"][:] = getattr(truth, name)
        for lane in range(LANES):
            self.code.set_true_coefficients(self.rows.reshape(-1), lane, SILVERBOX_SAMPLING_STEP)

    def set_coefficients(self, mean, cov):
        names = [COEFFICIENTS[k] for k in self.active]
        for k, i in enumerate(self.active):
            self[COEFFICIENTS[i]][:] = mean[i]
            for name, j in zip(names[k:], self.active[k:], strict=True):
                self[f"P_{COEFFICIENTS[i]}_{name}"][:] = cov[i, j]

    def appraise(self):
        for lane in range(LANES):
            self.code.evaluate_belief(self.rows.reshape(-1), lane, SILVERBOX_SAMPLING_STEP)

    def settle(self, input_cost=0.0, terminal=False, terminated_return=None):
        weights = np.array(REWARDS[self.reward].weights)
        price = np.array([np.sqrt(input_cost)])
        self.code.finish_step(
            self.rows.reshape(-1), SILVERBOX_SAMPLING_STEP, MAX_OUTPUT, float(HORIZON), price, np.empty(0), weights
        )
        forfeits = terminated_return is not None
        if terminal or forfeits:
            payer(self.kernel_spec)(self.rows.reshape(-1), terminal, forfeits, terminated_return or 0.0)

    @property
    def belief(self):
        return Belief(self.model, self.rows[: len(self.prior.record), 0])


def random_belief(rng):
    """Means and an ill-conditioned covariance of the coefficients, as in an experiment."""
    mean = to_coefficients(SILVERBOX_TWIN) + 0.05 * rng.standard_normal(4)
    factor = rng.standard_normal((4, 4)) * 10 ** rng.uniform(-4, -1, (4, 1))
    return mean, factor @ factor.T


@pytest.mark.parametrize("nonlinear", [True, False])
def test_information_measures_equal_a_gaussians(nonlinear):
    for seed in range(20):
        assert_appraised_as_a_gaussian(nonlinear, seed)


def assert_appraised_as_a_gaussian(nonlinear, seed):
    rng = np.random.default_rng(seed)
    lanes = Lanes(nonlinear)
    mean, cov = random_belief(rng)
    if not nonlinear:
        mean[1] = cov[1, :] = cov[:, 1] = 0.0
    scales = rng.uniform(0.7, 1.3, 4)
    truth = Parameters(zip(PARAMETERS, scales * TWIN, strict=True))
    lanes.set_truth(truth)
    np.testing.assert_allclose([lanes[f"TRUE_{name}"][0] for name in lanes.model.coefficients], lanes.truth, rtol=1e-13)
    lanes.set_coefficients(mean, cov)
    lanes.appraise()

    active = lanes.active
    density = multivariate_normal(mean[active], cov[np.ix_(active, active)]).logpdf(lanes.truth)
    _, log_det = np.linalg.slogdet(cov[np.ix_(active, active)])
    np.testing.assert_allclose(lanes["LOG_DET"], log_det, rtol=1e-8)
    # The kernel omits the constant, which cancels in differences of log densities.
    np.testing.assert_allclose(lanes["LOG_DENSITY"] - 0.5 * len(active) * np.log(2 * np.pi), density, rtol=1e-7)

    estimate = to_parameters(mean)[: len(active)]
    error = np.abs(estimate / [truth.m, truth.c, truth.a, truth.b][: len(active)] - 1.0)
    np.testing.assert_allclose(lanes["PARAMETER_ERROR"], np.minimum(error, 1.0).mean(), rtol=1e-10)


@pytest.mark.parametrize("nonlinear", [True, False])
def test_halving_the_covariance_pays_half_a_bit_per_coefficient(nonlinear):
    lanes = Lanes(nonlinear)
    for name in lanes.place:
        if name.startswith("P_") and not {"x1", "x2"} & set(name.split("_")):
            lanes[name][:] *= 0.5
    lanes.settle()
    np.testing.assert_allclose(lanes["REWARD"], 0.5 * np.log(2.0) * len(ACTIVE[nonlinear]), rtol=1e-12)
    np.testing.assert_array_equal(lanes["REWARD"], lanes["INFORMATION_GAIN"])
    lanes.settle()
    np.testing.assert_array_equal(lanes["REWARD"], 0.0)


@pytest.mark.parametrize("reward", REWARDS)
def test_a_step_pays_the_increase_of_the_named_measure(reward):
    lanes = Lanes(reward=reward)
    before = lanes.belief
    lanes.set_coefficients(*random_belief(np.random.default_rng(1)))
    lanes["HOOK_REWARD"][:] = 1.25
    after, truth = lanes.belief, lanes.truth

    def error(belief):
        estimate, _ = belief.physical()
        return np.minimum(np.abs(estimate / TWIN - 1.0), 1.0)

    worth = {
        "information_gain": before.entropy() - after.entropy(),
        "log_posterior": after.log_prob(truth) - before.log_prob(truth),
        "parameter_error": (error(before) - error(after)).mean(),
    } | dict.fromkeys(WORKED, 1.25)
    lanes.settle()
    np.testing.assert_allclose(lanes["REWARD"], worth[reward], rtol=1e-8)
    np.testing.assert_allclose(lanes["INFORMATION_GAIN"], worth["information_gain"], rtol=1e-8)
    np.testing.assert_allclose(lanes["LOG_POSTERIOR_GAIN"], worth["log_posterior"], rtol=1e-8)


def test_an_input_costs_what_is_asked_for_it():
    lanes = Lanes()
    lanes["INPUT_u"][:] = np.linspace(-0.15, 0.15, LANES)
    lanes.settle(input_cost=2.0)
    np.testing.assert_allclose(lanes["REWARD"], -2.0 * lanes["INPUT_u"] ** 2, rtol=1e-12)
    assert not lanes["INFORMATION_GAIN"].any()


def test_the_error_of_each_parameter_is_capped():
    lanes = Lanes()
    far = to_coefficients(Parameters(zip(PARAMETERS, TWIN * [5.0, 1.0, -1.0, 1.0], strict=True)))
    lanes.set_coefficients(far, lanes.belief.coefficients_cov)
    lanes.appraise()
    np.testing.assert_allclose(lanes["PARAMETER_ERROR"], 0.5, rtol=1e-12)  # m and a are off by more than themselves
    lanes["eta"][:] = 0.0  # as if the input had no effect: no parameter is identifiable
    lanes.appraise()
    np.testing.assert_array_equal(lanes["PARAMETER_ERROR"], 1.0)


def test_episodes_end_at_the_limit_or_at_the_horizon():
    lanes = Lanes()
    lanes["Y_y"][:4] = MAX_OUTPUT, np.nextafter(MAX_OUTPUT, 1), -MAX_OUTPUT, -0.7
    lanes["ELAPSED_SAMPLES"][4:7] = HORIZON - 2, HORIZON - 1, HORIZON - 1
    lanes["Y_y"][6] = 0.7
    lanes.settle()
    assert lanes["TERMINATED"][:8].tolist() == [0, 1, 0, 1, 0, 0, 1, 0]
    assert lanes["TRUNCATED"][:8].tolist() == [0, 0, 0, 0, 0, 1, 0, 0]
    assert lanes["ELAPSED_SAMPLES"][:8].tolist() == [1, 1, 1, 1, HORIZON - 1, HORIZON, HORIZON, 1]
    assert not lanes["DIVERGED"].any()


def impossible():
    """Names of rows, and values that are invalid for a belief or a plant."""
    names = belief_rows(difference())
    variances = [f"P_{name}_{name}" for name in difference().names]
    for name in (*names[:6], *variances, "GAMMA_RATE", "XI_RATE_y", "X_x1", "Y_y"):
        yield from ((name, value) for value in (np.nan, np.inf, -np.inf))
    for i, first in enumerate(COEFFICIENTS):
        yield from (
            (f"P_{first}_{second}", value) for second in COEFFICIENTS[i + 1 :] for value in (np.nan, np.inf, 1e3)
        )
    yield from ((name, 0.0) for name in ("P_theta2_theta2", "GAMMA_RATE", "XI_RATE_y"))
    yield from ((name, -1.0) for name in ("P_x1_x1", "P_x2_x2", "P_theta2_theta2", "GAMMA_RATE", "XI_RATE_y"))


@pytest.mark.parametrize("reward", REWARDS)
def test_impossible_states_end_the_episode_and_pay_nothing(reward):
    for name, value in impossible():
        lanes = Lanes(reward=reward)
        lanes["ELAPSED_SAMPLES"][:] = HORIZON - 1
        lanes["HOOK_REWARD"][:] = 2.0
        before = lanes["LOG_DET"][1], lanes["LOG_DENSITY"][1], lanes["PARAMETER_ERROR"][1]
        lanes[name][1] = value
        lanes.settle()
        case = f"{name} = {value}"
        assert lanes["DIVERGED"].tolist() == [0, 1] + [0] * (LANES - 2), case
        assert lanes["TERMINATED"][1] == 1, case
        assert lanes["TRUNCATED"][1] == 0, case
        for outcome in ("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN"):
            assert lanes[outcome][1] == 0, case
        assert (lanes["LOG_DET"][1], lanes["LOG_DENSITY"][1], lanes["PARAMETER_ERROR"][1]) == before, case


@pytest.mark.parametrize("reward", WORKED)
def test_work_that_is_not_finite_ends_the_episode(reward):
    for paid in (np.nan, np.inf, -np.inf):
        lanes = Lanes(reward=reward)
        lanes["HOOK_REWARD"][3] = paid
        lanes.settle()
        assert np.flatnonzero(lanes["DIVERGED"]).tolist() == [3]
        np.testing.assert_array_equal(lanes["REWARD"], 0.0)


def test_an_action_off_the_record_ends_the_episode_and_pays_nothing():
    lanes = Lanes(reward="log_posterior")
    lanes.set_coefficients(*random_belief(np.random.default_rng(2)))
    lanes["OFF_RECORD"][1] = 1.0
    lanes.settle()
    assert lanes["TERMINATED"][:2].tolist() == [0, 1]
    assert not lanes["DIVERGED"].any()
    assert lanes["REWARD"][1] == lanes["INFORMATION_GAIN"][1] == 0.0
    assert lanes["REWARD"][0] != 0.0


def three_steps(**options):
    """Rewards (3, LANES) of steps of 1, 2 and 3 minus a cost of ½; the last step terminates lane 1."""
    lanes, paid = Lanes(reward="fisher"), []
    lanes["ELAPSED_SAMPLES"][:] = HORIZON - 3
    lanes["INPUT_u"][:] = 0.1
    for worth in (1.0, 2.0, 3.0):
        lanes["HOOK_REWARD"][:] = worth
        lanes["Y_y"][1] = 0.7 if worth == 3.0 else 0.0
        lanes.settle(input_cost=50.0, **options)
        paid.append(lanes["REWARD"].copy())
    assert lanes["TERMINATED"][:3].tolist() == [0, 1, 0]
    assert lanes["TRUNCATED"][:3].tolist() == [1, 0, 1]
    return np.array(paid)


def test_a_terminal_reward_is_the_sum_at_the_end():
    dense, terminal = three_steps(), three_steps(terminal=True)
    np.testing.assert_array_equal(terminal[:2], 0.0)
    np.testing.assert_array_equal(terminal[2], dense[0] + dense[1] + dense[2])
    np.testing.assert_allclose(terminal[2], 4.5, rtol=1e-14)


@pytest.mark.parametrize("terminal", [False, True])
def test_a_terminated_episode_returns_the_given_number(terminal):
    for worth in (-10.0, 0.0, 2.5):
        kept, paid = three_steps(terminal=terminal), three_steps(terminal=terminal, terminated_return=worth)
        np.testing.assert_allclose(paid.sum(axis=0)[1], worth, rtol=0, atol=1e-14)
        paid[2, 1] = kept[2, 1]
        np.testing.assert_array_equal(paid, kept)  # and nothing else is touched


def test_a_diverged_episode_returns_the_given_number():
    lanes = Lanes(reward="fisher")
    lanes["HOOK_REWARD"][:] = 4.0
    lanes.settle(terminated_return=-1.0)
    lanes["X_x1"][2] = np.nan
    lanes.settle(terminated_return=-1.0)
    assert lanes["DIVERGED"].tolist() == [0, 0, 1] + [0] * (LANES - 3)
    assert lanes["REWARD"][:4].tolist() == [4.0, 4.0, -5.0, 4.0]


def test_rewards_by_name():
    for name in REWARDS:
        check_reward(name)
    with pytest.raises(ValueError, match="did you mean 'information_gain'"):
        check_reward("infomation_gain")
    for unknown in ("entropy!", None, 0, []):
        with pytest.raises(ValueError, match="reward must be one of"):
            check_reward(unknown)
