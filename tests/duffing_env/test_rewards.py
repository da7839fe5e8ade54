"""Rewards and endings against plain linear algebra."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from duffing_env.layout import LAYOUT, N_ROWS
from duffing_env.rewards import REWARDS, appraise, pay, reward_number, settle
from estimator import SAMPLING_STEP, SILVERBOX_TWIN, Belief, PhysicalParameters, Prior, to_coefficients
from estimator.lanes import LANES
from estimator.record import COEFFICIENTS, COVARIANCES, QUANTITIES, RECORD_SIZE

PARAMETERS = ("m", "c", "a", "b")
TWIN = np.array([getattr(SILVERBOX_TWIN, name) for name in PARAMETERS])
HORIZON, MAX_OUTPUT = 10, 0.6
ACTIVE = {True: [0, 1, 2, 3], False: [0, 2, 3]}


@cache
def prior_record(nonlinear):
    """The prior, which is a quadrature; hundreds of blocks start from it."""
    return Prior.silverbox_twin().to_record(nonlinear=nonlinear)


class Lanes:
    """A block of which every lane believes the prior and has the twin for its truth."""

    def __init__(self, nonlinear=True):
        self.rows = np.zeros((N_ROWS, LANES))
        self.rows[:RECORD_SIZE] = prior_record(nonlinear)[:, None]
        self.nonlinear = nonlinear
        self.set_truth(SILVERBOX_TWIN)
        self.appraise()

    def __getitem__(self, name):
        return self.rows[LAYOUT[name]]

    def set_truth(self, truth):
        psi = to_coefficients(truth)
        self.truth = psi
        values = (truth.m, truth.c, truth.a, truth.b, psi.theta1, psi.theta2, psi.theta3, psi.eta)
        names = (*PARAMETERS, "true_t1", "true_t2", "true_t3", "true_e")
        for name, value in zip(names, values, strict=True):
            self[name][:] = value

    def set_coefficients(self, mean, cov):
        for name, value in zip(COEFFICIENTS, mean, strict=True):
            self[name][:] = value
        for i, first in enumerate(COEFFICIENTS):
            for j, second in enumerate(COEFFICIENTS[i:], start=i):
                self[f"P_{first}_{second}"][:] = cov[i, j]

    def appraise(self):
        for lane in range(LANES):
            appraise(self.rows.reshape(-1), lane, SAMPLING_STEP, float(self.nonlinear), 0.0)

    def settle(self, reward="information_gain", input_cost=0.0, terminal=False, terminated_return=None):
        settings = float(self.nonlinear), 0.0, float(REWARDS[reward]), input_cost
        settle(self.rows.reshape(-1), MAX_OUTPUT, float(HORIZON), SAMPLING_STEP, *settings)
        forfeits = terminated_return is not None
        if terminal or forfeits:
            pay(self.rows.reshape(-1), float(terminal), float(forfeits), terminated_return or 0.0)

    @property
    def belief(self):
        return Belief(self.rows[:RECORD_SIZE, 0], nonlinear=self.nonlinear)


def random_belief(rng):
    """Means and a covariance of the coefficients, ill-conditioned as those of an experiment are."""
    psi = to_coefficients(SILVERBOX_TWIN)
    mean = np.array([psi.theta1, psi.theta2, psi.theta3, psi.eta]) + 0.05 * rng.standard_normal(4)
    factor = rng.standard_normal((4, 4)) * 10 ** rng.uniform(-4, -1, (4, 1))
    return mean, factor @ factor.T


@pytest.mark.parametrize("nonlinear", [True, False])
@pytest.mark.parametrize("seed", range(20))
def test_appraisal_is_that_of_a_gaussian(seed, nonlinear):
    rng = np.random.default_rng(seed)
    lanes = Lanes(nonlinear)
    mean, cov = random_belief(rng)
    if not nonlinear:
        mean[1] = cov[1, :] = cov[:, 1] = 0.0
    scales = rng.uniform(0.7, 1.3, 4)
    truth = PhysicalParameters(*(scales * TWIN))
    lanes.set_truth(truth)
    lanes.set_coefficients(mean, cov)
    lanes.appraise()

    active = ACTIVE[nonlinear]
    psi = np.array([lanes.truth.theta1, lanes.truth.theta2, lanes.truth.theta3, lanes.truth.eta])
    density = multivariate_normal(mean[active], cov[np.ix_(active, active)]).logpdf(psi[active])
    _, log_det = np.linalg.slogdet(cov[np.ix_(active, active)])
    np.testing.assert_allclose(lanes["log_det"], log_det, rtol=1e-8)
    # The kernel leaves the constant away, which no difference of two densities has.
    np.testing.assert_allclose(lanes["log_density"] - 0.5 * len(active) * np.log(2 * np.pi), density, rtol=1e-7)

    estimate, _ = lanes.belief.physical()
    error = np.abs(estimate / [truth.m, truth.c, truth.a, truth.b] - 1.0)
    np.testing.assert_allclose(lanes["error"], np.minimum(error, 1.0).mean(), rtol=1e-12)


@pytest.mark.parametrize("nonlinear", [True, False])
def test_halving_the_covariance_is_worth_half_a_bit_for_each_coefficient(nonlinear):
    lanes = Lanes(nonlinear)
    lanes.set_coefficients(lanes.belief.coefficients_mean, 0.5 * lanes.belief.coefficients_cov)
    lanes.settle()
    np.testing.assert_allclose(lanes["reward"], 0.5 * np.log(2.0) * len(ACTIVE[nonlinear]), rtol=1e-12)
    np.testing.assert_array_equal(lanes["reward"], lanes["information_gain"])
    lanes.settle()
    np.testing.assert_array_equal(lanes["reward"], 0.0)


@pytest.mark.parametrize("reward", REWARDS)
def test_a_step_is_worth_the_increase_by_the_named_measure(reward):
    lanes = Lanes()
    before = lanes.belief
    lanes.set_coefficients(*random_belief(np.random.default_rng(1)))
    lanes["surprise"][:] = 1.25
    lanes["fisher_gain"][:] = 0.75
    lanes["misfit"][:] = 0.3
    if reward == "simulation_error":
        lanes["error"][:] = 0.9
    after, truth = lanes.belief, lanes.truth

    def error(belief):
        estimate, _ = belief.physical()
        return np.minimum(np.abs(estimate / TWIN - 1.0), 1.0)

    worth = {
        "information_gain": before.entropy() - after.entropy(),
        "log_posterior": after.log_prob(truth) - before.log_prob(truth),
        "parameter_error": (error(before) - error(after)).mean(),
        "free_energy": -1.25,
        "fisher": 0.75,
        "expected_free_energy": -1.25,
        "simulation_error": 0.6,
    }
    lanes.settle(reward)
    np.testing.assert_allclose(lanes["reward"], worth[reward], rtol=1e-8)
    np.testing.assert_allclose(lanes["information_gain"], worth["information_gain"], rtol=1e-8)
    np.testing.assert_allclose(lanes["log_posterior_gain"], worth["log_posterior"], rtol=1e-8)


def test_an_input_costs_what_is_asked_for_it():
    lanes = Lanes()
    lanes["u"][:] = np.linspace(-0.15, 0.15, LANES)
    lanes.settle(input_cost=2.0)
    np.testing.assert_allclose(lanes["reward"], -2.0 * lanes["u"] ** 2, rtol=1e-12)
    assert not lanes["information_gain"].any()


def test_the_error_of_each_parameter_is_capped():
    lanes = Lanes()
    far = to_coefficients(PhysicalParameters(*(TWIN * [5.0, 1.0, -1.0, 1.0])))
    lanes.set_coefficients([far.theta1, far.theta2, far.theta3, far.eta], lanes.belief.coefficients_cov)
    lanes.appraise()
    np.testing.assert_allclose(lanes["error"], 0.5, rtol=1e-12)  # m and a are off by more than themselves
    lanes["e"][:] = 0.0  # as if the input had no effect: no parameter can be told
    lanes.appraise()
    np.testing.assert_array_equal(lanes["error"], 1.0)


def test_episodes_end_at_the_limit_or_at_the_horizon():
    lanes = Lanes()
    lanes["y"][:4] = MAX_OUTPUT, np.nextafter(MAX_OUTPUT, 1), -MAX_OUTPUT, -0.7
    lanes["elapsed"][4:7] = HORIZON - 2, HORIZON - 1, HORIZON - 1
    lanes["y"][6] = 0.7
    lanes.settle()
    assert lanes["terminated"][:8].tolist() == [0, 1, 0, 1, 0, 0, 1, 0]
    assert lanes["truncated"][:8].tolist() == [0, 0, 0, 0, 0, 1, 0, 0]
    assert lanes["elapsed"][:8].tolist() == [1, 1, 1, 1, HORIZON - 1, HORIZON, HORIZON, 1]
    assert not lanes["diverged"].any()


def impossible():
    """Names of rows and values that no belief and no plant may have."""
    variances = [name for name in COVARIANCES if name.split("_")[1] == name.split("_")[2]]
    for name in (*QUANTITIES, *variances, "g_rate", "n_rate", "x", "y"):
        yield from ((name, value) for value in (np.nan, np.inf, -np.inf))
    for i, first in enumerate(COEFFICIENTS):
        yield from (
            (f"P_{first}_{second}", value) for second in COEFFICIENTS[i + 1 :] for value in (np.nan, np.inf, 1e3)
        )
    yield from (
        (name, value) for name in ("P_x0_x0", "P_x1_x1", "P_t2_t2", "g_rate", "n_rate") for value in (0.0, -1.0)
    )


@pytest.mark.parametrize("reward", REWARDS)
def test_what_cannot_be_ends_the_episode_and_is_worth_nothing(reward):
    for name, value in impossible():
        lanes = Lanes()
        lanes["elapsed"][:] = HORIZON - 1
        lanes["surprise"][:] = 2.0
        lanes["misfit"][:] = 0.5
        before = lanes["log_det"][1], lanes["log_density"][1], lanes["error"][1]
        lanes[name][1] = value
        lanes.settle(reward)
        case = f"{name} = {value}"
        assert lanes["diverged"].tolist() == [0, 1] + [0] * (LANES - 2), case
        assert lanes["terminated"][1] == 1, case
        assert lanes["truncated"][1] == 0, case
        for outcome in ("reward", "information_gain", "log_posterior_gain"):
            assert lanes[outcome][1] == 0, case
        assert (lanes["log_det"][1], lanes["log_density"][1], lanes["error"][1]) == before, case


@pytest.mark.parametrize("told", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("reward", ["free_energy", "expected_free_energy"])
def test_a_free_energy_that_is_not_finite_ends_the_episode(reward, told):
    lanes = Lanes()
    lanes["surprise"][3] = told
    lanes.settle(reward)
    assert np.flatnonzero(lanes["diverged"]).tolist() == [3]
    np.testing.assert_array_equal(lanes["reward"], 0.0)


def test_an_action_off_the_record_ends_the_episode_and_is_worth_nothing():
    lanes = Lanes()
    lanes.set_coefficients(*random_belief(np.random.default_rng(2)))
    lanes["off_record"][1] = 1.0
    lanes.settle("log_posterior")
    assert lanes["terminated"][:2].tolist() == [0, 1]
    assert not lanes["diverged"].any()
    assert lanes["reward"][1] == lanes["information_gain"][1] == 0.0
    assert lanes["reward"][0] != 0.0


def three_steps(**options):
    """Rewards (3, LANES) of steps that are worth 1, 2 and 3, less a cost of ½; lane 1 is terminated by the last."""
    lanes, told = Lanes(), []
    lanes["elapsed"][:] = HORIZON - 3
    lanes["u"][:] = 0.1
    for worth in (1.0, 2.0, 3.0):
        lanes["fisher_gain"][:] = worth
        lanes["y"][1] = 0.7 if worth == 3.0 else 0.0
        lanes.settle("fisher", input_cost=50.0, **options)
        told.append(lanes["reward"].copy())
    assert lanes["terminated"][:3].tolist() == [0, 1, 0]
    assert lanes["truncated"][:3].tolist() == [1, 0, 1]
    return np.array(told)


def test_a_terminal_reward_is_the_sum_at_the_end():
    dense, terminal = three_steps(), three_steps(terminal=True)
    np.testing.assert_array_equal(terminal[:2], 0.0)
    np.testing.assert_array_equal(terminal[2], dense[0] + dense[1] + dense[2])
    np.testing.assert_allclose(terminal[2], 4.5, rtol=1e-14)


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("worth", [-10.0, 0.0, 2.5])
def test_an_episode_that_is_terminated_returns_what_was_said(worth, terminal):
    kept, told = three_steps(terminal=terminal), three_steps(terminal=terminal, terminated_return=worth)
    np.testing.assert_allclose(told.sum(axis=0)[1], worth, rtol=0, atol=1e-14)
    told[2, 1] = kept[2, 1]
    np.testing.assert_array_equal(told, kept)  # and nothing else is touched


def test_an_episode_that_diverges_returns_what_was_said():
    lanes = Lanes()
    lanes["fisher_gain"][:] = 4.0
    lanes.settle("fisher", terminated_return=-1.0)
    lanes["x"][2] = np.nan
    lanes.settle("fisher", terminated_return=-1.0)
    assert lanes["diverged"].tolist() == [0, 0, 1] + [0] * (LANES - 3)
    assert lanes["reward"][:4].tolist() == [4.0, 4.0, -5.0, 4.0]


def test_rewards_by_name():
    assert [reward_number(name) for name in REWARDS] == [0, 1, 2, 3, 4, 5, 6]
    with pytest.raises(ValueError, match="did you mean 'information_gain'"):
        reward_number("infomation_gain")
    for unknown in ("entropy!", None, 0, []):
        with pytest.raises(ValueError, match="reward must be one of"):
            reward_number(unknown)
