"""A million samples: covariances stay positive semi-definite, estimates and memory stay bounded."""

import resource

import numpy as np
import pytest

from estimator import OnlineEstimator, Rig, difference, duffing

SAMPLES, STRETCH = 1_048_576, 8_192
ODE = duffing(offsets=True, feedthrough=True, noise="held")
ODE_E = duffing(offsets=True, feedthrough=True, cubic_damping=True, noise="held")
OWN_TAPS = Rig.silverbox("zero_order", 0)
ESTIMATORS = {
    "paper, structured": lambda: OnlineEstimator(),
    "paper, mean field": lambda: OnlineEstimator(factorisation="mean_field"),
    "paper, drift": lambda: OnlineEstimator(drift=0.003),
    "three-tap": lambda: OnlineEstimator(difference("three-tap"), rig=OWN_TAPS),
    "cubic": lambda: OnlineEstimator(difference("cubic"), rig=OWN_TAPS),
    "ODE": lambda: OnlineEstimator(ODE),
    "ODE, look-ahead, cubic damping": lambda: OnlineEstimator(ODE_E, rig=Rig.silverbox("look_ahead")),
    "ODE, sigma points": lambda: OnlineEstimator(ODE, expectations="sigma_points"),
    "ODE, drift": lambda: OnlineEstimator(ODE, drift=1e-4),
    "paper, ensemble": lambda: OnlineEstimator(noise_hypotheses=5),
}


def soundness(cov):
    """The smallest eigenvalue of the correlations of the unknown quantities."""
    std = np.sqrt(np.diag(cov))
    free = std > 0
    return np.linalg.eigvalsh(cov[np.ix_(free, free)] / np.outer(std[free], std[free]))[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_million_samples(name, record):
    estimator = ESTIMATORS[name]()
    u, y = (np.resize(series, SAMPLES) for series in (record.u, record.y))
    smallest, largest, memory = np.inf, 0.0, []
    for start in range(0, SAMPLES, STRETCH):
        free_energies = estimator.run(u[start : start + STRETCH], y[start : start + STRETCH])
        belief = estimator.belief
        assert np.isfinite(free_energies).all()
        covariances = (belief.coefficients_cov, belief.state_cov)
        smallest = min(smallest, *(soundness(cov) for cov in covariances))
        largest = max(largest, np.abs(belief.state_mean[0]))
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)
    grown = memory[-1] - memory[len(memory) // 4]
    print(f"\n{name}: smallest eigenvalue of the correlations {smallest:.1e}, |x| at most {largest:.2f} V, ", end="")
    print(f"memory grown by {grown:.1f} MiB in the last three quarters", end="")
    assert smallest > 0
    assert largest < 1
    assert grown < 5
