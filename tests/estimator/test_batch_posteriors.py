"""Posteriors of many records at once equal single estimators' beliefs."""

import re

import numpy as np
import pytest
from estimators import ONE_TAP, OWN_TAPS, pendulum_estimator, record
from tables import table

from estimator import OnlineEstimator, Rig, difference, duffing, recorded_prior, silverbox_prior
from estimator.inference.batch_posteriors import posteriors

LENGTHS = [40, 7, 0, 40] + 31 * [25]  # more than a block of lanes
HELD = Rig.silverbox("zero_order", -1)
CASES = {
    "paper": (silverbox_prior(), None, OWN_TAPS),
    "paper, delay 1": (silverbox_prior(), ONE_TAP, ONE_TAP),
    "mean field": (OnlineEstimator(factorisation="mean_field").belief, None, OWN_TAPS),
    "three-tap": (recorded_prior(difference("three-tap")), None, OWN_TAPS),
    "ode": (silverbox_prior(duffing()), None, Rig.silverbox("linear")),
    "ode, held": (silverbox_prior(duffing()), HELD, HELD),
}


@pytest.fixture(scope="module")
def records():
    """u, y (n, T) that end before their first NaN."""
    u, y = (np.array(rows) for rows in zip(*(record(40, seed=row) for row in range(len(LENGTHS))), strict=True))
    for row, length in enumerate(LENGTHS):
        u[row, length:] = y[row, length:] = np.nan
    return u, y


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[pytest.mark.slow] * (case in ("ode", "ode, held", "three-tap"))) for case in CASES],
)
def test_beliefs_are_those_of_one_estimator_after_the_other(case, records):
    prior, rig, same = CASES[case]
    u, y = records
    beliefs = posteriors(u, y, prior, rig)
    assert len(beliefs) == len(LENGTHS)
    for row, (belief, length) in enumerate(zip(beliefs, LENGTHS, strict=True)):
        estimator = OnlineEstimator(prior.model, prior, same, factorisation=prior.factorisation)
        estimator.run(u[row, :length], y[row, :length])
        np.testing.assert_allclose(belief.record, estimator.belief.record, rtol=1e-6, atol=1e-14)
        assert belief._identity == estimator.belief._identity
    assert beliefs[2] == prior


@pytest.mark.slow  # seconds of compilation
def test_several_sensors(records):
    estimator = pendulum_estimator()
    prior = estimator.belief
    u, y = np.ones((2, 20)), 0.01 * np.random.default_rng(0).standard_normal((2, 20, 2))
    beliefs = posteriors(u, y, prior)
    estimator.run(u[1], y[1])
    np.testing.assert_allclose(beliefs[1].record, estimator.belief.record, rtol=1e-6, atol=1e-14)


@table(
    ("call", "message"),
    [
        (
            lambda u: posteriors(u[0], u[0], silverbox_prior()),
            "u must be of n records, but has shape (40,); pass u[None] for one",
        ),
        (
            lambda u: posteriors(u, u[:, :-1], silverbox_prior()),
            "u and y must have one shape, (T,) or (n, T), and y a last axis for several sensors, but have (35, 40)",
        ),
        (lambda u: posteriors(u, u * np.nan, silverbox_prior()), "but in record 0 they are not"),
        (lambda u: posteriors(np.ma.masked_array(u), u, silverbox_prior()), "u must not be a masked array"),
        (lambda u: posteriors(u, u + 1j, silverbox_prior()), "y must be numbers"),
        (lambda u: posteriors(u, u, 3), "prior must be a Belief, but is 3"),
        (
            lambda u: posteriors(u, u, silverbox_prior(duffing()), Rig.silverbox("look_ahead")),
            "interpolation must be 'zero_order' or 'linear', but is 'look_ahead'",
        ),
        (
            lambda u: posteriors(u, u, silverbox_prior(), Rig.silverbox("zero_order", -1)),
            "delay must be 0 or more for a difference equation, but is -1",
        ),
    ],
)
def test_invalid_records_are_refused(call, message, records):
    with pytest.raises(ValueError, match=re.escape(message)):
        call(records[0])
