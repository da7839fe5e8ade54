"""The estimator of a run: the belief from applied inputs and outputs, predicted to when the next input acts."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from agents.planning.model_probe import believed_resonance, only_input_rows, probe_dynamics
from agents.planning.open_loop.posterior_samples import SystemDraws, draw_from_estimator
from estimator.belief import Belief, covariance_indices
from estimator.compilation.array_operations import copy as copy_numbers
from estimator.compilation.simd import kernel
from estimator.engine.noise_free_step import compile_noise_free_step
from estimator.identification.fitting.posterior_belief import refit_coefficients
from estimator.models.model import Model
from estimator.online import OnlineEstimator
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import reset_state, rig_prior
from estimator.support.array_types import FloatArray

#: Longest pause between two blocks, whose length is unknown [periods of small motions].
_MAX_PAUSE_PERIODS = 2.0

#: The same [samples].
_MAX_PAUSE_SAMPLES = 4_000

#: Gaussians in the mixture of the states after a pause.
_N_COMPONENTS = 16

#: Variance that is added to each of these Gaussians, as a fraction of the mixture's variance.
_COMPONENT_INFLATION = 0.01

#: Output beyond which a system has run away [ranges of the output].
_DIVERGED_OUTPUT = 3.0


class _GaussianComponent(NamedTuple):
    """A component of a mixture: logarithm of its weight, mean (n,) and covariance (n, n)."""

    log_weight: float
    mean: FloatArray
    cov: FloatArray


class _FreeResponse(Protocol):
    def __call__(self, systems: FloatArray, u: float, lengths: npt.NDArray[np.int64]) -> object:
        """Let systems (N, d), states before coefficients, respond to one sample of u and then ``lengths`` of zero."""


@cache
def _compile_free_response(model: Model) -> _FreeResponse:
    """The compiled free response of a model."""
    kernels = compile_noise_free_step(model)
    layout, step, n = kernels.layout, kernels.step, model.n_states
    size, n_variables, input_index = len(layout), len(model.names), layout[only_input_rows(model)[0]]

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

    compiled: _FreeResponse = free_response
    return compiled


def _fit_gaussian_mixture(states: FloatArray) -> list[_GaussianComponent]:
    """A mixture of Gaussians for states (N, n), by k-means."""
    from scipy.cluster.vq import kmeans2

    stds = states.std(axis=0)
    labels = kmeans2(states / stds, _N_COMPONENTS, seed=0, minit="++")[1]
    clusters = [states[labels == k] for k in range(_N_COMPONENTS)]
    return [
        _GaussianComponent(
            float(np.log(len(cluster) / len(states))),
            cluster.mean(axis=0),
            np.cov(cluster.T) + _COMPONENT_INFLATION * np.diag(stds**2),
        )
        for cluster in clusters
        if len(cluster) > states.shape[1]
    ]


class RunEstimator:
    """The online estimator of a run. Sample k is the output at a tick and the input that is applied from this tick on.

    Args:
        rig: with a guess where there is no prior.
        prior: the belief before the run, such as ``identify(...).belief``; None: by the rig's guess. Its state is
            reset, because the rig has moved since.

    Raises:
        ValueError: for a rig with neither guess nor prior, with an input that is not held, or with a negative delay.
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
        # Each output is given with the input before it: so the belief is of the tick, before the next input.
        self.delay, causal_rig = rig.integer_delay, replace(rig, delay=rig.integer_delay - 1)
        prior = rig_prior(rig) if prior is None else reset_state(prior)
        self._n_pauses = 0
        self._start_components: list[_GaussianComponent] = []
        self._systems_after_pause: SystemDraws | None = None
        self._rig, self._prior = rig, prior
        self._blocks: list[tuple[FloatArray, FloatArray]] = []
        self.online = OnlineEstimator(
            prior.model, prior, causal_rig, noise_hypotheses=(7, 7), expectations="sigma_points"
        )

    @property
    def belief(self) -> Belief:
        """The belief at the last tick."""
        return self.online.belief

    def update(self, u: npt.ArrayLike, y: npt.ArrayLike) -> None:
        """Update by outputs (N,) at ticks, NaN where one is missing, each with the input of the tick before it.

        Of several inputs u is (N, inputs).

        After a pause the estimator starts from each Gaussian of the mixture; the one with the best evidence is kept.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        components, self._start_components, self._systems_after_pause = self._start_components, [], None
        initial_arrays, best, best_evidence = self.online.arrays(), None, -np.inf
        for log_weight, mean, cov in components:
            self._set_state(mean, cov)
            try:
                evidence = log_weight - self.online.run(u, y, missing=True)[:, -1].sum()
            except ValueError:  # the belief overflows: this component is far from the truth
                evidence = -np.inf
            if evidence > best_evidence:
                best, best_evidence = self.online.arrays(), evidence
            self.online.restore(initial_arrays)
        if best is None:
            self.online.run(u, y, missing=True)
        else:
            self.online.restore(best)

    def update_block(self, u: FloatArray, y: FloatArray) -> None:
        """Update by a block: outputs (N,) at its ticks, NaN where one is missing, and the inputs applied from them on.

        The coefficients are fitted to all blocks together, but not to the first one, which is silent.

        Raises:
            ValueError: where the belief overflows; it is then as before.
        """
        initial_arrays, components = self.online.arrays(), self._start_components
        previous_inputs = np.concatenate([[0.0], u[:-1]])
        self.update(previous_inputs, y)
        self._blocks.append((u, y))
        if len(self._blocks) == 1:
            return
        coefficients = refit_coefficients(self._rig, self._blocks, self._prior, self.belief)
        first_pass = self.online.arrays()
        # The state now is estimated once more, by the same block, with these coefficients.
        self.online.restore(initial_arrays)
        self._start_components = components
        self._set_coefficients(*coefficients)
        try:
            self.update(previous_inputs, y)
        except ValueError:  # the belief overflows with these: the state of the first pass stays
            self.online.restore(first_pass)
        self._set_coefficients(*coefficients)

    def compile_block_update(self) -> None:
        """Compile the functions that `update_block` calls."""
        refit_coefficients(self._rig, [(np.zeros(8), np.zeros(8))] * 2, self._prior, self.belief)

    def draw_systems(self, rng: np.random.Generator) -> SystemDraws:
        """Draw systems from the belief: states and coefficients (draws, d), and noises (draws, 2).

        After a pause these are the systems whose free response was computed: a Gaussian of their states would put many
        out of the range.
        """
        return self._systems_after_pause or draw_from_estimator(self.online, rng)

    def predict_ahead(self, u: float | FloatArray) -> Belief:
        """The belief when the next input begins to act, if the present input is u; the estimator does not change."""
        copied = copy.copy(self.online)  # `run` changes no array that the copy shares
        inputs = np.zeros((1 + self.delay, *np.shape(u)))
        inputs[0] = u
        copied.run(inputs, np.full(len(inputs), np.nan), missing=True)
        return copied.belief

    def start_pause(self, u: float) -> None:
        """Begin a pause of unknown length without input, after a last sample with u.

        The belief about the state becomes a mixture over the lengths; coefficients and noises stay as they are.

        Raises:
            ValueError: where most of the systems that are drawn from the belief run away without input.
        """
        rng = np.random.default_rng(self._n_pauses)
        self._n_pauses += 1
        systems, noises = draw_from_estimator(self.online, rng)
        systems = np.ascontiguousarray(systems)
        n = self.online.model.n_states
        max_pause = int(np.clip(_MAX_PAUSE_PERIODS / believed_resonance(self.belief), 8, _MAX_PAUSE_SAMPLES))
        # Each system responds by its own equation: a linear prediction would leave the two wells.
        _compile_free_response(self.online.model)(
            systems, u / self.online.scales.input, rng.integers(max_pause, size=len(systems))
        )
        states = systems[:, :n]
        outputs = probe_dynamics(self.online.model, systems[:, n:], states).outputs_shown
        kept = states[(np.abs(outputs) < _DIVERGED_OUTPUT) & np.isfinite(states).all(axis=1)]
        if len(kept) < len(states) / 2:
            raise ValueError(
                "rig must be known well enough to stay in its range between blocks, but most systems that are drawn "
                "from the belief run away; give a narrower guess, or run sample by sample"
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
