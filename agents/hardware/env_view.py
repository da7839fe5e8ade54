"""What a policy sees of a run: the same as of an environment, read off the estimator's belief."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from duffing_env.storage.kernel_spec import observation_bounds
from duffing_env.tracks.rig_plant_env import RigPlantExperiment
from estimator.belief import Belief
from estimator.inference.free_run import output_at
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray


class EnvView:
    """Stands where a policy expects the unwrapped environment of the rig around its plant.

    Args:
        rig: of the run.
        prior: the belief that the run starts from.
        horizon: of the run.

    Attributes:
        experiment: that of ``Rig-v0`` around a plant.
        belief: the belief now; to be set.
        shown: (1, entries) what `observation` gave last.
    """

    def __init__(self, rig: Rig, prior: Belief, horizon: int) -> None:
        # The delay is the estimator's affair: a policy sees the belief that its input will meet.
        self.experiment = RigPlantExperiment(rig=replace(rig, delay=0), prior=prior, horizon=horizon)
        self.max_input, self.horizon = float(self.experiment.max_input), horizon
        self.belief = prior
        self.last_observations = self.observation(0.0, 0.0, 0)[None]

    @property
    def unwrapped(self) -> EnvView:
        """Itself."""
        return self

    @property
    def records(self) -> FloatArray:
        """(1, size) the belief now as the flat record of `estimator.Belief`."""
        return self.belief.record[None].copy()

    def observation(self, u: float, y: float, elapsed: int) -> npt.NDArray[np.float32]:
        """The observation (entries,) of `duffing_env.env`, after an input and an output in the belief's scales.

        Args:
            u: the last input.
            y: the last output; NaN, a missing one, is shown as what the model expects of the sensor.
            elapsed: samples since the run began.
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
            [u / self.max_input, y / self.experiment.max_output],
            [max(0.0, 1.0 - elapsed / self.horizon), 1.0],
        ])  # fmt: skip
        low, high = np.array(list(observation_bounds(belief.model).values())).T
        clipped: npt.NDArray[np.float32] = np.clip(values, low, high).astype(np.float32)
        self.last_observations = clipped[None]
        return clipped
