"""Foresight: a network sees what its belief expects of simple inputs, and is kept from what would end the episode.

The best input is a sharp function of the belief: it turns over where a push would come too late or lead too far. A
network learns such a function poorly from means, deviations and displacements. It learns it well from what the believed
oscillator does with a push up, none or a push down, and what that would teach (`agents.policies.prospects`). Three
things are done for it:

- **Features.** Observations are turned upright, so that x_t ≥ 0, and the action is turned back: the task is odd.
- **A shield.** An action in whose direction no way is left to stay within the displacement limit is replaced by none,
  or by a push the other way, whichever is safe. So also a policy that still tries its actions out seldom ends an
  episode, and learns to go close to the limit.
- **A drive**, where the energy is limited: the action is how hard to push along the motion (or against it), not the
  input itself. Of all ways to swing an oscillator up, to push in proportion to its motion takes least energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.policies.prospects import FEATURES, Outlook, look_at
from duffing_env.experiment import Experiment
from duffing_env.layout import SETTINGS
from estimator.parameters import FloatArray
from estimator.record import COEFFICIENTS

#: How hard the drive pushes, in parts of what the oscillator moves by itself in two samples: at action 0, which swings
#: it up, and what an action of 1 adds; an action of -1 brakes.
_DRIVE, _DRIVE_SPAN = 0.06, 0.1

#: An oscillator that is within this part of the limit is at rest; it is pushed as if it moved by so much.
_REST, _NUDGE = 0.007, 0.05

_X0, _X1 = FEATURES.index("state_x0"), FEATURES.index("state_x1")


@dataclass(frozen=True)
class View:
    """What n observations look like with foresight.

    Attributes:
        features: (n, len(FEATURES)) float32 what the network sees.
        safe: (n, 3) whether a push up, none, a push down need not lead beyond the limit.
        signs: (n,) -1.0 where the observation was turned over.
        motions: (n,) the input that is all of the motion [V], upright.
    """

    features: npt.NDArray[np.float32]
    safe: npt.NDArray[np.bool_]
    signs: FloatArray
    motions: FloatArray


class Foresight:
    """What turns observations into features, and what a network chooses into actions.

    Args:
        outlook: what observations are relative to, and what is ahead.
    """

    def __init__(self, outlook: Outlook) -> None:
        self._outlook = outlook

    @classmethod
    def of(cls, env: Any, rate: FloatArray) -> Foresight:
        """That of an environment of duffing_env, single or vector, to train with.

        Args:
            env: the unwrapped environment.
            rate: (4, 4) information about the coefficients that a sample brings on average.

        Raises:
            ValueError: where the belief is not one of the difference equation with an unknown cubic coefficient, or an
                action is held for several samples.
        """
        if not _is_believed(env.experiment):
            raise ValueError(
                "env must believe the difference equation, with an unknown cubic coefficient, for foresight, but its "
                f"experiment is {type(env.experiment).__name__}; set foresight to false"
            )
        if env.experiment.hold != 1:
            raise ValueError(f"hold must be 1 for foresight, but is {env.experiment.hold}; set foresight to false")
        return cls(_outlook_of(env.experiment, rate))

    @classmethod
    def from_array(cls, numbers: npt.ArrayLike) -> Foresight:
        """That which `to_array` gave."""
        n = len(COEFFICIENTS)
        center, std, others, rate = np.split(np.asarray(numbers, dtype=np.float64), [n, 2 * n, 2 * n + 5])
        max_input, max_output, samples, energy, variance = others.tolist()
        return cls(Outlook(center, std, max_input, max_output, samples, energy, variance, rate.reshape(n, n)))

    def to_array(self) -> FloatArray:
        """All of it, flat, as a file holds it."""
        return np.concatenate([np.ravel(entry) for entry in self._outlook])

    def moved_to(self, env: Any) -> Foresight:
        """The same in another environment: with that one's prior, limits, noises and length.

        What a sample brings is taken to grow with the squares of what it is made of, beside those of the noises. Where
        the belief is another one than the difference equation's, or only one of the two inputs is limited in energy,
        it stays as it is.
        """
        if not _is_believed(env.experiment):
            return self
        here, there = self._outlook, _outlook_of(env.experiment, self._outlook.rate)
        if np.isfinite(here.energy) != np.isfinite(there.energy):
            return self
        x, u = there.max_output / here.max_output, there.max_input / here.max_input
        growth = np.array([x, x**3, x, u]) * np.sqrt(here.variance / there.variance)
        return Foresight(there._replace(rate=here.rate * np.outer(growth, growth)))

    @property
    def is_drive(self) -> bool:
        """Whether an action is how hard to push along the motion."""
        return bool(np.isfinite(self._outlook.energy))

    def look(self, observations: npt.ArrayLike) -> View:
        """What observations (n, features) look like."""
        return View(*look_at(observations, self._outlook))

    def act(self, choices: npt.ArrayLike, view: View) -> npt.NDArray[np.float32]:
        """The actions (n, 1) in [-1, 1] that a network's choices (n,) in [-1, 1] stand for."""
        chosen = np.clip(np.asarray(choices, dtype=np.float64), -1.0, 1.0)
        if self.is_drive:
            outlook = self._outlook
            at_rest = np.abs(view.features[:, [_X0, _X1]]).max(axis=1) < _REST
            nudge = _NUDGE * outlook.max_output / outlook.center[-1]
            motions = np.where(at_rest, nudge, view.motions)
            chosen = np.clip((_DRIVE + _DRIVE_SPAN * chosen) * motions / outlook.max_input, -1.0, 1.0)
        up, none, down = view.safe.T
        chosen = np.where((chosen > 0) & ~up, np.where(none, 0.0, -1.0), chosen)
        chosen = np.where((chosen < 0) & ~down, np.where(none, 0.0, 1.0), chosen)
        chosen = np.where((chosen == 0) & ~none, np.where(up, 1.0, -1.0), chosen)
        actions: npt.NDArray[np.float32] = (chosen * view.signs).astype(np.float32)[:, None]
        return actions


def _is_believed(experiment: Experiment) -> bool:
    """Whether an experiment's belief is that of the difference equation with an unknown cubic coefficient."""
    return experiment.estimator_kind != "ode" and experiment.is_nonlinear


def _outlook_of(experiment: Experiment, rate: FloatArray) -> Outlook:
    """What is ahead in an experiment."""
    settings = dict(zip(SETTINGS, experiment.settings.tolist(), strict=True))
    prior = experiment.believed
    return Outlook(
        center=np.array([settings[f"prior_{name}"] for name in COEFFICIENTS]),
        std=1.0 / np.array([settings[f"scale_{name}"] for name in COEFFICIENTS]),
        max_input=settings["max_input"],
        max_output=settings["max_output"],
        samples=settings["horizon"],
        energy=settings["budget"],
        variance=prior.gamma_rate / prior.gamma_shape + prior.xi_rate / prior.xi_shape,
        rate=np.asarray(rate, dtype=np.float64),
    )
