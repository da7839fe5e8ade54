"""Foresight: a network sees what its belief expects of simple inputs, and is kept from what would end the episode.

The best input is a sharp function of the belief: it turns over where a push would come too late or lead too far. A
network learns such a function poorly from means, deviations and displacements. It learns it well from what the believed
oscillator does with a push up, none or a push down, and what that would teach (`agents.policies.imagined`). Four
things are done for it:

- **Features.** Where the model is odd, observations are turned upright, so that the first sensor shows nothing
  negative, and the action is turned back.
- **A measure.** A push is as hard as that of the best imagined way that begins in its direction.
- **A shield.** An action in whose direction no way is left to stay within the displacement limit is replaced by none,
  or by a push the other way, whichever is safe. So also a policy that still tries its actions out seldom ends an
  episode, and learns to go close to the limit.
- **A burst**, where the energy is limited: the action is how much harder to push than the best burst does that is
  imagined to the end of the episode (`agents.policies.bursts`), not the input itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.asked import check_shown
from agents.planner.fading import faded_of
from agents.planner.imagination import RISK, Terms, margin
from agents.planner.motion import View, is_of_rig, limit_of, places, reach_of, shaken_of, survey, swing_of
from agents.policies.bursts import burster, drawn
from agents.policies.imagined import BOUND, FEATURES, HASTE, Ahead, as_feature, imaginer, look_ahead
from agents.policies.prospects import EXPECTED, Outlook, feature_names, look_at
from agents.policies.sight import Sight
from duffing_env.experiment import Experiment
from estimator.models.difference import difference
from estimator.models.model import Model
from estimator.parameters import FloatArray

#: A push alone changes the displacement by no more than half of this part of its limit in a move.
_LEAP = 1.0

#: What a sample of the rest of an episode brings, in parts of one of a swing at the limit. All of it praises ways that
#: teach what such a swing does not, such as to rest with a push on.
_USUAL = 0.1

#: Chance that an episode on a simulated plant leaves the limit if every output were at the margin from it. The
#: planner's is smaller, and so is that of policies on a rig: here an early end costs only what would have been learned.
_RISK = 0.02

_HARDER, _AS_IT_IS = (FEATURES.index(f"best_{way}_whole") for way in ("up", "none"))


class Foresight:
    """What turns observations into features, and what a network chooses into actions.

    Args:
        outlook: what observations are relative to, and what is ahead.
        view: how the believed model is taken.
    """

    def __init__(self, outlook: Outlook, view: View | None = None) -> None:
        self._outlook = outlook
        self._view = view or View(difference())

    @classmethod
    def of(cls, env: Any, rate: FloatArray) -> Foresight:
        """That of an environment of duffing_env, single or vector, to train with.

        Args:
            env: the unwrapped environment.
            rate: (K, K) information about the coefficients that a sample brings on average.

        Raises:
            ValueError: where an action is held for several samples.
        """
        if env.experiment.hold != 1:
            raise ValueError(f"hold must be 1 for foresight, but is {env.experiment.hold}; set foresight to false")
        return cls(_outlook_of(env.experiment, rate), View.of(env.experiment))

    @classmethod
    def from_array(cls, numbers: npt.ArrayLike, view: dict[str, Any] | None = None) -> Foresight:
        """That which `to_array` and `describe` gave; a policy without a description believes Eq. (2)."""
        described = dict(view or {})
        model = Model(**described.pop("model")) if "model" in described else difference()
        k = model.n_coefficients
        flat = np.asarray(numbers, dtype=np.float64)
        # All but the energy, which may be without limit, are finite; deviations, limits and noises are positive.
        if flat.shape != (2 * k + 6 + k * k,) or not np.isfinite(np.delete(flat, 2 * k + 3)).all():
            raise ValueError(f"foresight must be {2 * k + 6 + k * k} finite numbers, but is {flat.tolist()!r:.200}")
        if not (flat[k : 2 * k + 6] > 0).all():
            raise ValueError(f"foresight must have positive deviations and limits, but has {flat[k : 2 * k + 6]}")
        center, std, others, rate = np.split(flat, [k, 2 * k, 2 * k + 6])
        max_input, max_output, samples, energy, process, sensor = others.tolist()
        seen = View(model, **described)
        sizes = swing_of(seen, center, max_input, max_output).scales
        rate = rate.reshape(k, k)
        return cls(Outlook(center, std, max_input, max_output, samples, energy, process, sensor, rate, sizes), seen)

    def to_array(self) -> FloatArray:
        """All of it but the model, flat, as a file holds it."""
        return np.concatenate([np.ravel(entry) for entry in self._outlook[:-1]])

    def to_tensors(self) -> dict[str, FloatArray]:
        """The same, by the name that a policy's file has it under."""
        return {"foresight": self.to_array()}

    def describe(self) -> dict[str, Any]:
        """The model and how it is taken, as JSON can hold it."""
        return {"model": self._view.model.to_dict(), "degree": self._view.degree, "lag": self._view.lag}

    def moved_to(self, env: Any) -> Foresight:
        """The same in another environment: with that one's prior, limits, noises and length.

        What a sample brings is taken to grow with the squares of what it is made of, beside those of the noises. Where
        the belief is of another model, or only one of the two inputs is limited in energy, it stays as it is.
        """
        if View.of(env.experiment) != self._view:
            return self
        here, there = self._outlook, _outlook_of(env.experiment, self._outlook.rate)
        if np.isfinite(here.energy) != np.isfinite(there.energy):
            return self
        at_limits = (survey(self._view.model, here.center, o.scales, o.max_input) for o in (here, there))
        made, made_there = (found.regressors[0] for found in at_limits)
        growth = np.abs(np.divide(made_there, made, out=np.ones_like(made), where=made != 0))
        growth *= np.sqrt((here.process + here.sensor) / (there.process + there.sensor))
        return Foresight(there._replace(rate=here.rate * np.outer(growth, growth)), self._view)

    @property
    def observation_size(self) -> int:
        """Entries of the observations that it looks at."""
        return places(self._view.model).size

    @property
    def features(self) -> int:
        """What a network sees."""
        return len(feature_names(self._view.model))

    @property
    def to_come(self) -> int:
        """Which of the features is what is still to come."""
        return self.features - len(EXPECTED) + EXPECTED.index("to_come")

    def look(self, observations: npt.ArrayLike) -> Sight:
        """What observations (n, features) look like."""
        found = look_at(observations, self._outlook, self._view)
        return Sight(*found, np.ones((len(found[0]), 2)), np.ones(len(found[0])))


