"""Many hypotheses about the same records, each fitted to its most probable coefficients, in a lane of its own.

A hypothesis says how the input went between samples, with which delay, which terms the equation has, and how the two
noises share what the outputs show: σ_w/σ_v. With the Kalman filter's innovations ν_t and their variances S_t at the
coefficients ψ it is judged by the free energy of a Gaussian at the minimum (variational Laplace),

    L = ½ Σ_t (ν_t²/S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0),    F = L + ½ log det(Λ0 + I) - ½ log det Λ0,

with the information I of `estimator.information`. The level of the noises is not searched: S grows with it as a whole,
so at the best level Σ ν²/S is the number of outputs N, and ½ Σ(...) = ½ (Σ log S + N log(Σ ν²/S / N) + N). The
first outputs of a record, as many as there are states, do not count: any motion may have been before them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.identification.problem import Problem, Samples
from estimator.information import Followed, follow
from estimator.parameters import FloatArray

#: Damping at the start of a fit, its change after a step that fails or succeeds, its least, and where a fit is given
#: up.
_DAMPING, _UP, _DOWN, _LEAST, _STUCK = 1e-6, 30.0, 0.1, 1e-9, 1e2

#: A step that promises to lower the loss by less is the last of a fit [nats]: it is a seventh of a standard deviation,
#: of which it leaves a small part.
_SMALL = 1e-2

#: So many times what the last step gained is what a fit may still gain.
_MANY = 10.0


@dataclass(frozen=True)
class Hypothesis:
    """What is held for true while the coefficients are fitted.

    Attributes:
        interpolation: of the input.
        delay: of the input, in samples.
        lag: time constant of a first-order lag of the input, in samples.
        ratio: σ_w/σ_v inside.
        motions: (records, 2) displacement and velocity a sample before each record, about which the filter is linear at
            its first samples; at rest where it is None.
    """

    interpolation: str
    delay: float
    ratio: float = 1.0
    motions: FloatArray | None = field(default=None, compare=False)
    lag: float = 0.0

    @property
    def path(self) -> tuple[str, float, float]:
        """How the input went: interpolation, delay and lag."""
        return self.interpolation, self.delay, self.lag


@dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian over the coefficients of `Problem.model`: mean (K,) and precision (K, K)."""

    mean: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, mean: FloatArray, cov: FloatArray) -> Prior:
        """That of given moments (K,) and (K, K)."""
        scale = np.sqrt(np.diag(cov))
        return cls(mean, np.linalg.inv(cov / np.outer(scale, scale)) / np.outer(scale, scale))

    def widened(self, more: Sequence[tuple[float, float]]) -> Prior:
        """With more coefficients, of means and standard deviations."""
        n, means, stds = len(self.mean), [mean for mean, _ in more], np.array([std for _, std in more])
        precision = np.zeros((n + len(stds),) * 2)
        precision[:n, :n], precision[n:, n:] = self.precision, np.diag(stds**-2)
        return Prior(np.append(self.mean, means), precision)


@dataclass(frozen=True, eq=False)
class Fits:
    """What became of H hypotheses.

    Attributes:
        hypotheses: in order.
        mean: (H, K) most probable coefficients.
        cov: (H, K, K) their covariance.
        level: (H,) σ_v.
        free_energy: (H,) in nats, up to a constant that all share; inf where the numbers ran away, or the records and
            the prior leave a coefficient open.
        loss: (H,) the part of it that is L.
    """

    hypotheses: tuple[Hypothesis, ...]
    mean: FloatArray
    cov: FloatArray
    level: FloatArray
    free_energy: FloatArray
    loss: FloatArray

    def best(self, count: int) -> Fits:
        """Those of the lowest free energies, the lowest first."""
        return self.where(np.argsort(self.free_energy, kind="stable")[:count])

    def where(self, chosen: npt.NDArray[Any]) -> Fits:
        """Those of some hypotheses, told by their numbers or by flags."""
        kept = tuple(self.hypotheses[i] for i in np.arange(len(self.hypotheses))[chosen])
        parts = (self.mean, self.cov, self.level, self.free_energy, self.loss)
        return Fits(kept, *(part[chosen] for part in parts))

    @classmethod
    def joined(cls, several: Sequence[Fits]) -> Fits:
        """All of several."""
        parts = zip(*((f.mean, f.cov, f.level, f.free_energy, f.loss) for f in several), strict=True)
        return cls(tuple(h for f in several for h in f.hypotheses), *(np.concatenate(part) for part in parts))


class _Held(NamedTuple):
    """What does not move in a fit of H hypotheses of G kinds: how the input went, and with which delay.

    Attributes:
        kinds: (H,) of each.
        inputs: (G, records, N, rows).
        outputs: (G, records, N, 1).
        spans: (G, records, N), or None.
        ratios: (H,).
        motions: (H, records, 2).
    """

    kinds: npt.NDArray[np.intp]
    inputs: FloatArray
    outputs: FloatArray
    spans: FloatArray | None
    ratios: FloatArray
    motions: FloatArray

    def of(self, chosen: npt.NDArray[np.intp]) -> _Held:
        """That of some hypotheses."""
        return self._replace(kinds=self.kinds[chosen], ratios=self.ratios[chosen], motions=self.motions[chosen])


