"""How the policies of the tracks of Eq. (1) look, that were trained before foresight read beliefs: by observations.

An observation does not hold the covariance of the state, nor that of state and coefficients. They are taken to be those
of a state that was just seen, and nothing. Where the energy is limited, an action is how hard to push along the motion.
A card whose foresight does not say ``reads_belief`` is of such a policy; it can go when these are trained anew.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.planner.motion import places, survey
from agents.policies.foresight import NUDGE, REST, THRIFT, CommonForesight, Sight, acted
from agents.policies.imagined import FEATURES
from estimator.belief import covariance_places
from estimator.parameters import FloatArray

#: Covariances of float32 correlations are made positive definite by this much.
_RIDGE = 1e-6

#: As `agents.policies.imagined.HASTE`.
_HASTE = 3.0

_FREE = [FEATURES.index(f"free_{t}") for t in (1, 2, 3)]


class RecalledForesight(CommonForesight):
    """`CommonForesight` by observations alone; arguments and errors are the same."""

    def __init__(self, env: Any, *, own: bool = False) -> None:
        super().__init__(env, own=own)
        setup, prior = env.experiment.setup, env.experiment.believed
        self._center, self._std, self._reach = prior.coefficients_mean, 1.0 / setup.inverse_std, setup.max_output
        self._variances = prior.noises[1:4:2] / prior.noises[0:3:2]
        self._ahead = self._ahead._replace(haste=_HASTE)
        gain = abs(survey(self._view.model, self._center, np.zeros(self._view.model.n_states)).gains[0])
        self._nudge = NUDGE * setup.max_output / (gain * self._terms.pace**2)

    def look(self, observations: npt.ArrayLike) -> Sight:
        """What observations (n, entries) look like."""
        seen, at = np.ascontiguousarray(observations, dtype=np.float32), places(self._view.model)
        records = self._recall(seen)
        sight = self._seen(seen, records)
        n, d = self._view.model.n_states, len(self._view.model.names)
        found = survey(self._view.model, records[:, n:d], records[:, :n])
        then = sight.signs * sight.features[:, _FREE[0]] * self._terms.limit
        motions = sight.signs * (found.velocities + then - found.shown) / self._terms.pace
        motions *= found.gains / np.maximum(found.gains**2, 1e-300)
        sight.features[:, THRIFT] = seen[:, at.budget_left]
        return Sight(sight.features, sight.safe, sight.signs, motions)

    def act(self, choices: npt.ArrayLike, view: Sight) -> npt.NDArray[np.float32]:
        """As `agents.policies.foresight.Foresight.act`."""
        motions, chosen = None, self._push * np.asarray(choices, dtype=np.float64)
        if np.isfinite(self._ahead.energy):
            at_rest = np.abs(view.features[:, _FREE]).max(axis=1) < REST
            motions, chosen = np.where(at_rest, self._nudge, view.motions), np.asarray(choices)
        return acted(chosen, view, motions, self._terms.amplitude, self._push)

    def _recall(self, seen: npt.NDArray[np.float32]) -> FloatArray:
        """The flat records (n, size) of beliefs that observations (n, entries) tell."""
        model, at = self._view.model, places(self._view.model)
        n, k = model.n_states, model.n_coefficients
        process, sensor = (self._variances[:, None] * np.exp(-seen[:, at.noise : at.noise + 2].T)).astype(np.float64)
        correlations = np.zeros((len(seen), k, k))
        rows, columns = np.triu_indices(k, 1)
        correlations[:, rows, columns] = seen[:, at.correlation : at.correlation + len(rows)]
        correlations += correlations.transpose(0, 2, 1) + (1.0 + _RIDGE) * np.eye(k)
        stds = self._std * np.exp(seen[:, at.log_std : at.log_std + k])
        joint = np.zeros((len(seen), n + k, n + k))
        joint[:, n:, n:] = stds[:, :, None] * stds[:, None] * correlations
        scales = (self._terms.scales / self._reach) ** 2
        joint[:, range(n), range(n)] = 0.5 * np.outer(process + sensor, scales)
        sensors = [np.ones(len(seen)), sensor] * model.n_outputs
        records = np.empty((len(seen), len(self._env.records[0])))
        records[:, :n] = self._reach * seen[:, at.state : at.state + n]
        records[:, n : n + k] = self._center + self._std * seen[:, at.mean : at.mean + k]
        records[:, covariance_places(model)] = joint
        records[:, -2 - 2 * model.n_outputs :] = np.transpose([np.ones(len(seen)), process, *sensors])
        return records