class CommonForesight:
    """A policy's look at the belief and model of its environment, single or vector; no function of the observation.

    So such a policy plays the environment that it was made for, and no other, and sees its observations as they are.
    What it sees is `agents.policies.imagined`, of the environment's beliefs as the planner reads them; nothing of it is
    of the systems that a policy was trained on. So with that alone a policy plays any environment. Beside the
    observation itself it tells more of one model, and a policy plays environments of that. Outputs keep a margin
    (`agents.planner.imagination.margin`) from the planner's limit (`agents.planner.motion.limit_of`): on a rig the
    planner's own, else one for a risk of 2 % in place of 0.1 %.

    An action is a push. Where the energy is limited it is how much harder to push than the best burst, and the features
    of what is best tell what harder, as hard and softer ways bring, in place of a push up, none and a push down.

    Args:
        env: the unwrapped environment.
        own: whether the observation stands behind the features, turned upright.

    Raises:
        ValueError: where an action is held for several samples, or ``env`` is not one of duffing_env.
    """

    def __init__(self, env: Any, *, own: bool = False) -> None:
        experiment: Experiment | None = getattr(env, "experiment", None)
        if experiment is None:
            raise ValueError(
                f"env must be one of duffing_env for foresight, but is {type(env).__name__}; pass that one"
            )
        if experiment.hold != 1:
            raise ValueError(f"hold must be 1 for foresight, but is {experiment.hold}; set foresight to false")
        setup, prior, self._view = experiment.setup, experiment.believed, View.of(experiment)
        center = prior.coefficients_mean
        swing = swing_of(self._view, center, setup.max_input, setup.max_output)
        rate = _USUAL * swing.taught / sum(float(rate / shape) for shape, rate in (prior.noises[:2], prior.noises[2:4]))
        gain = abs(survey(self._view.model, center, np.zeros(self._view.model.n_states)).gains[0]) * swing.pace**2
        push = min(setup.max_input, _LEAP * setup.max_output / gain)
        # A limit of energy allows for smaller pushes, under which a swing takes longer to build.
        lasting = min(setup.max_input, HASTE * float(np.sqrt(setup.budget / setup.horizon)))
        slow = swing if lasting == setup.max_input else swing_of(self._view, center, lasting, setup.max_output)
        moves, most = look_ahead(slow.built / swing.pace, setup.horizon / swing.pace)
        known = np.asarray(np.linalg.inv(prior.coefficients_cov), dtype=np.float64)
        risk = RISK if is_of_rig(experiment) else _RISK
        self._ahead = Ahead(push, moves, most, setup.horizon, setup.budget, rate, known)
        self._terms = Terms(
            setup.max_input,
            np.inf,
            limit_of(experiment, swing.scales),
            margin(int(setup.horizon), risk),
            np.zeros(len(center)),
            swing.scales,
            swing.pace,
            shaken_of(experiment, swing),
            firm=1.0,
            faded=faded_of(slow),
            reach=reach_of(experiment, self._view, swing),
        )
        at, model = places(self._view.model), self._view.model
        odd = (*range(at.state, at.state + model.n_states), at.last_input)
        self._odd = (*odd, *range(at.last_output, at.last_output + model.n_outputs))
        self._own, self._env = own, env

    def to_tensors(self) -> dict[str, FloatArray]:
        """Nothing: all of it is taken from the environment at hand."""
        return {}

    def describe(self) -> dict[str, Any]:
        """As `Foresight.describe`."""
        return {"is_common": True}

    @property
    def observation_size(self) -> int:
        """Entries of the observations that it looks at."""
        return places(self._view.model).size

    @property
    def features(self) -> int:
        """What a network sees."""
        return len(FEATURES) + self._own * self.observation_size

    @property
    def to_come(self) -> int:
        """As `Foresight.to_come`."""
        return FEATURES.index("to_come")

    def look(self, observations: npt.ArrayLike) -> Sight:
        """What the environment's beliefs look like, which it has just shown in observations (n, entries).

        Raises:
            ValueError: for observations that it did not show last.
        """
        seen = np.ascontiguousarray(observations, dtype=np.float32)
        check_shown(self._env, seen)
        return self._seen(seen, self._env.records)

    def _seen(self, seen: npt.NDArray[np.float32], records: FloatArray) -> Sight:
        """What beliefs look like."""
        n, largest, limited = len(seen), self._terms.amplitude, np.isfinite(self._ahead.energy)
        features, safe = np.empty((n, len(FEATURES)), dtype=np.float32), np.empty((n, 3), dtype=np.bool_)
        signs, shares, bursts, worths = np.empty(n), np.empty((n, 2)), np.zeros(n), np.empty((n, 3))
        if limited:
            episode = float(self._ahead.samples), self._ahead.energy
            burster(self._view)(records, seen, *episode, self._terms, drawn(), bursts, worths)
        # What is foreseen to be safe is so for pushes that are no harder than these.
        pushes = np.abs(bursts)
        imaginer(self._view)(records, seen, self._ahead, self._terms, features, safe, signs, shares, pushes)
        if limited:
            harder, best, softer = worths.T
            features[:, _HARDER] = as_feature(harder - softer)
            features[:, _AS_IT_IS] = np.maximum(1.0, as_feature(best - np.maximum(harder, softer)))
        if self._own:
            upright = np.clip(seen, -BOUND, BOUND)
            upright[:, self._odd] *= signs[:, None].astype(np.float32)
            features = np.concatenate([features, upright], axis=1)
        return Sight(features, safe, signs, shares, pushes / largest, bursts / largest if limited else None)


def _outlook_of(experiment: Experiment, rate: FloatArray) -> Outlook:
    """What is ahead in an experiment."""
    setup, center = experiment.setup, experiment.believed.coefficients_mean
    return Outlook(
        center=center,
        std=1.0 / setup.inverse_std,
        max_input=setup.max_input,
        max_output=setup.max_output,
        samples=setup.horizon,
        energy=setup.budget,
        process=float(np.exp(-setup.log_precisions[0])),
        sensor=float(np.exp(-setup.log_precisions[1])),
        rate=np.asarray(rate, dtype=np.float64),
        scales=swing_of(View.of(experiment), center, setup.max_input, setup.max_output).scales,
    )
