"""Estimators in files: they continue bit by bit, and nothing but our own files is read."""

import json

import numpy as np
import pytest

from estimator import NLARX, DuffingODE, OnlineEstimator, load_estimator, save_estimator
from estimator.models.regressors import Term

ESTIMATORS = {
    "structured": lambda: OnlineEstimator(NLARX()),
    "mean field": lambda: OnlineEstimator(NLARX(input_delay=0), factorisation="mean_field", iterations=4),
    "linear": lambda: OnlineEstimator(NLARX(nonlinear=False)),
    "three-tap": lambda: OnlineEstimator(NLARX(regressors="three-tap")),
    "own terms": lambda: OnlineEstimator(NLARX(regressors=(Term(1), Term(0, 1), Term(tap=2), Term(1, 1)))),
    "ode": lambda: OnlineEstimator(DuffingODE(cubic_damping=True)),
    "ode, look-ahead": lambda: OnlineEstimator(DuffingODE("look_ahead", substeps=3)),
    "ode, sigma points": lambda: OnlineEstimator(DuffingODE("look_ahead"), expectations="sigma_points", drift=1e-3),
    "three-tap, sigma points": lambda: OnlineEstimator(NLARX(regressors="three-tap"), expectations="sigma_points"),
    "ensemble": lambda: OnlineEstimator(NLARX(), noise_hypotheses=3),
    "ode ensemble": lambda: OnlineEstimator(DuffingODE("look_ahead", substeps=3), noise_hypotheses=3),
}


def some_record(samples=300):
    rng = np.random.default_rng(3)
    u = rng.uniform(-0.1, 0.1, samples)
    y = np.zeros(samples)
    for t in range(2, samples):
        y[t] = 1.48 * y[t - 1] - 1.5 * y[t - 1] ** 3 - 0.94 * y[t - 2] + 0.39 * u[t - 1]
    return u, y + 5e-4 * rng.standard_normal(samples)


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_a_saved_estimator_continues_bit_by_bit(kind, tmp_path):
    u, y = some_record()
    original = ESTIMATORS[kind]()
    original.run(u[:200], y[:200])
    save_estimator(original, tmp_path / "estimator.npz")
    resumed = load_estimator(tmp_path / "estimator.npz")
    expected = original.run(u[200:], y[200:])
    np.testing.assert_array_equal(resumed.run(u[200:], y[200:]), expected)
    for name, array in original.arrays().items():
        np.testing.assert_array_equal(resumed.arrays()[name], array, err_msg=name)
    original.rewind()
    resumed.rewind()
    np.testing.assert_array_equal(resumed.run(u, y), original.run(u, y))


def test_settings_come_back(tmp_path):
    original = ESTIMATORS["own terms"]()
    save_estimator(original, tmp_path / "estimator.npz")
    resumed = load_estimator(tmp_path / "estimator.npz")
    assert resumed.model == original.model
    assert (resumed.iterations, resumed.factorisation) == (original.iterations, original.factorisation)


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("not an archive")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "future.npz", description=np.array(json.dumps({"format": 99})))
    np.savez(tmp_path / "objects.npz", description=np.array([{"format": 1}], dtype=object))
    for name, message in (("text", "not one"), ("other", "not one"), ("future", "of 99"), ("objects", "not one")):
        with pytest.raises(ValueError, match=message):
            load_estimator(tmp_path / f"{name}.npz")
    with pytest.raises(FileNotFoundError):
        load_estimator(tmp_path / "missing.npz")


def test_nothing_is_half_written(tmp_path, monkeypatch):
    path = tmp_path / "estimator.npz"
    save_estimator(ESTIMATORS["structured"](), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("estimator.files.os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_estimator(ESTIMATORS["ode"](), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["estimator.npz"]
