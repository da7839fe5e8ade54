"""Noises of a record by profile likelihood: ratios of sensors and of sources, their use online, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from estimator import Model, OnlineEstimator, profile_noises, weak_prior

#: Two coupled states, each with a sensor and with noise of its own.
PAIR = Model(
    "pair",
    {"x": "V", "w": "V"},
    {"loss": "1", "gain": "1"},
    noise=("1", "1"),
    outputs={"y": "x", "z": "w"},
    next_state=("0.5*x + 0.4*w + gain*u", "loss*w + 0.2*x"),
    independent_noise=True,
)
TRUTH = 0.6, 0.8
PROCESS, SENSORS = np.array([0.05, 0.25]), np.array([0.03, 0.3])


def record(samples, seed=0, process=PROCESS, sensors=SENSORS):
    rng = np.random.default_rng(seed)
    u, y, (x, w) = rng.uniform(-1, 1, samples), np.empty((samples, 2)), (0.0, 0.0)
    for t in range(samples):
        x, w = np.array([0.5 * x + 0.4 * w + TRUTH[1] * u[t], TRUTH[0] * w + 0.2 * x]) + process * rng.standard_normal(
            2
        )
        y[t] = np.array([x, w]) + sensors * rng.standard_normal(2)
    return u, y


def prior_of(model, process=0.05, sensors=0.05):
    return weak_prior(model, [0.5, 1.0], 0.1 * np.eye(2), process, sensors)


def stds(belief):
    return np.sqrt(belief.noises[1::2] / belief.noises[::2])


def test_sensors_and_sources_that_are_ten_times_apart_are_found_from_equal_ones():
    u, y = record(3000)
    found = profile_noises(prior_of(PAIR), u, y)
    process, *sensors = stds(found)
    assert sensors == pytest.approx(SENSORS, rel=0.15)
    assert process == pytest.approx(PROCESS[0], rel=0.3)
    assert found.model.noise[0] == "1"
    assert float(found.model.noise[1].split("*")[0]) == pytest.approx(PROCESS[1] / PROCESS[0], rel=0.3)
    assert (found.noises[::2] == 2.0).all()
    assert (found.mean == prior_of(PAIR).mean).all()


def test_the_same_is_found_from_a_start_beyond():
    u, y = record(2000, 1)
    near = stds(profile_noises(prior_of(PAIR), u, y))
    far = stds(profile_noises(prior_of(PAIR, 0.2, [0.3, 0.03]), u, y))
    assert far == pytest.approx(near, rel=0.003)


def test_the_profiled_prior_predicts_another_record_better():
    shared = replace(PAIR, independent_noise=False)
    prior = prior_of(shared)
    found = profile_noises(prior, *record(1000, 2, process=np.array([0.02, 0.02])))
    assert found.model == shared
    u, y = record(1000, 3, process=np.array([0.02, 0.02]))
    energies = [float(np.sum(OnlineEstimator(shared, one).run(u, y))) for one in (prior, found)]
    assert energies[1] < energies[0] - 100


def test_another_shape_is_refused():
    u, y = record(20)
    with pytest.raises(ValueError, match=r"u must be of one record, but has shape \(1, 20\); pass u\[0\]"):
        profile_noises(prior_of(PAIR), u[None], y[None])
    with pytest.raises(ValueError, match="u and y must have one shape"):
        profile_noises(prior_of(PAIR), u, y[:, 0])
