"""Classical policies with feedback: they read the believed resonance, or the believed velocity, off the observation.

| Name | Input | Frequency content |
|------|-------|-------------------|
| ``square-believed`` | square wave at the linear resonance of the posterior's mean | a line that moves, odd harmonics |
| ``velocity-sign`` | ±limit with the sign of the believed velocity x_t - x_{t-1} | at the resonance of that amplitude |

Both give ±amplitude: the amplitude limit, or the budget's RMS where that is smaller. Both brake, giving the input
against the velocity, while the displacement is beyond `TURN` of the limit that ends the episode. An input u that pumps
over 2 T of a swing and brakes over 2 (A - T) of it does no work at an amplitude of A = 2 T, so that even without
damping the amplitude settles at or below 0.8 of the limit. Both are deterministic: the seed has no effect.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.policies.excitations import resonance
from agents.policies.signals import Limits, limits_of
from duffing_env.experiment import Experiment, SimulatedExperiment
from duffing_env.layout import OBSERVATION, SETTINGS
from estimator.parameters import SAMPLING_STEP

TURN = 0.4
"""Displacement beyond which the policies brake, in parts of the one that ends the episode."""

_ENTRY = {name: i for i, name in enumerate(OBSERVATION)}


class VelocitySign:
    """Pushes in the direction in which the oscillator is believed to move, and so pumps energy in.

    It needs neither a model nor a frequency: whatever the oscillator's resonance is at its present amplitude, the
    input is in phase with the velocity there.

    Attributes:
        limits: What the input keeps to.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits

    def predict(
        self,
        observation: ArrayLike,
        state: Any = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Any]:
        """Gives the next input of each environment, as Stable-Baselines3's policies do.

        Args:
            observation: Shape `(n, 22)` for n environments, or `(22,)` for one.
            state: Not used, and handed back.
            episode_start: Not used.
            deterministic: Without effect.

        Returns:
            Actions, float32 of shape `(n, 1)`, or `(1,)` for one environment; and the state.

        Raises:
            ValueError: `observation` is not one of duffing_env.
        """
        rows = _rows(observation)
        pumping = np.where(_velocity(rows) < 0.0, -1.0, 1.0)
        return _actions(observation, rows, pumping, self.limits), state


class SquareBelieved:
    """A square wave whose frequency is the linear resonance that the posterior's mean has, sample by sample.

    The phase goes on as the frequency changes; an episode begins with a positive half-wave.

    Attributes:
        limits: What the input keeps to.
    """

    def __init__(self, limits: Limits, experiment: Experiment) -> None:
        """Takes from the experiment what an observed mean, in the prior's standard deviations, stands for.

        Args:
            limits: What the input keeps to.
            experiment: That of the environment.
        """
        self.limits = limits
        settings = experiment.settings
        self._centers = settings[[SETTINGS["prior_t1"], SETTINGS["prior_t3"]]]
        self._stds = 1.0 / settings[[SETTINGS["scale_t1"], SETTINGS["scale_t3"]]]

    def predict(
        self,
        observation: ArrayLike,
        state: NDArray[np.float64] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Gives the next input of each environment, as Stable-Baselines3's policies do.

        Args:
            observation: Shape `(n, 22)` for n environments, or `(22,)` for one.
            state: What the last call returned: the phases, shape `(n,)`, in periods. None: all begin at 0.
            episode_start: Shape `(n,)`: which environments begin an episode, and so at phase 0. None: none does.
            deterministic: Without effect.

        Returns:
            Actions, float32 of shape `(n, 1)`, or `(1,)` for one environment; and the state for the next call.

        Raises:
            ValueError: `observation` is not one of duffing_env, or `state` or `episode_start` is for another number
                of environments.
        """
        rows = _rows(observation)
        phase = np.zeros(len(rows)) if state is None else state
        starts = np.zeros(len(rows), dtype=bool) if episode_start is None else np.atleast_1d(episode_start)
        for name, given in (("state", phase), ("episode_start", starts)):
            if len(given) != len(rows):
                raise ValueError(
                    f"{name} is for {len(given)} environments, but observation is for {len(rows)}; pass None when the "
                    "batch changes"
                )
        phase = np.where(starts, 0.0, phase)
        wave = np.where(phase < 0.5, 1.0, -1.0)
        following = (phase + SAMPLING_STEP * self.frequency(rows)) % 1.0
        return _actions(observation, rows, wave, self.limits), following

    def frequency(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The linear resonance that is believed, shape `(n,)` [Hz], of observations `(n, 22)`."""
        means = observations[:, [_ENTRY["mean_t1"], _ENTRY["mean_t3"]]]
        theta1, theta3 = (self._centers + self._stds * means).T
        return resonance(theta1, theta3)


def _rows(observation: ArrayLike) -> NDArray[np.float64]:
    """The observations as a batch `(n, 22)`."""
    observed = np.asarray(observation, dtype=np.float64)
    if observed.ndim not in (1, 2) or observed.shape[-1] != len(OBSERVATION):
        raise ValueError(
            f"observation must have the shape ({len(OBSERVATION)},) or (environments, {len(OBSERVATION)}), as those of "
            f"duffing_env have, but its shape is {observed.shape}; a policy with feedback needs them as they are"
        )
    return np.atleast_2d(observed)


def _velocity(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The believed x_t - x_{t-1}, shape `(n,)`, in parts of the displacement limit."""
    return rows[:, _ENTRY["state_x0"]] - rows[:, _ENTRY["state_x1"]]


def _actions(
    observation: ArrayLike, rows: NDArray[np.float64], signs: NDArray[np.float64], limits: Limits
) -> NDArray[np.float32]:
    """These signs `(n,)` at full amplitude, or braking where the displacement is large; in the observation's shape."""
    beyond = np.abs(rows[:, _ENTRY["state_x0"]]) > TURN
    signs = np.where(beyond, -np.sign(_velocity(rows)), signs)
    # An input of one magnitude has that magnitude as its RMS.
    amplitude = limits.fit(np.array([limits.max_input])).item()
    return (amplitude * signs).astype(np.float32).reshape(*np.shape(observation)[:-1], 1)


def make_velocity_sign(env: Any, seed: int) -> VelocitySign:
    """``velocity-sign`` for an unwrapped environment (or None); the seed has no effect."""
    return VelocitySign(limits_of(env)[0])


def make_square_believed(env: Any, seed: int) -> SquareBelieved:
    """``square-believed`` for an unwrapped environment (or None: the defaults); the seed has no effect.

    Raises:
        ValueError: `env` is not one of duffing_env.
    """
    limits, _ = limits_of(env)
    return SquareBelieved(limits, SimulatedExperiment() if env is None else env.experiment)


FEEDBACK: dict[str, Callable[[Any, int], VelocitySign | SquareBelieved]] = {
    "square-believed": make_square_believed,
    "velocity-sign": make_velocity_sign,
}
"""Name of a policy with feedback to what makes it from the unwrapped environment and the seed."""
