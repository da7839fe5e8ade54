"""Hypotheses about the noise ratio: the mixture against its definition, and whether it finds the ratio."""

import re

import numpy as np
import pytest
from scipy.special import logsumexp

from estimator import NLARX, SILVERBOX_TWIN, DuffingODE, OnlineEstimator, Prior, to_coefficients
from estimator.ensemble import FARTHEST, LEVELS, SWITCHING, displaced, matched_gamma, mix
from estimator.filters import NLARXFilter
from estimator.models.regressors import PRESETS

RATIOS = 5
TRUTH = to_coefficients(SILVERBOX_TWIN)
MODELS = {
    "paper": NLARX(),
    "terms": NLARX(regressors=PRESETS["paper"]),
    "ode": DuffingODE(),
    "look-ahead": DuffingODE("look_ahead"),
}
ANY_MODEL = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


def simulated(process_noise, measurement_noise, samples, seed=0):
    """A difference equation, paired by index with the input of the sample before (Eq. 2): u, y."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-0.15, 0.15, samples), np.zeros(samples)
    for t in range(1, samples):  # x[-1] is 0 while it stands for the displacement before the first
        x[t] = TRUTH.theta1 * x[t - 1] + TRUTH.theta2 * x[t - 1] ** 3 + TRUTH.theta3 * x[t - 2] + TRUTH.eta * u[t - 1]
        x[t] += process_noise * rng.standard_normal()
    return u, x + measurement_noise * rng.standard_normal(samples)


@pytest.fixture(scope="module")
def samples():
    return simulated(5e-4, 5e-4, 200)


def ensemble(model, **options):
    return OnlineEstimator(model, noise_hypotheses=RATIOS, **options)


def members(estimator):
    """The same members as estimators of their own, with the priors that the documentation says."""
    prior = Prior.silverbox_twin() if estimator.model == NLARX() else estimator.model.prior()
    noises = np.array([prior.gamma_shape, prior.gamma_rate, prior.xi_shape, prior.xi_rate])
    for level in (1 / 3, 1, 3):
        for factor in (1 / 30, 30**-0.5, 1, 30**0.5, 30):
            moved = displaced(noises, factor, level)
            fields = {name: getattr(prior, name) for name in prior.__dataclass_fields__}
            yield OnlineEstimator(
                estimator.model, type(prior)(**{**fields, "gamma_rate": moved[1], "xi_rate": moved[3]})
            )


def assert_same(first, second):
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, second.arrays()[name], err_msg=name)


# --- The mixture ---------------------------------------------------------------------------------------------------


def mixed(weights, energies, predictions):
    """The twin of `mix`, in logarithms: weights, free energies (T, iterations), forecasts (T, 2)."""
    log_weights, free_energies, forecasts = np.log(weights), [], []
    for F, (means, variances) in zip(energies.transpose(1, 2, 0), predictions.transpose(1, 2, 0), strict=True):
        w = (1 - SWITCHING) * np.exp(log_weights) + SWITCHING / len(weights)
        alive = np.isfinite(F[-1]) & np.isfinite(means)
        w = np.where(alive, w, 0) / w[alive].sum()
        F, means, variances = F[:, alive], means[alive], variances[alive]
        joint = np.full((len(F), len(w)), -np.inf)
        joint[:, alive] = np.log(w[alive]) - F
        free_energies.append(-logsumexp(joint, axis=1))
        log_weights = joint[-1] + free_energies[-1][-1]
        mean = w[alive] @ means
        forecasts.append([mean, w[alive] @ (variances + means**2) - mean**2])
    return np.exp(log_weights), np.array(free_energies), np.array(forecasts)


@pytest.mark.parametrize("scale", [0.1, 10.0, 1000.0])
def test_mix_equals_its_twin(scale):
    rng = np.random.default_rng(0)
    energies = scale * rng.standard_normal((4, 50, 3))
    predictions = np.abs(rng.standard_normal((4, 50, 2)))
    energies[2, 30:] = predictions[2, 30:] = np.nan  # a member that overflowed
    weights = rng.dirichlet(np.ones(4))
    expected = mixed(weights, energies, predictions)
    free_energies, forecasts = np.empty((50, 3)), np.empty((50, 2))
    mix(weights, energies, predictions, free_energies, forecasts)
    np.testing.assert_allclose(weights, expected[0], rtol=1e-8, atol=1e-290)
    np.testing.assert_allclose(free_energies, expected[1], rtol=1e-10, atol=1e-12 * scale)
    np.testing.assert_allclose(forecasts, expected[2], rtol=1e-8)
    assert weights[2] == 0


def test_a_hypothesis_comes_back_when_it_is_true_again():
    energies = np.zeros((2, 2000, 1))
    energies[1, :1960] = 1.0  # long enough for exp(-1960), which is 0
    energies[0, 1960:] = 1.0
    weights, predictions = np.full(2, 0.5), np.ones((2, 2000, 2))
    mix(weights, energies, predictions, np.empty((2000, 1)), np.empty((2000, 2)))
    assert weights[1] > 0.99
    assert weights.sum() == pytest.approx(1)


def test_nothing_left_is_not_finite():
    free_energies, forecasts = np.zeros((1, 1)), np.zeros((1, 2))
    mix(np.full(2, 0.5), np.full((2, 1, 1), np.nan), np.ones((2, 1, 2)), free_energies, forecasts)
    assert not np.isfinite(free_energies).any()
    assert np.isnan(forecasts).all()


def test_displacement_keeps_the_shapes_and_says_ratio_and_sum():
    noises = np.array([2.0, 2.0 * 3e-3**2, 5.0, 5.0 * 1e-3**2])
    moved = displaced(noises, 7.0, 3.0)
    q, r = moved[1] / moved[0], moved[3] / moved[2]
    assert (moved[0], moved[2]) == (2.0, 5.0)
    assert np.sqrt(q / r) == pytest.approx(7 * 3)
    assert q + r == pytest.approx(9 * (3e-3**2 + 1e-3**2))
    np.testing.assert_allclose(displaced(noises, 1.0, 1.0), noises, rtol=1e-14)


def test_a_matched_gamma_has_the_mixtures_variance_and_its_spread():
    assert matched_gamma(np.ones(1), np.array([3.0]), np.array([2e-6])) == pytest.approx((3.0, 2e-6), rel=1e-12)
    # Of shapes this large 1/g is normal about rate/shape, with the relative variance 1/shape.
    rng = np.random.default_rng(1)
    weights, shapes, rates = np.array([0.2, 0.8]), np.array([3e3, 1e4]), np.array([3e3, 2e4])
    which = rng.choice(2, 400_000, p=weights)
    variances = 1 / rng.gamma(shapes[which], 1 / rates[which])
    shape, rate = matched_gamma(weights, shapes, rates)
    assert rate / shape == pytest.approx(variances.mean(), rel=0.003)
    assert 1 / shape == pytest.approx(variances.var() / variances.mean() ** 2, rel=0.01)


# --- The estimator -------------------------------------------------------------------------------------------------


@ANY_MODEL
def test_it_is_the_mixture_of_its_members(samples, model):
    u, y = samples
    estimator, alone = ensemble(model), list(members(ensemble(model)))
    free_energies = estimator.run(u, y)
    energies = np.array([each.run(u, y) for each in alone])
    assert free_energies.shape == energies.shape[1:]
    # By the chain rule the sum is the evidence of the whole record; but for the chance of switching, which costs
    # little, and pays where another member is the best now.
    evidence = logsumexp(-energies[:, :, -1].sum(axis=1)) - np.log(len(alone))
    assert free_energies[:, -1].sum() == pytest.approx(-evidence, abs=0.1)
    start = np.full(len(alone), 1 / len(alone))
    weights, expected, forecasts = mixed(start, energies, np.array([each.forecasts for each in alone]))
    np.testing.assert_allclose(free_energies, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(estimator.forecasts, forecasts, rtol=1e-6, atol=1e-12)
    # The moments, by raw second moments.
    beliefs = [each.belief for each in alone]
    means = np.array([belief.coefficients_mean for belief in beliefs])
    mean = weights @ means
    seconds = [belief.coefficients_cov + np.outer(m, m) for belief, m in zip(beliefs, means, strict=True)]
    cov = np.tensordot(weights, seconds, 1) - np.outer(mean, mean)
    std = np.sqrt(np.abs(np.diag(cov))) + 1e-9
    # u0 is turned back from its force at the mixture's mean, to first order, so that this one is rounded generously.
    np.testing.assert_allclose((estimator.belief.coefficients_mean - mean) / std, 0, atol=1e-3)
    np.testing.assert_allclose((estimator.belief.coefficients_cov - cov) / np.outer(std, std), 0, atol=1e-2)
    variance = weights @ [1 / belief.gamma_mean for belief in beliefs]
    assert 1 / estimator.belief.gamma_mean == pytest.approx(variance, rel=1e-8)


@pytest.mark.parametrize("drift", [0.0, 0.01])
def test_lanes_are_members_run_one_by_one(samples, drift, monkeypatch):
    # More than a block. A member in a lane of its own block rounds otherwise.
    in_lanes, one_by_one = (OnlineEstimator(NLARX(), drift=drift, noise_hypotheses=13) for _ in range(2))
    expected = in_lanes.run(*samples)
    monkeypatch.setattr("estimator.ensemble.NLARXFilter", type("Other", (NLARXFilter,), {}))
    np.testing.assert_allclose(one_by_one.run(*samples), expected, rtol=1e-9, atol=1e-9)
    for name, array in in_lanes.arrays().items():
        np.testing.assert_allclose(array, one_by_one.arrays()[name], rtol=1e-8, atol=1e-15, err_msg=name)


@ANY_MODEL
def test_run_is_repeated_update(samples, model):
    u, y = samples[0][:80], samples[1][:80]
    whole, single, parts = (ensemble(model) for _ in range(3))
    free_energies = whole.run(u, y)
    for u_t, y_t in zip(u, y, strict=True):
        single.update(u_t, y_t)
    in_parts = [parts.run(u[a:b], y[a:b]) for a, b in ((0, 1), (1, 30), (30, 80))]
    np.testing.assert_array_equal(np.concatenate(in_parts), free_energies)
    assert_same(whole, single)
    assert_same(whole, parts)


@ANY_MODEL
def test_rewind_keeps_the_weights(samples, model):
    estimator = ensemble(model)
    estimator.run(*samples)
    weights, before = estimator.arrays()["weights"].copy(), estimator.belief
    estimator.rewind()
    np.testing.assert_array_equal(estimator.arrays()["weights"], weights)
    np.testing.assert_allclose(estimator.belief.coefficients_mean, before.coefficients_mean, rtol=1e-3)
    assert estimator.belief.gamma_mean == before.gamma_mean
    assert np.isfinite(estimator.run(*samples)).all()


def test_nothing_is_learned_from_a_gap(samples):
    u, y = samples
    estimator = ensemble(MODELS["terms"], drift=0.01)
    estimator.run(u, y)
    before = estimator.belief
    free_energies = estimator.run(u[:20], np.full(20, np.nan), missing=True)
    np.testing.assert_allclose(free_energies, 0, atol=1e-12)
    assert estimator.belief.gamma_mean == pytest.approx(before.gamma_mean, rel=1e-3)
    assert (np.diag(estimator.belief.coefficients_cov) > np.diag(before.coefficients_cov)).all()  # the drift
    with pytest.raises(ValueError, match=re.escape("missing must be False for regressors='paper'")):
        ensemble(NLARX()).run(u, y, missing=True)


def test_predictions_and_free_runs_are_those_of_the_mean(samples):
    u, y = samples
    estimator = ensemble(NLARX())
    estimator.run(u, y)
    mean = estimator.belief.coefficients_mean
    np.testing.assert_array_equal(estimator.predict(u, y), NLARX().predict(mean, u, y))
    np.testing.assert_array_equal(estimator.simulate(u, y[:5]), NLARX().simulate(mean, u, y[:5]))
    ode = ensemble(DuffingODE())
    ode.run(u, y)
    before = {name: array.copy() for name, array in ode.arrays().items()}
    assert np.isfinite(ode.predict(u, y)).all()
    assert np.isfinite(ode.simulate(u, y[:5])).all()
    for name, array in ode.arrays().items():
        np.testing.assert_array_equal(array, before[name])


def test_what_is_known_stays_known(samples):
    estimator = ensemble(DuffingODE())
    estimator.run(*samples)
    assert estimator.belief.parameters()["cubic_damping"] == (0.0, 0.0, "V⁻² s")
    assert np.isfinite(estimator.belief.entropy())
    linear = ensemble(NLARX(nonlinear=False))
    linear.run(*samples)
    np.testing.assert_array_equal(linear.belief.theta_cov[1], 0.0)


def test_a_member_that_overflowed_has_no_say(samples):
    estimator = ensemble(MODELS["terms"])
    estimator.run(*samples)
    arrays = {name: array.copy() for name, array in estimator.arrays().items()}
    arrays["mean_0"][:] = np.nan
    estimator.restore(arrays)
    assert np.isfinite(estimator.run(*samples)).all()
    assert np.isfinite(estimator.forecasts).all()
    assert np.isfinite(estimator.belief.mean).all()
    assert np.isfinite(estimator.noise_ratio.std)


def test_unchanged_after_an_update_that_raised(samples):
    estimator, untouched = ensemble(NLARX()), ensemble(NLARX())
    for each in (estimator, untouched):
        each.run(*samples)
    with pytest.raises(ValueError, match=re.escape("must keep the belief finite, but near sample 0")):
        estimator.update(0.1, 1e200)
    assert_same(estimator, untouched)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: OnlineEstimator(noise_hypotheses=0),
            "noise_hypotheses must be a whole number of at least 1, but is 0",
        ),
        (
            lambda: OnlineEstimator(noise_hypotheses=2.0),
            "noise_hypotheses must be a whole number of at least 1, but is 2.0",
        ),
        (
            lambda: OnlineEstimator(factorisation="mean_field", noise_hypotheses=9),
            "noise_hypotheses must be 1 for factorisation='mean_field', but is 9; use factorisation='structured'",
        ),
        (lambda: OnlineEstimator().noise_ratio, "noise_hypotheses must be above 1 for noise_ratio, but is 1"),
    ],
)
def test_errors_name_the_argument_and_its_value(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


# --- Whether it is right -------------------------------------------------------------------------------------------


def test_alone_the_difference_of_the_precisions_hardly_moves():
    """What the module's first lines derive, and why there are hypotheses at all."""
    prior = Prior.silverbox_twin(process_noise=2e-3 / 3, measurement_noise=1e-3 / 3)
    estimator = OnlineEstimator(NLARX(), prior)
    estimator.run(*simulated(2e-3, 1e-3, 600))
    belief = estimator.belief
    assert belief.gamma_mean < (2e-3 / 3) ** -2 / 5  # it has learned much
    difference = (2e-3 / 3) ** -2 - (1e-3 / 3) ** -2
    assert belief.gamma_mean - belief.xi_mean == pytest.approx(difference, rel=0.1)


