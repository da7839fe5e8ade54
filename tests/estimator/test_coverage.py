"""Coverage: on systems drawn from the prior, 90 % intervals hold the truth in 90 % of the cases.

The bounds are quantiles of what a calibrated posterior gives: hits are binomial with p = 0.9, and the sum of the NEES
is chi-squared with as many degrees of freedom for each system as it has coefficients.
"""

import json

import numpy as np
import pytest
from scipy.stats import binom, chi2

from benchmarks import coverage
from benchmarks.coverage import HYPOTHESES, LEVEL, Case, Config, evaluate, tables, wilson
from benchmarks.systems import MAX_INPUT, MODELS, ODE, draw, make_prior, simulate, simulate_ode
from estimator import SILVERBOX_TWIN, coefficients_of, difference, recorded_prior
from estimator.models.difference import Term

TAIL = 1e-4  # chance that a calibrated posterior misses one bound of one check
PHYSICAL = {"m", "c", "a", "b"}
CALIBRATED = ("structured", "offset", "three-tap", "cubic", "ode", "ensemble")  # tables


def assert_calibrated(result):
    for name, hits in result.hits.items():
        assert binom.ppf(TAIL, result.kept, LEVEL) <= hits <= binom.isf(TAIL, result.kept, LEVEL), name
    freedoms = len(set(result.hits) - PHYSICAL) * result.kept
    assert chi2.ppf(TAIL, freedoms) <= result.nees * freedoms <= chi2.isf(TAIL, freedoms)


def test_structured_intervals_hold_the_truth():
    # With 120 systems the bounds are 94 to 118 hits (78 to 98 %), and 0.78 to 1.26 for the NEES.
    result = evaluate(Case("structured", 5e-4, 5e-4, 256, (5e-4, 5e-4)), 120, np.random.default_rng(0))
    assert result.kept >= 118
    assert_calibrated(result)
    # The two noises share one posterior shape of 130, hence 9 % per system and 1 % for the median of 120.
    assert result.gamma == pytest.approx(1, abs=0.05)
    assert result.xi == pytest.approx(1, abs=0.05)
    assert result.ratio_std is None


@pytest.mark.parametrize("model", [model for model in MODELS if model != "paper"])
def test_intervals_of_every_model_hold_the_truth(model):
    result = evaluate(Case("structured", 5e-4, 5e-4, 256, (5e-4, 5e-4), model), 120, np.random.default_rng(0))
    assert result.kept >= 110
    assert_calibrated(result)


@pytest.mark.parametrize(
    "case",
    [
        Case("mean_field", 1e-4, 3e-4, 256, (1e-4, 3e-4)),
        Case("structured", 2e-3, 1e-3, 256, (5e-4, 5e-4)),
        Case("structured", 5e-4, 5e-4, 256, (1.5e-3, 1.5e-3)),
    ],
    ids=["mean field", "noise priors too small", "noise priors too large"],
)
def test_where_the_manual_says_that_they_do_not(case):
    # docs/coverage.md names these as limits; and the check above can fail.
    result = evaluate(case, 120, np.random.default_rng(0))
    with pytest.raises(AssertionError):
        assert_calibrated(result)


@pytest.mark.parametrize(
    "case",
    [
        Case("structured", 2e-3, 1e-3, 256, (5e-4, 5e-4), hypotheses=HYPOTHESES),
        Case("structured", 5e-4, 5e-4, 256, (1.5e-3, 1.5e-3), hypotheses=HYPOTHESES),
    ],
    ids=["noise priors too small", "noise priors too large"],
)
def test_an_ensemble_mends_wrong_noise_priors(case):
    result = evaluate(case, 60, np.random.default_rng(0))
    assert_calibrated(result)
    assert result.ratio_std < 0.5
    for low, high in (result.gamma_range, result.xi_range):
        assert 1 / 3 < low < high < 3


def test_systems_that_leave_the_range_are_left_out():
    one = coefficients_of(difference(), SILVERBOX_TWIN)
    theta1, theta2, theta3, eta = one
    both = np.array([one, one * [1, 1, 1, 50]])
    terms = (Term(1), Term(3), Term(0, 1), Term(tap=0))
    u, y, stayed = simulate(terms, both, 1e-4, 1e-4, 500, np.random.default_rng(0))
    assert stayed.tolist() == [True, False]
    assert np.isfinite(y).all()
    x = x_last = 0.0
    for t in range(500):
        x, x_last = theta1 * x + theta2 * x**3 + theta3 * x_last + eta * u[0, t], x
        assert abs(y[0, t] - x) < 0.02  # but for the noises
    assert np.abs(u).max() <= MAX_INPUT


