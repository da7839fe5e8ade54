"""Likelihoods of records with as many Runge-Kutta steps as their own error asks for."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.inference.record_filter import RecordLikelihoods, record_likelihoods, with_substeps
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: Largest change of a loss by twice as many Runge-Kutta steps [nats].
_MAX_CHANGE = 0.1

#: The same, as a fraction of the misfit ½ Σ ν²/S: far from a record, its likelihood need not be known to a nat.
_MAX_RELATIVE_CHANGE = 1e-4

#: Factor on the steps over which each doubling must change the loss by no more.
_AGREEING_FACTOR = 4

#: Factor on the steps that is tested then: long steps that pass over a pole of the equation, or an unstable state that
#: noise explains, may agree with one another, and be wrong.
_TEST_FACTOR = 16

#: Runge-Kutta steps per sample, at most; equations are too stiff for the method where these do not suffice.
MOST_SUBSTEPS = 4096


class ConvergedLikelihoods(NamedTuple):
    """Likelihoods of n series, and the steps that they took.

    Attributes:
        likelihoods: totals of each series; where the loss does not converge, it is inf, and the rest NaN.
        substeps: (n,) Runge-Kutta steps per sample from which on the loss of each series has converged; 0 where it does
            not. The likelihoods themselves are of 16 times as many.
    """

    likelihoods: RecordLikelihoods
    substeps: npt.NDArray[np.intp]


def converged_likelihoods(
    model: Model,
    coefficients: FloatArray,
    inputs: FloatArray,
    y: FloatArray,
    noises: FloatArray,
    initial_state_cov: FloatArray,
    initial_state: FloatArray | float = 0.0,
    sample_lengths: FloatArray | None = None,
    initial_state_slopes: FloatArray | None = None,
    most_substeps: int = MOST_SUBSTEPS,
) -> ConvergedLikelihoods:
    """Run the linearised filter over n series, each with the Runge-Kutta steps that its error asks for.

    It is for users who search far from the truth of a stiff equation, where too few steps may make a likelihood high.
    It does not find every such hole: steps that agree with one another may all pass over a pole of the equation.

    The steps of a series are doubled, from the model's own on, until its loss ½ Σ (ν²/S + log S) has twice changed by
    no more than a tenth of a nat, or by 1e-4 of its misfit, and changes by no more with 16 times the steps. A
    difference equation has none. Arguments that are not named here are as for
    `estimator.inference.record_filter.record_likelihoods`.

    Args:
        model: the equation.
        coefficients: (n, K) coefficients.
        inputs: (n, T, rows) inputs of each sample.
        y: (n, T, p) outputs.
        noises: variances of the noises, one row or (n, ...).
        initial_state_cov: covariance of the states at the start.
        initial_state: mean of the states at the start, one number or (n, n_states).
        sample_lengths: (n, T) length of each sample.
        initial_state_slopes: (n, n_states, K) derivatives of ``initial_state``.
        most_substeps: Runge-Kutta steps per sample, at most.
    """
    count = len(coefficients)
    noise_rows = np.broadcast_to(noises, (count, np.shape(noises)[-1]))
    starts = np.broadcast_to(initial_state, (count, model.n_states))

    def run(number: int, chosen: npt.NDArray[np.intp]) -> RecordLikelihoods:
        return record_likelihoods(
            with_substeps(model, number),
            coefficients[chosen],
            inputs[chosen],
            y[chosen],
            noise_rows[chosen],
            initial_state_cov,
            starts[chosen],
            None if sample_lengths is None else sample_lengths[chosen],
            None,
            None if initial_state_slopes is None else initial_state_slopes[chosen],
        )

    def agrees(old: RecordLikelihoods, new: RecordLikelihoods) -> npt.NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            allowed = np.maximum(_MAX_CHANGE, _MAX_RELATIVE_CHANGE * new.innovations_squared / 2)
            return np.asarray(np.abs(new.loss - old.loss) <= allowed)  # False for NaN

    active = np.arange(count)
    found = run(model.substeps, active)
    if not model.is_continuous:
        return ConvergedLikelihoods(found, np.where(np.isfinite(found.loss), 1, 0))
    substeps, steps, agreeing = np.zeros(count, dtype=np.intp), model.substeps, np.zeros(count, dtype=np.intp)
    while len(active) and (_TEST_FACTOR // _AGREEING_FACTOR) * 2 * steps <= most_substeps:
        steps *= 2
        latest = run(steps, active)
        agreeing[active] = np.where(agrees(_of(found, active), latest), agreeing[active] + 1, 0)
        _store(found, active, latest)
        candidates = active[2 ** agreeing[active] >= _AGREEING_FACTOR]
        finest = run(steps * _TEST_FACTOR // _AGREEING_FACTOR, candidates)
        is_same = agrees(_of(found, candidates), finest)
        agreeing[candidates[~is_same]] = 0
        accepted = candidates[is_same]
        _store(found, accepted, _of(finest, is_same))
        substeps[accepted] = steps // _AGREEING_FACTOR
        active = active[substeps[active] == 0]
    found.loss[active] = np.inf
    for values in found[1:]:
        values[active] = np.nan
    return ConvergedLikelihoods(found, substeps)


def _of(likelihoods: RecordLikelihoods, chosen: npt.NDArray[Any]) -> RecordLikelihoods:
    """The likelihoods of the chosen series."""
    return RecordLikelihoods(*(values[chosen] for values in likelihoods))


def _store(likelihoods: RecordLikelihoods, chosen: npt.NDArray[np.intp], new: RecordLikelihoods) -> None:
    """Overwrite the likelihoods of the chosen series."""
    for values, replacement in zip(likelihoods, new, strict=True):
        values[chosen] = replacement
