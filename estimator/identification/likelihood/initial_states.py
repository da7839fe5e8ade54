"""Most probable initial state of each record.

The filter of a fit is linear about its estimate of the state. A record may begin in any motion, and an accelerometer or
a strong resonance does not reveal it at once: a filter that begins at rest takes the difference for noise, and its
coefficients are wrong. Therefore the filter begins at the most probable state at the coefficients of the previous fit,
unless the previous state, or rest at an equilibrium of the spring, explains the whole record far better.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.identification.likelihood.fit_hypothesis import FitHypothesis
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.inference.record_filter import record_likelihoods
from estimator.support.array_types import FloatArray

#: Displacements, and velocities, in the grid of initial states.
_GRID_POINTS = 11

#: Extent of the grid, in largest displacements and velocities.
_GRID_EXTENT = 1.5

#: Bounds of the samples on which the grid is judged; between them it is one period.
_JUDGED_SAMPLES_BOUNDS = (16, 256)

#: Series that the filter takes at once, about.
_MAX_SERIES_PER_BATCH = 2048

#: Sensor noise of the first Newton steps, as a fraction of the output, at least: with it the filter converges from the
#: nearest point of the grid although the oscillator is nonlinear.
_COARSE_SENSOR_FRACTION = 0.3

#: Newton steps with that noise, and with the noise of the hypothesis.
_NEWTON_STEPS = (4, 6)

#: Likelihood by which the previous state or rest must be better [nats]. A few nats do not count: the filter is linear
#: about different points.
_MIN_GAIN = 10.0

#: Step of the finite differences, in largest states.
_FINITE_DIFFERENCE_STEP = 1e-3

#: Longest Newton step, in largest states.
_MAX_NEWTON_STEP = 0.3

#: Fractions of the Newton step that are tried.
_LINE_SEARCH_FRACTIONS = np.array([1.0, 0.3, 0.1, 0.01])

#: Offsets of the points whose losses give gradient and Hessian by x and v.
_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]], dtype=np.float64)


def find_initial_states(
    problem: ScaledRecords, hypothesis: FitHypothesis, points: FloatArray, sensor_std: float
) -> FloatArray:
    """The most probable displacement and velocity one sample before each record.

    Args:
        problem: the records.
        hypothesis: the input path, the noise ratio, and the previous initial states.
        points: (P, K) coefficients.
        sensor_std: sensor noise σ_v.

    Returns:
        (P, records, 2) states, scaled.
    """
    period = 2 * np.pi / problem.mean_frequency
    first_period = problem.truncated(int(np.clip(period, *_JUDGED_SAMPLES_BOUNDS)))
    grid_axis = np.linspace(-_GRID_EXTENT, _GRID_EXTENT, _GRID_POINTS)
    grid = np.stack(np.meshgrid(grid_axis, grid_axis, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    series, unit = np.arange(len(points) * len(problem.u)), problem.max_state

    losses = _initial_state_loss(first_period, hypothesis, points, np.zeros((2, 2)))
    coarse_sensor_std = max(sensor_std, _COARSE_SENSOR_FRACTION * problem.output_rms)
    # In batches, because many records make many series.
    parts = np.array_split(np.repeat(grid, len(series), axis=1), -(-len(series) * len(grid) // _MAX_SERIES_PER_BATCH))
    found = grid[np.concatenate([losses(unit * part, coarse_sensor_std) for part in parts]).argmin(axis=0), 0]
    for sensor in np.repeat([coarse_sensor_std, sensor_std], _NEWTON_STEPS):
        stencil_losses = losses(unit * (found + _FINITE_DIFFERENCE_STEP * _STENCIL[:, None]), sensor)
        candidates = found + _LINE_SEARCH_FRACTIONS[:, None, None] * _newton_step(stencil_losses)
        candidate_losses = losses(unit * candidates, sensor)
        best = candidate_losses.argmin(axis=0)
        found = np.where((candidate_losses[best, series] < stencil_losses[0])[:, None], candidates[best, series], found)
    rest = np.zeros_like(found)
    previous = rest if hypothesis.initial_states is None else np.tile(hypothesis.initial_states, (len(points), 1))
    equilibria = np.repeat(well_displacements(problem, points), len(problem.u), axis=1)
    options = np.stack([unit * found, previous, rest, *(np.stack([x, np.zeros_like(x)], axis=1) for x in equilibria)])
    option_losses = _initial_state_loss(problem, hypothesis, points, problem.initial_state_cov)(options, sensor_std)
    option_losses[0] -= _MIN_GAIN
    return np.asarray(options[option_losses.argmin(axis=0), series]).reshape(len(points), -1, 2)


def _newton_step(stencil_losses: FloatArray) -> FloatArray:
    """(records, 2) Newton steps for the losses at `_STENCIL`; downhill where the Hessian is not positive definite."""
    here, right, left, up, down, both, neither = stencil_losses
    with np.errstate(invalid="ignore"):  # infinite where the filter diverged
        slope = np.stack([right - left, up - down], axis=1) / (2 * _FINITE_DIFFERENCE_STEP)
        xx, vv = right - 2 * here + left, up - 2 * here + down
        xv = (both + neither - right - left - up - down + 2 * here) / 2
        curvature = (
            np.stack([np.stack([xx, xv], axis=1), np.stack([xv, vv], axis=1)], axis=1) / _FINITE_DIFFERENCE_STEP**2
        )
    finite = np.isfinite(curvature).all(axis=(1, 2)) & np.isfinite(slope).all(axis=1)
    slope[~finite], curvature[~finite] = 0.0, np.eye(2)
    values, eigenvectors = np.linalg.eigh(curvature)
    values = np.maximum(np.abs(values), 1e-12 * np.abs(values).max(axis=1, keepdims=True) + 1e-300)
    step = -np.einsum("rij,rj,rkj,rk->ri", eigenvectors, 1 / values, eigenvectors, slope)
    length = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _MAX_NEWTON_STEP / np.maximum(length, 1e-300)))


def _initial_state_loss(
    problem: ScaledRecords, hypothesis: FitHypothesis, points: FloatArray, cov: FloatArray
) -> Callable[[FloatArray, float], FloatArray]:
    """A function from initial states (C, S, 2) and σ_v to negative log likelihoods (C, S).

    Each of the S series is a record at one of the points (P, K); ``cov`` is the covariance of the initial state.
    """
    inputs, outputs, spans, _ = problem.filter_samples(*hypothesis.input_path)
    ratio = hypothesis.noise_ratio
    at = np.repeat(points, len(inputs), axis=0)

    def losses(candidates: FloatArray, sensor: float) -> FloatArray:
        count, series = candidates.shape[:2]
        times = count * series // len(inputs)
        loss = record_likelihoods(
            problem.model,
            np.tile(at, (count, 1)),
            np.tile(inputs, (times, 1, 1)),
            np.tile(outputs, (times, 1, 1)),
            problem.noises_of_records(np.tile([(ratio * sensor) ** 2, sensor**2], (times, 1))),
            cov,
            candidates.reshape(-1, 2),
            None if spans is None else np.tile(spans, (times, 1)),
        ).loss
        return np.where(np.isfinite(loss), loss, np.inf).reshape(count, series)

    return losses


def well_displacements(problem: ScaledRecords, coefficients: FloatArray) -> FloatArray:
    """(n, P) displacements of the two wells of the spring at coefficients (P, K), from its inflection.

    Empty where no spring has two wells; 0 for each spring that has one.
    """
    names = list(problem.model.coefficients)
    stiffness, cubic = coefficients[:, names.index("stiffness")], coefficients[:, names.index("cubic")]
    has_two_wells = (stiffness < 0) & (cubic > 0)
    if not has_two_wells.any():
        return np.empty((0, len(coefficients)))
    distance = np.sqrt(np.divide(-stiffness, cubic, out=np.zeros(len(coefficients)), where=has_two_wells))
    return np.stack([distance, -distance])
