"""Open-loop policies: they play excitation signals, and do not use the observation.

`SignalPolicy` plays a `SignalDraw` of `agents.policies.excitations` through Stable-Baselines3's `predict`, one signal
for each environment of a batch, and of several inputs an independent one for each. `make_signal` fits an excitation to
an environment: to its amplitude limits, to the length of its episodes, and to its input budget where it has one.
`agents.policies.make_policy` calls it by name.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.planning.model_probe import believed_resonance
from agents.policies.excitations import EXCITATIONS, SignalDraw, draw_recorded
from agents.predict_argument_checks import MAX_SAMPLES, check_batch_size, check_state, episode_starts
from estimator.belief import Belief
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP
from estimator.support.argument_checks import (
    MAX_SEED,
    MIN_MAGNITUDE,
    check_integer,
    is_finite_number,
    short_repr,
    to_float_array,
)

#: Number of actions played (n,), and actions (n, actions of a draw, inputs) of each environment's signal.
SignalState = tuple[NDArray[np.int64], NDArray[np.float32]]

#: Amplitude limit without an environment [V]; the largest input of the Silverbox record is 0.149 V.
DEFAULT_MAX_INPUT = 0.15

#: Resonance of the Silverbox in cycles per sample, to which bands and holds of the signals are fitted.
_SILVERBOX_RESONANCE = 68.1 * SILVERBOX_SAMPLING_STEP

#: Samples of a draw for an environment, at most; the next draw continues it in longer episodes.
_MAX_DRAW_SAMPLES = 2**16

#: Samples of a draw for an environment whose episodes have no fixed length.
DEFAULT_SAMPLES = 1024

#: Part of the budget that signals use: float32 rounding of the actions must not exceed it.
_RMS_SAFETY_FACTOR = 1.0 - 1e-6


@dataclass(frozen=True)
class InputLimits:
    """Limits of the inputs.

    Attributes:
        max_input: The input at action 1, in volts, positive; or for several inputs of each, in its own unit.
        max_rms: The largest root mean square over an episode, in volts, positive; None where there is none. Of several
            inputs it is the root of the sum of their mean squares.
        hold: Samples that an action is applied for, at least 1.

    Raises:
        ValueError: `max_input` or `max_rms` is not positive and finite.
    """

    max_input: float | tuple[float, ...] = DEFAULT_MAX_INPUT
    max_rms: float | None = None
    hold: int = 1

    def __post_init__(self) -> None:
        for name, value in (*(("max_input", one) for one in self.max_inputs), ("max_rms", self.max_rms)):
            if value is not None and not (is_finite_number(value) and MIN_MAGNITUDE <= value <= 1e300):
                raise ValueError(
                    f"{name} must be positive and finite, in volts, from {MIN_MAGNITUDE} to 1e300, but it is "
                    f"{short_repr(value)}"
                )
        check_integer("hold", self.hold, 10**9)

    @property
    def max_inputs(self) -> tuple[float, ...]:
        """The input at action 1, of each input."""
        return self.max_input if isinstance(self.max_input, tuple) else (self.max_input,)

    def to_actions(self, volts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turns inputs into actions within the limits. This is the one place where signals are scaled.

        Each input is clipped at its `max_input`. Where the root mean square of all is then above `max_rms`, they are
        scaled down to it as a whole, by one factor, because the environment would otherwise play their beginning at
        full size and cut the rest to zero. They are never scaled up.

        Where an action is applied for several samples, the input is what a slower generator makes of it: the first of
        every `hold` samples, held. Frequencies stay what they are in Hz; those above half of the actions' rate fold.

        Args:
            volts: The inputs of an episode, or of a part that repeats, shape `(n_samples, inputs)`, or `(n_samples,)`
                of one input.

        Returns:
            Actions in [-1, 1], shape `(ceil(n_samples / hold), inputs)` or `(ceil(n_samples / hold),)`.
        """
        largest = np.array(self.max_inputs)
        columns = volts.reshape(len(volts), -1)
        held = np.repeat(columns[:: self.hold], self.hold, axis=0)[: len(columns)]
        actions = np.clip(held / largest, -1.0, 1.0)
        if self.max_rms is not None:
            # In parts of the first input's limit.
            allowed = _RMS_SAFETY_FACTOR * self.max_rms / largest[0]
            rms = np.sqrt(np.mean(((largest / largest[0] * actions) ** 2).sum(axis=1)))
            if rms > allowed:
                actions *= allowed / rms
        played: NDArray[np.float64] = actions[:: self.hold]
        return played if volts.ndim == 2 else played[:, 0]


