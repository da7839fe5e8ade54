"""Random systems for the coverage tables: drawn and simulated, with a prior that has the moments of the draw.

Every population has the four parameters of an oscillator near the twin of the Silverbox; further parameters are
Gaussian about 0. The difference equations start at rest, under independent uniform inputs. ``ode`` has the same inputs;
its initial state, which separates its offsets, is drawn from the prior. ``wide`` is the equation of ``ode`` from rest,
under three times the multisine of the Silverbox, with a Gaussian prior that is wide beside a sample's information.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from duffing_env.plants.silverbox_record import synthesise_multisine
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
from estimator.models.difference_equation import PRESETS, Term
from estimator.models.expression import evaluate, parse
from estimator.priors import log_uniform_moments
from estimator.support.array_types import FloatArray

#: Names of the populations.
POPULATIONS = ("paper", "offset", "three-tap", "cubic", "ode", "wide")

#: Relative spread of the four parameters: log-uniform on the twin's value * [1 - SPREAD, 1 + SPREAD]. In ``wide`` it is
#: their relative standard deviation.
SPREAD = 0.3

#: Inputs are uniform on ± this [V].
MAX_INPUT = 0.15

#: Displacement beyond which a system is dropped [V]: the difference equations diverge there, the circuit does not.
MAX_DISPLACEMENT = 0.75

#: Standard deviation of the states' prior [V, and V per sample].
STATE_STD = 1e-3

#: Standard deviations of the coefficients that Eq. (2) does not have, by unit.
_OTHERS = {"V": 2e-3, "1": 0.05}

#: Standard deviation of coefficients of products [V⁻¹, V⁻²].
_PRODUCT = 0.1

#: Physical equation of the tables; its process noise is an acceleration held over a sample.
ODE = duffing(offsets=True, feedthrough=True, noise="held")

#: Its coefficients that vary by the spread, in the order of the draws.
_DRAWN = ("stiffness", "damping", "gain", "cubic")

#: Standard deviations of u0 [V], y0 [V] and d.
_OFFSETS = (0.02, 0.02, 0.1)

#: In ``wide``, coefficients below this part of their mean are drawn again.
_LEAST = 0.1

#: In ``wide``, the input over the Silverbox's.
_AMPLIFICATION = 3


@dataclass(frozen=True)
class Systems:
    """N systems and their records.

    Attributes:
        truth: (N, K) the true coefficients of the population's model.
        physical: (N, 4) m, c, a and b of ``paper``; None of the others.
        u: (N, T) inputs [V].
        y: (N, T) outputs [V].
        stayed: (N,) whether the displacement stayed below `MAX_DISPLACEMENT`.
    """

    truth: FloatArray
    physical: FloatArray | None
    u: FloatArray
    y: FloatArray
    stayed: np.ndarray


def make_model(population: str) -> Model:
    """The equation of a population in `POPULATIONS`."""
    return ODE if population in ("ode", "wide") else difference(population)


def make_rig(population: str) -> Rig:
    """The rig of a population: how the input acts within a sample, and its delay."""
    if make_model(population).is_continuous:
        return Rig.silverbox("linear")
    return Rig.silverbox("zero_order", int(population == "offset"))


def names_of(population: str) -> tuple[str, ...]:
    """Names of the coefficients in the tables: in a difference equation, the names of the terms that they multiply."""
    if make_model(population).is_continuous:
        return tuple(ODE.coefficients)
    return ("θ1", "θ2", "θ3", "η") if population == "paper" else tuple(t.expression for t in PRESETS[population])


def make_prior(
    population: str, process_noise: float, measurement_noise: float, noise_shape: float, spread: float = SPREAD
) -> Belief:
    """The prior with the moments of the population `draw` draws from, and Gamma priors centred at the given noises."""
    if population == "paper":
        return silverbox_prior(None, spread, process_noise, measurement_noise, noise_shape)
    model = make_model(population)
    weak = recorded_prior(model, spread, process_noise, measurement_noise, noise_shape)
    if population == "wide":
        return weak
    mean, cov = weak.mean, weak.cov
    if population == "ode":
        factor = 2 * spread / np.log((1 + spread) / (1 - spread))  # mean of a value over the twin's, and of its square
        places = [model.names.index(coefficient) for coefficient in _DRAWN]
        offset = model.names.index("output_offset")
        cov[places, places] = (factor - factor**2) * mean[places] ** 2
        mean[places] *= factor
        cov[:2, :2] = STATE_STD**2 * np.eye(2)
        cov[0, 0] += cov[offset, offset]
        # The force is stiffness y0 - gain u0, of a stiffness and a gain that are drawn as well.
        k, g, f = (model.names.index(name) for name in ("stiffness", "gain", "force"))
        cov[f, f] = cov[offset, offset] * (mean[k] ** 2 + cov[k, k] + mean[g] ** 2 + cov[g, g])
        for other in (0, offset):
            cov[f, other] = cov[other, f] = mean[k] * cov[offset, offset]
    else:
        terms, four = PRESETS[population], _paper_terms(population)
        cov = np.diag([STATE_STD**2] * 2 + [_std(term) ** 2 for term in terms])
        mean[2:] = 0.0
        places = [2 + terms.index(term) for term in four]
        mean[places], cov[np.ix_(places, places)] = log_uniform_moments(difference(), SILVERBOX_TWIN, spread)
    noises = weak.noises
    return Belief.of(model, mean, cov, (noises[0], noises[1]), (noises[2], noises[3]))


def _paper_terms(preset: str) -> tuple[Term, ...]:
    """The terms of Eq. (2) in the order of (θ1, θ2, θ3, η): its input acts a sample before the output."""
    return (*PRESETS["paper"][:3], Term(tap=0 if preset in ("paper", "offset") else 1))


def _std(term: Term) -> float:
    return _OTHERS.get(term.unit, _PRODUCT)


def draw(
    population: str,
    systems: int,
    process_noise: float,
    measurement_noise: float,
    samples: int,
    rng: np.random.Generator,
    spread: float = SPREAD,
) -> Systems:
    """Draw systems of a population and simulate them.

    Args:
        population: one of `POPULATIONS`. ``paper`` and the presets: m, c, a and b are log-uniform, the other
            coefficients normal (offset 2 mV, further taps 0.05, further products 0.1 V⁻¹ or V⁻²). ``ode``: stiffness,
            damping, gain and cubic stiffness are log-uniform, offsets and feedthrough as `recorded_prior` has them.
            ``wide``: all of that prior, but none of the four below a tenth of its mean.
        systems: their number N.
        process_noise: standard deviation of what the process noise of a sample does to the displacement [V].
        measurement_noise: standard deviation of v [V].
        samples: number of samples T.
        rng: draws systems, inputs and noises.
        spread: of the four.
    """
    physical, start = None, None
    if population == "wide":
        truth = _ode_coefficients(_normal_factors(systems, spread, rng), rng)
    else:
        factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), (systems, 4)))
        if population == "ode":
            truth = _ode_coefficients(factors, rng)
        else:
            physical = np.array(list(SILVERBOX_TWIN.values())) * factors
            known = coefficients_of(difference(), Parameters(zip("mcab", physical.T, strict=True)))
            four = dict(zip(_paper_terms(population), known.T, strict=True))
            terms = PRESETS[population]
            truth = np.column_stack([four[t] if t in four else _std(t) * rng.standard_normal(systems) for t in terms])
    shape = (systems, samples)
    if population == "wide":
        u = np.array([_AMPLIFICATION * synthesise_multisine(rng, 1)[500 : 500 + samples] for _ in range(systems)])
    else:
        u = rng.uniform(-MAX_INPUT, MAX_INPUT, shape)
    w, v = process_noise * rng.standard_normal(shape), measurement_noise * rng.standard_normal(shape)
    if population == "ode":
        start = STATE_STD * rng.standard_normal((systems, 2))
    signal, stayed = simulate(make_model(population), truth, u, w, start, make_rig(population).delay)
    return Systems(truth, physical if population == "paper" else None, u, signal + v, stayed)


def _normal_factors(systems: int, spread: float, rng: np.random.Generator) -> FloatArray:
    """(N, 4) of `_DRAWN`, over their means; those with one below `_LEAST` are drawn again."""
    factors = 1 + spread * rng.standard_normal((systems, 4))
    while (low := (factors < _LEAST).any(axis=1)).any():
        factors[low] = 1 + spread * rng.standard_normal((low.sum(), 4))
    return factors


def _ode_coefficients(factors: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, 7) coefficients of `ODE`, from factors (N, 4) of `_DRAWN`; offsets and feedthrough are drawn."""
    systems = len(factors)
    truth = dict(zip(ODE.coefficients, np.tile(recorded_prior(ODE).coefficients_mean, (systems, 1)).T, strict=True))
    for coefficient, factor in zip(_DRAWN, factors.T, strict=True):
        truth[coefficient] = truth[coefficient] * factor
    u0, y0, d = (_OFFSETS * rng.standard_normal((systems, 3))).T
    truth |= {"output_offset": y0, "feedthrough": d, "force": truth["stiffness"] * y0 - truth["gain"] * u0}
    return np.column_stack([truth[coefficient] for coefficient in ODE.coefficients])


