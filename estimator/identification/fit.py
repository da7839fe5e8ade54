"""Many hypotheses about the same records, each fitted to its most probable coefficients, in a lane of its own.

A hypothesis says how the input went between samples, with which delay, which terms the equation has, and how the two
noises share what the outputs show: σ_w/σ_v. With the Kalman filter's innovations ν_t and their variances S_t at the
coefficients ψ it is judged by the free energy of a Gaussian at the minimum (variational Laplace),

    L = ½ Σ_t (ν_t²/S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0),    F = L + ½ log det(Λ0 + I) - ½ log det Λ0,

with the information I of `estimator.information`. The level of the noises is not searched: S grows with it as a whole,
so at the best level Σ ν²/S is the number of outputs N, and ½ Σ(...) = ½ (Σ log S + N log(Σ ν²/S / N) + N).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from estimator.identification.problem import EXTRA, Problem
from estimator.information import follow
from estimator.parameters import FloatArray

Flags: TypeAlias = npt.NDArray[np.bool_]

#: Damping at the start of a fit, its change after a step that fails or succeeds, and where a fit is given up: the slope
#: leaves out what S and the gain tell, so at the minimum no step of any length succeeds.
_DAMPING, _UP, _DOWN, _STUCK = 1e-3, 10.0, 0.1, 1e2

#: A step that promises to lower the loss by less ends a fit [nats]; it is a fraction of a standard deviation.
_SMALL = 1e-3


@dataclass(frozen=True)
class Hypothesis:
    """What is held for true while the coefficients are fitted.

    Attributes:
        interpolation: of the input.
        delay: of the input, in samples.
        extra: terms beside those of Eq. (1) with offsets.
        ratio: σ_w/σ_v inside.
    """

    interpolation: str
    delay: int
    extra: tuple[str, ...] = ()
    ratio: float = 1.0


@dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian over the coefficients of `Problem.model`: mean (K,) and precision (K, K)."""

    mean: FloatArray
    precision: FloatArray


@dataclass(frozen=True, eq=False)
class Fits:
    """What became of H hypotheses.

    Attributes:
        hypotheses: in order.
        mean: (H, K) most probable coefficients.
        cov: (H, K, K) their covariance; 0 for terms that a hypothesis does not have.
        level: (H,) σ_v.
        free_energy: (H,) in nats, up to a constant that all share; inf where the numbers ran away.
    """

    hypotheses: tuple[Hypothesis, ...]
    mean: FloatArray
    cov: FloatArray
    level: FloatArray
    free_energy: FloatArray

    @property
    def best(self) -> int:
        """The hypothesis of the lowest free energy."""
        return int(np.argmin(self.free_energy))

    def where(self, chosen: Flags) -> Fits:
        """Those of some hypotheses."""
        kept = tuple(h for h, keep in zip(self.hypotheses, chosen, strict=True) if keep)
        return Fits(kept, self.mean[chosen], self.cov[chosen], self.level[chosen], self.free_energy[chosen])


