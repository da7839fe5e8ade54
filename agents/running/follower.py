"""The estimator of a run: told what was applied, and asked for the belief that the next input meets."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from agents.planner.motion import resonances, survey
from estimator.belief import Belief, covariance_places
from estimator.online import OnlineEstimator
from estimator.parameters import FloatArray
from estimator.rig import Rig
from estimator.rig_prior import rig_prior

#: A pause is of an unknown length up to so many periods, and never more samples.
_PERIODS, _LONGEST = 2.0, 4_000

#: Lengths of it that are looked at.
_LENGTHS = 40


class Follower:
    """Follows a run. Sample k of a run is the output at a tick and the input that is applied from that tick on.

    Args:
        rig: with a guess.
        prior: what is believed before the run, such as the ``belief`` of `estimator.identify`; the guess where None.
        pauses: whether there will be some. The state is then known so little that a derivative at its mean would learn
            too much from the first samples after them: points that spread as the belief does take its place.

    Raises:
        ValueError: for a rig without a guess, or whose input is not held, or comes early.
    """

    def __init__(self, rig: Rig, prior: Belief | None = None, pauses: bool = False) -> None:
        if rig.interpolation != "zero_order":
            raise ValueError(
                f"interpolation must be 'zero_order' for a run, whose inputs are held, but is {rig.interpolation!r}"
            )
        if rig.delay < 0:
            raise ValueError(f"delay must be 0 or more for a run, but is {rig.delay}; an input acts after its tick")
        if rig.guess is None:
            raise ValueError("rig must have a guess of m, c, a and b for a run, but has none; add one to the rig")
        # What came before an output is given with it: so the belief is that of the tick, before the next input.
        self.delay, paired = rig.delay, replace(rig, delay=rig.delay - 1)
        prior = rig_prior(rig) if prior is None else prior
        expectations = "sigma_points" if pauses else "first_order"
        self.estimator = OnlineEstimator(prior.model, prior, paired, noise_hypotheses=9, expectations=expectations)

    @property
    def belief(self) -> Belief:
        """At the last tick."""
        return self.estimator.belief

    def take(self, u: npt.ArrayLike, y: npt.ArrayLike) -> None:
        """Take outputs (N,) at ticks, NaN where one is missing, each with the input of the tick before it.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        self.estimator.run(u, y, missing=True)

    def ahead(self, u: float) -> Belief:
        """When the next input begins to act, if the one in force is u; nothing changes."""
        return self._after(u, 1 + self.delay).belief

    def pause(self, u: float) -> None:
        """A pause of unknown length without input begins, after a last sample with u. What is known of the state fades.

        The state becomes what it may be after any of the lengths; coefficients and noises stay as they are.
        """
        longest = self._pause_samples()
        step = max(1, longest // _LENGTHS)
        later, means, covs = self._after(u, 1 + self.delay), [], []
        for _ in range(_LENGTHS):
            means.append(later.belief.state_mean)
            covs.append(later.belief.state_cov)
            later.run(np.zeros(step), np.full(step, np.nan), missing=True)
        mean = np.mean(means, axis=0)
        cov = np.mean(covs, axis=0) + np.cov(np.array(means).T, bias=True)
        self.estimator.rewind()
        self._put_state(mean, cov)

    def _after(self, u: float, samples: int) -> OnlineEstimator:
        """A copy that has followed so many samples without outputs: one with u, the others with none."""
        later = copy.copy(self.estimator)  # `run` leaves what it shares as it is
        inputs = np.zeros(samples)
        inputs[0] = u
        later.run(inputs, np.full(samples, np.nan), missing=True)
        return later

    def _pause_samples(self) -> int:
        belief = self.belief
        found = survey(belief.model, belief.coefficients_mean, np.zeros(belief.model.n_states))
        cycles = float(resonances(belief.model, found.slopes)[0])
        return int(np.clip(_PERIODS / max(cycles, 1e-9), _LENGTHS, _LONGEST))

    def _put_state(self, mean: FloatArray, cov: FloatArray) -> None:
        arrays, model = self.estimator.arrays(), self.estimator.model
        n, places = model.n_states, covariance_places(model)
        arrays["records"][:, :n] = mean
        arrays["records"][:, places[:n, :n]] = cov
        self.estimator.restore(arrays)
