"""What a policy sees of a run: the same as of an environment, read off the estimator's belief."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from duffing_env.experiment import Experiment
from duffing_env.layout import observation_bounds
from estimator.belief import Belief
from estimator.models.model import Model
from estimator.parameters import FloatArray


@dataclass(frozen=True)
class RunExperiment(Experiment):
    """The experiment that a run is, in the numbers near one in which its belief is.

    Attributes:
        prior: the belief that the run starts from.
        horizon: its samples.
    """

    prior: Belief | None = None
    horizon: int = 256

    @property
    def samples(self) -> int:
        """The horizon."""
        return self.horizon

    @property
    def model(self) -> Model:
        """That of the prior."""
        return self.believed.model

    @property
    def step(self) -> float:
        """That of the prior."""
        return self.believed.step

    @property
    def believed(self) -> Belief:
        """The prior."""
        assert self.prior is not None
        return self.prior


class Observed:
    """Stands where a policy expects an unwrapped environment.

    Args:
        prior: the belief that the run starts from.
        max_input: limit of the input, in the belief's scale.
        max_output: of the output.
        samples: of the run.

    Attributes:
        experiment: limits, horizon and prior.
        belief: the belief now; to be set.
    """

    def __init__(self, prior: Belief, max_input: float, max_output: float, samples: int) -> None:
        self.experiment = RunExperiment(prior=prior, horizon=samples, max_input=max_input, max_output=max_output)
        self.max_input, self.horizon = max_input, samples
        self.belief = prior

    @property
    def unwrapped(self) -> Observed:
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
            y: the last output; NaN, a missing one, is shown as what is believed of it.
            elapsed: samples since the run began.
        """
        belief, prior, model = self.belief, self.experiment.believed, self.belief.model
        cov, first = belief.coefficients_cov, np.sqrt(np.diag(prior.coefficients_cov))
        stds = np.sqrt(np.diag(cov))
        pairs = list(combinations(range(model.n_coefficients), 2))
        precisions = np.log(belief.noises[::2] / belief.noises[1::2]) - np.log(prior.noises[::2] / prior.noises[1::2])
        states = belief.state_mean / self.experiment.max_output
        values = np.concatenate([
            (belief.coefficients_mean - prior.coefficients_mean) / first,
            np.log(stds / first),
            [cov[i, j] / (stds[i] * stds[j]) for i, j in pairs],
            precisions,
            states,
            [u / self.max_input, states[0] if np.isnan(y) else y / self.experiment.max_output],
            [max(0.0, 1.0 - elapsed / self.horizon), 1.0],
        ])  # fmt: skip
        low, high = np.array(list(observation_bounds(model).values())).T
        shown: npt.NDArray[np.float32] = np.clip(values, low, high).astype(np.float32)
        return shown
