"""Models with plain reference functions, random beliefs, and blocks of lanes, for the engine's tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from reference.filters import EPS, Plant
from reference.plants import DRAG as SIGNED_DRAG
from reference.plants import VAN_DER_POL
from reference.structured import Belief

from estimator.engine.storage_layout import input_rows
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM
from estimator.models.wiener_hammerstein import WIENER_HAMMERSTEIN

#: Drag, quadratic in the speed, and a sensor without sign.
DRAG = replace(SIGNED_DRAG, outputs={"y": "abs(x)"})


#: Noise in both rates, and its strength depends on the state.
INDEPENDENT = Model(
    "independent",
    {"x": "m", "v": "m/s"},
    {"k": "1", "cubic": "1", "gain": "1"},
    noise=("0.5", "2 + 0.1*x"),
    outputs={"y": "x"},
    rates=("v", "gain*u - k*x - cubic*x**3 - 0.1*v"),
    substeps=4,
    independent_noise=True,
)

#: Noise in both next states.
ADDED = Model(
    "added",
    {"x": "m", "w": "m"},
    {"a": "1", "b": "1"},
    noise=("1", "0.3"),
    outputs={"y": "x", "z": "w"},
    next_state=("a*x + b*w + u", "x - 0.1*w**3"),
    independent_noise=True,
)


@dataclass(frozen=True)
class Case:
    """A model, its equations written again, and where its quantities are.

    Attributes:
        model: the declaration.
        plant: the same by hand.
        center: means of states and coefficients.
        degree: of the input's polynomial.
    """

    model: Model
    plant: Plant
    center: tuple[float, ...]
    degree: int = 0

    @property
    def operations(self) -> int:
        """Roundings in sequence within a sample: of the integrator's stages and of the algebra.

        A stage sums a product with each quantity for the mean, its slopes and the noise, and evaluates the equation,
        of at most 20 operations; the algebra sums over all quantities twice per sensor, and divides.
        """
        m = len(self.model.names)
        stages = 4 * self.plant.substeps
        return stages * (2 * m + 20) + self.model.n_outputs * (4 * m + 40) + 20


def _duffing(z, c, u):
    return [z[1], c[3] * u - c[2] * z[1] - c[0] * z[0] - c[1] * z[0] ** 3]


def _duffing_full(z, c, u):
    force, y0, cubic_damping = c[4:7]
    acceleration = c[3] * u + force - c[2] * z[1] - c[0] * z[0] - c[1] * (z[0] - y0) ** 3 - cubic_damping * z[1] ** 3
    return [z[1], acceleration]


def _first(z, c, u):
    return [z[0]]


def _magnitude(value):
    """Its absolute value, whose slope complex steps can find."""
    return value * np.sign(np.real(value))


def _white(z, c):
    return [0.0, np.sqrt(3.0)]


def _paper(z, c, u):
    return [c[0] * z[0] + c[1] * z[0] ** 3 + c[2] * z[1] + c[3] * u[0], z[0]]


def _three_tap(z, c, u):
    return [c[0] * z[0] + c[1] * z[0] ** 3 + c[2] * z[1] + c[3] * u[0] + c[4] * u[1] + c[5] * u[2] + c[6], z[0]]


def _cubic(z, c, u):
    x, w = z
    more = c[7] * x**2 + c[8] * x**2 * w + c[9] * x * w**2 + c[10] * w**3
    return [_three_tap(z, c, u)[0] + more, x]


def _independent(z, c, u):
    return [z[1], c[2] * u - c[0] * z[0] - c[1] * z[0] ** 3 - 0.1 * z[1]]


_ADDED = {"show": _first, "noise": lambda z, c: [1.0, 0.0]}
_WHITE = Plant(_duffing, _first, _white, substeps=8)
_COEFFICIENTS = (0.45, 1.2, 0.08, 0.5)
_FULL = Plant(
    _duffing_full, lambda z, c, u: [z[0] + c[7] * u], lambda z, c: [0.0, 2.0], substeps=8, held=True
)  # fmt: skip
_LAGS = (0.1, 0.05, 1.4, -1.5, -0.9)

CASES = {
    "duffing": Case(duffing(), _WHITE, (0.1, -0.05, *_COEFFICIENTS), degree=1),
    "duffing, held input": Case(duffing(), _WHITE, (0.1, -0.05, *_COEFFICIENTS)),
    "duffing, spline": Case(duffing(), _WHITE, (0.1, -0.05, *_COEFFICIENTS), degree=5),
    "duffing, all terms": Case(
        duffing(offsets=True, cubic_damping=True, feedthrough=True, noise="held"), _FULL,
        (0.1, -0.05, *_COEFFICIENTS, 0.01, -0.02, 0.3, 0.05), degree=1,
    ),
    "paper": Case(difference("paper"), Plant(_paper, **_ADDED), (*_LAGS, 0.4)),
    "three-tap": Case(difference("three-tap"), Plant(_three_tap, **_ADDED), (*_LAGS, 0.2, 0.1, 0.05, 0.01)),
    "cubic": Case(
        difference("cubic"), Plant(_cubic, **_ADDED), (*_LAGS, 0.2, 0.1, 0.05, 0.01, 0.1, 0.2, -0.3, 0.1)
    ),
    "pendulum": Case(
        PENDULUM,
        Plant(
            lambda z, c, u: [z[1], c[2] * u - c[1] * z[1] - c[0] * np.sin(z[0])], lambda z, c, u: [z[0], z[1]], _white,
            substeps=2,
        ),
        (1.0, 0.2, 0.6, 0.1, 0.4), degree=1,
    ),
    "wiener-hammerstein": Case(
        WIENER_HAMMERSTEIN,
        Plant(
            lambda z, c, u: [z[1], c[0] * (u - z[0]) - c[1] * z[1], c[3] * (z[0] + c[2] * z[0] ** 3 - z[2])],
            lambda z, c, u: [z[2]], lambda z, c: [0.0, np.sqrt(3.0), 1.0], substeps=4,
        ),
        (0.3, -0.1, 0.2, 0.5, 0.3, 0.4, 0.6),
    ),
    "van der pol": Case(
        VAN_DER_POL,
        Plant(
            lambda z, c, u: [z[1], c[2] * u - c[0] * z[0] + c[1] * (1 - z[0] ** 2) * z[1]], _first, _white, substeps=4
        ),
        (0.8, -0.3, 0.6, 0.5, 0.4), degree=1,
    ),
    "drag": Case(
        DRAG,
        Plant(
            lambda z, c, u: [z[1], c[2] * u - c[0] * z[0] - c[1] * z[1] * _magnitude(z[1])],
            lambda z, c, u: [_magnitude(z[0])], _white, substeps=4,
        ),
        (-0.8, 0.9, 0.5, 0.6, 0.4), degree=1,
    ),
    "independent noises": Case(
        INDEPENDENT,
        Plant(_independent, _first, lambda z, c: [0.5, 2.0 + 0.1 * z[0]], substeps=4, independent=True),
        (0.3, -0.2, 0.6, 0.3, 0.4), degree=1,
    ),
    "independent noises, held": Case(
        replace(INDEPENDENT, held=True, substeps=2),
        Plant(_independent, _first, lambda z, c: [0.5, 2.0 + 0.1 * z[0]], substeps=2, held=True, independent=True),
        (0.3, -0.2, 0.6, 0.3, 0.4),
    ),
    "independent noises, added": Case(
        ADDED,
        Plant(
            lambda z, c, u: [c[0] * z[0] + c[1] * z[1] + u[0], z[0] - 0.1 * z[1] ** 3], lambda z, c, u: [z[0], z[1]],
            lambda z, c: [1.0, 0.3], independent=True,
        ),
        (0.2, 0.1, 0.7, -0.4),
    ),
}  # fmt: skip

#: One configuration of each of the five smooth models.
FIVE = ("duffing", "paper", "pendulum", "wiener-hammerstein", "van der pol")


def random_belief(case: Case, rng: np.random.Generator, width: float = 0.1) -> Belief:
    """Correlated at will, standard deviations over two decades below ``width``, noises over two decades."""
    m = len(case.center)
    std = width * np.exp(rng.uniform(np.log(1e-2), 0.0, m))
    factor = rng.standard_normal((m, m + 2))
    cov = factor @ factor.T
    cov *= np.outer(std, std) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    mean = np.array(case.center) + 0.1 * rng.standard_normal(m)
    shapes = np.exp(rng.uniform(0.0, np.log(1e3), 1 + case.model.n_outputs))
    variances = np.exp(rng.uniform(np.log(1e-3), np.log(1e-1), len(shapes))) ** 2
    gamma, *xi = [(a, a * v) for a, v in zip(shapes, variances, strict=True)]
    return Belief(mean, cov, gamma, xi)


def random_inputs(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Taps, or coefficients of the polynomial."""
    return 0.5 * rng.standard_normal(len(input_rows(case.model, case.degree)))


