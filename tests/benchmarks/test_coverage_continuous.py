"""Coverage on Continuous-v0: the intervals of its own estimator hold the truth, and those of the other do not."""

import json

import numpy as np
import pytest
from scipy.stats import binom, chi2

from benchmarks import coverage_continuous
from benchmarks.coverage import LENGTHS, LEVEL, NOISES
from benchmarks.coverage_continuous import COEFFICIENTS, PHYSICAL, Config, evaluate

TAIL = 1e-4  # chance that a calibrated posterior misses one bound of one check


def assert_calibrated(result):
    for name, hits in result.hits.items():
        assert binom.ppf(TAIL, result.systems, LEVEL) <= hits <= binom.isf(TAIL, result.systems, LEVEL), name
    freedoms = 4 * result.systems
    assert chi2.ppf(TAIL, freedoms) <= result.nees * freedoms <= chi2.isf(TAIL, freedoms)


def test_intervals_of_the_plants_own_equation_hold_the_truth():
    result = evaluate("ode", 5e-4, 5e-4, 256, 128, seed=1)
    assert list(result.hits) == [*COEFFICIENTS, *PHYSICAL]
    assert_calibrated(result)
    assert result.gamma == pytest.approx(1, abs=0.05)
    assert result.xi == pytest.approx(1, abs=0.05)


def test_those_of_the_difference_equation_do_not():
    result = evaluate("nlarx", 5e-4, 5e-4, 256, 128, seed=1)
    assert list(result.hits) == [*PHYSICAL]
    assert result.hits["m"] == result.hits["a"] == 0
    assert result.nees > 50


def test_the_seed_decides():
    assert evaluate("ode", 1e-4, 3e-4, 32, 8, seed=2) == evaluate("ode", 1e-4, 3e-4, 32, 8, seed=2)
    assert evaluate("ode", 1e-4, 3e-4, 32, 8, seed=3) != evaluate("ode", 1e-4, 3e-4, 32, 8, seed=2)


def test_the_command_writes_its_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(coverage_continuous, "NOISES", ((5e-4, 5e-4),))
    monkeypatch.setattr(coverage_continuous, "LENGTHS", (16, 32))
    path = tmp_path / "coverage.json"
    coverage_continuous.main(Config(systems=3, json=path))
    written = json.loads(path.read_text(encoding="utf-8"))
    assert {estimator: len(rows) for estimator, rows in written.items()} == {"ode": 2, "nlarx": 2}
    assert set(written["ode"][0]["wilson"]) == {*COEFFICIENTS, *PHYSICAL}
    assert "| 0.0005  | 0.0005  | 16 |" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("noises", NOISES, ids=str)
@pytest.mark.parametrize("samples", LENGTHS)
def test_full_coverage(noises, samples):
    result = evaluate("ode", *noises, samples, 500, seed=1)
    fractions = np.array(list(result.hits.values())) / result.systems
    assert ((fractions >= 0.85) & (fractions <= 0.95)).all()
    assert_calibrated(result)
