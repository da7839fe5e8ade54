"""The estimator of a run: told what was applied, and asked for the belief that the next input meets."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.planner.futures import Drawn, drawn_from
from agents.planner.motion import frequency, survey
from estimator.arrays import copy as copy_numbers
from estimator.belief import Belief, covariance_places
from estimator.engine.motion import motion
from estimator.identification.beliefs import refit
from estimator.lanes import kernel
from estimator.models.model import Model
from estimator.online import OnlineEstimator
from estimator.parameters import FloatArray
from estimator.rig import Rig
from estimator.rig_prior import begun_again, rig_prior

#: A pause is of an unknown length up to so many periods, and never more samples.
_PERIODS, _LONGEST = 2.0, 4_000

#: Where a system may be after a pause is taken apart into so many Gaussians, each wider by this part of the variance.
_PARTS, _WIDER = 16, 0.01

#: What is so far out, in parts of the output's range, has run away.
_FAR = 3.0


@cache
def _ringer(model: Model) -> Any:
    """``ring(systems, u, lengths)``: states in rows, behind them coefficients, after a sample with u and pauses."""
    found = motion(model)
    at, step, n = found.layout, found.step, model.n_states
    size, d, place = len(at), len(model.names), at["INPUT"]

    @kernel(kind=f"{model.name}_{model.digest}")
    def ring(systems, u, lengths):
        W = np.zeros(size)
        for i in range(len(systems)):
            copy_numbers(W, 0, systems[i], d)
            W[place] = u
            step(W)
            W[place] = 0.0
            for _ in range(lengths[i]):
                step(W)
            copy_numbers(systems[i], 0, W, n)

    return ring


def _parts(states: FloatArray) -> list[tuple[float, FloatArray, FloatArray]]:
    """A mixture of Gaussians for states (N, n): logarithm of the weight, mean and covariance of each."""
    from scipy.cluster.vq import kmeans2

    size = states.std(axis=0)
    labels = kmeans2(states / size, _PARTS, seed=0, minit="++")[1]
    parts = [states[labels == k] for k in range(_PARTS)]
    return [
        (float(np.log(len(part) / len(states))), part.mean(axis=0), np.cov(part.T) + _WIDER * np.diag(size**2))
        for part in parts
        if len(part) > states.shape[1]
    ]


class Follower:
    """Follows a run. Sample k of a run is the output at a tick and the input that is applied from that tick on.

    Args:
        rig: with a guess, where there is no prior.
        prior: what is believed before the run, such as the ``belief`` of `estimator.identify`; the guess where None.
            Nobody knows what the rig did since: its state does not count.

    Raises:
        ValueError: for a rig with neither guess nor prior, or whose input is not held, or comes early.
    """

    def __init__(self, rig: Rig, prior: Belief | None = None) -> None:
        if rig.interpolation != "zero_order":
            raise ValueError(
                f"interpolation must be 'zero_order' for a run, whose inputs are held, but is {rig.interpolation!r}"
            )
        if rig.delay < 0:
            raise ValueError(f"delay must be 0 or more for a run, but is {rig.delay}; an input acts after its tick")
        if rig.guess is None and prior is None:
            raise ValueError(
                "rig must have a guess of m, c, a and b for a run, but has none; add one, or go on from a posterior"
            )
        # What came before an output is given with it: so the belief is that of the tick, before the next input.
        self.delay, paired = rig.whole_delay, replace(rig, delay=rig.whole_delay - 1)
        prior = rig_prior(rig) if prior is None else begun_again(prior)
        self._paused = 0
        self._starts: list[tuple[float, FloatArray, FloatArray]] = []
        self._rung: Drawn | None = None
        self._rig, self._prior = rig, prior
        self._blocks: list[tuple[FloatArray, FloatArray]] = []
        self.estimator = OnlineEstimator(
            prior.model, prior, paired, noise_hypotheses=(7, 7), expectations="sigma_points"
        )

    @property
    def belief(self) -> Belief:
        """At the last tick."""
        return self.estimator.belief

    def take(self, u: npt.ArrayLike, y: npt.ArrayLike) -> None:
        """Take outputs (N,) at ticks, NaN where one is missing, each with the input of the tick before it.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        starts, self._starts, self._rung = self._starts, [], None
        begun, best, most = self.estimator.arrays(), None, -np.inf
        for logarithm, mean, cov in starts:
            self._put_state(mean, cov)
            try:
                evidence = logarithm - self.estimator.run(u, y, missing=True)[:, -1].sum()
            except ValueError:  # as far from the truth as that
                evidence = -np.inf
            if evidence > most:
                best, most = self.estimator.arrays(), evidence
            self.estimator.restore(begun)
        if best is None:
            self.estimator.run(u, y, missing=True)
        else:
            self.estimator.restore(best)

    def take_block(self, u: FloatArray, y: FloatArray) -> None:
        """Take a block: outputs (N,) at its ticks, NaN where one is missing, each with the input applied from it on.

        The coefficients are then what all blocks tell together. The first, a silent one, tells nothing of them.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        begun, starts, before = self.estimator.arrays(), self._starts, np.concatenate([[0.0], u[:-1]])
        self.take(before, y)
        self._blocks.append((u, y))
        if len(self._blocks) == 1:
            return
        coefficients, taken = refit(self._rig, self._blocks, self._prior, self.belief), self.estimator.arrays()
        # Where the rig is now is what the block tells of a rig with these coefficients.
        self.estimator.restore(begun)
        self._starts = starts
        self._put_coefficients(*coefficients)
        try:
            self.take(before, y)
        except ValueError:  # it overflows with these: the state stays that of the first time
            self.estimator.restore(taken)
        self._put_coefficients(*coefficients)

    def practise(self) -> None:
        """Compile what `take_block` calls."""
        refit(self._rig, [(np.zeros(8), np.zeros(8))] * 2, self._prior, self.belief)

    def drawn(self, rng: np.random.Generator) -> Drawn:
        """States and coefficients (draws, d) and noises (draws, 2) of systems that are believed in now.

        After a pause they are those that rang: a Gaussian of their states would put many out of the range.
        """
        return self._rung or drawn_from(self.estimator, rng)

    def ahead(self, u: float) -> Belief:
        """When the next input begins to act, if the one in force is u; nothing changes."""
        later = copy.copy(self.estimator)  # `run` leaves what it shares as it is
        inputs = np.zeros(1 + self.delay)
        inputs[0] = u
        later.run(inputs, np.full(len(inputs), np.nan), missing=True)
        return later.belief

    def pause(self, u: float) -> None:
        """A pause of unknown length without input begins, after a last sample with u. What is known of the state fades.

        The state becomes what it may be after any of the lengths; coefficients and noises stay as they are.

        Raises:
            ValueError: where most of what is believed runs away by itself.
        """
        rng = np.random.default_rng(self._paused)
        self._paused += 1
        systems, noises = drawn_from(self.estimator, rng)
        systems = np.ascontiguousarray(systems)
        n, longest = self.estimator.model.n_states, int(np.clip(_PERIODS / frequency(self.belief), 8, _LONGEST))
        # Each rings by itself: of two wells, a linear forecast would not know that they hold.
        _ringer(self.estimator.model)(
            systems, u / self.estimator.scales.input, rng.integers(longest, size=len(systems))
        )
        states = systems[:, :n]
        shown = survey(self.estimator.model, systems[:, n:], states).shown
        kept = states[(np.abs(shown) < _FAR) & np.isfinite(states).all(axis=1)]
        if len(kept) < len(states) / 2:
            raise ValueError(
                "rig must be known well enough to stay in its range between blocks, but most of what is believed runs "
                "away; give a narrower guess, or run sample by sample"
            )
        self.estimator.rewind()
        self._put_state(kept.mean(axis=0), np.cov(kept.T))
        self._rung = systems, noises
        self._starts = _parts(kept)

    def _put_state(self, mean: FloatArray, cov: FloatArray) -> None:
        arrays, model = self.estimator.arrays(), self.estimator.model
        n, places = model.n_states, covariance_places(model)
        arrays["records"][:, :n] = mean
        arrays["records"][:, places[:n, :n]] = cov
        self.estimator.restore(arrays)

    def _put_coefficients(self, mean: FloatArray, cov: FloatArray) -> None:
        arrays, model = self.estimator.arrays(), self.estimator.model
        n, d, places = model.n_states, len(model.names), covariance_places(model)
        arrays["records"][:, n:d] = mean
        arrays["records"][:, places[n:, n:]] = cov
        arrays["records"][:, places[:n, n:]] = 0.0
        self.estimator.restore(arrays)
