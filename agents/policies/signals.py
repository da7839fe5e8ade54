"""Excitation signals as policies: they choose the input without looking at the observation.

An excitation is drawn by a `Draw`, a function that turns a generator and a number of samples into
an input in volts. `SignalPolicy` plays such draws through Stable-Baselines3's `predict`, one signal
for each environment of a batch. The `make_...` functions fit the known excitations to an
environment's amplitude limit and episode length; `agents.policies.make_policy` calls them by name.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duffing_env.silverbox import regime_input

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]
# Samples already played, shape (n,), and actions, shape (n, samples), of each environment's signal.
SignalState = tuple[NDArray[np.int64], NDArray[np.float32]]

DEFAULT_MAX_INPUT = 0.15  # V; the largest input of the Silverbox record is 0.149 V
DEFAULT_SAMPLES = 1024  # for environments whose episodes have no fixed length


class SignalPolicy:
    """Plays an excitation, drawn anew for each episode, on a batch of environments.

    Environment i draws from a generator of its own, the i-th child of the seed. So its k-th signal
    depends on the seed, i and k only: not on the size of the batch, nor on when the other
    environments end their episodes.

    Attributes:
        name: The name of the excitation.
        max_input: The input at action 1, in volts.
        samples: The length of one draw. A signal that runs out before its episode ends is
            continued by the next draw.
        seed: The seed that `reset` starts from.
    """

    def __init__(
        self,
        name: str,
        draw: Draw,
        *,
        max_input: float,
        samples: int = DEFAULT_SAMPLES,
        seed: int = 0,
    ) -> None:
        """Fits an excitation to an amplitude limit.

        Args:
            name: The name of the excitation.
            draw: Gives one excitation in volts, shape `(samples,)`, from a generator and a number
                of samples.
            max_input: The input at action 1, in volts, positive; the signal is clipped there.
            samples: The length of one draw, at least 1.
            seed: The seed of all the signals.

        Raises:
            ValueError: `max_input` is not positive and finite, or `samples` is below 1.
        """
        if not (np.isfinite(max_input) and max_input > 0.0):
            raise ValueError(f"max_input must be positive and finite, in volts, but it is {max_input}")
        if samples < 1:
            raise ValueError(f"samples must be 1 or more, but it is {samples}")
        self.name = name
        self.max_input = max_input
        self.samples = samples
        self.seed = seed
        self._draw = draw
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Starts over: the next signal of each environment is its first one again.

        Args:
            seed: Replaces the seed; None keeps it.
        """
        if seed is not None:
            self.seed = seed
        self._seeds = np.random.SeedSequence(self.seed)
        self._generators: list[np.random.Generator] = []

    def predict(
        self,
        observation: ArrayLike,
        state: SignalState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], SignalState]:
        """Gives the next input of each environment, as Stable-Baselines3's policies do.

        Args:
            observation: Shape `(n, features)` for n environments, or `(features,)` for one. Only
                its shape matters.
            state: What the last call returned; None draws a new signal for every environment. A
                caller who always passes None gets first samples only.
            episode_start: Shape `(n,)`: which environments begin an episode with this
                observation, and so draw a new signal. None means that none does.
            deterministic: Part of the signature, without effect: a signal is random by its draw,
                and reproducible by its seed.

        Returns:
            The actions, u / max_input clipped to [-1, 1], as float32 of shape `(n, 1)`, or `(1,)`
            for one environment; and the state for the next call. The state that was passed in is
            left as it was.

        Raises:
            ValueError: `observation` has neither one nor two dimensions, or `state` or
                `episode_start` is for another number of environments.
        """
        observed = np.shape(observation)
        if len(observed) not in (1, 2):
            raise ValueError(
                "observation must have the shape (features,) or (environments, features), but its "
                f"shape is {observed}; flatten it per environment"
            )
        rows = 1 if len(observed) == 1 else observed[0]
        if state is None:
            position = np.full(rows, self.samples)
            signals = np.empty((rows, self.samples), dtype=np.float32)
        else:
            position, signals = state
            _check_rows("state", len(position), rows)
        due = position == self.samples
        if episode_start is not None:
            starts = np.atleast_1d(np.asarray(episode_start, dtype=bool))
            _check_rows("episode_start", len(starts), rows)
            due = due | starts
        if due.any():
            position = np.where(due, 0, position)
            signals = signals.copy()
            for row in np.flatnonzero(due).tolist():
                signals[row] = self._next_signal(row)
        actions = signals[np.arange(rows), position][:, np.newaxis]
        return actions.reshape(*observed[:-1], 1), (position + 1, signals)

    def _next_signal(self, row: int) -> NDArray[np.float64]:
        """The actions, shape `(samples,)`, of the next draw for environment `row`."""
        missing = row + 1 - len(self._generators)
        if missing > 0:
            self._generators += map(np.random.default_rng, self._seeds.spawn(missing))
        volts = self._draw(self._generators[row], self.samples)
        return np.clip(volts / self.max_input, -1.0, 1.0)


