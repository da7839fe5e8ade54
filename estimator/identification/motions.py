"""The motion that each record begins in.

The filter of a fit is linear about where it believes the oscillator to be. A record may begin anywhere, and an
accelerometer or a strong resonance does not tell where at once: a filter that begins at rest takes the difference for
noise, and its coefficients are wrong. So it begins at the most probable motion, at the coefficients of the fit before;
unless all of the record is explained far better by where it began then, or by rest, in each of the wells too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.identification.fit import Hypothesis
from estimator.identification.problem import Problem
from estimator.identification.start import rests
from estimator.information import follow
from estimator.parameters import FloatArray

#: A grid of so many displacements and velocities each, up to so much of the largest, is looked at first. What is judged
#: is the first period of a record, of so many samples at least and at most.
_GRID, _WIDEST, _PERIOD = 11, 1.5, (16, 256)

#: Series that are judged at once, about.
_AT_ONCE = 2048

#: With noises of at least so much of the output a filter comes to the motion from the nearest place of the grid, though
#: the oscillator is not linear. Newton's method takes so many steps with them, and so many with the noises as they are.
_COARSE, _STEPS = 0.3, (4, 6)

#: Nats by which another motion must be better. A few do not tell: the filter is not linear about the same place.
_BETTER = 10.0

#: Distance of finite differences, and the longest step, in parts of the largest.
_APART, _FARTHEST = 1e-3, 0.3

#: Parts of Newton's step that are tried.
_PARTS = np.array([1.0, 0.3, 0.1, 0.01])

#: Offsets of the points whose losses tell slope and curvature by x and v.
_AROUND = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]], dtype=np.float64)


def motions(problem: Problem, hypothesis: Hypothesis, points: FloatArray, level: float) -> FloatArray:
    """The most probable displacement and velocity a sample before each record.

    Args:
        problem: the records.
        hypothesis: about the input and the noises, with the motions that were found before.
        points: (P, K) coefficients.
        level: σ_v.

    Returns:
        (P, records, 2), scaled.
    """
    period = 2 * np.pi / problem.frequency
    first = problem.shortened(int(np.clip(period, *_PERIOD)))
    places = np.linspace(-_WIDEST, _WIDEST, _GRID)
    grid = np.stack(np.meshgrid(places, places, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    series, unit = np.arange(len(points) * len(problem.u)), problem.largest

    losses = _judge(first, hypothesis, points, np.zeros((2, 2)))
    coarse = max(level, _COARSE * problem.size)
    # In parts, where many records make many series.
    parts = np.array_split(np.repeat(grid, len(series), axis=1), -(-len(series) * len(grid) // _AT_ONCE))
    found = grid[np.concatenate([losses(unit * part, coarse) for part in parts]).argmin(axis=0), 0]
    for sensor in np.repeat([coarse, level], _STEPS):
        around = losses(unit * (found + _APART * _AROUND[:, None]), sensor)
        candidates = found + _PARTS[:, None, None] * _newton(around)
        tried = losses(unit * candidates, sensor)
        best = tried.argmin(axis=0)
        found = np.where((tried[best, series] < around[0])[:, None], candidates[best, series], found)
    rest = np.zeros_like(found)
    before = rest if hypothesis.motions is None else np.tile(hypothesis.motions, (len(points), 1))
    wells = np.repeat(rests(problem, points), len(problem.u), axis=1)
    choice = np.stack([unit * found, before, rest, *(np.stack([x, np.zeros_like(x)], axis=1) for x in wells)])
    chosen = _judge(problem, hypothesis, points, problem.start)(choice, level)
    chosen[0] -= _BETTER
    return np.asarray(choice[chosen.argmin(axis=0), series]).reshape(len(points), -1, 2)


def _newton(around: FloatArray) -> FloatArray:
    """(records, 2) steps to the minimum of parabolas through losses at `_AROUND`; downhill where they have none."""
    here, right, left, up, down, both, neither = around
    with np.errstate(invalid="ignore"):  # infinite where the numbers ran away
        slope = np.stack([right - left, up - down], axis=1) / (2 * _APART)
        xx, vv = right - 2 * here + left, up - 2 * here + down
        xv = (both + neither - right - left - up - down + 2 * here) / 2
        curvature = np.stack([np.stack([xx, xv], axis=1), np.stack([xv, vv], axis=1)], axis=1) / _APART**2
    finite = np.isfinite(curvature).all(axis=(1, 2)) & np.isfinite(slope).all(axis=1)
    slope[~finite], curvature[~finite] = 0.0, np.eye(2)
    values, ways = np.linalg.eigh(curvature)
    values = np.maximum(np.abs(values), 1e-12 * np.abs(values).max(axis=1, keepdims=True) + 1e-300)
    step = -np.einsum("rij,rj,rkj,rk->ri", ways, 1 / values, ways, slope)
    length = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _FARTHEST / np.maximum(length, 1e-300)))


def _judge(
    problem: Problem, hypothesis: Hypothesis, points: FloatArray, cov: FloatArray
) -> Callable[[FloatArray, float], FloatArray]:
    """Candidates (C, S, 2) and σ_v to minus the log likelihoods (C, S) of what begins there, within cov.

    Each of the S series is a record at one of the points (P, K).
    """
    inputs, outputs, spans, _ = problem.samples_of(*hypothesis.path)
    ratio = hypothesis.ratio
    at = np.repeat(points, len(inputs), axis=0)

    def losses(candidates: FloatArray, sensor: float) -> FloatArray:
        count, series = candidates.shape[:2]
        times = count * series // len(inputs)
        loss = follow(
            problem.model,
            np.tile(at, (count, 1)),
            np.tile(inputs, (times, 1, 1)),
            np.tile(outputs, (times, 1, 1)),
            problem.loud(np.tile([(ratio * sensor) ** 2, sensor**2], (times, 1))),
            cov,
            candidates.reshape(-1, 2),
            None if spans is None else np.tile(spans, (times, 1)),
        ).loss
        return np.where(np.isfinite(loss), loss, np.inf).reshape(count, series)

    return losses
