"""The filter of an online estimator: a belief, or a mixture over noise hypotheses, and the inputs that still act."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief, check_belief_record, couple_initial_states, covariance_indices
from estimator.inference import filter_loop
from estimator.inference.input_interpolation import InputStencil, input_stencil, rig_input_degree
from estimator.inference.noise_grid import (
    NoiseRatio,
    initial_weights,
    log_noise_ratio,
    member_priors,
    noise_ratio_posterior,
    pack_into_lanes,
)
from estimator.inference.noise_mixture import MixtureMoments, compile_mixture
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import equal_effect_log_ratio
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.settings import EstimatorSettings
from estimator.support.argument_checks import to_float_array
from estimator.support.array_types import FloatArray

#: Shape of a Gamma belief that stays under updates [1].
_CERTAIN_SHAPE = 1e15

#: Magnitude of a negative eigenvalue of a correlation matrix that rounding may leave [1].
_EIGENVALUE_TOLERANCE = 1e-5


class Filter:
    """Filter of any model.

    Args:
        prior: belief one sample before the first.
        rig: timing and interpolation of the inputs.
        settings: options of the updates.
    """

    def __init__(self, prior: Belief, rig: Rig, settings: EstimatorSettings) -> None:
        self.prior, self.rig, self.settings = prior, rig, settings
        self.model: Model = prior.model
        self.input_stencil: InputStencil = input_stencil(self.model, rig)
        records = member_priors(prior, settings.noise_hypotheses)
        members = len(records)
        self._loop = self._compile_loop(members)
        lanes = self._loop.lanes
        blocks = -(-members // lanes)
        self._block = np.zeros((blocks, len(self._loop.layout) * lanes))
        self._weights = self._initial_weights(records)
        self._begun = np.zeros(1)
        self._inputs = np.zeros(self.input_stencil.n_stored + self.model.n_inputs)
        self._outputs = np.zeros((self.input_stencil.lookahead + 1, self.model.n_outputs))
        self._walk = settings.drift**2 * np.diag(prior.coefficients_cov)
        self._first = prior.record.copy()
        shape = [
            self.input_stencil.stride,
            self.input_stencil.n_stored,
            self.input_stencil.lookahead,
            self.input_stencil.repeats_first,
        ]
        self._stencil_sizes = np.array(shape, dtype=np.int64)
        self._write_records(records)

    def _initial_weights(self, records: FloatArray) -> FloatArray:
        """(members,) weights before the first sample. With the prior of a rig's guess, both noises are unknown."""
        unknown = self.rig.guess is not None and isinstance(self.settings.noise_hypotheses, tuple)
        return initial_weights(self._noises(records), equal_effect_log_ratio(self.prior) if unknown else None)

    def _compile_loop(self, members: int) -> filter_loop.FilterLoop:
        settings = self.settings
        if settings.factorisation == "mean_field":
            return filter_loop.compile_mean_field_loop(settings.iterations, settings.as_published)
        return filter_loop.compile_structured_loop(
            self.model, rig_input_degree(self.model, self.rig), settings.iterations, settings.expectations, members
        )

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_loop"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._loop = self._compile_loop(self.members)

    def copy(self) -> Filter:
        """An independent copy."""
        other = object.__new__(Filter)
        other.__dict__.update(self.__dict__)
        for name in ("_block", "_weights", "_begun", "_inputs", "_outputs"):
            setattr(other, name, getattr(self, name).copy())
        return other

    @property
    def members(self) -> int:
        """Number of noise hypotheses."""
        return len(self._weights)

    @property
    def is_waiting(self) -> bool:
        """Whether the next sample is only stored, until the input after it is known."""
        return self.input_stencil.lookahead and not self._begun[0]

    def step(self, u: float, y: float, energies: FloatArray, forecasts: FloatArray) -> int:
        """Update by one sample of one input and one sensor; see `run`."""
        self._inputs[-1] = u
        self._outputs[-1, 0] = y
        overflowed_at: int = self._loop.run(
            self._block, self._weights, self._begun, self._inputs, self._outputs,
            self.input_stencil.stencil, self._stencil_sizes, self._walk, energies, forecasts,
        )  # fmt: skip
        return overflowed_at

    def run(self, u: FloatArray, y: FloatArray, energies: FloatArray, forecasts: FloatArray) -> int:
        """Update by samples; a sample that waits for a later input is used by the next call.

        Args:
            u: (T, inputs) inputs.
            y: (T, sensors) outputs.
            energies: (T or more, iterations) receives the free energies, from the front; empty to skip all checks.
            forecasts: (T or more, sensors, 2) receives the predictive means and variances of the outputs.

        Returns:
            The sample at which the numbers overflowed, and then nothing has changed; or -1.
        """
        stored = self.input_stencil.n_stored
        if self.input_stencil.needs_whole_record:
            inputs = self.input_stencil.spline_coefficients(u).reshape(-1)
        else:
            inputs = np.concatenate([self._inputs[:stored], u.reshape(-1)])
        outputs = np.concatenate([self._outputs[:-1], y])
        overflowed_at: int = self._loop.run(
            self._block, self._weights, self._begun, inputs, outputs,
            self.input_stencil.stencil, self._stencil_sizes, self._walk, energies, forecasts,
        )  # fmt: skip
        if overflowed_at < 0:
            self._inputs[:stored] = inputs[:stored]
            self._outputs[:-1] = outputs[: self.input_stencil.lookahead]
        return max(0, overflowed_at - int(self.input_stencil.lookahead)) if overflowed_at >= 0 else -1

    def rewind(self) -> None:
        """Reset the state and the inputs; keep coefficients, noises and weights."""
        records, n = self.records, self.model.n_states
        places = covariance_indices(self.model)
        of_states = np.concatenate([np.arange(n), places[:n].reshape(-1)])
        records[:, of_states] = self._first[of_states]
        coupled = places[:n, n:].reshape(-1)
        records[:, coupled] = 0.0
        for record in records if self.model.initial_states else ():
            mean, cov = record[: len(places)], record[places]
            couple_initial_states(self.model, mean, cov)
            record[places] = cov
        self._write_records(records)
        self._inputs[:], self._outputs[:], self._begun[:] = 0.0, 0.0, 0.0

    @property
    def records(self) -> FloatArray:
        """(members, size) flat records of all beliefs; a copy."""
        blocks, lanes, size = len(self._block), self._loop.lanes, len(self._first)
        rows = self._block[:, : size * lanes].reshape(blocks, size, lanes)
        return rows.transpose(0, 2, 1).reshape(blocks * lanes, size)[: self.members].copy()

    def _write_records(self, records: FloatArray) -> None:
        size, lanes = len(self._first), self._loop.lanes
        self._block[:, : size * lanes] = pack_into_lanes(records, lanes)

    @property
    def belief(self) -> Belief:
        """The current belief; for several hypotheses, with the moments of their mixture."""
        return self.prior.with_records(self._mixture_record()[None])[0]

    @property
    def noise_ratio(self) -> NoiseRatio:
        """Posterior of the noise ratio, from the weights and the precisions of the members."""
        weights, _ = self._compiled_mixture.mixture(self._block, self._weights)
        ratios = np.array([log_noise_ratio(noises) for noises in self._noises(self.records[weights > 0])])
        records = member_priors(self.prior, self.settings.noise_hypotheses)
        first = np.array([log_noise_ratio(noises) for noises in self._noises(records)])
        return noise_ratio_posterior(weights[weights > 0], ratios, first, self._initial_weights(records))

    @property
    def _compiled_mixture(self) -> MixtureMoments:
        """The moments of mixtures of the model's beliefs."""
        return compile_mixture(len(self.model.names), 1 + self.model.n_outputs)

    def _noises(self, records: FloatArray) -> FloatArray:
        """(M, 2 + 2 s) shapes and rates of the precisions in records (M, size)."""
        return records[:, -2 - 2 * self.model.n_outputs :]

    def _mixture_record(self) -> FloatArray:
        """(size,) record with the mixture's moments."""
        if self.members == 1:
            return self.records[0]
        record: FloatArray = self._compiled_mixture.mixture(self._block, self._weights)[1]
        return record

    @property
    def is_paper_model(self) -> bool:
        """Whether the model is the paper's, whose predictions start from measured outputs."""
        return self.model == difference()

    def predict(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions (T, sensors) with the coefficients fixed at their means."""
        if not self.is_paper_model:
            return self.with_known_parameters().forecast(u, y)[:, :, 0]
        t1, t2, t3, eta = self.belief.coefficients_mean
        predicted, last = y.copy(), y[1:-1, 0]
        acting = np.concatenate([np.zeros(self.rig.integer_delay), u[:, 0]])[2 : len(y)]
        predicted[2:, 0] = t1 * last + t2 * last**3 + t3 * y[:-2, 0] + eta * acting
        return predicted

    def simulate(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run (T, sensors) from the first outputs, with the coefficients fixed at their means."""
        given = len(y_init)
        unseen = np.full((len(u) - given, y_init.shape[1]), np.nan)
        filter_at_mean = self.with_known_parameters(state=y_init[::-1][:2, 0] if self.is_paper_model else None)
        if self.is_paper_model:
            # The state is measured; the inputs that still act are the new ones and the delayed ones.
            kept = filter_at_mean.input_stencil.n_past
            filter_at_mean._inputs[:-1] = np.concatenate([np.zeros(kept), u[:given, 0]])[given:]
            return (
                np.concatenate([y_init, filter_at_mean.forecast(u[given:], unseen)[:, :, 0]])
                if len(unseen)
                else y_init.copy()
            )
        forecasts = filter_at_mean.forecast(u, np.concatenate([y_init, unseen]))[:, :, 0]
        forecasts[:given] = y_init
        return forecasts

    def with_known_parameters(self, state: FloatArray | None = None) -> Filter:
        """A filter with coefficients and noises fixed at their means, and the state too if it is given."""
        n, d = self.model.n_states, len(self.model.names)
        record, places = self._mixture_record(), covariance_indices(self.model)
        cov = np.zeros((d, d))
        if state is None:
            record[:n] = self._first[:n]
            cov[:n, :n] = self._first[places[:n, :n]]
            couple_initial_states(self.model, record[:d], cov)
        else:
            record[:n] = state
        record[places] = cov
        noises = self._noises(record[None])[0]
        noises *= np.repeat(_CERTAIN_SHAPE / noises[::2], 2)
        # One iteration would be enough, but the loop with the filter's own number is compiled already.
        settings = replace(self.settings, drift=0.0, noise_hypotheses=1)
        if settings.factorisation == "mean_field":
            settings = EstimatorSettings()
        return Filter(self.prior.with_records(record[None])[0], self.rig, settings)

    def forecast(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """(T, sensors, 2) predictive mean and variance of each output."""
        forecasts = np.empty((len(u) + 1, y.shape[1], 2))
        no_energies = np.empty((0, 1))
        used = len(u) - int(self.is_waiting)
        self.run(u, y, no_energies, forecasts)
        if self.input_stencil.lookahead:  # the input after the last is taken as the last
            self.run(u[-1:], np.full((1, y.shape[1]), np.nan), no_energies, forecasts[used:])
        return forecasts[: len(u)]

    def arrays(self) -> dict[str, FloatArray]:
        """The complete state of the filter, by name; copies."""
        return {
            "records": self.records,
            "weights": self._weights.copy(),
            "first": self._first.copy(),
            "walk": self._walk.copy(),
            "inputs": self._inputs[: self.input_stencil.n_stored].copy(),
            "outputs": self._outputs[:-1].copy(),
            "begun": self._begun.copy(),
        }

    def restore(self, arrays: Mapping[str, npt.ArrayLike]) -> None:
        """Set the state to the `arrays` of a filter with the same settings; an error changes nothing.

        Raises:
            ValueError: naming the array, if it is missing, unknown or impossible for such a filter.
        """
        expected = self.arrays()
        if set(arrays) != set(expected):
            raise ValueError(
                f"arrays must be {sorted(expected)}, but are {sorted(arrays)}; use arrays() of an estimator"
            )
        checked = {name: _checked_array(name, arrays[name], expected[name]) for name in expected}
        weights, alive = checked["weights"], checked["weights"] > 0
        if not (weights >= 0).all() or not np.isclose(weights.sum(), 1.0, rtol=1e-6):
            raise ValueError(f"weights must be probabilities, but are {weights.tolist()}; use arrays() of an estimator")
        if checked["begun"][0] not in (0.0, 1.0):
            raise ValueError(f"begun must be 0 or 1, but is {checked['begun'][0]}; use arrays() of an estimator")
        if (checked["walk"] < 0).any():
            raise ValueError(
                f"walk must be at least 0, but is {checked['walk'].tolist()}; use arrays() of an estimator"
            )
        for name, records in (("records", checked["records"][alive]), ("first", checked["first"][None])):
            for record in records:
                check_belief_record(name, self.model, record, _EIGENVALUE_TOLERANCE)
        if self.members > 1:  # the mixture's moments may overflow, or vanish, where no member's do
            blocks = pack_into_lanes(checked["records"], self._loop.lanes)
            _, record = self._compiled_mixture.mixture(blocks, weights)
            check_belief_record("records", self.model, record, _EIGENVALUE_TOLERANCE)
        for name in ("weights", "first", "walk", "begun"):
            setattr(self, f"_{name}", checked[name])
        self._inputs[: self.input_stencil.n_stored], self._outputs[:-1] = checked["inputs"], checked["outputs"]
        self._write_records(checked["records"])


def _checked_array(name: str, value: npt.ArrayLike, expected: FloatArray) -> FloatArray:
    """A copy of a float64 array of the expected shape and range."""
    array = to_float_array(name, value)
    if np.asarray(value).dtype != np.float64 or array.shape != expected.shape:
        raise ValueError(
            f"{name} must be float64 of shape {expected.shape}, but is {np.asarray(value).dtype} of {array.shape}; use "
            f"arrays() of an estimator with the same settings"
        )
    # A member without weight may have overflowed, and a stored output may be missing.
    if name not in ("records", "outputs") and not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, but is {array.tolist()}; use arrays() of an estimator")
    if name == "outputs" and np.isinf(array).any():
        raise ValueError(f"outputs must be finite or missing, but are {array.tolist()}; use arrays() of an estimator")
    # `check_belief_record` has the range of beliefs.
    if (
        name not in ("records", "first")
        and (np.abs(array) > (most := MAGNITUDE_BOUNDS[1] ** (1 + (name == "walk")))).any()
    ):
        worst = array.flat[np.nanargmax(np.abs(array))]
        raise ValueError(f"{name} must be within ±{most:g}, but has {worst:g}; use arrays() of an estimator")
    return array
