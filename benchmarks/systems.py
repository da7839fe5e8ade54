"""Systems for the coverage tables: drawn at random and simulated, with the prior that has the moments of the draw.

Every model has the four parameters of an oscillator near the twin of the Silverbox; what else it has is Gaussian about
0. All get inputs that are independent and uniform. The difference equations start at rest; of the physical equation the
start tells the offsets apart, and is therefore drawn as the prior has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator import (
    SILVERBOX_TWIN,
    Model,
    Parameters,
    Rig,
    coefficients_of,
    difference,
    duffing,
    recorded_prior,
    silverbox_prior,
)
from estimator.belief import Belief
from estimator.models.difference import PRESETS, Term
from estimator.parameters import FloatArray
from estimator.priors import log_uniform_moments

MODELS = ("paper", "offset", "three-tap", "cubic", "ode")

SPREAD = 0.3  # of the four: log-uniform on the twin's value * [1 - SPREAD, 1 + SPREAD]
MAX_INPUT = 0.15  # V; inputs are independent and uniform on ± this
MAX_DISPLACEMENT = 0.75  # V; above it the difference equations blow up, where the circuit does not
STATE_STD = 1e-3  # V, and V per sample; of the state's prior

#: Standard deviations of the coefficients that Eq. (2) does not have, by unit.
_OTHERS = {"V": 2e-3, "1": 0.05}
_PRODUCT = 0.1

#: The physical equation of the tables: its noise is an acceleration held over a sample.
ODE = duffing(offsets=True, feedthrough=True, noise="held")

#: What is log-uniform of it, in the order of the draws.
_DRAWN = ("stiffness", "damping", "gain", "cubic")


@dataclass(frozen=True)
class Systems:
    """N systems and their records.

    Attributes:
        names: (K,) of what is to be identified.
        truth: (N, K) their true values.
        u: (N, T) inputs [V].
        y: (N, T) outputs [V].
        stayed: (N,) whether the displacement stayed below `MAX_DISPLACEMENT`.
    """

    names: tuple[str, ...]
    truth: FloatArray
    u: FloatArray
    y: FloatArray
    stayed: np.ndarray


def make_model(name: str) -> Model:
    """The estimator's model of a population in `MODELS`."""
    return ODE if name == "ode" else difference(name)


def make_rig(name: str) -> Rig:
    """How its inputs act: the newest tap with the output of its own index; of the physical equation linearly."""
    return Rig.silverbox("linear") if name == "ode" else Rig.silverbox("zero_order", int(name == "offset"))


def make_prior(name: str, process_noise: float, measurement_noise: float, noise_shape: float) -> Belief:
    """The prior with the moments of the population `draw` draws from, and Gamma priors centred at the given noises."""
    if name == "paper":
        return silverbox_prior(None, SPREAD, process_noise, measurement_noise, noise_shape)
    model = make_model(name)
    weak = recorded_prior(model, SPREAD, process_noise, measurement_noise, noise_shape)
    mean, cov = weak.mean, weak.cov
    if name == "ode":
        width = np.log((1 + SPREAD) / (1 - SPREAD))
        factor = 2 * SPREAD / width  # mean of a value over the twin's, and of its square
        places = [model.names.index(coefficient) for coefficient in _DRAWN]
        offset = model.names.index("output_offset")
        cov[places, places] = (factor - factor**2) * mean[places] ** 2
        mean[places] *= factor
        cov[:2, :2] = STATE_STD**2 * np.eye(2)
        cov[0, 0] += cov[offset, offset]
        mean, cov = _with_force(model, mean, cov)
    else:
        terms, four = PRESETS[name], _paper_terms(name)
        cov = np.diag([STATE_STD**2] * 2 + [_std(term) ** 2 for term in terms])
        mean[2:] = 0.0
        places = [2 + terms.index(term) for term in four]
        mean[places], cov[np.ix_(places, places)] = log_uniform_moments(difference(), SILVERBOX_TWIN, SPREAD)
    noises = weak.noises
    return Belief.of(model, mean, cov, (noises[0], noises[1]), (noises[2], noises[3]))