def put(W: np.ndarray, layout, lanes: int, lane: int, values: dict[str, float]) -> None:
    """Write rows of one lane."""
    for row, value in values.items():
        W[layout[row] * lanes + lane] = value


def put_belief(W, layout, lanes, lane, case: Case, belief: Belief) -> None:
    """Write a belief into a lane."""
    names = case.model.names
    values = dict(zip(names, belief.mean, strict=True))
    values |= {f"P_{i}_{j}": belief.cov[a, b] for a, i in enumerate(names) for b, j in enumerate(names) if a <= b}
    values |= {"GAMMA_SHAPE": belief.gamma[0], "GAMMA_RATE": belief.gamma[1]}
    for y, (shape, rate) in zip(case.model.outputs, belief.xi, strict=True):
        values |= {f"XI_SHAPE_{y}": shape, f"XI_RATE_{y}": rate}
    put(W, layout, lanes, lane, values)


def get_belief(W, layout, lanes, lane, case: Case) -> Belief:
    """The belief in a lane."""
    names = case.model.names
    at = lambda row: W[layout[row] * lanes + lane]  # noqa: E731
    cov = np.array([[at(f"P_{names[min(a, b)]}_{names[max(a, b)]}") for b in range(len(names))] for a in range(len(names))])  # fmt: skip  # noqa: E501
    xi = [(at(f"XI_SHAPE_{y}"), at(f"XI_RATE_{y}")) for y in case.model.outputs]
    return Belief(np.array([at(i) for i in names]), cov, (at("GAMMA_SHAPE"), at("GAMMA_RATE")), xi)


def block(layout, lanes: int) -> np.ndarray:
    """An empty block."""
    return np.zeros((max(layout.values()) + 1) * lanes)


def assert_agrees(actual: Belief, outcome, operations: int) -> None:
    """Equality within the rounding of successive operations, times the condition number."""
    tolerance = EPS * operations * outcome.condition
    assert tolerance < 1e-6, "the case is too badly conditioned to tell anything"
    expected, scale = outcome.belief, outcome.scale
    size = np.where(scale > 0, scale, 1.0) + np.abs(expected.mean)
    np.testing.assert_array_less(np.abs(actual.mean - expected.mean), tolerance * size)
    scale = scale + tolerance * np.abs(expected.mean)  # a known quantity has only the rounding error of its mean
    allowed = tolerance * np.outer(scale, scale)
    assert (np.abs(actual.cov - expected.cov) <= allowed).all()
    for ours, theirs in zip((actual.gamma, *actual.xi), (expected.gamma, *expected.xi), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=tolerance)
