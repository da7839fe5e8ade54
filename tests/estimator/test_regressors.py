"""Declared regressors: the joint filter is the lanes' one on the paper's model, and does what it says beyond it."""

from dataclasses import replace

import numpy as np
import pytest

from estimator import (
    NLARX,
    SAMPLING_STEP,
    SILVERBOX_TWIN,
    DuffingODE,
    JointBelief,
    OnlineEstimator,
    Prior,
    to_coefficients,
)
from estimator.models.regressors import PRESETS, Term

PAPER = NLARX(regressors=PRESETS["paper"])


def simulate(samples, rng, process_noise=1e-4, measurement_noise=3e-4, jump=None):
    """The paper's oscillator; its mass is 1.3 times as large from sample ``jump`` on."""
    before = to_coefficients(SILVERBOX_TWIN)
    after = to_coefficients(replace(SILVERBOX_TWIN, m=1.3 * SILVERBOX_TWIN.m))
    u = rng.uniform(-0.1, 0.1, samples)
    x = np.zeros(samples + 1)
    for t in range(samples):
        c = before if jump is None or t < jump else after
        x[t + 1] = c.theta1 * x[t] + c.theta2 * x[t] ** 3 + c.theta3 * (x[t - 1] if t else 0.0) + c.eta * u[t]
        x[t + 1] += process_noise * rng.standard_normal()
    return u, x[:samples] + measurement_noise * rng.standard_normal(samples)


def joint_twin(prior):
    """The same belief as a `Prior`, for the joint filter."""
    mean = np.concatenate([prior.state_mean, prior.theta_mean, [prior.eta_mean]])
    cov = np.zeros((6, 6))
    cov[:2, :2], cov[2:, 2:] = prior.state_cov, prior.coefficients_cov
    names, units = tuple(t.name for t in PAPER.terms), tuple(t.unit for t in PAPER.terms)
    return JointBelief(
        names, units, mean, cov, prior.gamma_shape, prior.gamma_rate, prior.xi_shape, prior.xi_rate
    )  # fmt: skip


