"""Simulation, extended Kalman filter and Fisher information of any model, with matrices.

Derivatives are taken by a complex step: with f analytic, Im f(x + iε)/ε is its derivative to rounding for ε = 1e-30,
and through an integrator it is the derivative of the integrator's own arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np

from estimator.models.expression import evaluate, parse

EPS = np.finfo(float).eps
_STEP = 1e-30


def where(comparison, left, right, first, second):
    """The first value where a comparison of the real parts holds, else the second."""
    order = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}[comparison]
    return np.where(order(np.real(left), np.real(right)), first, second)


#: Functions of the language, for real numbers and for complex steps.
FUNCTIONS = {name: getattr(np, name) for name in ("sin", "cos", "exp", "log", "sqrt", "tanh")} | {
    "atan": np.arctan,
    "abs": lambda x: np.sign(np.real(x)) * x,
    "sign": lambda x: np.sign(np.real(x)),
    "min": lambda *values: reduce(lambda a, b: where("<", b, a, b, a), values),
    "max": lambda *values: reduce(lambda a, b: where(">", b, a, b, a), values),
    "where": where,
}


@dataclass(frozen=True)
class Plant:
    """A model as ordinary functions of a state z (n,), coefficients c (K,) and the input: a number, or (inputs,).

    A function may give a number for each of its rows where z is of columns (n, m).

    Attributes:
        move: the rates ``f(z, c, u)`` of a differential equation, or the next state ``f(z, c, taps)``; the newest tap
            comes first.
        show: what the sensors show, ``f(z, c, u)`` -> (sensors,).
        noise: how unit process noise moves the state, ``f(z, c)`` -> (n,).
        substeps: Runge-Kutta steps per sample; 0 for a difference equation.
        held: whether the noise is constant over a sample.
        independent: whether each state has noise of its own, which ``noise`` scales.
        slopes: whether ``move`` and ``show`` take inputs and their time derivatives, (2, inputs).
    """

    move: Callable
    show: Callable
    noise: Callable
    substeps: int = 0
    held: bool = False
    independent: bool = False
    slopes: bool = False

    def effects(self, z, c) -> np.ndarray:
        """How each source of unit process noise moves the state, (n, sources)."""
        g = np.array(self.noise(z, c), dtype=float)
        return np.diag(g) if self.independent else g[:, None]

    @classmethod
    def of(cls, model, ratios=None) -> Plant:
        """The plant of a declaration's strings; ``ratios``: factor on each state's noise."""

        slopes = "derivative(" in str([*model.update_expressions, *model.outputs.values()])

        def evaluated(texts, z, c, taps=()):
            """Values of texts, with the inputs of one age after the other, newest first."""
            names = dict(zip(model.names, [*z, *c], strict=True)) | {"pi": np.pi, **model.constants}
            forms = ("{}", "derivative({})") if slopes else ("{}", "{}[-1]", "{}[-2]")
            for form, values in zip(forms, taps, strict=False):
                written = map(form.format, model.inputs)
                names |= dict(zip(written, np.atleast_1d(values), strict=True))
            return [evaluate(parse(text, model.name), names, FUNCTIONS) for text in texts]

        def move(z, c, u):
            return evaluated(model.update_expressions, z, c, [u] if model.is_continuous and not slopes else u)

        return cls(
            move,
            lambda z, c, u: evaluated(model.outputs.values(), z, c, u if slopes else [u]),
            lambda z, c: np.multiply(evaluated(model.noise, z, c), 1.0 if ratios is None else ratios),
            substeps=model.substeps if model.is_continuous else 0,
            held=model.held,
            independent=model.independent_noise,
            slopes=slopes,
        )


def rows(values, x: np.ndarray) -> np.ndarray:
    """Values by row, each with the columns of x."""
    return np.array([value + 0 * x[0] for value in values])


def jacobian(f: Callable, x: np.ndarray) -> np.ndarray:
    """Derivative of f at x (m,), one column per entry of x; f has to take columns (m, m)."""
    columns = np.asarray(x)[:, None] + 1j * _STEP * np.eye(len(x))
    return rows(f(columns), columns).imag / _STEP


def central(f: Callable, x: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """Derivative of f at x (m,) by central differences of order 4, the last axis by entry of x."""
    columns = []
    for h, e in zip(np.broadcast_to(step, len(x)), np.eye(len(x)), strict=True):
        near, far = f(x + h * e) - f(x - h * e), f(x + 2 * h * e) - f(x - 2 * h * e)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=-1)


def runge_kutta(slope: Callable, x: np.ndarray, substeps: int = 1) -> np.ndarray:
    """x after a sample in which x' = slope(x, t), t from 0 to 1, by the method of order 4."""
    h = 1 / substeps
    for s in range(substeps):
        t = s * h
        k1 = slope(x, t)
        k2 = slope(x + h / 2 * k1, t + h / 2)
        k3 = slope(x + h / 2 * k2, t + h / 2)
        k4 = slope(x + h * k3, t + h)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