class SignalPolicy:
    """Plays an excitation, drawn anew for each episode, on a batch of environments.

    Environment i draws from a generator of its own, the i-th child of the seed. So its k-th signal
    depends on the seed, i and k only: not on the size of the batch, nor on when the other
    environments end their episodes. Of several inputs each draws from a generator of its own, a child of that.

    Attributes:
        name: The name of the excitation.
        limits: Limits of every signal.
        samples: The length of one draw. A signal that runs out before its episode ends is continued by the next draw.
        actions: The number of actions that play it: fewer, where an action is held for several samples.
        seed: The seed that `reset` starts from.

    Raises:
        ValueError: `max_input` or `max_rms` is not positive and finite, `n_samples` or `seed` is not a whole number, or
            there is not one draw for each input.
    """

    def __init__(
        self,
        name: str,
        draw: SignalDraw | Sequence[SignalDraw],
        *,
        max_input: float | Sequence[float],
        max_rms: float | None = None,
        samples: int = DEFAULT_SAMPLES,
        hold: int = 1,
        seed: int = 0,
    ) -> None:
        check_integer("samples", samples, MAX_SAMPLES)
        check_integer("seed", seed, MAX_SEED, 0)
        self.name = name
        self._draws = (draw,) if callable(draw) else tuple(draw)
        self.limits = InputLimits(tuple(max_input) if isinstance(max_input, Sequence) else max_input, max_rms, hold)
        if len(self._draws) != len(self.limits.max_inputs):
            raise ValueError(
                f"draw must be one for each input of max_input, {len(self.limits.max_inputs)}, but there are "
                f"{len(self._draws)}"
            )
        self.samples = samples
        self.actions = -(-samples // hold)
        self.seed = seed
        self.reset()

    @property
    def max_input(self) -> float | tuple[float, ...]:
        """The input at action 1, in volts, or of each of several inputs."""
        return self.limits.max_input

    def reset(self, seed: int | None = None) -> None:
        """Starts over, with another seed where there is one: the next signal of each environment is its first one."""
        if seed is not None:
            self.seed = seed
        self._seeds = np.random.SeedSequence(self.seed)
        self._generators: list[list[np.random.Generator]] = []

    def predict(
        self,
        observation: ArrayLike,
        state: SignalState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], SignalState]:
        """Gives the next input of each environment, as `agents.policies.Policy`.

        The observation is not looked at. An episode begins with a new signal, and so does every environment where the
        state is None: a caller who always passes None gets first samples only. `deterministic` is without effect: a
        signal is random by its draw, and reproducible by its seed.

        Raises:
            ValueError: `observation` has neither one nor two dimensions, or `state` or `episode_start` is for another
                number of environments.
        """
        observed = np.shape(
            observation if isinstance(observation, np.ndarray) else to_float_array("observation", observation)
        )
        if len(observed) not in (1, 2):
            raise ValueError(
                "observation must have the shape (features,) or (environments, features), but its "
                f"shape is {observed}; flatten it per environment"
            )
        rows = 1 if len(observed) == 1 else observed[0]
        if state is None:
            position = np.full(rows, self.actions)
            signals = np.empty((rows, self.actions, len(self._draws)), dtype=np.float32)
        else:
            check_state(state, 2)
            position, signals = state
            check_batch_size("state", len(position), rows)
        due = (position == self.actions) | episode_starts(episode_start, rows)
        if due.any():
            position = np.where(due, 0, position)
            signals = signals.copy()
            missing = rows - len(self._generators)
            for seed in self._seeds.spawn(max(0, missing)):
                seeds = [seed] if len(self._draws) == 1 else seed.spawn(len(self._draws))
                self._generators.append([np.random.default_rng(one) for one in seeds])
            for row in np.flatnonzero(due).tolist():
                generators = zip(self._draws, self._generators[row], strict=True)
                volts = np.stack([draw(generator, self.samples) for draw, generator in generators], axis=1)
                signals[row] = self.limits.to_actions(volts)
        actions = signals[np.arange(rows), position]
        return actions.reshape(*observed[:-1], len(self._draws)), (position + 1, signals)


