"""A model's extended Kalman filter in plain NumPy, with matrices, straight from the declaration's strings."""

from itertools import pairwise

import numpy as np

from estimator.models.difference import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM

#: Two taps of the input, two sensors of which one sees it, and noise that moves both states.
TANKS = Model(
    name="tanks",
    states={"upper": "m", "lower": "m"},
    coefficients={"flow": "1", "leak": "1", "valve": "1", "bias": "m"},
    next_state=("upper - flow*tanh(upper) + valve*(u + 0.5*u1)", "lower + flow*tanh(upper) - leak*tanh(lower)"),
    noise=("1", "0.5"),
    outputs={"level": "lower + bias", "top": "upper + 0.1*u"},
)

#: Model, interpolation, coefficients, scale of the input.
CASES = {
    "paper": (difference(), "zero_order", [1.48, -1.47, -0.939, 0.39], 0.12),
    "motion": (duffing(), "linear", [0.49, 1.96, 0.0687, 0.5], 0.12),
    "pendulum": (PENDULUM, "zero_order", [14.7 * 0.0025, 0.01, 3 * 0.0025], 2.0),
    "tanks": (TANKS, "zero_order", [0.3, 0.2, 0.4, 0.05], 0.3),
}

_FUNCTIONS = {name: getattr(np, name) for name in ("sin", "cos", "exp", "log", "sqrt", "tanh")}


def evaluated(texts, model, x, c, **inputs):
    names = dict(zip(model.names, [*x, *c], strict=True)) | inputs | _FUNCTIONS
    return np.array([eval(text, {"__builtins__": {}}, names) + 0.0 * x[0] for text in texts])


def slopes(function, x):
    """By complex steps, which are exact to rounding."""
    steps = 1e-30j * np.eye(len(x))
    return np.array([function(np.asarray(x) + step).imag / 1e-30 for step in steps]).T


def sample(model, interpolation, x, c, u, P, q):
    """State and covariance a sample later, from inputs u, newest first."""
    n = len(x)
    if not model.is_continuous:
        inputs = {"u": u[0], "u1": u[1], "u2": u[2]}
        A = slopes(lambda z: evaluated(model.moves, model, z, c, **inputs), x)
        g = evaluated(model.noise, model, x, c)
        return evaluated(model.moves, model, x, c, **inputs), A @ P @ A.T + q * np.outer(g, g)

    def rates(tau, joint):
        z, cov = joint[:n], joint[n:].reshape(n, n)
        now = u[0] if interpolation == "zero_order" else u[1] + tau * (u[0] - u[1])
        A = slopes(lambda s: evaluated(model.moves, model, s, c, u=now), z)
        g = evaluated(model.noise, model, z, c)
        moved = A @ cov + cov @ A.T + q * np.outer(g, g)
        return np.concatenate([evaluated(model.moves, model, z, c, u=now), moved.ravel()])

    joint = np.concatenate([x, P.ravel()])
    for begin, end in pairwise(np.linspace(0, 1, model.substeps + 1)):
        h = end - begin
        k1 = rates(begin, joint)
        k2 = rates(begin + h / 2, joint + h / 2 * k1)
        k3 = rates(begin + h / 2, joint + h / 2 * k2)
        k4 = rates(end, joint + h * k3)
        joint = joint + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return joint[:n], joint[n:].reshape(n, n)


def filtered(model, interpolation, c, u, y, q, r, state_variance=0.0, state=0.0):
    """Innovations (T, p) and variances (T, p) of outputs (T, p), sensor by sensor; y None: they are as expected."""
    x, P = state + np.zeros(model.n_states), state_variance * np.eye(model.n_states)
    padded = np.concatenate([[0.0, 0.0], u])
    innovations, variances, expected = np.empty((3, len(u), model.n_outputs))
    for t in range(len(u)):
        x, P = sample(model, interpolation, x, c, padded[t : t + 3][::-1], P, q)
        for k, text in enumerate(model.outputs.values()):
            h = slopes(lambda z: evaluated([text], model, z, c, u=u[t]), x)[0]  # noqa: B023
            expected[t, k] = evaluated([text], model, x, c, u=u[t])[0]
            innovations[t, k] = 0.0 if y is None else y[t, k] - expected[t, k]
            variances[t, k] = h @ P @ h + r
            gain = P @ h / variances[t, k]
            x, P = x + gain * innovations[t, k], P - np.outer(gain, h @ P)
    return innovations, variances, expected


def of_paper(theta, u, y, q, r, cov):
    """The same of the paper's model, from rest with a covariance (2, 2), in less time: both of (T,)."""
    mean, innovations, variances = np.zeros(2), np.empty(len(u)), np.empty(len(u))
    for t in range(len(u)):
        A = np.array([[theta[0] + 3 * theta[1] * mean[0] ** 2, theta[2]], [1.0, 0.0]])
        mean = np.array([theta @ np.array([mean[0], mean[0] ** 3, mean[1], u[t]]), mean[0]])
        cov = A @ cov @ A.T + np.diag([q, 0.0])
        innovations[t], variances[t] = y[t] - mean[0], cov[0, 0] + r
        gain = cov[:, 0] / variances[t]
        mean, cov = mean + gain * innovations[t], cov - np.outer(gain, cov[0])
    return innovations, variances


def information(model, interpolation, c, u, q, r, state_variance=0.0):
    """F along the response without noise, by central differences of the filter's innovations."""
    c = np.array(c, dtype=np.float64)
    _, variances, y = filtered(model, interpolation, c, u, None, q, r, state_variance)
    told = np.empty((len(c), *variances.shape))
    for j, h in enumerate(1e-5 * np.maximum(np.abs(c), 0.1)):
        sides = [
            filtered(model, interpolation, c + s * h * np.eye(len(c))[j], u, y, q, r, state_variance)[0]
            for s in (1, -1)
        ]
        told[j] = (sides[0] - sides[1]) / (2 * h)
    return np.einsum("itp,jtp,tp->ij", told, told, 1 / variances)


def log_likelihood(model, interpolation, c, u, y, q, r, state_variance=0.0, state=0.0):
    innovations, variances, _ = filtered(model, interpolation, c, u, y, q, r, state_variance, state)
    return -0.5 * np.sum(np.log(variances) + innovations**2 / variances)