# --- A sample of a plant -------------------------------------------------------------------------------------------


def polynomial(inputs: Sequence[float], t: float) -> float:
    """The input, or the inputs, at a time t in [0, 1] of the sample."""
    return sum(u * t**k for k, u in enumerate(inputs))


def acting(plant: Plant, u: np.ndarray, t: int, interpolation: str) -> tuple[float, ...]:
    """The inputs of sample t of a record u (T,) or (T, inputs), 0 before it: three taps, or the polynomial."""
    taps = [u[t - k] if t >= k else 0.0 * u[0] for k in range(3)]
    if not plant.substeps:
        return tuple(taps)
    return {"zero_order": (taps[0],), "linear": (taps[1], taps[0] - taps[1])}[interpolation]


def input_at(plant: Plant, inputs: Sequence[float], t: float) -> float | np.ndarray:
    """What a differential equation takes of the input at a time t in [0, 1] of the sample."""
    u = polynomial(inputs, t)
    return np.stack([u, polynomial([k * u for k, u in enumerate(inputs)][1:], t)]) if plant.slopes else u


def input_seen(plant: Plant, inputs: Sequence[float]) -> float | np.ndarray:
    """The input at the end of a sample: the newest tap, or the polynomial's value."""
    return input_at(plant, inputs, 1.0) if plant.substeps else inputs[0]


def moved(plant: Plant, z: np.ndarray, c: np.ndarray, inputs: Sequence[float]) -> np.ndarray:
    """The state after a sample."""
    z = np.asarray(z)
    if not plant.substeps:
        return rows(plant.move(z, c, inputs), z)
    return runge_kutta(lambda x, t: rows(plant.move(x, c, input_at(plant, inputs, t)), x), z, plant.substeps)


def spread(plant: Plant, z: np.ndarray, c: np.ndarray, inputs: Sequence[float]) -> np.ndarray:
    """N (n, n), covariance of the state by unit process noise over a sample."""
    n = len(z)
    if not plant.substeps:
        G = plant.effects(z, c)
        return G @ G.T

    def rates(x: np.ndarray, t: float) -> np.ndarray:
        z, u = x[:n], input_at(plant, inputs, t)
        f = lambda z: plant.move(z, c, u)  # noqa: E731
        slope, G = jacobian(f, z), plant.effects(z, c)
        N = x[n:].reshape(n, -1)
        rate = slope @ N + G if plant.held else slope @ N + N @ slope.T + G @ G.T
        return np.concatenate([rows(f(z), z), rate.ravel()])

    size = plant.effects(z, c).size if plant.held else n * n
    end = runge_kutta(rates, np.concatenate([z, np.zeros(size)]), plant.substeps)[n:].reshape(n, -1)
    return end @ end.T if plant.held else sound(end)


def sound(N: np.ndarray) -> np.ndarray:
    """N, where it is a covariance; else its variances, row by row with the nearest covariances that they can have.

    Truncation makes it none where slopes are steep, and where states go along with one another to a high order.
    """
    N, n = N.copy(), len(N)
    N[np.diag_indices(n)] = np.maximum(np.diag(N), 0.0)
    rest = N.copy()
    for a in range(n - 1):
        largest = np.sqrt(np.maximum(rest[a, a], 0.0) * np.maximum(np.diag(rest), 0.0))
        kept = np.where(np.arange(n) > a, np.clip(rest[a], -largest, largest), rest[a])
        N[a] += kept - rest[a]
        N[:, a] = N[a]
        rest[a] = rest[:, a] = kept
        if rest[a, a] > 0:
            rest = rest - np.outer(kept, kept) / rest[a, a]
    return N


