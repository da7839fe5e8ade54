"""Feedback policies without learning: they use the believed resonance, or the believed velocity, of the observation.

Velocity and resonance are defined for any model (`agents.planning.model_probe`): for Eq. (2) x_t - x_{t-1} and the
angle of the poles, for Eq. (1) x' and the square root of stiffness over mass, up to the damping.

Both policies give ±amplitude: the amplitude limit, or the budget's RMS where it is smaller. Both brake, with an input
against the velocity, while the believed amplitude of the oscillation exceeds `BRAKE_FRACTION` of the displacement that
ends the episode. Where the limits allow so large an amplitude, they spend the rest of the episode near it, pumping and
braking by turns, which puts most of the power above the resonance. Both are deterministic: the seed has no effect.
Where an action is held for several samples, both choose it by the belief at the first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.planning.model_probe import observation_layout, probe_dynamics, resonance_frequencies
from agents.policies.excitations import BAND
from agents.policies.signals import InputLimits, input_limits_of
from agents.predict_argument_checks import check_batch_size, check_state, episode_starts
from duffing_env.experiment_config import Experiment, SimulatedExperiment
from estimator.models.single_input import check_single_input
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP
from estimator.support.argument_checks import to_float_array

BRAKE_FRACTION = 0.7
"""Amplitude beyond which the policies brake, in parts of the displacement that ends the episode.