@pytest.mark.parametrize("noises", [(2e-3, 1e-3), (5e-4, 5e-4), (1e-4, 3e-4)])
@pytest.mark.parametrize("centers", [(5e-4, 5e-4), (2e-3, 1e-3), (2e-4, 6e-4)])
def test_both_noises_are_found_within_a_factor_of_three(noises, centers):
    # In total the centres are up to 3.5 times too small and 7 times too large.
    prior = Prior.silverbox_twin(process_noise=centers[0], measurement_noise=centers[1])
    estimator = OnlineEstimator(NLARX(), prior, noise_hypotheses=9)
    estimator.run(*simulated(*noises, 1500))
    ratio, belief = estimator.noise_ratio, estimator.belief
    assert ratio.std < 0.5
    assert abs(ratio.mean - np.log(noises[0] / noises[1])) < np.log(3) / 2
    assert 1 / 3 < belief.gamma_mean * noises[0] ** 2 < 3
    assert 1 / 3 < belief.xi_mean * noises[1] ** 2 < 3


def test_where_one_noise_hides_the_other_it_says_so():
    estimator = OnlineEstimator(NLARX(), noise_hypotheses=9)
    first = estimator.noise_ratio
    assert first.std == pytest.approx(first.prior_std)
    width = 2 * np.log(FARTHEST) * 9 / 8  # nine steps, as a density that is constant in the logarithm
    assert first.prior_std == pytest.approx(width / np.sqrt(12))
    assert first.mean == pytest.approx(0, abs=1e-12)
    assert len(LEVELS) * 9 == len(estimator.arrays()["weights"])
    estimator.run(*simulated(2e-3, 1e-5, 1500))
    assert estimator.noise_ratio.std > 0.5
    assert estimator.belief.gamma_mean * 2e-3**2 == pytest.approx(1, abs=0.2)
    assert 1 / estimator.belief.xi_mean < (5e-4) ** 2  # bounded from above only
