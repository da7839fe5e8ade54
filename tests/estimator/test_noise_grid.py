"""Noise hypotheses: the mixture against its definition, and recovery of the true ratio."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from estimators import AHEAD, pendulum_estimator, pendulum_prior, pendulum_record, record
from reference.filters import carried, difference_step
from reference.mixture import hypotheses, weighed
from reference.mixture import mixed as mixture_of
from reference.structured import structured_update
from scipy.special import logsumexp
from tables import table

from estimator import Channel, OnlineEstimator, Rig, difference, recorded_prior, silverbox_prior
from estimator.belief import Belief
from estimator.compilation.simd import LANES
from estimator.inference.noise_grid import (
    MAX_RATIO_FACTOR,
    TOTAL_STD_FACTORS,
    initial_weights,
    member_priors,
    moment_matched_gamma,
    noise_grid,
    pack_into_lanes,
    scale_noise_gammas,
)
from estimator.inference.noise_mixture import (
    SWITCHING_PROBABILITY,
    apply_switching,
    compile_mixture,
    forecast_mixture,
    mark_diverged,
    reweight,
)
from estimator.models.pendulum import PENDULUM
from estimator.rigs.rig_prior import rig_prior

RATIOS = 5
MODELS = {
    "paper": {"model": difference(), "rig": Rig.silverbox("zero_order", 1), "prior": silverbox_prior()},
    "look-ahead": AHEAD | {"prior": recorded_prior(AHEAD["model"])},
}
ANY_MODEL = pytest.mark.parametrize("model", MODELS)


@pytest.fixture(scope="module")
def samples():
    return record(200)


def ensemble(name):
    return OnlineEstimator(**MODELS[name], noise_hypotheses=RATIOS)


def members(name):
    """The members as single estimators, with the documented priors."""
    model, prior = MODELS[name]["model"], MODELS[name]["prior"]
    for level in (1 / 3, 1, 3):
        for factor in (1 / 30, 30**-0.5, 1, 30**0.5, 30):
            g_shape, g_rate, n_shape, n_rate = scale_noise_gammas(prior.noises, factor, level)
            moved = Belief.of(model, prior.mean, prior.cov, (g_shape, g_rate), (n_shape, n_rate))
            yield OnlineEstimator(**MODELS[name] | {"prior": moved})


# --- The mixture ---------------------------------------------------------------------------------------------------


def mixed(weights, energies, predictions):
    """The mixture in logarithms: weights, free energies (T, iterations), forecasts (T, 2)."""
    log_weights, free_energies, forecasts = np.log(weights), [], []
    for F, (means, variances) in zip(energies.transpose(1, 2, 0), predictions.transpose(1, 2, 0), strict=True):
        w = (1 - SWITCHING_PROBABILITY) * np.exp(log_weights) + SWITCHING_PROBABILITY / len(weights)
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


def take(weights, energies, predictions, free_energies, forecasts):
    """One sample as the estimator takes it: energies (M, iterations), predictions (M, 2); gives the weights."""
    energies, predictions = energies.copy(), predictions[:, None].copy()
    for each, predicted in zip(energies, predictions, strict=True):
        mark_diverged(each, predicted)
    shares = np.repeat(weights[:, None], energies.shape[1], axis=1)
    apply_switching(shares, energies)
    forecast_mixture(shares, predictions, forecasts[None])
    reweight(shares, energies, free_energies)
    return shares[:, -1]


@table("scale", [0.1, 10.0, 1000.0])
def test_weigh_equals_its_twin(scale):
    rng = np.random.default_rng(0)
    energies = scale * rng.standard_normal((4, 50, 3))
    predictions = np.abs(rng.standard_normal((4, 50, 2)))
    energies[2, 30:] = predictions[2, 30:] = np.nan  # a member that overflowed
    weights = rng.dirichlet(np.ones(4))
    expected = mixed(weights, energies, predictions)
    free_energies, forecasts = np.empty((50, 3)), np.empty((50, 2))
    for t in range(50):
        weights = take(weights, energies[:, t], predictions[:, t], free_energies[t], forecasts[t])
    np.testing.assert_allclose(weights, expected[0], rtol=1e-8, atol=1e-290)
    np.testing.assert_allclose(free_energies, expected[1], rtol=1e-10, atol=1e-12 * scale)
    np.testing.assert_allclose(forecasts, expected[2], rtol=1e-8)
    assert weights[2] == 0


def test_a_hypothesis_comes_back_when_it_is_true_again():
    energies = np.zeros((2, 2000, 1))
    energies[1, :1960] = 1.0  # long enough for exp(-1960), which is 0
    energies[0, 1960:] = 1.0
    weights, predictions = np.full(2, 0.5), np.ones((2, 2000, 2))
    for t in range(2000):
        weights = take(weights, energies[:, t], predictions[:, t], np.empty(1), np.empty(2))
    assert weights[1] > 0.99
    assert weights.sum() == pytest.approx(1)


def test_a_grid_without_finite_members_is_not_finite():
    free_energies, forecasts = np.zeros(1), np.zeros(2)
    take(np.full(2, 0.5), np.full((2, 1), np.nan), np.ones((2, 2)), free_energies, forecasts)
    assert not np.isfinite(free_energies).any()
    assert np.isnan(forecasts).all()


def test_displacement_keeps_the_shapes_and_says_ratio_and_sum():
    noises = np.array([2.0, 2.0 * 3e-3**2, 5.0, 5.0 * 1e-3**2])
    moved = scale_noise_gammas(noises, 7.0, 3.0)
    q, r = moved[1] / moved[0], moved[3] / moved[2]
    assert (moved[0], moved[2]) == (2.0, 5.0)
    assert np.sqrt(q / r) == pytest.approx(7 * 3)
    assert q + r == pytest.approx(9 * (3e-3**2 + 1e-3**2))
    np.testing.assert_allclose(scale_noise_gammas(noises, 1.0, 1.0), noises, rtol=1e-14)


def test_sensors_share_one_unknown_factor():
    noises = np.array([2.0, 2.0 * 3e-3**2, 5.0, 5.0 * 1e-3**2, 7.0, 7.0 * 4e-3**2])
    first = noises[:4]
    for grid_size in (3, (3, 2)):
        several, single = noise_grid(noises, grid_size), noise_grid(first, grid_size)
        np.testing.assert_array_equal(several[:, :4], single)
        np.testing.assert_allclose(several[:, 5], 7 / 5 * 4**2 * several[:, 3], rtol=1e-14)
        assert (several[:, 4] == 7.0).all()


def test_first_weights_are_half_a_cauchy_density_of_the_ratio():
    records = member_priors(silverbox_prior(), (3, 1))
    middle = np.log(2e-3)
    ratios = np.sqrt(records[:, -3] / records[:, -4] / (records[:, -1] / records[:, -2]))
    # The density of the logarithm is the density of the ratio, 1/(1 + (ratio/scale)²), times the ratio.
    density = ratios / (1 + (ratios / np.exp(middle)) ** 2)
    noises = records[:, -4:]
    np.testing.assert_allclose(initial_weights(noises, middle), density / density.sum(), rtol=1e-12)
    np.testing.assert_array_equal(initial_weights(noises), [1 / 3] * 3)


def test_only_a_rig_with_a_guess_says_where_noises_are_likely():
    guess = {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)}
    rig = Rig(1e-3, input=Channel("N", limit=6), output=Channel("m", range=0.03), guess=guess)
    own = OnlineEstimator(rig=rig)
    # 2500 N/m and 0.4 kg, and as much again of the cubic term at a third of the range: some 0.1 rad per sample.
    likely = own.noise_ratio.mean
    assert np.log(0.05**2) < likely < np.log(0.2**2)
    even = OnlineEstimator(rig.model, rig_prior(rig), replace(rig, guess=None), noise_hypotheses=(7, 7))
    assert np.ptp(even.arrays()["weights"]) == 0.0
    assert own.noise_ratio.prior_std < even.noise_ratio.prior_std


def test_a_matched_gamma_has_the_mixtures_variance_and_its_spread():
    assert moment_matched_gamma(np.ones(1), np.array([3.0]), np.array([2e-6])) == pytest.approx((3.0, 2e-6), rel=1e-12)
    # Of shapes this large 1/g is normal about rate/shape, with the relative variance 1/shape.
    rng = np.random.default_rng(1)
    weights, shapes, rates = np.array([0.2, 0.8]), np.array([3e3, 1e4]), np.array([3e3, 2e4])
    which = rng.choice(2, 400_000, p=weights)
    variances = 1 / rng.gamma(shapes[which], 1 / rates[which])
    shape, rate = moment_matched_gamma(weights, shapes, rates)
    assert rate / shape == pytest.approx(variances.mean(), rel=0.003)
    assert 1 / shape == pytest.approx(variances.var() / variances.mean() ** 2, rel=0.01)
    # The same in compiled code, of two noises.
    records = np.column_stack([np.zeros((2, 6 + 21)), shapes, rates, shapes, 2 * rates])
    np.testing.assert_allclose(
        compile_mixture(6).mixture(pack_into_lanes(records, LANES), weights)[1][6 + 21 :],
        [shape, rate, shape, 2 * rate],
    )


@table(("n_noises", "n"), [(2, 1), (2, 8), (2, 32), (4, 8)])
@table("members", [1, 21, 40])
def test_mixtures_have_the_moments_of_their_finite_members(members, n, n_noises):
    """Of one system or of several beside each other, also over many blocks; to the last bit the same."""
    names, rng = 6, np.random.default_rng(members)
    means, roots = rng.standard_normal((members, n, names)), rng.standard_normal((members, n, names, names))
    covs, noises = roots @ roots.swapaxes(2, 3), rng.uniform(1.0, 5.0, (members, n, 2 * n_noises))
    upper = np.triu_indices(names)
    records = np.concatenate([means, covs[:, :, upper[0], upper[1]], noises], axis=2)
    weights = rng.dirichlet(np.ones(members), n).T.copy()
    if members > 1:
        records[1, :, 8], records[2, : n // 2 + 1, 0], weights[3] = np.nan, np.inf, 0.0
    found, size = compile_mixture(names, n_noises), records.shape[2]
    before = np.full((LANES, size), np.nan)
    blocks = pack_into_lanes(np.concatenate([before, records.reshape(-1, size)]), LANES)
    finite = np.isfinite(records).all(axis=2)
    shares, mixed_records = weights * finite / (weights * finite).sum(axis=0), np.empty((size, LANES))
    found.mix(blocks, 1, shares.reshape(-1), n, mixed_records.reshape(-1), LANES)
    for j in range(n):
        kept = np.isfinite(records[:, j]).all(axis=1) & (weights[:, j] > 0)
        own = weights[kept, j] / weights[kept, j].sum()
        mean = own @ means[kept, j]
        off = means[kept, j] - mean
        cov = np.einsum("m,mij->ij", own, covs[kept, j] + off[:, :, None] * off[:, None, :])
        gammas = [
            moment_matched_gamma(own, noises[kept, j, k], noises[kept, j, k + 1]) for k in range(0, 2 * n_noises, 2)
        ]
        expected = np.concatenate([mean, cov[upper], *gammas])
        np.testing.assert_allclose(mixed_records[:, j], expected, rtol=1e-12, atol=1e-13)
        of_one, record = found.mixture(pack_into_lanes(records[:, j], LANES), weights[:, j].copy())
        np.testing.assert_allclose(record, mixed_records[:, j], rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(of_one[kept], own, rtol=1e-14)
        assert (of_one[~kept] == 0).all()


def test_a_mixture_without_finite_members_is_nan():
    records = np.full((2, 6 + 21 + 4), np.nan)
    assert np.isnan(compile_mixture(6).mixture(pack_into_lanes(records, LANES), np.full(2, 0.5))[1]).all()


# --- The estimator -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Member:
    """A belief of the references: shape and rate of γ, and of ξ."""

    mean: np.ndarray
    cov: np.ndarray
    gamma: tuple[float, float]
    xi: tuple[float, float]


def test_members_share_the_linearisation_about_their_mixture(samples):
    u, y = samples
    estimator, prior = ensemble("paper"), silverbox_prior()
    g, g_rate, n, n_rate = prior.noises
    beliefs = hypotheses(Member(prior.mean, prior.cov, (g, g_rate), (n, n_rate)), RATIOS)
    weights, expected = np.full(len(beliefs), 1 / len(beliefs)), []
    for t in range(len(u)):
        center = mixture_of(weights, beliefs).mean
        step = difference_step(center, u[t - 1] if t else 0.0)
        updates = [structured_update(one, carried(step, one.mean - center), y[t], 3) for one in beliefs]
        beliefs, energies = zip(*updates, strict=True)
        weights, energy = weighed(weights, energies)
        expected.append(energy)
    np.testing.assert_allclose(estimator.run(u, y)[:, -1], expected, rtol=1e-8, atol=1e-8)
    last = mixture_of(weights, beliefs)
    std = np.sqrt(np.diag(last.cov))
    np.testing.assert_allclose((estimator.belief.mean - last.mean) / std, 0, atol=1e-7)
    np.testing.assert_allclose((estimator.belief.cov - last.cov) / np.outer(std, std), 0, atol=1e-7)


def test_members_with_sigma_points_are_estimators_of_their_own(samples):
    u, y, model = *samples, "look-ahead"
    estimator, alone = ensemble(model), list(members(model))
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
    np.testing.assert_allclose((estimator.belief.coefficients_mean - mean) / std, 0, atol=1e-6)
    np.testing.assert_allclose((estimator.belief.coefficients_cov - cov) / np.outer(std, std), 0, atol=1e-5)
    variance = weights @ [1 / belief.gamma_mean for belief in beliefs]
    assert 1 / estimator.belief.gamma_mean == pytest.approx(variance, rel=1e-8)


def test_hypotheses_of_two_sensors_are_weighed_by_both():
    noise = np.array([1e-3, 8e-3])
    truth, u, y = pendulum_record(200, noise)
    prior = pendulum_prior(process_noise=3e-4, measurement_noise=noise / 3)
    estimator = pendulum_estimator(prior, noise_hypotheses=(3, 3), expectations="sigma_points")
    alone = []
    for noises in member_priors(prior, (3, 3))[:, -6:]:
        moved = Belief.of(PENDULUM, prior.mean, prior.cov, noises[:2], (noises[2:4], noises[4:]))
        alone.append(pendulum_estimator(moved, expectations="sigma_points"))
    weights, expected = np.full(9, 1 / 9), []
    for sample in np.array([each.run(u, y)[:, -1] for each in alone]).T:
        weights, energy = weighed(weights, sample)
        expected.append(energy)
    np.testing.assert_allclose(estimator.run(u, y)[:, -1], expected, rtol=1e-9, atol=1e-9)
    std = np.sqrt(np.diag(estimator.belief.coefficients_cov))
    mean = weights @ np.array([each.belief.coefficients_mean for each in alone])
    np.testing.assert_allclose((estimator.belief.coefficients_mean - mean) / std, 0, atol=1e-6)
    # The sensors' true factor is 3; a filter each about the mixture's mean finds it as well.
    shared = pendulum_estimator(prior, noise_hypotheses=(3, 3))
    shared.run(u, y)
    for found in (estimator, shared):
        np.testing.assert_allclose(np.sqrt(found.belief.noises[3::2] / found.belief.noises[2::2]), noise, rtol=0.2)
        assert (np.abs(found.belief.coefficients_mean - truth) < 4 * std).all()


@ANY_MODEL
def test_predictions_and_free_runs_are_those_of_the_mean(samples, model):
    u, y = samples
    estimator = ensemble(model)
    estimator.run(u, y)
    alone = OnlineEstimator(**MODELS[model] | {"prior": estimator.belief})
    if model == "paper":
        np.testing.assert_array_equal(estimator.predict(u, y), alone.predict(u, y))
        np.testing.assert_array_equal(estimator.simulate(u, y[:5]), alone.simulate(u, y[:5]))
    else:  # a filter of its own begins where the belief says that the state is
        estimator.rewind()
        alone.restore({**alone.arrays(), "first": estimator.arrays()["first"]})
        np.testing.assert_allclose(estimator.predict(u, y), alone.predict(u, y), atol=1e-9)


def test_an_overflowed_member_has_no_weight(samples):
    estimator = ensemble("look-ahead")
    estimator.run(*samples)
    arrays = estimator.arrays()
    arrays["records"][0], arrays["weights"][0] = np.nan, 0.0
    arrays["weights"] /= arrays["weights"].sum()
    estimator.restore(arrays)
    assert np.isfinite(estimator.run(*samples)).all()
    assert np.isfinite(estimator.forecasts).all()
    assert np.isfinite(estimator.belief.record).all()
    assert np.isfinite(estimator.noise_ratio.std)
    assert estimator.arrays()["weights"][0] == 0


def noisy(process_noise, measurement_noise, samples):
    return record(samples, process_noise, measurement_noise)


# --- Calibration ---------------------------------------------------------------------------------------------------


def test_a_single_filter_keeps_the_difference_of_the_precisions():
    """A single filter keeps the difference E[γ] - E[ξ] of its priors (module docstring)."""
    prior = silverbox_prior(process_noise=2e-3 / 3, measurement_noise=1e-3 / 3)
    estimator = OnlineEstimator(None, prior)
    estimator.run(*noisy(2e-3, 1e-3, 600))
    belief = estimator.belief
    assert belief.gamma_mean < (2e-3 / 3) ** -2 / 5  # it has learned much
    difference = (2e-3 / 3) ** -2 - (1e-3 / 3) ** -2
    assert belief.gamma_mean - belief.xi_mean == pytest.approx(difference, rel=0.1)


@pytest.mark.parametrize("noises", [(2e-3, 1e-3), (5e-4, 5e-4), (1e-4, 3e-4)])
@pytest.mark.parametrize("centers", [(5e-4, 5e-4), (2e-3, 1e-3), (2e-4, 6e-4)])
def test_both_noises_are_found_within_a_factor_of_three(noises, centers):
    # In total the centres are up to 3.5 times too small and 7 times too large.
    prior = silverbox_prior(process_noise=centers[0], measurement_noise=centers[1])
    estimator = OnlineEstimator(None, prior, noise_hypotheses=9)
    estimator.run(*noisy(*noises, 1500))
    ratio, belief = estimator.noise_ratio, estimator.belief
    assert ratio.std < 0.5
    assert abs(ratio.mean - np.log(noises[0] / noises[1])) < np.log(3) / 2
    assert 1 / 3 < belief.gamma_mean * noises[0] ** 2 < 3
    assert 1 / 3 < belief.xi_mean * noises[1] ** 2 < 3


def test_a_noise_hidden_by_the_other_has_a_wide_interval():
    estimator = OnlineEstimator(noise_hypotheses=9)
    first = estimator.noise_ratio
    assert first.std == pytest.approx(first.prior_std)
    width = 2 * np.log(MAX_RATIO_FACTOR) * 9 / 8  # nine steps, as a density that is constant in the logarithm
    assert first.prior_std == pytest.approx(width / np.sqrt(12))
    assert first.mean == pytest.approx(0, abs=1e-12)
    assert len(TOTAL_STD_FACTORS) * 9 == len(estimator.arrays()["weights"])
    estimator.run(*noisy(2e-3, 1e-5, 1500))
    assert estimator.noise_ratio.std > 0.5
    assert estimator.belief.gamma_mean * 2e-3**2 == pytest.approx(1, abs=0.2)
    assert 1 / estimator.belief.xi_mean < (5e-4) ** 2  # bounded from above only