An input of 0.15 V held for a sample changes an amplitude by about 0.09 V, for the lightest oscillators by 0.14 V, so
there must be room for more than one. Of 2,048 episodes of each track with a limit of 0.3 or 0.6 V, none ended early;
the largest displacement was 0.78 of the limit on Amplitude-v0, 0.93 on Output-v0 and 0.98 on Drift-v0.
"""

#: Lower and upper limit of a believed resonance, in cycles per sample.
_RESONANCE_BAND = (BAND[0] * SILVERBOX_SAMPLING_STEP, BAND[1] * SILVERBOX_SAMPLING_STEP)

#: The signs `(n,)` of inputs that need not brake, of velocities and phases of a wave of the believed resonance.
SignLaw = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


class FeedbackPolicy:
    """Common part of the policies: the limits, the prior that an observation is relative to, and the brake.

    Attributes:
        limits: Limits of the input.
    """

    def __init__(self, sign_law: SignLaw, limits: InputLimits, experiment: Experiment) -> None:
        """Takes the scale of observed means, in standard deviations of the prior, from the experiment."""
        self._sign_law, self.limits = sign_law, limits
        self._model, self._step = experiment.model, experiment.step
        self._layout = observation_layout(experiment.model)
        self._limit = float(experiment.max_output)
        self._centers = experiment.prior_belief.coefficients_mean
        self._stds = np.sqrt(np.diag(experiment.prior_belief.coefficients_cov))

    def frequency(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The linear resonance that is believed, shape `(n,)` [Hz], of observations `(n, features)`."""
        return self._read_motion(observations)[2] / self._step

    def amplitude(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The amplitude that is believed, shape `(n,)`, in parts of the displacement limit; see `_amplitude`."""
        return self._amplitude(*self._read_motion(observations))

    def _read_motion(
        self, rows: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The sensor's output and its velocity, in parts of the limit, and the resonance in cycles per sample."""
        layout, k, n = self._layout, self._model.n_coefficients, self._model.n_states
        means = self._centers + self._stds * rows[:, layout.mean : layout.mean + k]
        states = self._limit * rows[:, layout.state : layout.state + n]
        dynamics = probe_dynamics(self._model, means, states)
        cycles = np.clip(resonance_frequencies(self._model, dynamics.jacobians), *_RESONANCE_BAND)
        return dynamics.outputs_shown / self._limit, dynamics.velocities / self._limit, cycles

    def _amplitude(
        self, outputs: NDArray[np.float64], velocities: NDArray[np.float64], cycles: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The amplitude of a free oscillation at the believed resonance, φ rad per sample.

        For a differential equation A² = x² + (x' / φ)². Two samples of a difference equation determine it anywhere in
        the oscillation: A² = (x_t² + x_{t-1}² - 2 x_t x_{t-1} cos φ) / sin² φ. A hardening oscillator swings
        faster than that near the middle, so there A is taken for larger than it is.
        """
        angles = 2.0 * np.pi * cycles
        if self._model.is_continuous:
            return np.hypot(outputs, velocities / angles)
        previous_outputs = outputs - velocities
        return np.sqrt(outputs**2 + previous_outputs**2 - 2.0 * outputs * previous_outputs * np.cos(angles)) / np.sin(
            angles
        )

    def predict(
        self,
        observation: ArrayLike,
        state: NDArray[np.float64] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Gives the next input of each environment, as `agents.policies.Policy`; there is nothing random about it.

        The state is the phases, shape `(n,)`, in periods; an episode begins at 0, and all do where it is None.

        Raises:
            ValueError: `observation` is not one of duffing_env, or `state` or `episode_start` is for another number
                of environments.
        """
        rows = self._rows(observation)
        if state is not None:
            check_state(state, 1)
        phase = np.zeros(len(rows)) if state is None else state
        check_batch_size("state", len(phase), len(rows))
        phase = np.where(episode_starts(episode_start, len(rows)), 0.0, phase)
        motion = self._read_motion(rows)
        signs = np.where(
            self._amplitude(*motion) > BRAKE_FRACTION, -np.sign(motion[1]), self._sign_law(motion[1], phase)
        )
        # An input of one magnitude has that magnitude as its RMS.
        size = self.limits.to_actions(np.array(self.limits.max_inputs)).item()
        actions = (size * signs).astype(np.float32).reshape(*np.shape(observation)[:-1], 1)
        return actions, (phase + self.limits.hold * motion[2]) % 1.0

    def _rows(self, observation: ArrayLike) -> NDArray[np.float64]:
        """The observations as a batch `(n, features)`."""
        observed = to_float_array("observation", observation)
        size = self._layout.size
        if observed.ndim not in (1, 2) or observed.shape[-1] != size:
            raise ValueError(
                f"observation must have the shape ({size},) or (environments, {size}), as duffing_env gives it, "
                f"but its shape is {observed.shape}; a policy with feedback needs them as they are"
            )
        return np.atleast_2d(observed)


def velocity_sign(velocities: NDArray[np.float64], phases: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pushes in the direction in which the oscillator is believed to move, and so pumps energy in.

    It needs no frequency: whatever the oscillator's resonance is at its present amplitude, the input is in phase with
    the velocity there, but for half a sample. Only the brake looks at the model.
    """
    return np.where(velocities < 0.0, -1.0, 1.0)


def square_believed(velocities: NDArray[np.float64], phases: NDArray[np.float64]) -> NDArray[np.float64]:
    """A square wave whose frequency is the linear resonance that the posterior's mean has, sample by sample.

    The phase goes on as the frequency changes; an episode begins with a positive half-wave.
    """
    return np.where(phases < 0.5, 1.0, -1.0)


def make_feedback(sign_law: SignLaw, env: Any, seed: int) -> FeedbackPolicy:
    """A policy with feedback for an unwrapped environment (or None: the defaults); the seed has no effect.

    Raises:
        ValueError: `env` is not one of duffing_env, or has several inputs.
    """
    limits, _ = input_limits_of(env)
    experiment = SimulatedExperiment() if env is None else env.experiment
    check_single_input(
        "a feedback law, which pushes along one velocity", experiment.model, "choose a signal such as prbs"
    )
    return FeedbackPolicy(sign_law, limits, experiment)


FEEDBACK: dict[str, Callable[[Any, int], FeedbackPolicy]] = {
    "square-believed": partial(make_feedback, square_believed),
    "velocity-sign": partial(make_feedback, velocity_sign),
}
"""Name of a policy with feedback to what makes it from the unwrapped environment and the seed."""