def simulate(
    model: Model, coefficients: FloatArray, u: FloatArray, w: FloatArray, start: FloatArray | None, delay: int = 0
) -> tuple[FloatArray, np.ndarray]:
    """Simulate systems by the declaration of their model, evaluated by NumPy; shares nothing with the engine.

    A differential equation moves by Runge-Kutta steps; its input goes linearly from one sample to the next, from 0.

    Args:
        model: the equation.
        coefficients: (N, K).
        u: (N, T) inputs.
        w: (N, T) process noises.
        start: (N, n) states one sample before the first, but for the output's offset; at rest where None.
        delay: samples by which a difference equation's inputs act later.

    Returns:
        (N, T) what the first sensor shows without its noise; and (N,) whether a difference equation's signal stayed
        below `MAX_DISPLACEMENT`.
    """
    n, samples = u.shape
    known, functions = dict(zip(model.coefficients, coefficients.T, strict=True)), {"sqrt": np.sqrt}
    moves = [parse(text, model.name) for text in model.update_expressions]
    shown = parse(next(iter(model.outputs.values())), model.name)
    strengths = [evaluate(parse(text, model.name), {}, functions) for text in model.noise]
    state = np.zeros((model.n_states, n)) if start is None else start.T.copy()
    state[0] += known.get("output_offset", 0.0)
    signal, stayed, none = np.empty_like(u), np.ones(n, dtype=bool), np.zeros(n)

    def names(state: FloatArray, inputs: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        return known | dict(zip(model.states, state, strict=True)) | dict(inputs)

    def moved(state: FloatArray, noise: FloatArray, inputs: Mapping[str, FloatArray]) -> FloatArray:
        values = names(state, inputs)
        rates = (evaluate(move, values, functions) for move in moves)
        return np.array([rate + by * noise for rate, by in zip(rates, strengths, strict=True)])

    h = 1 / model.substeps
    for t in range(samples):
        now, last, older = (u[:, t - delay - i] if t - delay - i >= 0 else none for i in range(3))
        if model.is_continuous:
            for i in range(model.substeps):
                begin, middle, end = (last + (now - last) * (i + part) * h for part in (0.0, 0.5, 1.0))
                r1 = moved(state, w[:, t], {"u": begin})
                r2 = moved(state + h / 2 * r1, w[:, t], {"u": middle})
                r3 = moved(state + h / 2 * r2, w[:, t], {"u": middle})
                r4 = moved(state + h * r3, w[:, t], {"u": end})
                state = state + h / 6 * (r1 + 2 * r2 + 2 * r3 + r4)
        else:
            state = moved(state, w[:, t], {"u": now, "u[-1]": last, "u[-2]": older})
            stayed &= np.abs(state[0]) < MAX_DISPLACEMENT
            state[:, ~stayed] = 0.0  # so that those that left do not overflow
        signal[:, t] = evaluate(shown, names(state, {"u": now}), functions)
    return signal, stayed
