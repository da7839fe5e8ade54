from pathlib import Path

import numpy as np
import pytest

from benchmarks import estimators, silverbox_peer_filters
from duffing_env.plants.silverbox_record import SilverboxRecord
from estimator import SILVERBOX_TWIN, OnlineEstimator, coefficients_of, difference


def test_the_record_is_used_where_it_is(record: SilverboxRecord) -> None:
    u, y, origin = estimators.samples()
    np.testing.assert_array_equal(y, record.multisine.y[: estimators.SAMPLES])
    assert "record" in origin
    assert len(u) == estimators.SAMPLES


def test_without_the_record_the_twin_stands_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimators, "record_available", lambda: False)
    u, y, origin = estimators.samples()
    assert "synthesised" in origin
    estimator = OnlineEstimator()
    estimator.run(u, y)
    eta = coefficients_of(difference(), SILVERBOX_TWIN)[3]
    assert estimator.belief.coefficients_mean[3] == pytest.approx(eta, rel=0.02)


def test_peers_get_the_equation_and_the_inputs_that_act_on_each_output(tmp_path: Path) -> None:
    estimators.write_samples(tmp_path / "samples.npz")
    u, y, _ = estimators.samples()
    with np.load(tmp_path / "samples.npz") as given:
        np.testing.assert_array_equal(given["y"], y)
        model, taps = silverbox_peer_filters.model(dict(given), "paper"), silverbox_peer_filters.taps_of(given["u"])
    coefficients = coefficients_of(difference(), SILVERBOX_TWIN)
    moved = model.move([y[8], y[7], *coefficients], taps[9])
    assert moved == pytest.approx((coefficients @ [y[8], y[8] ** 3, y[7], u[8]], y[8]))
    assert model.cov.shape == (6, 6)
    assert np.linalg.eigvalsh(model.cov)[0] > 0


def test_errors_are_in_millivolts() -> None:
    coefficients = coefficients_of(difference(), SILVERBOX_TWIN)
    theta1, theta2, theta3, _ = coefficients
    u = np.random.default_rng(0).uniform(-0.1, 0.1, 500)
    y = np.zeros(500)
    for t in range(2, 500):
        y[t] = coefficients @ [y[t - 1], y[t - 1] ** 3, y[t - 2], u[t - 1]]
    assert estimators._errors(coefficients, u, y) == pytest.approx((0.0, 0.0), abs=1e-9)
    one_step, _ = estimators._errors(coefficients, u, y + np.where(np.arange(500) == 400, 1e-3, 0.0))
    weights = 1 + (theta1 + 3 * theta2 * y[400] ** 2) ** 2 + theta3**2
    assert one_step == pytest.approx(np.sqrt(weights / 498), rel=1e-2)
