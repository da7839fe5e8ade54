"""Coverage: on oscillators drawn from the prior, 90 % intervals hold the truth in 90 % of the cases.

The bounds are quantiles of what a calibrated posterior gives: hits are binomial with p = 0.9, and the sum of the NEES
is chi-squared with four degrees of freedom for each system.
"""

import json

import numpy as np
import pytest
from scipy.stats import binom, chi2

from benchmarks import coverage
from benchmarks.coverage import LEVEL, QUANTITIES, Case, Config, evaluate, tables, wilson

TAIL = 1e-4  # chance that a calibrated posterior misses one bound of one check


def assert_calibrated(result):
    for name, hits in result.hits.items():
        assert binom.ppf(TAIL, result.kept, LEVEL) <= hits <= binom.isf(TAIL, result.kept, LEVEL), name
    freedoms = 4 * result.kept
    assert chi2.ppf(TAIL, freedoms) <= result.nees * freedoms <= chi2.isf(TAIL, freedoms)


def test_structured_intervals_hold_the_truth():
    # With 120 systems the bounds are 94 to 118 hits (78 to 98 %), and 0.78 to 1.26 for the NEES.
    result = evaluate(Case("structured", 5e-4, 5e-4, 256, (5e-4, 5e-4)), 120, np.random.default_rng(0))
    assert result.kept >= 118
    assert_calibrated(result)
    # The two noises share one posterior shape of 130, hence 9 % per system and 1 % for the median of 120.
    assert result.gamma == pytest.approx(1, abs=0.05)
    assert result.xi == pytest.approx(1, abs=0.05)


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


def test_systems_that_leave_the_range_are_left_out():
    psi = coverage.to_coefficients(coverage.SILVERBOX_TWIN)
    both = type(psi)(psi.theta1, psi.theta2, psi.theta3, np.array([psi.eta, 50 * psi.eta]))
    u, y, stayed = coverage.simulate(both, 1e-4, 1e-4, 500, np.random.default_rng(0))
    assert stayed.tolist() == [True, False]
    assert np.isfinite(y).all()
    x = x_last = 0.0
    for t in range(500):
        x, x_last = psi.theta1 * x + psi.theta2 * x**3 + psi.theta3 * x_last + psi.eta * u[0, t], x
        assert abs(y[0, t] - x) < 0.02  # but for the noises
    assert np.abs(u).max() <= 0.15


def test_the_command_writes_its_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(coverage, "NOISES", ((5e-4, 5e-4), (1e-4, 3e-4)))
    monkeypatch.setattr(coverage, "LENGTHS", (64,))
    path = tmp_path / "coverage.json"
    coverage.main(Config(systems=3, json=path))
    written = json.loads(path.read_text(encoding="utf-8"))
    assert [len(rows) for rows in written.values()] == [2, 2, 2, 2, 1]
    row = written["structured"][0]
    assert set(row["hits"]) == set(QUANTITIES)
    assert row["wilson"]["θ1"] == list(wilson(row["hits"]["θ1"], row["kept"]))
    assert list(tmp_path.iterdir()) == [path]
    assert "| 0.0005  | 0.0005  |" in capsys.readouterr().out


def test_wilson_interval_of_a_textbook_example():
    # Of 10 trials 9: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n) with z = 1.96.
    assert wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", tables()["structured"], ids=lambda c: f"{c.process_noise}-{c.measurement_noise}-{c.samples}"
)
def test_full_coverage(case):
    result = evaluate(case, 500, np.random.default_rng(1))
    assert result.kept >= 490
    for name, hits in result.hits.items():
        assert 0.85 <= hits / result.kept <= 0.95, name
    assert_calibrated(result)
