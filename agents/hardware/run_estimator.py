"""The estimator of a run: told what was applied, and asked for the belief that the next input meets."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from agents.planning.model_probe import believed_resonance, local_dynamics
from agents.planning.open_loop.posterior_samples import SystemDraws, draw_from_estimator
from estimator.belief import Belief, covariance_indices
from estimator.compilation.array_operations import copy as copy_numbers
from estimator.compilation.simd import kernel
from estimator.engine.noise_free_response import compile_noise_free_response
from estimator.identification.fitting.posterior_belief import refit_coefficients
from estimator.models.model import Model
from estimator.online import OnlineEstimator
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import reset_state, rig_prior
from estimator.support.array_types import FloatArray

#: A pause is of an unknown length up to so many periods, and never more samples.
_MAX_PAUSE_PERIODS, _MAX_PAUSE_SAMPLES = 2.0, 4_000

#: Where a system may be after a pause is taken apart into so many Gaussians, each wider by this part of the variance.
_N_COMPONENTS, _COMPONENT_INFLATION = 16, 0.01

#: What is so far out, in parts of the output's range, has run away.
_DIVERGED_OUTPUT = 3.0


@cache
def _compile_free_response(model: Model) -> Any:
    """``free_response(systems, u, lengths)``: states in rows, behind them coefficients, after a sample with u and pauses."""
    kernels = compile_noise_free_response(model)
    layout, step, n = kernels.layout, kernels.step, model.n_states
    size, n_variables, input_index = len(layout), len(model.names), layout["INPUT"]

    @kernel(variant=f"{model.name}_{model.digest}")
    def free_response(systems, u, lengths):
        W = np.zeros(size)
        for i in range(len(systems)):
            copy_numbers(W, 0, systems[i], n_variables)
            W[input_index] = u
            step(W)
            W[input_index] = 0.0
            for _ in range(lengths[i]):
                step(W)
            copy_numbers(systems[i], 0, W, n)

    return free_response


def _fit_gaussian_mixture(states: FloatArray) -> list[tuple[float, FloatArray, FloatArray]]:
    """A mixture of Gaussians for states (N, n): logarithm of the weight, mean and covariance of each."""
    from scipy.cluster.vq import kmeans2

    stds = states.std(axis=0)
    labels = kmeans2(states / stds, _N_COMPONENTS, seed=0, minit="++")[1]
    clusters = [states[labels == k] for k in range(_N_COMPONENTS)]
    return [
        (
            float(np.log(len(cluster) / len(states))),
            cluster.mean(axis=0),
            np.cov(cluster.T) + _COMPONENT_INFLATION * np.diag(stds**2),
        )
        for cluster in clusters
        if len(cluster) > states.shape[1]
    ]


class RunEstimator:
    """Follows a run. Sample k of a run is the output at a tick and the input that is applied from that tick on.

    Args:
        rig: with a guess, where there is no prior.
        prior: what is believed before the run, such as the ``belief`` of `online.identify`; the guess where None.
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
        self.delay, causal_rig = rig.integer_delay, replace(rig, delay=rig.integer_delay - 1)
        prior = rig_prior(rig) if prior is None else reset_state(prior)
        self._n_pauses = 0
        self._start_components: list[tuple[float, FloatArray, FloatArray]] = []
        self._systems_after_pause: SystemDraws | None = None
        self._rig, self._prior = rig, prior
        self._blocks: list[tuple[FloatArray, FloatArray]] = []
        self.online = OnlineEstimator(
            prior.model, prior, causal_rig, noise_hypotheses=(7, 7), expectations="sigma_points"
        )

    @property
    def belief(self) -> Belief:
        """At the last tick."""
        return self.online.belief

    def update(self, u: npt.ArrayLike, y: npt.ArrayLike) -> None:
        """Take outputs (N,) at ticks, NaN where one is missing, each with the input of the tick before it.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        components, self._start_components, self._systems_after_pause = self._start_components, [], None
        initial_arrays, best, best_evidence = self.online.arrays(), None, -np.inf
        for log_weight, mean, cov in components:
            self._set_state(mean, cov)
            try:
                evidence = log_weight - self.online.run(u, y, missing=True)[:, -1].sum()
            except ValueError:  # as far from the truth as that
                evidence = -np.inf
            if evidence > best_evidence:
                best, best_evidence = self.online.arrays(), evidence
            self.online.restore(initial_arrays)
        if best is None:
            self.online.run(u, y, missing=True)
        else:
            self.online.restore(best)

    def update_block(self, u: FloatArray, y: FloatArray) -> None:
        """Take a block: outputs (N,) at its ticks, NaN where one is missing, each with the input applied from it on.

        The coefficients are then what all blocks tell together. The first, a silent one, tells nothing of them.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        initial_arrays, components, previous_inputs = (
            self.online.arrays(),
            self._start_components,
            np.concatenate([[0.0], u[:-1]]),
        )
        self.update(previous_inputs, y)
        self._blocks.append((u, y))
        if len(self._blocks) == 1:
            return
        coefficients, first_pass = (
            refit_coefficients(self._rig, self._blocks, self._prior, self.belief),
            self.online.arrays(),
        )
        # Where the rig is now is what the block tells of a rig with these coefficients.
        self.online.restore(initial_arrays)
        self._start_components = components
        self._set_coefficients(*coefficients)
        try:
            self.update(previous_inputs, y)
        except ValueError:  # it overflows with these: the state stays that of the first time
            self.online.restore(first_pass)
        self._set_coefficients(*coefficients)

    def compile_block_update(self) -> None:
        """Compile what `update_block` calls."""
        refit_coefficients(self._rig, [(np.zeros(8), np.zeros(8))] * 2, self._prior, self.belief)

    def draw_systems(self, rng: np.random.Generator) -> SystemDraws:
        """States and coefficients (draws, d) and noises (draws, 2) of systems that are believed in now.

        After a pause they are those that rang: a Gaussian of their states would put many out of the range.
        """
        return self._systems_after_pause or draw_from_estimator(self.online, rng)

    def predict_ahead(self, u: float) -> Belief:
        """When the next input begins to act, if the one in force is u; nothing changes."""
        copied = copy.copy(self.online)  # `run` leaves what it shares as it is
        inputs = np.zeros(1 + self.delay)
        inputs[0] = u
        copied.run(inputs, np.full(len(inputs), np.nan), missing=True)
        return copied.belief

    def start_pause(self, u: float) -> None:
        """A pause of unknown length without input begins, after a last sample with u. What is known of the state fades.

        The state becomes what it may be after any of the lengths; coefficients and noises stay as they are.

        Raises:
            ValueError: where most of what is believed runs away by itself.
        """
        rng = np.random.default_rng(self._n_pauses)
        self._n_pauses += 1
        systems, noises = draw_from_estimator(self.online, rng)
        systems = np.ascontiguousarray(systems)
        n, max_pause = (
            self.online.model.n_states,
            int(np.clip(_MAX_PAUSE_PERIODS / believed_resonance(self.belief), 8, _MAX_PAUSE_SAMPLES)),
        )
        # Each rings by itself: of two wells, a linear forecast would not know that they hold.
        _compile_free_response(self.online.model)(
            systems, u / self.online.scales.input, rng.integers(max_pause, size=len(systems))
        )
        states = systems[:, :n]
        outputs = local_dynamics(self.online.model, systems[:, n:], states).outputs_shown
        kept = states[(np.abs(outputs) < _DIVERGED_OUTPUT) & np.isfinite(states).all(axis=1)]
        if len(kept) < len(states) / 2:
            raise ValueError(
                "rig must be known well enough to stay in its range between blocks, but most of what is believed runs "
                "away; give a narrower guess, or run sample by sample"
            )
        self.online.rewind()
        self._set_state(kept.mean(axis=0), np.cov(kept.T))
        self._systems_after_pause = systems, noises
        self._start_components = _fit_gaussian_mixture(kept)

    def _set_state(self, mean: FloatArray, cov: FloatArray) -> None:
        arrays, model = self.online.arrays(), self.online.model
        n, places = model.n_states, covariance_indices(model)
        arrays["records"][:, :n] = mean
        arrays["records"][:, places[:n, :n]] = cov
        self.online.restore(arrays)

    def _set_coefficients(self, mean: FloatArray, cov: FloatArray) -> None:
        arrays, model = self.online.arrays(), self.online.model
        n, d, places = model.n_states, len(model.names), covariance_indices(model)
        arrays["records"][:, n:d] = mean
        arrays["records"][:, places[n:, n:]] = cov
        arrays["records"][:, places[:n, n:]] = 0.0
        self.online.restore(arrays)
