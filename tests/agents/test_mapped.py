"""How many ways through the map are followed."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agents.planner.imagination import LOST
from agents.planner.mapped import _HALVINGS, _HOPELESS, enough_for


@settings(deadline=None)
@given(arrays(float, st.integers(1, 200), elements=st.floats(-1.0, 1.0)), st.integers(1, 64))
def test_no_more_ways_are_followed_than_there_is_place_for(scores, most):
    enough = enough_for(scores, most)
    assert scores.max() - _HOPELESS <= enough <= scores.max()
    followed = np.sum(scores >= enough)
    assert followed <= most or enough == scores.max()
    # A bit lower there would be too many, unless all that are not hopeless have a place.
    lower = np.sum(scores >= enough - 1.01 * _HOPELESS * 0.5**_HALVINGS)
    assert lower > most or np.sum(scores >= scores.max() - _HOPELESS) <= most


def test_ways_that_are_lost_are_followed_when_there_are_no_others():
    assert enough_for(np.full(5, LOST), 3) == LOST


def test_the_best_of_many_are_followed():
    scores = np.random.default_rng(0).permutation(np.arange(400) * 1e-3)
    np.testing.assert_array_equal(np.sort(scores[scores >= enough_for(scores, 96)])[-90:], np.arange(310, 400) * 1e-3)