class Step(NamedTuple):
    """A sample of a plant from a mean (m,) of states and coefficients.

    Attributes:
        moved: (n,) states after it.
        jacobian: (m, m) of states and coefficients after it, by those before.
        noise: (n, n) covariance that unit process noise adds.
    """

    moved: np.ndarray
    jacobian: np.ndarray
    noise: np.ndarray


def sample(plant: Plant, n: int, mean: np.ndarray, inputs: Sequence[float]) -> Step:
    """A sample of any plant of n states."""
    mean = np.asarray(mean, dtype=float)
    S = np.eye(len(mean))
    S[:n] = jacobian(lambda x: moved(plant, x[:n], x[n:], inputs), mean)
    return Step(moved(plant, mean[:n], mean[n:], inputs), S, spread(plant, mean[:n], mean[n:], inputs))


def carried(step: Step, deviation: np.ndarray) -> Step:
    """The same sample of a mean that deviates by (m,) from the one it was linearised about."""
    return step._replace(moved=step.moved + step.jacobian[: len(step.moved)] @ deviation)


def difference_step(mean: Sequence[float], u: float) -> Step:
    """Eq. (2), by hand: a sample from the mean (6,) of (x_t, x_{t-1}, θ1, θ2, θ3, η)."""
    x, last_x, t1, t2, t3, e = mean
    S = np.eye(6)
    S[0] = [t1 + 3 * t2 * x**2, t3, x, x**3, last_x, u]
    S[1] = [1, 0, 0, 0, 0, 0]
    return Step(np.array([t1 * x + t2 * x**3 + t3 * last_x + e * u, x]), S, np.diag([1.0, 0.0]))


def oscillator(substeps: int = 8) -> Plant:
    """Eq. (1), by hand, with time counted in samples: of (x, x') and (stiffness, cubic, damping, gain)."""
    return Plant(
        lambda z, c, u: [z[1], c[3] * u - c[2] * z[1] - c[0] * z[0] - c[1] * z[0] ** 3],
        lambda z, c, u: [z[0]],
        lambda z, c: [0.0, np.sqrt(3.0)],
        substeps=substeps,
    )


def continuous_step(mean: Sequence[float], last_u: float, u: float) -> Step:
    """Eq. (1): a sample from the mean (6,) of (x, x', stiffness, cubic, damping, gain); the input goes linearly."""
    return sample(oscillator(), 2, mean, (last_u, u - last_u))


# --- A filter ------------------------------------------------------------------------------------------------------


def predicted(cov: np.ndarray, step: Step, q: float) -> np.ndarray:
    """Covariance (m, m) after a step, with process noise of variance q."""
    after = step.jacobian @ cov @ step.jacobian.T
    n = len(step.noise)
    after[:n, :n] += q * step.noise
    return after


class Seen(NamedTuple):
    """The update by an output.

    Attributes:
        gain: (m,) by which the innovation moves the mean.
        variance: of the innovation.
        cov: (m, m) afterwards.
    """

    gain: np.ndarray
    variance: float
    cov: np.ndarray


def seen(cov: np.ndarray, r: float, h: np.ndarray | None = None) -> Seen:
    """After an output with noise of variance r that shows ``h`` (m,) of the quantities, or the first of them."""
    c = cov[:, 0] if h is None else cov @ h
    variance = (c[0] if h is None else h @ c) + r
    gain = c / variance
    return Seen(gain, variance, cov - np.outer(gain, c))


def information_gain(before: np.ndarray, after: np.ndarray) -> float:
    """½ log det of a covariance before less that after [nats]."""
    return 0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1])