def make_signal(name: str, env: Any, seed: int) -> SignalPolicy:
    """The policy that plays an excitation on an unwrapped environment (or None).

    On an environment that replays a record (it has `recorded_input`) the regimes ``silverbox-...`` play that input
    from its first sample in every episode; on others, a stretch of the regime.

    Signals are made for the Silverbox. On a rig each of their values is held for as many samples as the rig's
    resonance, as its prior believes it, is slower, and they reach as far as its limit.

    Raises:
        ValueError: `env` is not one of duffing_env.
    """
    limits, samples = input_limits_of(env)
    draws = [EXCITATIONS[name](max_input) for max_input in limits.max_inputs]
    experiment: Any = getattr(env, "experiment", None)
    if getattr(experiment, "rig", None) is not None:
        hold = hold_for_resonance(experiment.prior_belief, samples)
        silverbox_draw = EXCITATIONS[name](DEFAULT_MAX_INPUT)
        draws = [
            partial(_stretched_draw, draw=silverbox_draw, hold=hold, amplitude_ratio=max_input / DEFAULT_MAX_INPUT)
            for max_input in limits.max_inputs
        ]
    recorded = getattr(env, "recorded_input", None)
    if recorded is not None and name.startswith("silverbox-"):
        draws, samples = [draw_recorded(recorded)], len(recorded)
    return SignalPolicy(
        name, draws, max_input=limits.max_input, max_rms=limits.max_rms, samples=samples, hold=limits.hold, seed=seed
    )


def hold_for_resonance(prior: Belief, n_samples: int) -> int:
    """Samples to hold each value of an excitation for, at least 1, so that it excites what is believed."""
    return int(np.clip(round(_SILVERBOX_RESONANCE / believed_resonance(prior)), 1, max(1, n_samples // 8)))


def _stretched_draw(
    rng: np.random.Generator, samples: int, draw: SignalDraw, hold: int, amplitude_ratio: float
) -> NDArray[np.float64]:
    """A draw that is slower, and in another unit."""
    # Below 5 samples a multisine has no line in its band.
    values: NDArray[np.float64] = np.repeat(amplitude_ratio * draw(rng, max(5, -(-samples // hold))), hold)[:samples]
    return values


def input_limits_of(env: Any) -> tuple[InputLimits, int]:
    """The limits of the inputs, and the length of an episode, of an unwrapped environment (or None).

    Raises:
        ValueError: `env` is not one of duffing_env.
    """
    if env is None:
        return InputLimits(), DEFAULT_SAMPLES
    if not hasattr(env, "max_input"):
        raise ValueError(
            f"env must be an environment of duffing_env, which has max_input, but its unwrapped type is "
            f"{type(env).__name__}; pass what gym.make, gym.make_vec or DuffingVecEnv made of its id"
        )
    experiment = getattr(env, "experiment", None)
    by_input = getattr(experiment, "max_inputs", None)
    max_inputs = (env.max_input,) if by_input is None else tuple(by_input.tolist())
    max_input = max_inputs if len(max_inputs) > 1 else max_inputs[0]
    limits = InputLimits(max_input, getattr(experiment, "max_rms", None), getattr(experiment, "hold", 1))
    return limits, min(getattr(env, "horizon", None) or DEFAULT_SAMPLES, _MAX_DRAW_SAMPLES)
