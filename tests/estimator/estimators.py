"""One estimator of every kind, and records of oscillators."""

import numpy as np
from scipy.integrate import solve_ivp

from estimator import SILVERBOX_TWIN, OnlineEstimator, Parameters, Rig, coefficients_of, difference, duffing
from estimator.models.difference_equation import Term
from estimator.models.pendulum import PENDULUM
from estimator.priors import weak_prior

TRUTH = Parameters(zip(difference().coefficients, coefficients_of(difference(), SILVERBOX_TWIN).tolist(), strict=True))

#: The physical equation as the Silverbox needs it.
ODE = duffing(offsets=True, feedthrough=True, noise="held")

#: A difference equation of this test alone.
TERMS = (Term(1), Term(3), Term(0, 1), Term(1, 1), Term(tap=0), Term(tap=1), Term(tap=2))

#: As a rig with a guess is estimated, with an input that is known a sample later.
AHEAD = {"model": duffing(offsets=True), "rig": Rig.silverbox("look_ahead"), "expectations": "sigma_points"}

ONE_TAP, OWN_TAPS = Rig.silverbox("zero_order", 1), Rig.silverbox("zero_order", 0)

KINDS = {
    "paper": lambda: OnlineEstimator(),
    "mean field": lambda: OnlineEstimator(rig=OWN_TAPS, factorisation="mean_field"),
    "published": lambda: OnlineEstimator(factorisation="mean_field", as_published=True),
    "own terms, drift": lambda: OnlineEstimator(difference(TERMS), rig=OWN_TAPS, drift=0.01),
    "ode": lambda: OnlineEstimator(ODE),
    "ode, held input": lambda: OnlineEstimator(duffing(offsets=True), rig=Rig.silverbox("zero_order")),
    "ode, look-ahead": lambda: OnlineEstimator(ODE, rig=Rig.silverbox("look_ahead"), iterations=2),
    "ode, sigma points": lambda: OnlineEstimator(**AHEAD, drift=1e-3),
    "ensemble": lambda: OnlineEstimator(noise_hypotheses=3),
    "large ensemble": lambda: OnlineEstimator(noise_hypotheses=13, drift=0.01),
    "ode ensemble": lambda: OnlineEstimator(**AHEAD, noise_hypotheses=3),
}


def record(samples=300, process_noise=5e-4, measurement_noise=5e-4, seed=0):
    """u, y of Eq. (2), paired by index with the input of the sample before."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-0.15, 0.15, samples), np.zeros(samples)
    for t in range(1, samples):  # x[-1] is 0 while it stands for the displacement before the first
        x[t] = TRUTH.theta1 * x[t - 1] + TRUTH.theta2 * x[t - 1] ** 3 + TRUTH.theta3 * x[t - 2] + TRUTH.eta * u[t - 1]
        x[t] += process_noise * rng.standard_normal()
    return u, x + measurement_noise * rng.standard_normal(samples)


def motion(u, coefficients, interpolation="linear"):
    """(x, x') of Eq. (1) from rest one sample before the first (T, 2), by SciPy; time in samples.

    ``coefficients``: stiffness, cubic, damping, gain.
    """
    k, b, c, g = coefficients
    states, state = np.zeros((len(u), 2)), np.zeros(2)
    padded = np.concatenate([[0.0], u])
    for t in range(len(u)):
        first, last = padded[t], padded[t if interpolation == "zero_order" else t + 1]

        def rates(tau, z, first=first, last=last):
            return [z[1], g * (first + tau * (last - first)) - c * z[1] - k * z[0] - b * z[0] ** 3]

        state = solve_ivp(rates, (0, 1), state, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
        states[t] = state
    return states


def pendulum_prior(**noises):
    """The prior of a model with two sensors."""
    return weak_prior(PENDULUM, [14.7 * 0.05**2, 0.0, 3.0 * 0.05**2], np.diag([1e-6, 1e-6, 1e-6]), **noises)


def pendulum_estimator(prior=None, **options):
    """One of a model with two sensors."""
    prior = prior or pendulum_prior(process_noise=1e-3, measurement_noise=1e-3)
    return OnlineEstimator(PENDULUM, prior, Rig(prior.step, "linear"), **options)


def pendulum_record(samples, noise):
    """True coefficients, inputs (T,) and outputs (T, 2) of a pendulum whose sensors have these standard deviations."""
    rng = np.random.default_rng(0)
    truth = np.array([14.7, 0.02, 3.0]) * [0.05**2, 0.05, 0.05**2]
    u, state, y = rng.uniform(-2, 2, samples), np.zeros(2), np.empty((samples, 2))
    last = 0.0
    for t in range(samples):
        for i in range(50):
            force = last + (u[t] - last) * (i + 0.5) / 50
            middle = state[1] + (truth[2] * force - truth[1] * state[1] - truth[0] * np.sin(state[0])) / 100
            slope = truth[2] * force - truth[1] * middle - truth[0] * np.sin(state[0] + state[1] / 100)
            state = state + np.array([middle, slope]) / 50
        last, y[t] = u[t], state + noise * rng.standard_normal(2)
    return truth, u, y


def assert_same(first, second):
    """Same beliefs, inputs and weights, bit by bit."""
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, second.arrays()[name], err_msg=name)
    np.testing.assert_array_equal(first.free_energies, second.free_energies)