def _with_force(model: Model, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The force's moments, stiffness y0 - gain u0, of a stiffness and a gain that are drawn as well."""
    k, g, f, offset = (model.names.index(name) for name in ("stiffness", "gain", "force", "output_offset"))
    spread = cov[offset, offset]  # of u0 as well
    cov[f, f] = spread * (mean[k] ** 2 + cov[k, k] + mean[g] ** 2 + cov[g, g])
    for other in (0, offset):
        cov[f, other] = cov[other, f] = mean[k] * spread
    return mean, cov


def _paper_terms(name: str) -> tuple[Term, ...]:
    """The terms of Eq. (2) in the order of (θ1, θ2, θ3, η): its input acts a sample before the output."""
    return (*PRESETS["paper"][:3], Term(tap=0 if name in ("paper", "offset") else 1))


def _std(term: Term) -> float:
    return _OTHERS.get(term.unit, _PRODUCT)


def draw(
    name: str, systems: int, process_noise: float, measurement_noise: float, samples: int, rng: np.random.Generator
) -> Systems:
    """Draw systems of a population and simulate them.

    Args:
        name: one of `MODELS`. ``paper`` and the presets: m, c, a and b are log-uniform, the other coefficients normal
            (offset 2 mV, further taps 0.05, further products 0.1 V⁻¹ or V⁻²). ``ode``: stiffness, damping, gain and
            cubic stiffness are log-uniform, offsets and feedthrough as `recorded_prior` has them.
        systems: their number N.
        process_noise: standard deviation of what the process noise of a sample does to the displacement [V].
        measurement_noise: standard deviation of v [V].
        samples: number of samples T.
        rng: draws systems, inputs and noises.
    """
    factors = np.exp(rng.uniform(np.log(1 - SPREAD), np.log(1 + SPREAD), (systems, 4)))
    if name == "ode":
        weak = recorded_prior(ODE)
        truth = dict(zip(ODE.coefficients, np.tile(weak.coefficients_mean, (systems, 1)).T, strict=True))
        for coefficient, factor in zip(_DRAWN, factors.T, strict=True):
            truth[coefficient] = truth[coefficient] * factor
        u0, y0, d = ([0.02, 0.02, 0.1] * rng.standard_normal((systems, 3))).T
        truth |= {"output_offset": y0, "feedthrough": d, "force": truth["stiffness"] * y0 - truth["gain"] * u0}
        coefficients = np.column_stack([truth[coefficient] for coefficient in ODE.coefficients])
        records = simulate_ode(coefficients, process_noise, measurement_noise, samples, rng)
        return Systems(tuple(ODE.coefficients), coefficients, *records)
    physical = np.array(list(SILVERBOX_TWIN.values())) * factors
    known = coefficients_of(difference(), Parameters(zip("mcab", physical.T, strict=True)))
    four = dict(zip(_paper_terms(name), known.T, strict=True))
    terms = PRESETS[name]
    coefficients = np.column_stack(
        [four[term] if term in four else _std(term) * rng.standard_normal(systems) for term in terms]
    )
    delayed = tuple(term._replace(tap=1) if name == "offset" and term.tap == 0 else term for term in terms)
    records = simulate(delayed, coefficients, process_noise, measurement_noise, samples, rng)
    if name == "paper":
        names = ("θ1", "θ2", "θ3", "η", "m", "c", "a", "b")
        return Systems(names, np.column_stack([coefficients, physical]), *records)
    return Systems(tuple(term.expression for term in terms), coefficients, *records)


def simulate(
    terms: tuple[Term, ...],
    coefficients: FloatArray,
    process_noise: float,
    measurement_noise: float,
    samples: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Simulate difference equations with coefficients (N, K), each with its own input: u, y (N, T) and stayed (N,)."""
    shape = (len(coefficients), samples)
    u, w, y = _inputs_and_noises(shape, process_noise, measurement_noise, rng)
    stayed = np.ones(shape[0], dtype=bool)
    x = x_last = np.zeros(shape[0])
    for t in range(samples):
        total = np.zeros(shape[0])
        for term, c in zip(terms, coefficients.T, strict=True):
            tap = term.tap
            drive = 1.0 if tap is None else u[:, t - tap] if t >= tap else 0.0
            total = total + c * (x**term.lag1 * x_last**term.lag2 * drive)
        x, x_last = total + w[:, t], x
        stayed &= np.abs(x) < MAX_DISPLACEMENT
        x = np.where(stayed, x, 0.0)  # so that those that left do not overflow
        y[:, t] += x
    return u, y, stayed


def simulate_ode(
    coefficients: FloatArray, process_noise: float, measurement_noise: float, samples: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Simulate the physical equation with coefficients (N, 7) and an input that is linear between samples.

    It starts at random one sample before the first, with the standard deviations of the prior, under no input. Returns
    as `simulate`; its cubic stiffness hardens, so that all systems stay.
    """
    shape = (len(coefficients), samples)
    u, w, y = _inputs_and_noises(shape, process_noise, measurement_noise, rng)
    k, b, c, g, f, y0, d = coefficients.T
    x, v = STATE_STD * rng.standard_normal((len(coefficients), 2)).T
    state = np.array([x + y0, v])

    def rates(state: FloatArray, force: FloatArray) -> FloatArray:
        z, v = state
        return np.array([v, force - c * v - k * z - b * (z - y0) ** 3])

    before, h = np.zeros(len(coefficients)), 1 / ODE.substeps
    for t in range(samples):
        for i in range(ODE.substeps):
            # The process noise is a force over the sample: alone, it would move z by w.
            begin, middle, end = (
                g * (before + (u[:, t] - before) * (i + part) * h) + f + 2 * w[:, t] for part in (0.0, 0.5, 1.0)
            )
            r1 = rates(state, begin)
            r2 = rates(state + h / 2 * r1, middle)
            r3 = rates(state + h / 2 * r2, middle)
            r4 = rates(state + h * r3, end)
            state = state + h / 6 * (r1 + 2 * r2 + 2 * r3 + r4)
        before = u[:, t]
        y[:, t] += state[0] + d * u[:, t]
    return u, y, np.ones(shape[0], dtype=bool)


def _inputs_and_noises(
    shape: tuple[int, int], process_noise: float, measurement_noise: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    u = rng.uniform(-MAX_INPUT, MAX_INPUT, shape)
    return u, process_noise * rng.standard_normal(shape), measurement_noise * rng.standard_normal(shape)
