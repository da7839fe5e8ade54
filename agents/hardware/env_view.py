"""A run as an environment: observation and belief for a policy, computed from the estimator of the run."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from duffing_env.env_common import action_space
from duffing_env.storage.kernel_spec import observation_bounds
from duffing_env.tracks.external_plant_env import RigPlantExperiment
from estimator.belief import Belief
from estimator.inference.free_run import output_at
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray


class EnvView:
    """The object that takes the place of the unwrapped environment ``Rig-v0`` for a policy.

    Args:
        rig: of the run.
        prior: the belief at the start of the run.
        horizon: number of samples of the run.

    Attributes:
        experiment: the experiment of ``Rig-v0`` around a plant.
        max_input: largest input, in the belief's scale; of several inputs by their names.
        max_inputs: (inputs,) the same as an array.
        action_space: of ``Rig-v0``.
        horizon: number of samples of the run.
        belief: the belief now; the run sets it.
        last_observations: (1, entries) the last result of `observation`.
    """

    def __init__(self, rig: Rig, prior: Belief, horizon: int) -> None:
        # The estimator takes the delay into account: a policy gets the belief at the time when its input acts.
        self.experiment = RigPlantExperiment(rig=replace(rig, delay=0), prior=prior, horizon=horizon)
        self.max_input, self.max_inputs, self.horizon = self.experiment.max_input, self.experiment.max_inputs, horizon
        self.action_space = action_space(self.experiment)
        self.belief = prior
        self.last_observations = self.observation(np.zeros(len(self.max_inputs)), 0.0, 0)[None]

    @property
    def unwrapped(self) -> EnvView:
        """This object."""
        return self

    @property
    def records(self) -> FloatArray:
        """The belief now as the flat record (1, size) of `estimator.Belief`."""
        return self.belief.record[None].copy()

    def observation(self, u: float | FloatArray, y: float, elapsed: int) -> npt.NDArray[np.float32]:
        """The observation (entries,) of ``Rig-v0``, after an input and an output in the belief's scales.

        Args:
            u: the last input, or (inputs,) inputs.
            y: the last output; NaN, a missing output, is replaced by the model's prediction.
            elapsed: samples since the start of the run.
        """
        belief, prior = self.belief, self.experiment.prior_belief
        cov, prior_stds = belief.coefficients_cov, np.sqrt(np.diag(prior.coefficients_cov))
        stds = np.sqrt(np.diag(cov))
        pairs = list(combinations(range(len(stds)), 2))
        log_noise_ratios = np.log(belief.noises[::2] / belief.noises[1::2]) - np.log(
            prior.noises[::2] / prior.noises[1::2]
        )
        if np.isnan(y):
            y = output_at(belief.model, belief.coefficients_mean, belief.state_mean, u)
        values = np.concatenate([
            (belief.coefficients_mean - prior.coefficients_mean) / prior_stds,
            np.log(stds / prior_stds),
            [cov[i, j] / (stds[i] * stds[j]) for i, j in pairs],
            log_noise_ratios,
            belief.state_mean / self.experiment.max_output,
            u / self.max_inputs,
            [y / self.experiment.max_output],
            [max(0.0, 1.0 - elapsed / self.horizon), 1.0],
        ])  # fmt: skip
        low, high = np.array(list(observation_bounds(belief.model).values())).T
        clipped: npt.NDArray[np.float32] = np.clip(values, low, high).astype(np.float32)
        self.last_observations = clipped[None]
        return clipped