def test_taps_reach_back_from_their_own_sample():
    coefficients = np.array([[0.3, 0.5, 0.7, 2e-3, 0.2]])
    terms = (Term(tap=0), Term(tap=1), Term(tap=2), Term(), Term(1, 1))
    u, y, _ = simulate(terms, coefficients, 1e-300, 1e-300, 50, np.random.default_rng(0))
    x = np.zeros(52)  # two before the first
    past = np.concatenate([[0, 0], u[0]])
    for t in range(2, 52):
        x[t] = 0.3 * past[t] + 0.5 * past[t - 1] + 0.7 * past[t - 2] + 2e-3 + 0.2 * x[t - 1] * x[t - 2]
    np.testing.assert_allclose(y[0], x[2:], rtol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_the_prior_has_the_moments_of_the_draw(model):
    systems = 4000
    prior = make_prior(model, 1e-3, 1e-3, 2.0)
    mean, cov = prior.coefficients_mean, prior.coefficients_cov
    drawn = draw(model, systems, 1e-3, 1e-3, 3, np.random.default_rng(0)).truth[:, : len(mean)]
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((drawn.mean(0) - mean) / std, 0, atol=5 / np.sqrt(systems))
    difference = (np.cov(drawn.T) - cov) / np.outer(std, std)
    np.testing.assert_allclose(difference, 0, atol=8 / np.sqrt(systems))


def test_the_physical_equation_moves_as_its_filter_expects():
    """Without noises, a filter that knows the coefficients forecasts every output."""
    from estimator import OnlineEstimator, Rig
    from estimator.belief import Belief

    truth = recorded_prior(ODE).coefficients_mean[None].copy()
    truth[0, 4:] = 2e-3, -0.03, 0.05  # force, y0, d
    u, y, _ = simulate_ode(truth, 1e-30, 1e-30, 60, np.random.default_rng(0))
    cov = np.diag([1e-6, 1e-6] + [0.0] * 7)
    prior = Belief.of(ODE, [-0.03, 0.0, *truth[0]], cov, (1e15, 1e15 * 1e-20), (1e15, 1e15 * 1e-20))
    estimator = OnlineEstimator(ODE, prior, Rig.silverbox("linear"))
    estimator.run(u[0], y[0])
    # What is left of the unknown first state after two outputs is 1e-10 V and its velocity.
    np.testing.assert_allclose(estimator.forecasts[4:, 0], y[0, 4:], atol=1e-8)


def test_the_command_writes_its_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(coverage, "NOISES", ((5e-4, 5e-4), (1e-4, 3e-4)))
    monkeypatch.setattr(coverage, "LENGTHS", (64,))
    path = tmp_path / "coverage.json"
    coverage.main(Config(systems=3, json=path))
    written = json.loads(path.read_text(encoding="utf-8"))
    assert list(written) == list(tables())
    assert [len(rows) for rows in written.values()] == [2] * 13 + [1] * 2
    row = written["structured"][0]
    assert set(row["hits"]) == {"θ1", "θ2", "θ3", "η"} | PHYSICAL
    assert row["wilson"]["θ1"] == list(wilson(row["hits"]["θ1"], row["kept"]))
    assert list(written["ode"][0]["hits"]) == list(ODE.coefficients)
    assert list(tmp_path.iterdir()) == [path]
    printed = capsys.readouterr().out
    assert "| 0.0005  | 0.0005  |" in printed
    assert "std of log" in printed
    coverage.main(Config(systems=3, only=("off",)))
    assert "structured" not in capsys.readouterr().out


def test_wilson_interval_of_a_textbook_example():
    # Of 10 trials 9: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n) with z = 1.96.
    assert wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [case for title in CALIBRATED for case in tables()[title]],
    ids=lambda c: f"{c.model}-{c.hypotheses}-{c.process_noise}-{c.measurement_noise}-{c.samples}",
)
def test_full_coverage(case):
    result = evaluate(case, 500, np.random.default_rng(1))
    assert result.kept >= (460 if case.model == "cubic" else 490)
    for name, hits in result.hits.items():
        assert 0.85 <= hits / result.kept <= 0.95, name
    assert_calibrated(result)