class Fitter:
    """Fits hypotheses about a problem.

    Args:
        problem: the records.
        prior: of the coefficients.
    """

    def __init__(self, problem: Problem, prior: Prior) -> None:
        self.problem, self.prior = problem, prior
        self._outputs, self._samples = problem.outputs, problem.samples
        self._inputs: dict[tuple[str, int], FloatArray] = {}

    def on(self, problem: Problem) -> Fitter:
        """The same for other records."""
        return Fitter(problem, self.prior)

    def fit(
        self, hypotheses: list[Hypothesis], start: FloatArray, level: FloatArray | float, iterations: int = 30
    ) -> Fits:
        """Fit each hypothesis by damped Gauss-Newton steps (Levenberg and Marquardt).

        Args:
            hypotheses: H of them.
            start: (K,) or (H, K) coefficients to begin with.
            level: (H,) or one: σ_v to begin with.
            iterations: at most.
        """
        names = list(self.problem.model.coefficients)
        count = len(hypotheses)
        free = np.array([[_has(h, name) for name in names] for h in hypotheses])
        points = np.where(free, np.broadcast_to(start, (count, len(names))), 0.0)
        inputs = np.concatenate([self._driven(h) for h in hypotheses])
        ratios = np.array([h.ratio for h in hypotheses])
        levels = np.broadcast_to(np.asarray(level, dtype=np.float64), count).copy()
        scale = 1 / np.sqrt(np.diag(self.prior.precision))
        loss, slope, curvature, levels = self._appraise(points, inputs, ratios, levels, free)
        damping = np.full(count, _DAMPING)
        done = ~np.isfinite(loss)
        for _ in range(iterations):
            if done.all():
                break
            diagonal = np.einsum("hii->hi", curvature)
            damped = curvature + (damping[:, None] * diagonal)[:, :, None] * np.eye(len(names))
            step = -_solved(damped, slope)
            step[done] = 0.0
            promised = -0.5 * np.einsum("hk,hk->h", slope, step)
            trial = points + scale * step
            new_loss, new_slope, new_curvature, new_levels = self._appraise(trial, inputs, ratios, levels, free)
            better = (new_loss <= loss) & ~done  # False for what is not finite
            points = np.where(better[:, None], trial, points)
            loss, levels = np.where(better, new_loss, loss), np.where(better, new_levels, levels)
            slope = np.where(better[:, None], new_slope, slope)
            curvature = np.where(better[:, None, None], new_curvature, curvature)
            damping = np.where(better, np.maximum(_DOWN * damping, 1e-9), _UP * damping)
            done |= (promised < _SMALL) | (damping > _STUCK)
        inverse = _inverted(curvature)
        cov = np.where(free[:, :, None] & free[:, None, :], inverse, 0.0) * np.outer(scale, scale)
        log_det = np.linalg.slogdet(curvature)[1] - np.array([self._prior_log_det(row, scale) for row in free])
        energy = np.where(np.isfinite(loss + log_det), loss + 0.5 * log_det, np.inf)
        return Fits(tuple(hypotheses), points, cov, levels, energy)

    def _driven(self, hypothesis: Hypothesis) -> FloatArray:
        key = hypothesis.interpolation, hypothesis.delay
        if key not in self._inputs:
            self._inputs[key] = self.problem.inputs(*key)
        return self._inputs[key]

    def _appraise(
        self,
        points: FloatArray,
        inputs: FloatArray,
        ratios: FloatArray,
        levels: FloatArray,
        free: npt.NDArray[np.bool_],
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Loss (H,), its slope (H, K) and curvature (H, K, K) in units of the prior, and the best levels (H,)."""
        records, count = len(self.problem.u), len(points)
        noises = np.stack([(ratios * levels) ** 2, levels**2], axis=1)
        found = follow(
            self.problem.model,
            np.repeat(points, records, axis=0),
            inputs,
            np.tile(self._outputs, (count, 1, 1)),
            np.repeat(noises, records, axis=0),
            self.problem.start,
        )
        total = lambda values: values.reshape(count, records, *values.shape[1:]).sum(axis=1)  # noqa: E731
        loss, slope, information, misfit = (total(values) for values in found)
        n = self._samples
        with np.errstate(all="ignore"):
            excess = misfit / n
            data = 0.5 * (2 * loss - misfit + n * np.log(excess) + n)
            scale = 1 / np.sqrt(np.diag(self.prior.precision))
            away = np.where(free, points - self.prior.mean, 0.0)
            pull = away @ self.prior.precision
            whole = data + 0.5 * (away * pull).sum(axis=1)
            slope = np.where(free, scale * (slope / excess[:, None] + pull), 0.0)
            curvature = (information / excess[:, None, None] + self.prior.precision) * np.outer(scale, scale)
        both = free[:, :, None] & free[:, None, :]
        curvature = np.where(both, curvature, np.eye(len(scale)))
        bad = ~(np.isfinite(whole) & np.isfinite(slope).all(axis=1) & np.isfinite(curvature).all(axis=(1, 2)))
        whole = np.where(bad, np.inf, whole)
        slope[bad], curvature[bad] = 0.0, np.eye(len(scale))
        return whole, slope, curvature, np.where(bad, levels, levels * np.sqrt(np.where(bad, 1.0, excess)))

    def _prior_log_det(self, free: Flags, scale: FloatArray) -> float:
        unit = (self.prior.precision * np.outer(scale, scale))[np.ix_(free, free)]
        return float(np.linalg.slogdet(unit)[1])


def _has(hypothesis: Hypothesis, name: str) -> bool:
    return name not in EXTRA or name in hypothesis.extra


def _unit(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrices with 1 on their diagonals, and the roots of those that they had."""
    root = np.sqrt(np.einsum("hii->hi", matrices))
    return matrices / (root[:, :, None] * root[:, None, :]), root


def _solved(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    unit, root = _unit(matrices)
    try:
        return np.asarray(np.linalg.solve(unit, (vectors / root)[:, :, None])[:, :, 0] / root)
    except np.linalg.LinAlgError:
        return np.zeros_like(vectors)


def _inverted(matrices: FloatArray) -> FloatArray:
    unit, root = _unit(matrices)
    try:
        return np.asarray(np.linalg.inv(unit) / (root[:, :, None] * root[:, None, :]))
    except np.linalg.LinAlgError:
        return np.zeros_like(matrices)


def with_ratios(hypothesis: Hypothesis, ratios: FloatArray) -> list[Hypothesis]:
    """The same hypothesis at several ratios of the noises."""
    return [replace(hypothesis, ratio=float(ratio)) for ratio in ratios]
