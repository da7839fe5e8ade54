"""Systems sampled from a belief, their simulated outputs, and the probability that an output leaves its limit."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from functools import cache

import numpy as np
from scipy.special import betaincinv

from estimator.belief import Belief, covariance_indices
from estimator.inference.free_run import free_run
from estimator.models.model import Model
from estimator.online import OnlineEstimator
from estimator.support.array_types import FloatArray

#: Systems drawn from a belief, at least.
MIN_DRAWS = 500

#: Confidence of upper limits of probabilities.
_CONFIDENCE = 0.95

#: Draws that are simulated at once.
_BATCH_SIZE = 250

#: Factor by which an unsafe input shrinks.
_BACKOFF_FACTOR = 0.8

#: Times that it shrinks, at most: down to a thousandth.
_MAX_BACKOFFS = 31

#: Input that noise of unit strength is equal to, at most: a drawn system may have hardly any gain.
_MAX_NOISE_INPUT = 1e12

#: States and coefficients (draws, d), and deviations of the process noise and each sensor's (draws, 1 + sensors).
SystemDraws = tuple[FloatArray, FloatArray]


def required_draws(max_probability: float, n_planned: int) -> int:
    """Draws that can show a probability below ``max_probability``, besides ``n_planned`` that are optimised for."""
    return max(MIN_DRAWS, math.ceil(-math.log(1.0 - _CONFIDENCE) / max_probability) + n_planned)


def draw_from_records(
    model: Model, records: FloatArray, weights: FloatArray, rng: np.random.Generator, n_draws: int = MIN_DRAWS,
    deviation_scale: float = 1.0,
) -> SystemDraws:  # fmt: skip
    """Systems from a mixture of beliefs, records (n, size) as `estimator.Belief` keeps them, with weights (n,).

    Deviations from a belief's means, and of the noises, are ``deviation_scale`` times the believed ones.
    """
    weights = np.where(np.isfinite(records).all(axis=1), weights, 0.0)
    counts = rng.multinomial(n_draws, weights / weights.sum())
    d, places = len(model.names), covariance_indices(model)
    drawn, noises = [], []
    for record, count in zip(records, counts.tolist(), strict=True):
        if count:
            drawn.append(rng.multivariate_normal(record[:d], deviation_scale**2 * record[places], count, method="eigh"))
            shapes, rates = record[-2 * (1 + model.n_outputs) :].reshape(-1, 2).T
            noises.append(deviation_scale / np.sqrt(rng.gamma(shapes, 1.0 / rates, (count, len(shapes)))))
    return np.concatenate(drawn), np.concatenate(noises)


def draw_from_estimator(estimator: OnlineEstimator, rng: np.random.Generator) -> SystemDraws:
    """Systems from an estimator's posterior, a mixture of its noise hypotheses."""
    arrays = estimator.arrays()
    return draw_from_records(estimator.model, arrays["records"], arrays["weights"], rng)


def draw_at_rest(belief: Belief, rng: np.random.Generator, n_draws: int = MIN_DRAWS) -> SystemDraws:
    """Oscillators of Eq. (1) from a belief, each at an equilibrium without input: with two wells, in either."""
    drawn, noises = draw_from_records(belief.model, belief.record[None], np.ones(1), rng, n_draws)
    n = belief.model.n_states
    drawn[:, :n] = 0.0
    for system in drawn:
        system[0] = rng.choice(equilibria(belief.model, system[n:]))
    return drawn, noises


def equilibria(model: Model, coefficients: FloatArray) -> list[float]:
    """Stable equilibria x of an oscillator of Eq. (1) without input: one, or one in each of two wells.

    The origin, where there is none.
    """
    c = dict(zip(model.coefficients, coefficients.tolist(), strict=True))
    shift = c.get("output_offset", 0.0) if "output_offset" in model.rates[1] else 0.0
    # cubic s³ + stiffness (s + shift) = force, with s the displacement.
    found = np.roots([c["cubic"], 0.0, c["stiffness"], c["stiffness"] * shift - c.get("force", 0.0)])
    s = found.real[np.abs(found.imag) < 1e-9 * (1.0 + np.abs(found.real))]
    stable = s[c["stiffness"] + 3.0 * c["cubic"] * s**2 > 0.0]
    return [float(value + shift) for value in stable] or [0.0]


@cache
def noise_as_input(model: Model) -> Callable[..., FloatArray]:
    """Process noise of unit strength as an input held over a sample: a function of (draws,) coefficients.

    Raises:
        ValueError: for a model whose noise acts on another state than its input does.
    """
    import sympy as sp

    from estimator.engine.symbolic import differentiate, symbol

    motion_equations, u = differentiate(model), symbol(next(iter(model.inputs)))
    moved = {name: sp.diff(move, u) for name, move in zip(model.states, motion_equations.moves, strict=True)}
    forces = [
        noise / moved[name] for name, noise in zip(model.states, motion_equations.noise, strict=True) if noise != 0
    ]
    coefficients = [symbol(name) for name in model.coefficients]
    if len(forces) != 1 or not forces[0].free_symbols <= set(coefficients) or forces[0].has(sp.zoo):
        raise ValueError(
            f"model must have its process noise where its input acts, to be planned in blocks, but {model.name!r} has "
            f"noise {list(model.noise)} for {list(model.update_expressions)}; plan sample by sample"
        )
    force: Callable[..., FloatArray] = sp.lambdify(coefficients, forces[0])
    return force


