"""Systems drawn from a belief, what they do with inputs, and how probable it is that an output leaves its range."""

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

#: Systems that are drawn from a belief, at least.
MIN_DRAWS = 500

#: How certain it is that a probability is no more than what the draws tell of it.
_CONFIDENCE = 0.95

#: Draws that are followed at once.
_BATCH_SIZE = 250

#: An input that is too large is tried again at this share, so often: down to a thousandth.
_BACKOFF_FACTOR, _MAX_BACKOFFS = 0.8, 31

#: What noise of unit strength adds to the input at most: a drawn system may have hardly any gain.
_MAX_NOISE_INPUT = 1e12

#: States and coefficients (draws, d), and deviations of the process noise and each sensor's (draws, 1 + sensors).
SystemDraws = tuple[FloatArray, FloatArray]


def required_draws(max_probability: float, n_planned: int) -> int:
    """Systems that can tell a probability below a bound, also where so many of them are planned for."""
    return max(MIN_DRAWS, math.ceil(-math.log(1.0 - _CONFIDENCE) / max_probability) + n_planned)


def draw_from_records(
    model: Model, records: FloatArray, weights: FloatArray, rng: np.random.Generator, n_draws: int = MIN_DRAWS,
    deviation_scale: float = 1.0,
) -> SystemDraws:  # fmt: skip
    """Systems from a mixture of beliefs, records (n, size) as `estimator.Belief` keeps them, with weights (n,).

    Deviations from a belief's means, and of the noises, are ``deviation_scale`` times what is believed.
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
    """Systems from an estimator's posterior, its hypotheses as often as they are probable."""
    arrays = estimator.arrays()
    return draw_from_records(estimator.model, arrays["records"], arrays["weights"], rng)


def draw_at_rest(belief: Belief, rng: np.random.Generator, n_draws: int = MIN_DRAWS) -> SystemDraws:
    """Oscillators of Eq. (1) from a belief, each where it rests without input: of two wells, in either."""
    drawn, noises = draw_from_records(belief.model, belief.record[None], np.ones(1), rng, n_draws)
    n = belief.model.n_states
    drawn[:, :n] = 0.0
    for system in drawn:
        system[0] = rng.choice(equilibria(belief.model, system[n:]))
    return drawn, noises


def equilibria(model: Model, coefficients: FloatArray) -> list[float]:
    """States x at which an oscillator of Eq. (1) rests without input: one, or that of each of two wells.

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
    """What process noise of unit strength adds to the input, held over a sample: a function of (draws,) coefficients.

    Raises:
        ValueError: for a model whose noise acts on another state than its input does.
    """
    import sympy as sp

    from estimator.engine.symbolic import differentiate, symbol

    motion_equations, u = differentiate(model), symbol("u")
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
    """What drawn systems do with inputs, in their noises, which stay the same from input to input.

    Args:
        model: of the systems.
        draws: states, coefficients and noises.
        limit: of the output, in the belief's scale.
        rng: of the noises.
        delay: samples by which inputs act later.
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
        """(draws, samples) what process noise adds to the input, and what the first sensor adds to its output."""
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
        """The first draws, and at most so many, that inputs (N,), in the belief's scale, take out of the limit.

        Args:
            u: the inputs.
            max_count: draws that are returned at most.
            planned: draws that the inputs were planned for, and which therefore do not tell how safe they are.
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
        """(draws, N) what the sensors of some draws show with inputs (N,), in the belief's scale."""
        acting = np.concatenate([np.zeros(self.delay), u])[: len(u)]
        process, sensor = self.disturbances(len(u))
        disturbed_input, coefficients, states = acting + process[draws], self.coefficients[draws], self.states[draws]
        with np.errstate(over="ignore", invalid="ignore"):
            return free_run(self.model, coefficients, disturbed_input, states, self.interpolation) + sensor[draws]

    def violation_probability(self, u: FloatArray, max_probability: float = 1.0) -> float:
        """That inputs (N,), in the belief's scale, take the output out of its limit at any of the samples: `probability_bound`.

        Draws are counted until it is not below the bound any more.
        """
        return self.probability_bound(len(self.violating_draws(u, self.min_violations_for(max_probability))))

    def probability_bound(self, count: int, n_planned: int = 0) -> float:
        """The upper 95 % limit of the probability of what so many of the draws do: it is never 0.

        The exact limit (Clopper and Pearson), without so many draws that were planned for.
        """
        draws = len(self.states) - n_planned
        return float(betaincinv(count + 1, draws - count, _CONFIDENCE)) if count < draws else 1.0

    def min_violations_for(self, max_probability: float, n_planned: int = 0) -> int:
        """The least number of draws whose `probability_bound` is not below a bound, 1 at least."""
        draws = len(self.states) - n_planned
        return max(1, next((k for k in range(draws) if self.probability_bound(k, n_planned) >= max_probability), draws))

    def safe_scale(self, u: FloatArray, max_probability: float) -> tuple[float, float]:
        """The largest share of inputs whose `violation_probability` of leaving the limit is below a bound, and that probability.

        Returns:
            The share, in (0, 1], or 0 where even no input is too much; and the probability at it.
        """
        scale = 1.0
        for _ in range(_MAX_BACKOFFS):
            probability = self.violation_probability(scale * u, max_probability)
            if probability < max_probability:
                return scale, probability
            scale *= _BACKOFF_FACTOR
        return 0.0, self.violation_probability(0.0 * u)