def test_the_paper_s_terms_give_the_lanes_estimator():
    u, y = simulate(600, np.random.default_rng(0))
    prior = Prior.silverbox_twin()
    lanes, joint = OnlineEstimator(NLARX(), prior), OnlineEstimator(PAPER, joint_twin(prior))
    np.testing.assert_allclose(joint.run(u, y), lanes.run(u, y), rtol=1e-9, atol=1e-9)
    std = np.sqrt(np.diag(lanes.belief.coefficients_cov))
    difference = (joint.belief.coefficients_mean - lanes.belief.coefficients_mean) / std
    assert np.abs(difference).max() < 1e-7
    ratio = joint.belief.coefficients_cov / np.outer(std, std)
    np.testing.assert_allclose(ratio, lanes.belief.coefficients_cov / np.outer(std, std), atol=1e-7)
    np.testing.assert_allclose(joint.forecasts, lanes.forecasts, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("preset", ["offset", "three-tap", "cubic"])
def test_free_runs_follow_a_plain_loop(preset):
    rng = np.random.default_rng(1)
    model = NLARX(regressors=preset)
    u, y = simulate(300, rng)
    estimator = OnlineEstimator(model)
    estimator.run(u, y)
    c = estimator.belief.coefficients_mean
    simulated = estimator.simulate(u, y[:40])
    np.testing.assert_array_equal(simulated[:40], y[:40])
    x = list(simulated[40:42])
    for t in range(42, 300):
        taps = {None: 1.0, 0: u[t], 1: u[t - 1], 2: u[t - 2]}
        terms = [
            k * x[-1] ** term.lag1 * x[-2] ** term.lag2 * taps[term.tap] for k, term in zip(c, model.terms, strict=True)
        ]
        x.append(sum(terms))
    np.testing.assert_allclose(simulated[40:], x, rtol=1e-10, atol=1e-13)


def test_terms_name_themselves():
    assert [term.name for term in PRESETS["three-tap"]] == ["x1", "x1^3", "x2", "u0", "u1", "u2", "1"]
    assert [(t.name, t.unit) for t in (Term(2, 1), Term(1, tap=0), Term())] == [
        ("x1^2 x2", "V^-2"),
        ("x1 u0", "V^-1"),
        ("1", "V"),
    ]


@pytest.mark.parametrize("model", [NLARX(regressors="three-tap"), DuffingODE(), DuffingODE("look_ahead")], ids=str)
def test_run_is_repeated_update(model):
    u, y = simulate(120, np.random.default_rng(2))
    at_once, one_by_one = OnlineEstimator(model), OnlineEstimator(model)
    at_once.run(u, y)
    for t in range(120):
        one_by_one.update(u[t], y[t])
    np.testing.assert_array_equal(at_once.belief.mean, one_by_one.belief.mean)
    np.testing.assert_array_equal(at_once.belief.cov, one_by_one.belief.cov)


@pytest.mark.parametrize(
    ("model", "prior", "drift"),
    [
        (PAPER, PAPER.prior(process_noise=1e-4, measurement_noise=3e-4), 0.003),
        (NLARX(), Prior.silverbox_twin(process_noise=1e-4, measurement_noise=3e-4, noise_shape=2.0), 0.01),
    ],
    ids=["terms", "paper"],
)
def test_a_jump_of_the_mass_is_tracked_within_300_samples(model, prior, drift):
    u, y = simulate(1800, np.random.default_rng(3), jump=1500)

    def mass_error(drift):
        estimator = OnlineEstimator(model, prior, drift=drift)
        estimator.run(u, y)
        _, _, theta3, eta = estimator.belief.coefficients_mean
        return abs(-theta3 * SAMPLING_STEP**2 / eta / (1.3 * SILVERBOX_TWIN.m) - 1)

    assert mass_error(drift) < 0.02
    assert mass_error(0.0) > 0.1


def test_missing_outputs_widen_the_belief_in_the_state_and_teach_nothing():
    u, y = simulate(400, np.random.default_rng(4))
    estimator = OnlineEstimator(PAPER, PAPER.prior(process_noise=1e-4, measurement_noise=3e-4))
    estimator.run(u[:300], y[:300])
    before = estimator.belief
    gap = np.full(100, np.nan)
    free_energies = estimator.run(u[300:], gap, missing=True)
    after = estimator.belief
    np.testing.assert_array_equal(after.coefficients_mean, before.coefficients_mean)
    np.testing.assert_array_equal(after.coefficients_cov, before.coefficients_cov)
    assert (after.gamma_shape, after.xi_rate) == (before.gamma_shape, before.xi_rate)
    assert after.state_cov[0, 0] > 5 * before.state_cov[0, 0]
    assert (free_energies == 0).all()
    with pytest.raises(ValueError, match=r"y must be finite, but y\[0\] is nan"):
        estimator.run(u[300:], gap)
    with pytest.raises(ValueError, match="missing must be False"):
        OnlineEstimator().run(u[300:], gap, missing=True)


@pytest.mark.parametrize("model", [NLARX(), NLARX(regressors="three-tap"), DuffingODE()], ids=str)
def test_hard_records_leave_a_sound_belief(model):
    """A hundred thousand samples; saturated, quantised outputs; an input that is constant zero."""
    u, y = simulate(100_000, np.random.default_rng(5))
    u[20_000:30_000] = 0.0
    y = np.round(np.clip(y, -0.1, 0.1) * 4096) / 4096
    estimator = OnlineEstimator(model)
    free_energies = estimator.run(u, y)
    assert np.isfinite(free_energies).all()
    cov = estimator.belief.coefficients_cov
    unknown = np.diag(cov) > 0
    std = np.sqrt(np.diag(cov))[unknown]
    assert np.linalg.eigvalsh(cov[np.ix_(unknown, unknown)] / np.outer(std, std))[0] > 0


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"regressors must be one of .* but is 'qubic'"):
        NLARX(regressors="qubic")
    with pytest.raises(ValueError, match="different terms"):
        NLARX(regressors=(Term(1), Term(1)))
    with pytest.raises(ValueError, match="nonlinear must be True"):
        NLARX(nonlinear=False, regressors="cubic")
    with pytest.raises(ValueError, match="factorisation must be 'structured'"):
        OnlineEstimator(NLARX(regressors="cubic"), factorisation="mean_field")
    with pytest.raises(ValueError, match="prior must have the parameters"):
        OnlineEstimator(NLARX(regressors="cubic"), Prior.silverbox_twin())
    with pytest.raises(ValueError, match="prior must be a Prior"):
        OnlineEstimator(NLARX(), DuffingODE().prior())
    with pytest.raises(ValueError, match="drift must be 0 in mean field"):
        OnlineEstimator(factorisation="mean_field", drift=0.1)
    with pytest.raises(ValueError, match="drift must be at least 0"):
        OnlineEstimator(drift=-0.1)
    with pytest.raises(ValueError, match="spline"):
        OnlineEstimator(DuffingODE("spline")).update(0.0, 0.0)


def test_three_taps_on_the_record(record):
    """One pass over the official training part: below the issue's 0.45, 0.65 and 0.46 mV; paper, offset far above."""
    train, arrow = slice(40_650, 40_650 + 65_062), slice(100, 40_575)
    errors, free_energies = {}, {}
    for preset in ("paper", "offset", "three-tap"):
        model = NLARX(regressors=PRESETS[preset])
        estimator = OnlineEstimator(model)
        free_energies[preset] = estimator.run(record.u[train], record.y[train])[:, -1].sum()
        simulated = estimator.simulate(record.u[arrow], record.y[arrow][:50])
        errors[preset] = 1e3 * np.sqrt(np.mean((simulated - record.y[arrow])[50:] ** 2))
    assert errors["three-tap"] < 0.65 < errors["offset"] < 1.5 < errors["paper"]
    assert free_energies["three-tap"] < free_energies["offset"] < free_energies["paper"]