def _longer(series: FloatArray, samples: int, rows: int | None = None) -> FloatArray:
    """(records, N, ...) made longer with NaN, and wider with zeros."""
    more = samples - series.shape[1]
    if rows is not None:
        series = np.pad(series, ((0, 0), (0, 0), (0, rows - series.shape[2])))
    return (
        np.pad(series, ((0, 0), (0, more), *([(0, 0)] * (series.ndim - 2))), constant_values=np.nan) if more else series
    )


class Fitter:
    """Fits hypotheses about a problem.

    Args:
        problem: the records.
        prior: of the coefficients.
    """

    def __init__(self, problem: Problem, prior: Prior) -> None:
        self.problem, self.prior = problem, prior
        self._scale = 1 / np.sqrt(np.diag(prior.precision))
        self._samples: dict[tuple[str, float, float], Samples] = {}

    def on(self, problem: Problem) -> Fitter:
        """The same for other records."""
        return Fitter(problem, self.prior)

    def fit(
        self,
        hypotheses: Sequence[Hypothesis],
        start: FloatArray,
        level: FloatArray | float,
        iterations: int = 30,
        bar: float = np.inf,
        pinned: FloatArray | None = None,
    ) -> Fits:
        """Fit each hypothesis by damped Gauss-Newton steps (Levenberg and Marquardt).

        Args:
            hypotheses: H of them.
            start: (K,) or (H, K) coefficients to begin with.
            level: (H,) or one: σ_v to begin with.
            iterations: at most.
            bar: a free energy; a hypothesis that cannot come below it is given up.
            pinned: (H, K) directions: no step changes their products with the coefficients. Covariances and free
                energies are as if nothing were pinned.
        """
        count, k = len(hypotheses), len(self._scale)
        points = np.broadcast_to(start, (count, k)).copy()
        pins = None if pinned is None else pinned * self._scale
        levels = np.broadcast_to(np.asarray(level, dtype=np.float64), count)
        held = self._held(hypotheses)
        loss, slope, curvature, levels = self._appraise(points, held, levels)
        damping = np.full(count, _DAMPING)
        at = np.flatnonzero(np.isfinite(loss))
        for _ in range(iterations):
            if not len(at):
                break
            damped = curvature[at] + (damping[at, None] * np.einsum("hii->hi", curvature[at]))[:, :, None] * np.eye(k)
            step = -(solved(damped, slope[at]) if pins is None else _solved_across(damped, slope[at], pins[at]))
            promised = -0.5 * np.einsum("hk,hk->h", slope[at], step)
            trial = points[at] + self._scale * step
            found = self._appraise(trial, held.of(at), levels[at])
            better = found[0] <= loss[at]  # False for what is not finite
            gained = np.where(better, loss[at] - found[0], promised)
            kept = at[better]
            points[kept] = trial[better]
            loss[kept], slope[kept], curvature[kept], levels[kept] = (values[better] for values in found)
            damping[at] = np.where(better, np.maximum(_DOWN * damping[at], _LEAST), _UP * damping[at])
            over = (
                (promised < _SMALL)
                | (damping[at] > _STUCK)
                | (self._energy(loss[at], curvature[at]) - _MANY * gained > bar)
            )
            at = at[~over]
        cov = inverted(curvature) * np.outer(self._scale, self._scale)
        energies = np.where(np.isfinite(cov).all(axis=(1, 2)), self._energy(loss, curvature), np.inf)
        return Fits(tuple(hypotheses), points, cov, levels, energies, loss)

    def loudness(self, hypothesis: Hypothesis, point: FloatArray, level: float) -> FloatArray:
        """(records,) the noises that each record shows at coefficients (K,), in parts of what they are on the whole."""
        held, seen = self._held([hypothesis]), [np.isfinite(y).sum() for y in self.problem.y]
        misfits = self._followed(point[None], held, np.array([level])).misfit
        parts = np.ones(len(seen)) if self.problem.loudness is None else self.problem.loudness
        excess = misfits / np.maximum(np.array(seen) - self.problem.model.n_states, 1)
        found = parts * np.sqrt(excess)
        return np.asarray(found / np.sqrt(np.average(found**2, weights=seen)))

    def _held(self, hypotheses: Sequence[Hypothesis]) -> _Held:
        rest = np.zeros((len(self.problem.u), 2))
        kinds = list(dict.fromkeys(h.path for h in hypotheses))
        for kind in kinds:
            if kind not in self._samples:
                self._samples[kind] = self.problem.samples_of(*kind)
        series = [self._samples[kind] for kind in kinds]
        longest = max(one.inputs.shape[1] for one in series)
        rows = max(one.inputs.shape[2] for one in series)
        timed = any(one.spans is not None for one in series)
        ones = lambda one: np.ones(one.inputs.shape[:2]) if one.spans is None else one.spans  # noqa: E731
        lengths = [_longer(ones(one), longest) for one in series] if timed else []
        return _Held(
            np.array([kinds.index(h.path) for h in hypotheses]),
            np.array([_longer(one.inputs, longest, rows) for one in series]),
            np.array([_longer(one.outputs, longest, 1) for one in series]),
            np.array(lengths) if lengths else None,
            np.array([h.ratio for h in hypotheses]),
            np.array([rest if h.motions is None else h.motions for h in hypotheses]),
        )

    def _appraise(
        self, points: FloatArray, held: _Held, levels: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Loss (H,), its slope (H, K) and curvature (H, K, K) in units of the prior, and the best levels (H,)."""
        problem, count, records = self.problem, len(points), len(self.problem.u)
        n = problem.samples - records * problem.model.n_states
        found = self._followed(points, held, levels)
        total = lambda values: values.reshape(count, records, *values.shape[1:]).sum(axis=1)  # noqa: E731
        with np.errstate(all="ignore"):
            loss, slope, information, misfit = (total(values) for values in found)
            excess = misfit / n
            data = 0.5 * (2 * loss - misfit + n * np.log(excess) + n)
            away = points - self.prior.mean
            pull = away @ self.prior.precision
            whole = data + 0.5 * (away * pull).sum(axis=1)
            slope = self._scale * (slope / excess[:, None] + pull)
            curvature = self._in_units(information / excess[:, None, None] + self.prior.precision)
        bad = ~(np.isfinite(whole) & np.isfinite(slope).all(axis=1) & np.isfinite(curvature).all(axis=(1, 2)))
        bad |= (np.einsum("hii->hi", curvature) <= 0).any(axis=1)
        whole = np.where(bad, np.inf, whole)
        slope[bad], curvature[bad] = 0.0, np.eye(len(self._scale))
        return whole, slope, curvature, np.where(bad, levels, levels * np.sqrt(np.where(bad, 1.0, excess)))

    def _followed(self, points: FloatArray, held: _Held, levels: FloatArray) -> Followed:
        """What the filter finds in all records at each of the points (H, K)."""
        problem, records, inputs = self.problem, len(self.problem.u), held.inputs[held.kinds]
        return follow(
            problem.model,
            np.repeat(points, records, axis=0),
            inputs.reshape(-1, *inputs.shape[2:]),
            held.outputs[held.kinds].reshape(-1, *held.outputs.shape[2:]),
            problem.loud(np.stack([(held.ratios * levels) ** 2, levels**2], axis=1)),
            problem.start,
            held.motions.reshape(-1, 2),
            None if held.spans is None else held.spans[held.kinds].reshape(-1, held.spans.shape[2]),
        )

    def _energy(self, loss: FloatArray, curvature: FloatArray) -> FloatArray:
        """(H,) free energies; inf where they are not finite."""
        log_det = np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(self._in_units(self.prior.precision))[1]
        return np.where(np.isfinite(loss + log_det), loss + 0.5 * log_det, np.inf)

    def _in_units(self, precision: FloatArray) -> FloatArray:
        """A precision of the coefficients, of these in standard deviations of the prior."""
        return precision * np.outer(self._scale, self._scale)


def _unit(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrices with 1 on their diagonals, and the roots of those that they had."""
    root = np.sqrt(np.einsum("hii->hi", matrices))
    return matrices / (root[:, :, None] * root[:, None, :]), root


def solved(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """(H, K) solutions; zeros where a matrix is singular."""
    unit, root = _unit(matrices)
    return _row_by_row(np.linalg.solve, 0.0, unit, (vectors / root)[:, :, None])[:, :, 0] / root


def _solved_across(matrices: FloatArray, vectors: FloatArray, pins: FloatArray) -> FloatArray:
    """(H, K) solutions in the planes that are at right angles to the pins (H, K)."""
    unit, root = _unit(matrices)
    plane = np.linalg.qr((pins / root)[:, :, None], mode="complete")[0][:, :, 1:]
    turned = np.swapaxes(plane, 1, 2)
    return (plane @ solved(turned @ unit @ plane, (turned @ (vectors / root)[:, :, None])[:, :, 0])[:, :, None])[
        :, :, 0
    ] / root


def inverted(matrices: FloatArray) -> FloatArray:
    """(H, K, K) inverses; NaN where a matrix is singular."""
    unit, root = _unit(matrices)
    return _row_by_row(np.linalg.inv, np.nan, unit) / (root[:, :, None] * root[:, None, :])


def _row_by_row(solve: Callable[..., FloatArray], lost: float, *stacks: FloatArray) -> FloatArray:
    """What ``solve`` makes of stacks: of all at once, or where a matrix is singular, of each; ``lost`` for that one."""
    try:
        return np.asarray(solve(*stacks))
    except np.linalg.LinAlgError:
        if len(stacks[0]) == 1:
            return np.full_like(stacks[-1], lost)
        rows = [[stack[i : i + 1] for stack in stacks] for i in range(len(stacks[0]))]
        return np.concatenate([_row_by_row(solve, lost, *row) for row in rows])


def with_ratios(hypothesis: Hypothesis, ratios: FloatArray) -> list[Hypothesis]:
    """The same hypothesis at several ratios of the noises."""
    return [replace(hypothesis, ratio=float(ratio)) for ratio in ratios]