class MonteCarloSystems:
    """Simulations of sampled systems, with noises that stay the same from input to input.

    Args:
        model: of the systems.
        draws: states, coefficients and noises.
        limit: of the output, in the belief's scale.
        rng: of the noises.
        delay: of the input, in samples.
        degree: of the input over a sample: 0 held, 1 linear.

    Attributes:
        states: (draws, n).
        coefficients: (draws, K).
        noises: (draws, 1 + sensors) standard deviations of the process noise and of each sensor's.
    """

    def __init__(
        self, model: Model, draws: SystemDraws, limit: float, rng: np.random.Generator, delay: int = 0, degree: int = 0
    ) -> None:
        systems, self.noises = draws
        self.model, self.limit, self.delay = model, limit, delay
        self.states, self.coefficients = systems[:, : model.n_states], systems[:, model.n_states :]
        self.interpolation = ("zero_order", "linear")[degree]
        self._seed = int(rng.integers(2**63))
        self._noise_inputs: tuple[FloatArray, FloatArray] | None = None

    def disturbances(self, samples: int) -> tuple[FloatArray, FloatArray]:
        """(draws, samples) process noise, as an addition to the input, and noise of the first sensor."""
        if self._noise_inputs is None or self._noise_inputs[0].shape[1] < samples:
            rng = np.random.default_rng(self._seed)
            process, sensor = rng.standard_normal((2, samples, len(self.noises))).swapaxes(1, 2)
            with np.errstate(divide="ignore"):
                force = np.abs(noise_as_input(self.model)(*self.coefficients.T))
            force = self.noises[:, 0] * np.minimum(force, _MAX_NOISE_INPUT)
            self._noise_inputs = force[:, None] * process, self.noises[:, 1:2] * sensor
        process, sensor = self._noise_inputs
        return process[:, :samples], sensor[:, :samples]

    def violating_draws(self, u: FloatArray, max_count: int, planned: Collection[int] = ()) -> list[int]:
        """The first draws whose outputs leave the limit under inputs (N,), in the belief's scale.

        Args:
            u: the inputs.
            max_count: draws that are returned, at most.
            planned: draws that the inputs were optimised for, which are no evidence of safety.
        """
        found: list[int] = []
        for first in range(0, len(self.states), _BATCH_SIZE):
            draws = slice(first, first + _BATCH_SIZE)
            is_out = ~(np.abs(self.simulate_outputs(u, draws)) <= self.limit).all(axis=1)
            found += [i for i in (first + np.flatnonzero(is_out)).tolist() if i not in planned]
            if len(found) >= max_count:
                break
        return found[:max_count]

    def simulate_outputs(self, u: FloatArray, draws: slice) -> FloatArray:
        """(draws, N) outputs of some draws under inputs (N,), in the belief's scale."""
        acting = np.concatenate([np.zeros(self.delay), u])[: len(u)]
        process, sensor = self.disturbances(len(u))
        disturbed_input, coefficients, states = acting + process[draws], self.coefficients[draws], self.states[draws]
        with np.errstate(over="ignore", invalid="ignore"):
            return free_run(self.model, coefficients, disturbed_input, states, self.interpolation) + sensor[draws]

    def violation_probability(self, u: FloatArray, max_probability: float = 1.0) -> float:
        """`probability_bound` that inputs (N,), in the belief's scale, take an output beyond its limit at any sample.

        Draws are counted until it reaches ``max_probability``.
        """
        return self.probability_bound(len(self.violating_draws(u, self.min_violations_for(max_probability))))

    def probability_bound(self, count: int, n_planned: int = 0) -> float:
        """Upper 95 % limit of the probability of an event that ``count`` of the draws show; never 0.

        The exact limit of Clopper and Pearson, without the ``n_planned`` draws that were optimised for.
        """
        draws = len(self.states) - n_planned
        return float(betaincinv(count + 1, draws - count, _CONFIDENCE)) if count < draws else 1.0

    def min_violations_for(self, max_probability: float, n_planned: int = 0) -> int:
        """The least number of draws, at least 1, whose `probability_bound` is not below ``max_probability``."""
        draws = len(self.states) - n_planned
        return max(1, next((k for k in range(draws) if self.probability_bound(k, n_planned) >= max_probability), draws))

    def safe_scale(self, u: FloatArray, max_probability: float) -> tuple[float, float]:
        """The largest scale of inputs whose `violation_probability` is below ``max_probability``.

        Returns:
            The scale, in (0, 1], or 0 where even zero input is unsafe; and the probability at this scale.
        """
        scale = 1.0
        for _ in range(_MAX_BACKOFFS):
            probability = self.violation_probability(scale * u, max_probability)
            if probability < max_probability:
                return scale, probability
            scale *= _BACKOFF_FACTOR
        return 0.0, self.violation_probability(0.0 * u)