def _check_rows(name: str, given: int, expected: int) -> None:
    if given != expected:
        raise ValueError(
            f"{name} is for {given} environments, but observation is for {expected}; pass None when the batch changes"
        )


def draw_regime(name: str) -> Draw:
    """A stretch of a regime of the Silverbox record, or of its synthesised stand-in.

    The stretch is contiguous and starts anywhere it fits, gaps and quiet beginning included. One
    longer than the regime starts at its first sample and repeats it.

    Args:
        name: `"multisine"` or `"arrow"`; see `duffing_env.silverbox.regime_input`.
    """

    def draw(rng: np.random.Generator, samples: int) -> NDArray[np.float64]:
        regime = regime_input(name, rng)
        start = rng.integers(max(regime.size - samples, 0), endpoint=True)
        return np.resize(regime[start : start + samples], samples)

    return draw


def draw_recorded(u: NDArray[np.float64]) -> Draw:
    """A given input in volts, shape `(samples,)`, from its first sample; repeated if too short."""
    return lambda rng, samples: np.resize(u, samples)


def draw_uniform(max_input: float) -> Draw:
    """Independent samples, uniform in ±`max_input` volts."""
    return lambda rng, samples: rng.uniform(-max_input, max_input, samples)


def draw_prbs(max_input: float, hold: int = 1) -> Draw:
    """A random binary signal: +`max_input` or -`max_input` volts with even odds.

    Args:
        max_input: The amplitude, in volts.
        hold: For how many samples each value is kept, at least 1.

    Raises:
        ValueError: `hold` is below 1.
    """
    if hold < 1:
        raise ValueError(f"hold must be 1 sample or more, but it is {hold}")

    def draw(rng: np.random.Generator, samples: int) -> NDArray[np.float64]:
        signs = rng.choice([-1.0, 1.0], size=-(-samples // hold))
        return max_input * np.repeat(signs, hold)[:samples]

    return draw


def make_silverbox(regime: str, env: Any, seed: int) -> SignalPolicy:
    """The reference policy of a regime.

    On an environment that replays a record (it has `recorded_input`) the policy plays that input
    from its first sample in every episode; on others, a stretch of the regime.

    Args:
        regime: `"multisine"` or `"arrow"`.
        env: The unwrapped environment, or None.
        seed: The seed of the signals.
    """
    max_input, samples = _limits(env)
    recorded = getattr(env, "recorded_input", None)
    if recorded is None:
        draw = draw_regime(regime)
    else:
        draw, samples = draw_recorded(recorded), len(recorded)
    name = f"silverbox-{regime}"
    return SignalPolicy(name, draw, max_input=max_input, samples=samples, seed=seed)


def make_uniform(env: Any, seed: int) -> SignalPolicy:
    """Independent inputs, uniform over the whole range of an unwrapped environment (or None)."""
    max_input, samples = _limits(env)
    draw = draw_uniform(max_input)
    return SignalPolicy("uniform", draw, max_input=max_input, samples=samples, seed=seed)


def make_prbs(env: Any, seed: int, hold: int = 1) -> SignalPolicy:
    """A random binary input at the limits of an unwrapped environment (or None)."""
    max_input, samples = _limits(env)
    draw = draw_prbs(max_input, hold)
    return SignalPolicy("prbs", draw, max_input=max_input, samples=samples, seed=seed)


def _limits(env: Any) -> tuple[float, int]:
    """The input at action 1, in volts, and the length of an episode, of an unwrapped env."""
    if env is None:
        return DEFAULT_MAX_INPUT, DEFAULT_SAMPLES
    if not hasattr(env, "max_input"):
        raise ValueError(
            f"env must be an environment of duffing_env, which has max_input, but its unwrapped "
            f"type is {type(env).__name__}; pass env=None for a limit of {DEFAULT_MAX_INPUT} V"
        )
    return env.max_input, getattr(env, "horizon", None) or DEFAULT_SAMPLES
