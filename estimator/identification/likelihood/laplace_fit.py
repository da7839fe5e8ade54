"""Laplace approximation of the posterior of the coefficients, for many hypotheses about the same records at once.

A hypothesis states interpolation, delay and lag of the input, the terms of the equation, and the noise ratio σ_w/σ_v.
With the Kalman filter's innovations ν_t and their variances S_t at the coefficients ψ, its evidence is the free energy
of a Gaussian at the minimum (variational Laplace),

    L = ½ Σ_t (ν_t²/S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0),    F = L + ½ log det(Λ0 + I) - ½ log det Λ0,

with the information I of `estimator.inference.fisher_information`. The level of the noises needs no search: all S are
proportional to it, so that at the best level Σ ν²/S is the number of outputs N, and the first sum of L is
½ (Σ log S + N log(Σ ν²/S / N) + N). The first outputs of each record, as many as there are states, do not count,
because the initial state is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.identification.likelihood.batch_linear_algebra import (
    invert_batch,
    solve_batch,
    solve_with_fixed_directions,
)
from estimator.identification.likelihood.fit_hypothesis import CoefficientPrior, FitHypothesis, LaplaceFits
from estimator.identification.likelihood.scaled_records import FilterSamples, ScaledRecords
from estimator.inference.record_filter import RecordLikelihoods, record_likelihoods
from estimator.support.array_types import FloatArray

#: Levenberg-Marquardt damping at the start of a fit.
_INITIAL_DAMPING = 1e-6

#: Factor of the damping after a step that fails.
_DAMPING_INCREASE = 30.0

#: Factor of the damping after a step that succeeds.
_DAMPING_DECREASE = 0.1

#: Smallest damping.
_MIN_DAMPING = 1e-9

#: Damping above which a fit ends.
_MAX_DAMPING = 1e2

#: Predicted decrease of the loss below which a step is the last of a fit [nats]: the step is a seventh of a standard
#: deviation, and the remaining error is far smaller.
_MIN_PREDICTED_GAIN = 1e-2

#: Largest remaining decrease of the free energy, in decreases by the last step.
_REMAINING_GAIN_FACTOR = 10.0


class _FilterInputs(NamedTuple):
    """The constant part of a fit of H hypotheses with G input paths.

    Attributes:
        input_path_index: (H,) index of the input path of each hypothesis.
        inputs: (G, records, N, rows) inputs over the samples.
        outputs: (G, records, N, 1) outputs at their ends.
        spans: (G, records, N) lengths of the samples in steps; None where all are one step.
        noise_ratios: (H,) σ_w/σ_v.
        initial_states: (H, records, 2) states one sample before each record.
    """

    input_path_index: npt.NDArray[np.intp]
    inputs: FloatArray
    outputs: FloatArray
    spans: FloatArray | None
    noise_ratios: FloatArray
    initial_states: FloatArray

    def of(self, chosen: npt.NDArray[np.intp]) -> _FilterInputs:
        """The inputs of the chosen hypotheses."""
        return self._replace(
            input_path_index=self.input_path_index[chosen],
            noise_ratios=self.noise_ratios[chosen],
            initial_states=self.initial_states[chosen],
        )


def _pad_series(series: FloatArray, n_samples: int, n_rows: int | None = None) -> FloatArray:
    """A series (records, N, ...) padded to ``n_samples`` with NaN, and to ``n_rows`` with zeros."""
    missing = n_samples - series.shape[1]
    if n_rows is not None:
        series = np.pad(series, ((0, 0), (0, 0), (0, n_rows - series.shape[2])))
    return (
        np.pad(series, ((0, 0), (0, missing), *([(0, 0)] * (series.ndim - 2))), constant_values=np.nan)
        if missing
        else series
    )


class LaplaceFitter:
    """Fits the coefficients of many hypotheses to the records of a problem.

    Args:
        problem: the records and the equation.
        prior: prior of the coefficients.
    """

    def __init__(self, problem: ScaledRecords, prior: CoefficientPrior) -> None:
        self.problem, self.prior = problem, prior
        self._scale = 1 / np.sqrt(np.diag(prior.precision))
        self._samples: dict[tuple[str, float, float], FilterSamples] = {}

    def for_problem(self, problem: ScaledRecords) -> LaplaceFitter:
        """A fitter of another problem, with the same prior."""
        return LaplaceFitter(problem, self.prior)

    def fit(
        self,
        hypotheses: Sequence[FitHypothesis],
        initial_coefficients: FloatArray,
        initial_sensor_std: FloatArray | float,
        iterations: int = 30,
        give_up_above: FloatArray | float = np.inf,
        fixed_directions: FloatArray | None = None,
    ) -> LaplaceFits:
        """Fit each hypothesis by damped Gauss-Newton steps (Levenberg-Marquardt).

        Args:
            hypotheses: the H hypotheses.
            initial_coefficients: (K,) or (H, K) coefficients to start from.
            initial_sensor_std: σ_v to start from, one or (H,).
            iterations: steps, at most.
            give_up_above: free energy, one or (H,); the fit of a hypothesis that cannot come below it ends.
            fixed_directions: (H, K) directions whose products with the coefficients no step changes. Covariances and
                free energies do not take them into account.
        """
        count, k = len(hypotheses), len(self._scale)
        points = np.broadcast_to(initial_coefficients, (count, k)).copy()
        scaled_directions = None if fixed_directions is None else fixed_directions * self._scale
        sensor_stds = np.broadcast_to(np.asarray(initial_sensor_std, dtype=np.float64), count)
        filter_inputs = self._filter_inputs(hypotheses)
        loss, gradient, curvature, sensor_stds = self._loss_and_derivatives(points, filter_inputs, sensor_stds)
        damping, bars = np.full(count, _INITIAL_DAMPING), np.broadcast_to(give_up_above, count)
        active = np.flatnonzero(np.isfinite(loss))
        for n_steps in range(iterations):
            if not len(active):
                break
            damped = curvature[active] + (damping[active, None] * np.einsum("hii->hi", curvature[active]))[
                :, :, None
            ] * np.eye(k)
            step = -(
                solve_batch(damped, gradient[active])
                if scaled_directions is None
                else solve_with_fixed_directions(damped, gradient[active], scaled_directions[active])
            )
            predicted = -0.5 * np.einsum("hk,hk->h", gradient[active], step)
            if n_steps == 0:
                can_win = ~self._is_lost(loss[active], curvature[active], predicted, bars[active])
                active, step, predicted = active[can_win], step[can_win], predicted[can_win]
                if not len(active):
                    break
            trial = points[active] + self._scale * step
            found = self._loss_and_derivatives(trial, filter_inputs.of(active), sensor_stds[active])
            better = found[0] <= loss[active]  # False for a loss that is not finite
            gained = np.where(better, loss[active] - found[0], predicted)
            accepted = active[better]
            points[accepted] = trial[better]
            loss[accepted], gradient[accepted], curvature[accepted], sensor_stds[accepted] = (
                values[better] for values in found
            )
            damping[active] = np.where(
                better,
                np.maximum(_DAMPING_DECREASE * damping[active], _MIN_DAMPING),
                _DAMPING_INCREASE * damping[active],
            )
            is_finished = (
                (predicted < _MIN_PREDICTED_GAIN)
                | (damping[active] > _MAX_DAMPING)
                | self._is_lost(loss[active], curvature[active], gained, bars[active])
            )
            active = active[~is_finished]
        cov = invert_batch(curvature) * np.outer(self._scale, self._scale)
        energies = np.where(np.isfinite(cov).all(axis=(1, 2)), self._free_energy(loss, curvature), np.inf)
        return LaplaceFits(tuple(hypotheses), points, cov, sensor_stds, energies, loss)

    def record_noise_scales(self, hypothesis: FitHypothesis, coefficients: FloatArray, sensor_std: float) -> FloatArray:
        """(records,) noises of each record at coefficients (K,), relative to the noises of all."""
        filter_inputs, n_observed = self._filter_inputs([hypothesis]), [np.isfinite(y).sum() for y in self.problem.y]
        misfits = self._run_filter(coefficients[None], filter_inputs, np.array([sensor_std])).innovations_squared
        known_scales = (
            np.ones(len(n_observed)) if self.problem.record_noise_scales is None else self.problem.record_noise_scales
        )
        excess = misfits / np.maximum(np.array(n_observed) - self.problem.model.n_states, 1)
        found = known_scales * np.sqrt(excess)
        return np.asarray(found / np.sqrt(np.average(found**2, weights=n_observed)))

    def _filter_inputs(self, hypotheses: Sequence[FitHypothesis]) -> _FilterInputs:
        rest = np.zeros((len(self.problem.u), 2))
        input_paths = list(dict.fromkeys(h.input_path for h in hypotheses))
        for input_path in input_paths:
            if input_path not in self._samples:
                self._samples[input_path] = self.problem.filter_samples(*input_path)
        series = [self._samples[kind] for kind in input_paths]
        longest = max(one.inputs.shape[1] for one in series)
        rows = max(one.inputs.shape[2] for one in series)
        has_spans = any(one.spans is not None for one in series)
        ones = lambda one: np.ones(one.inputs.shape[:2]) if one.spans is None else one.spans  # noqa: E731
        lengths = [_pad_series(ones(one), longest) for one in series] if has_spans else []
        return _FilterInputs(
            np.array([input_paths.index(h.input_path) for h in hypotheses]),
            np.array([_pad_series(one.inputs, longest, rows) for one in series]),
            np.array([_pad_series(one.outputs, longest, 1) for one in series]),
            np.array(lengths) if lengths else None,
            np.array([h.noise_ratio for h in hypotheses]),
            np.array([rest if h.initial_states is None else h.initial_states for h in hypotheses]),
        )

    def _loss_and_derivatives(
        self, points: FloatArray, filter_inputs: _FilterInputs, sensor_stds: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Loss (H,), its gradient (H, K) and curvature (H, K, K) by prior standard deviations, and best σ_v (H,)."""
        problem, count, records = self.problem, len(points), len(self.problem.u)
        n = problem.n_observed_outputs - records * problem.model.n_states
        found = self._run_filter(points, filter_inputs, sensor_stds)
        total = lambda values: values.reshape(count, records, *values.shape[1:]).sum(axis=1)  # noqa: E731
        with np.errstate(all="ignore"):
            loss, gradient, information, misfit = (total(values) for values in found)
            excess = misfit / n
            data = 0.5 * (2 * loss - misfit + n * np.log(excess) + n)
            deviation = points - self.prior.mean
            prior_gradient = deviation @ self.prior.precision
            total_loss = data + 0.5 * (deviation * prior_gradient).sum(axis=1)
            gradient = self._scale * (gradient / excess[:, None] + prior_gradient)
            curvature = self._in_prior_units(information / excess[:, None, None] + self.prior.precision)
        bad = ~(np.isfinite(total_loss) & np.isfinite(gradient).all(axis=1) & np.isfinite(curvature).all(axis=(1, 2)))
        bad |= (np.einsum("hii->hi", curvature) <= 0).any(axis=1)
        total_loss = np.where(bad, np.inf, total_loss)
        gradient[bad], curvature[bad] = 0.0, np.eye(len(self._scale))
        return (
            total_loss,
            gradient,
            curvature,
            np.where(bad, sensor_stds, sensor_stds * np.sqrt(np.where(bad, 1.0, excess))),
        )

    def _run_filter(
        self, points: FloatArray, filter_inputs: _FilterInputs, sensor_stds: FloatArray
    ) -> RecordLikelihoods:
        """The filter's results for all records at each of the points (H, K)."""
        problem, records = self.problem, len(self.problem.u)
        inputs = filter_inputs.inputs[filter_inputs.input_path_index]
        return record_likelihoods(
            problem.model,
            np.repeat(points, records, axis=0),
            inputs.reshape(-1, *inputs.shape[2:]),
            filter_inputs.outputs[filter_inputs.input_path_index].reshape(-1, *filter_inputs.outputs.shape[2:]),
            problem.noises_of_records(
                np.stack([(filter_inputs.noise_ratios * sensor_stds) ** 2, sensor_stds**2], axis=1)
            ),
            problem.initial_state_cov,
            filter_inputs.initial_states.reshape(-1, 2),
            None
            if filter_inputs.spans is None
            else filter_inputs.spans[filter_inputs.input_path_index].reshape(-1, filter_inputs.spans.shape[2]),
        )

    def _free_energy(self, loss: FloatArray, curvature: FloatArray) -> FloatArray:
        """(H,) free energies; inf where one is not finite."""
        log_det = np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(self._in_prior_units(self.prior.precision))[1]
        return np.where(np.isfinite(loss + log_det), loss + 0.5 * log_det, np.inf)

    def _is_lost(
        self, loss: FloatArray, curvature: FloatArray, last_gain: FloatArray, bars: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """(H,) whether fits cannot come below the free energies ``bars`` any more."""
        if np.isposinf(bars).all():
            return np.zeros(len(loss), dtype=np.bool_)
        return np.asarray(self._free_energy(loss, curvature) - _REMAINING_GAIN_FACTOR * last_gain > bars)

    def _in_prior_units(self, precision: FloatArray) -> FloatArray:
        """A precision of the coefficients, in units of the prior's standard deviations."""
        return precision * np.outer(self._scale, self._scale)