@dataclass
class Walk:
    """A path at known coefficients.

    Attributes:
        loss: minus the log likelihood, without the constant; 0 where outputs are not followed.
        gradient: (K,) its slope, the gains held.
        information: (K, K) Fisher's, of independent sensors, the gains held.
        shown: (T, sensors) expected outputs of the sensors.
        innovations, variances: (T, sensors); innovations are 0 where outputs are not followed.
        state, cov, sensitivity: at the end.
        growth: largest factor by which an error of the state has grown between any two samples.
    """

    loss: float
    gradient: np.ndarray
    information: np.ndarray
    shown: np.ndarray
    innovations: np.ndarray
    variances: np.ndarray
    state: np.ndarray
    cov: np.ndarray
    sensitivity: np.ndarray
    growth: float


def path(plant: Plant, z, V, c, inputs, Q: float, R: Sequence[float], y=None, slopes=None) -> Walk:
    """The Kalman filter of the model linearised along its own trajectory, with sensitivities at held gains.

    Args:
        plant: its equations.
        z, V: state and covariance before the first sample.
        c: coefficients.
        inputs: by sample: taps, or coefficients of the polynomial.
        Q, R: variances of the noises.
        y: outputs by sample and sensor; None where the trajectory is followed without them.
        slopes: (n, K) of the state before the first sample by the coefficients; 0 where it is None.
    """
    n, K, T = len(z), len(c), len(inputs)
    Z, F, slope = np.zeros((n, K)), np.zeros((K, K)), np.zeros(K)
    Z = Z if slopes is None else np.array(slopes)
    shown, innovations, variances = np.zeros((3, T, len(R)))
    transitions, growth = np.eye(n)[None], 1.0
    for t, taps in enumerate(inputs):
        step = sample(plant, n, np.concatenate([z, c]), taps)
        S = step.jacobian[:n]
        A = S[:, :n]
        z, V, Z = step.moved, A @ V @ A.T + Q * step.noise, A @ Z + S[:, n:]
        u = input_seen(plant, taps)
        for k, r in enumerate(R):
            at = np.concatenate([z, c])
            slopes = jacobian(lambda x, u=u: plant.show(x[:n], x[n:], u), at)[k]
            total = slopes[:n] @ Z + slopes[n:]
            shown[t, k] = plant.show(z, c, u)[k]
            e = innovations[t, k] = 0.0 if y is None else y[t][k] - shown[t, k]
            gain, variances[t, k], V = seen(V, r, slopes[:n])
            F = F + np.outer(total, total) / variances[t, k]
            slope = slope - total * e / variances[t, k]
            z, Z = z + gain * e, Z - np.outer(gain, total)
            A = A - np.outer(gain, slopes[:n] @ A)
        transitions = np.concatenate([A @ transitions, np.eye(n)[None]])
        growth = max(growth, np.abs(transitions).sum(axis=2).max())
    loss = 0.0 if y is None else 0.5 * np.sum(innovations**2 / variances + np.log(variances))
    return Walk(loss, slope, F, shown, innovations, variances, z, V, Z, growth)


def filter_paper(coefficients, u, y, q: float, r: float, cov=None) -> tuple[np.ndarray, np.ndarray]:
    """The filter of Eq. (2) from rest, of many at once and in less time: innovations and their variances (T, ...).

    Args:
        coefficients: (4, ...) θ1, θ2, θ3 and η.
        u: (T, ...) inputs.
        y: (T, ...) outputs.
        q, r: variances of the noises.
        cov: (2, 2) of the state before the first sample; known where it is None.
    """
    t1, t2, t3, e = coefficients
    x = last = np.zeros(np.broadcast_shapes(np.shape(t1), np.shape(u)[1:], np.shape(y)[1:]))
    (p, c), (_, s) = np.zeros((2, 2)) if cov is None else cov
    innovations, variances = np.empty((2, len(u), *x.shape))
    for t in range(len(u)):
        a = t1 + 3 * t2 * x**2
        x, last = t1 * x + t2 * x**3 + t3 * last + e * u[t], x
        p, c, s = a**2 * p + 2 * a * t3 * c + t3**2 * s + q, a * p + t3 * c, p
        innovations[t], variances[t] = y[t] - x, p + r
        x, last = x + p / (p + r) * innovations[t], last + c / (p + r) * innovations[t]
        p, c, s = p - p**2 / (p + r), c - p * c / (p + r), s - c**2 / (p + r)
    return innovations, variances
