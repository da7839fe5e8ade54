"""The linear programme of a refinement, against SciPy's, which has a cold start and dense matrices."""

import sys

import numpy as np
import pytest
from scipy.optimize import linprog

from agents.planning.projected_gradient import DesignLimits
from research.oracles.linear_programme import LinearProgramme

pytest.importorskip("highspy", reason="highspy is not installed; make installs it")
SAMPLES, STATES, RADIUS = 12, 2, 0.05


def line(rng):
    """Inputs, a gradient, outputs, and Jacobians of a damped system."""
    slopes = rng.normal(size=(SAMPLES, STATES + 1, STATES + 3)) * 0.4
    return rng.uniform(-0.1, 0.1, SAMPLES), rng.normal(size=SAMPLES), rng.uniform(-0.51, 0.51, SAMPLES), slopes


def reference(u, gradient, shown_now, slopes, limits, shown):
    """The best change by the equations: the states are written as matrices times the inputs' changes."""
    states, outputs, change = np.zeros((STATES, SAMPLES)), [], np.eye(SAMPLES)
    for t in range(SAMPLES):
        inputs = [change[t - lag] if t >= lag else np.zeros(SAMPLES) for lag in range(3)]
        after = slopes[t, :, :STATES] @ states + slopes[t, :, STATES:] @ np.array(inputs)
        states = after[:STATES]
        outputs.append(after[shown])
    G = np.array(outputs)
    rows = np.concatenate([G, -G])
    room = np.concatenate([limits.soft_limit - shown_now, limits.soft_limit + shown_now])
    if np.isfinite(limits.energy):
        rows, room = np.vstack([rows, 2 * u]), np.append(room, limits.energy - u @ u)
    low = np.maximum(-RADIUS, -limits.amplitude - u)
    high = np.minimum(RADIUS, limits.amplitude - u)
    return linprog(-gradient, A_ub=rows, b_ub=room, bounds=np.stack([low, high], axis=1)), G


@pytest.mark.parametrize("energy", [np.inf, 0.05])
@pytest.mark.parametrize("shown", [0, STATES])  # a state, or another output
def test_the_change_is_the_best_one_each_time(energy, shown):
    rng = np.random.default_rng(0)
    limits = DesignLimits(0.52, 0.51, 0.1, energy)
    programme, held = LinearProgramme(SAMPLES, STATES, shown, limits), 0
    for _ in range(5):
        given = line(rng)
        delta, states = programme.best_change(*given, RADIUS)
        wanted, G = reference(*given, limits, shown)
        assert given[1] @ delta == pytest.approx(-wanted.fun, rel=1e-6)
        assert np.abs(delta).max() <= RADIUS + 1e-9
        assert np.abs(given[2] + G @ delta).max() <= limits.soft_limit + 1e-7
        held += np.isclose(np.abs(given[2] + G @ delta), limits.soft_limit).sum()
        if shown == 0:
            np.testing.assert_allclose(states[1:, 0], (G @ delta)[:-1], atol=1e-9)
    assert held  # the limit is active


def test_an_infeasible_programme_has_no_solution_and_the_next_one_has():
    rng = np.random.default_rng(1)
    limits = DesignLimits(0.52, 0.51, 0.1, np.inf)
    programme = LinearProgramme(SAMPLES, STATES, 0, limits)
    u, gradient, shown, slopes = line(rng)
    assert programme.best_change(u, gradient, shown + 5.0, slopes, RADIUS) is None
    delta, _ = programme.best_change(u, gradient, shown, slopes, RADIUS)
    wanted, _ = reference(u, gradient, shown, slopes, limits, 0)
    assert gradient @ delta == pytest.approx(-wanted.fun, rel=1e-6)


def test_without_highspy_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "highspy", None)
    with pytest.raises(
        ModuleNotFoundError, match=r"^highspy is not installed; get it with: pip install 'highspy>=1.10"
    ):
        LinearProgramme(SAMPLES, STATES, 0, DesignLimits(0.52, 0.51, 0.1, np.inf))
