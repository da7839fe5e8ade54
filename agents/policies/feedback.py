"""Classical policies with feedback: they read the believed resonance, or the believed velocity, off the observation.

| Name | Input | Frequency content |
|------|-------|-------------------|
| ``square-believed`` | square wave at the linear resonance of the posterior's mean | a moving line, odd harmonics |
| ``velocity-sign`` | ±limit with the sign of the believed velocity x_t - x_{t-1} | the resonance of that amplitude |

Both give ±amplitude: the amplitude limit, or the budget's RMS where that is smaller. Both brake, giving the input
against the velocity, while the amplitude that the oscillation is believed to have is beyond `TURN` of the displacement
that ends the episode. Where the limits allow for an amplitude so large, they spend the rest of the episode about it,
pumping and braking by turns, which puts most of the power above the resonance. Both are deterministic: the seed has no
effect. Where an action is held for several samples, both choose it by what is believed at the first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.policies.excitations import resonance
from agents.policies.signals import Limits, limits_of
from duffing_env.experiment import Experiment, SimulatedExperiment
from duffing_env.layout import OBSERVATION, SETTINGS
from estimator.parameters import SAMPLING_STEP

TURN = 0.7
"""Amplitude beyond which the policies brake, in parts of the displacement that ends the episode.

An input of 0.15 V held for a sample changes an amplitude by about 0.09 V, for the lightest oscillators by 0.14 V, so
there must be room for more than one. Of 2,048 episodes of each track with a limit of 0.3 or 0.6 V, none ended early;
the largest displacement was 0.78 of the limit on Amplitude-v0, 0.93 on Output-v0 and 0.98 on Drift-v0.
"""

_ENTRY = {name: i for i, name in enumerate(OBSERVATION)}


class FeedbackPolicy:
    """What the policies have in common: the limits, the prior that an observation is relative to, and the brake.

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

    def frequency(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The linear resonance that is believed, shape `(n,)` [Hz], of observations `(n, 22)`."""
        means = observations[:, [_ENTRY["mean_t1"], _ENTRY["mean_t3"]]]
        theta1, theta3 = (self._centers + self._stds * means).T
        return resonance(theta1, theta3)

    def amplitude(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The amplitude that is believed, shape `(n,)`, in parts of the displacement limit.

        Two samples of a free oscillation at the believed resonance, φ rad apart, tell its amplitude wherever in the
        swing they were taken: A² = (x_t² + x_{t-1}² - 2 x_t x_{t-1} cos φ) / sin² φ. A hardening oscillator swings
        faster than that near the middle, so there A is taken for larger than it is.
        """
        x0, x1 = observations[:, _ENTRY["state_x0"]], observations[:, _ENTRY["state_x1"]]
        angle = 2.0 * np.pi * SAMPLING_STEP * self.frequency(observations)
        return np.sqrt(x0**2 + x1**2 - 2.0 * x0 * x1 * np.cos(angle)) / np.sin(angle)

    def _actions(
        self, observation: ArrayLike, rows: NDArray[np.float64], signs: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """These signs `(n,)` at full size, or braking where the amplitude is large; in the observation's shape."""
        signs = np.where(self.amplitude(rows) > TURN, -np.sign(_velocity(rows)), signs)
        # An input of one magnitude has that magnitude as its RMS.
        size = self.limits.fit(np.array([self.limits.max_input])).item()
        return (size * signs).astype(np.float32).reshape(*np.shape(observation)[:-1], 1)


class VelocitySign(FeedbackPolicy):
    """Pushes in the direction in which the oscillator is believed to move, and so pumps energy in.

    It needs no frequency: whatever the oscillator's resonance is at its present amplitude, the input is in phase with
    the velocity there, but for half a sample. Only the brake looks at the model.
    """

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
        return self._actions(observation, rows, pumping), state


class SquareBelieved(FeedbackPolicy):
    """A square wave whose frequency is the linear resonance that the posterior's mean has, sample by sample.

    The phase goes on as the frequency changes; an episode begins with a positive half-wave.
    """

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
        following = (phase + self.limits.hold * SAMPLING_STEP * self.frequency(rows)) % 1.0
        return self._actions(observation, rows, wave), following


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


def make_feedback(kind: type[VelocitySign] | type[SquareBelieved], env: Any, seed: int) -> Any:
    """A policy with feedback for an unwrapped environment (or None: the defaults); the seed has no effect.

    Raises:
        ValueError: `env` is not one of duffing_env.
    """
    limits, _ = limits_of(env)
    return kind(limits, SimulatedExperiment() if env is None else env.experiment)


FEEDBACK: dict[str, Callable[[Any, int], Any]] = {
    "square-believed": partial(make_feedback, SquareBelieved),
    "velocity-sign": partial(make_feedback, VelocitySign),
}
"""Name of a policy with feedback to what makes it from the unwrapped environment and the seed."""
