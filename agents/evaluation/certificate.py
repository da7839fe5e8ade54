"""Certificates: what no admissible input to Eq. (2) can exceed, stored beside each oracle.

    python -m agents.evaluation.certificate --env duffing_env/Amplitude-v0 --systems 24

**The bound.** With w = A z the linearised motion without noise (w_t = z_t - (θ1 + 3 θ2 x_{t-1}²) z_{t-1} - θ3 z_{t-2}),
Φ the regressors (x, x³, x', u) along the path, q and r the variances of the noises, the information is

    F = Φᵀ (q + r A Aᵀ)⁻¹ Φ  ⪯  (Φ - A V)ᵀ (Φ - A V) / q + Vᵀ V / r        for any V (T, 4),

with equality for one V. Let v_t = Wᵀ f(x_t, x_{t-1}, x_{t-2}), with odd monomials f. For any positive definite G

    log det M ≤ tr(G M) - log det G - 4,

so that the worth of every input is at most ½ [tr(G Λ0) - log det G - 4 + the most that Σ |φ_t - (A V)_t|²_G / q +
|v_t|²_G / r comes to]. Each term depends on five displacements in a row, and so the most is found by a dynamic
programme (`agents.evaluation.state_grid`). Under a limit of energy it would need the energy that is left as one more
state, and there is none yet: a price of energy instead bounds only mixtures of inputs, of which those of rest and much
energy are worth much more.

**G and W** are those of the best mixture of the paths that the programme has found so far; W is then a least squares
fit. Each programme adds a path to the mixture (Frank-Wolfe, fully corrective), until bound and mixture meet. The bound
holds for any G and W. A path keeps the displacements that it was found with, since rounding may lead its inputs
elsewhere; between nodes it may come to where one cannot stay within the limit, and is cut there.

**The grid.** The programme interpolates between nodes. Stored is the larger of the bounds on the grid and on one
of twice as many intervals, plus what they differ by. This allowance is no proof: on three and four times as many
intervals, the bounds of two systems of Output-v0, on which the grid tells most, lay at most 0.002 nats above it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement

import numpy as np

from agents.cli import JsonOptions, run_script
from agents.evaluation.oracle import Oracle, Systems
from agents.evaluation.state_grid import StateGrid
from estimator.free_run import free_run
from estimator.models.difference import difference
from estimator.parameters import FloatArray

#: Degrees of the monomials.
_DEGREES = (1, 3, 5)

#: Nodes along an axis of the displacements, and levels of the input.
_NODES, _LEVELS = 33, 5

#: Programmes, and the distance between bound and mixture [nats] at which they end.
_ROUNDS, _CLOSE = 16, 0.01

#: Steps that improve a mixture.
_STEPS = 200


@dataclass(frozen=True)
class Multipliers:
    """What a bound is taken with.

    Attributes:
        G: (4, 4), in units in which Λ0 is the identity.
        W: (features, 4), likewise.
    """

    G: FloatArray
    W: FloatArray


class Certificate:
    """The bound of one system.

    Args:
        systems: of a track with Eq. (2) as its plant, and no limit of energy.
        row: the system.
        n: nodes along an axis, an odd number.

    Raises:
        ValueError: for another plant, or with a limit of energy.
    """

    def __init__(self, systems: Systems, row: int, n: int = _NODES) -> None:
        if systems.plant.model != difference() or np.isfinite(systems.limits.energy):
            raise ValueError("systems must obey Eq. (2) without a limit of energy; no others have certificates yet")
        self.theta, self.samples, self.limits = systems.theta[row], systems.samples, systems.limits
        self.q, self.r = systems.variances[row]
        self.grid = StateGrid(self.theta, self.limits.output, self.limits.amplitude, n, _LEVELS)
        self.powers = [c for d in _DEGREES for c in combinations_with_replacement(range(3), d)]
        self.units = np.linalg.cholesky(np.linalg.inv(systems.precision))
        self.base = 0.5 * float(np.linalg.slogdet(systems.precision)[1])

    def features(self, *x: FloatArray) -> FloatArray:
        """(..., features) of x_t, x_{t-1} and x_{t-2}."""
        parts = np.broadcast_arrays(*(one / self.limits.output for one in x))
        return np.stack([np.prod([parts[i] for i in power], axis=0) for power in self.powers], axis=-1)

    def regressors(self, now: FloatArray, last: FloatArray, u: FloatArray) -> FloatArray:
        """(..., 4) φ of the sample from (x_t, x_{t-1}) under u_t, in units in which Λ0 is the identity."""
        phi: FloatArray = np.stack(np.broadcast_arrays(now, now**3, last, u), axis=-1) @ self.units
        return phi

    def slope(self, x: FloatArray) -> FloatArray:
        """θ1 + 3 θ2 x²."""
        slope: FloatArray = self.theta[0] + 3 * self.theta[1] * x**2
        return slope

    def moments(self, u: FloatArray, x: FloatArray | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
        """C (4, 4), N (f, 4) and M (f, f) of an input (T,), where the information is at most C - WᵀN - NᵀW + WᵀMW.

        ``x`` (T,) are the displacements that follow each input; they are calculated where they are not given.
        """
        x = np.concatenate([np.zeros(4), free_run(difference(), self.theta, u) if x is None else x])
        back = [x[4 - lag : len(x) - lag] for lag in range(5)]  # x_{t+1}, x_t, ...
        phi = self.regressors(back[1], back[2], u)
        f, f1, f2 = (self.features(*back[lag : lag + 3]) for lag in range(3))
        moved = f - self.slope(back[1])[:, None] * f1 - self.theta[2] * f2
        C, N, M = phi.T @ phi / self.q, moved.T @ phi / self.q, moved.T @ moved / self.q + f.T @ f / self.r
        return C, N, M

    def bound(self, multipliers: Multipliers, grid: StateGrid, layers: int = 2) -> tuple[float, FloatArray]:
        """The bound [nats], and the values of the programme (`StateGrid.values`)."""
        now, last, second, third = grid.nodes
        root = np.linalg.cholesky(multipliers.G)
        W = multipliers.W @ root
        u, after = (np.nan_to_num(found) for found in grid.actions(now[..., 0], last[..., 0]))
        # v_{t+1} (n, n, actions, 4), and what the motion makes of v_t and v_{t-1} (n, n, levels, levels, 4)
        next_v = self.features(after, now[..., 0], last[..., 0]) @ W
        wanted = self.regressors(now[..., 0], last[..., 0], u) @ root - next_v
        carried = self.slope(now)[..., None] * (self.features(now, last, second) @ W)
        carried = carried + self.theta[2] * (self.features(last, second, third) @ W)
        costs = np.zeros((*carried.shape[:-1], u.shape[-1]))
        for k in range(4):
            costs += (wanted[:, :, None, None, :, k] + carried[..., None, k]) ** 2 / self.q
        costs += ((next_v**2).sum(axis=-1) / self.r)[:, :, None, None]
        V = grid.values(costs, self.samples, layers)
        most = V[0, grid.n // 2, grid.n // 2, grid.levels // 2, grid.levels // 2]
        told = np.trace(multipliers.G) + most - np.linalg.slogdet(multipliers.G)[1] - 4.0
        return self.base + 0.5 * float(told), V

    def path(self, multipliers: Multipliers, V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The input (T,) that the programme holds for the best, from rest, and the displacements (T,) it leads to."""
        grid, root = self.grid, np.linalg.cholesky(multipliers.G)
        W, u, x = multipliers.W @ root, np.zeros(self.samples), np.zeros(self.samples)
        now, last, older, v, v1 = np.zeros(1), np.zeros(1), np.zeros(1), np.zeros((1, 4)), np.zeros((1, 4))
        for t in range(self.samples):
            inputs, after = grid.actions(now, last)
            allowed = ~np.isnan(inputs)
            if allowed.any():
                inputs, after = inputs[allowed], after[allowed]
            else:
                t1, t2, t3, _ = self.theta
                beyond = np.sign(t1 * now + t2 * now**3 + t3 * last)
                inputs, after = -beyond * self.limits.amplitude, beyond * self.limits.output
            next_v = self.features(after, now, last) @ W
            missed = self.regressors(now, last, inputs) @ root - next_v + self.slope(now) * v + self.theta[2] * v1
            told = (missed**2).sum(-1) / self.q + (next_v**2).sum(-1) / self.r
            best = int(np.argmax(told + self._between(V[t + 1], after, now, inputs, older)))
            u[t], x[t] = inputs[best], after[best]
            v1, v, last, now, older = v, next_v[best : best + 1], now, after[best : best + 1], inputs[best : best + 1]
        return u, x

    def _between(self, V: FloatArray, *point: FloatArray) -> FloatArray:
        """The value (actions,) at points between nodes; of those that cannot stay within the limit, far below."""
        bounds = (self.limits.output,) * 2 + (self.limits.amplitude,) * 2
        low, share = zip(
            *(self.grid.place(x, b, n) for x, b, n in zip(point, bounds, V.shape, strict=True)), strict=True
        )
        total, weight = np.zeros(len(point[0])), np.zeros(len(point[0]))
        for corner in np.ndindex(2, 2, 2, 2):
            value = V[tuple(at + up for at, up in zip(low, corner, strict=True))]
            part = np.ones(len(total))
            for w, up in zip(share, corner, strict=True):
                part = part * (w if up else 1.0 - w)
            alive = np.isfinite(value)
            total += np.where(alive, value, 0.0) * part
            weight += alive * part
        return np.where(weight > 1e-9, total / np.maximum(weight, 1e-9), -1e12)

    def find(self, inputs: FloatArray, rounds: int = _ROUNDS) -> float:
        """The bound [nats] of the worth ½ log det(Λ0 + F) of every admissible input.

        Args:
            inputs: (k, T) to begin the mixture with, such as the oracle's.
            rounds: programmes at most.
        """
        moments = [self.moments(u) for u in inputs]
        weights = np.full(len(moments), 1.0 / len(moments))
        least, best = np.inf, None
        for _ in range(rounds):
            weights, told, multipliers = self.mix(moments, weights)
            bound, V = self.bound(multipliers, self.grid, self.samples + 1)
            if bound < least:
                least, best = bound, multipliers
            if least < told + _CLOSE:
                break
            moments.append(self.moments(*self.path(multipliers, V)))
            weights = np.append(0.9 * weights, 0.1)
        assert best is not None
        fine = replace(self.grid, n=2 * self.grid.n - 1)
        refined = self.bound(best, fine)[0]
        return max(refined, least) + abs(refined - least)

    def mix(
        self, moments: list[tuple[FloatArray, FloatArray, FloatArray]], weights: FloatArray
    ) -> tuple[FloatArray, float, Multipliers]:
        """Improve a mixture of inputs by exponentiated gradient.

        Returns:
            Its weights, its worth [nats], and the multipliers of its bound.
        """
        C, N, M = (np.array(part) for part in zip(*moments, strict=True))

        def worth(p: FloatArray) -> tuple[float, FloatArray, Multipliers]:
            mean_M, mean_N = np.tensordot(p, M, 1), np.tensordot(p, N, 1)
            W = np.linalg.solve(mean_M + 1e-10 * np.diag(np.diag(mean_M)), mean_N)
            total = np.eye(4) + np.tensordot(p, C, 1) - mean_N.T @ W
            G = np.linalg.inv(total)
            each = C - W.T @ N - np.swapaxes(W.T @ N, 1, 2) + W.T @ M @ W
            told = self.base + 0.5 * float(np.linalg.slogdet(total)[1])
            return told, np.einsum("ij,nji->n", G, each), Multipliers(G.astype(np.float64), W.astype(np.float64))

        value, gains, found = worth(weights)
        rate = 1.0
        for _ in range(_STEPS):
            # In parts of the step that changes weights by a factor e.
            tried = weights * np.exp(rate * (gains - gains.max()) / (1e-12 + float(np.ptp(gains))))
            tried /= tried.sum()
            new = worth(tried)
            if new[0] > value - 1e-12:
                weights, (value, gains, found) = tried, new
                rate *= 1.5
            else:
                rate *= 0.4
            if rate < 1e-5:
                break
        return weights, value, found


@dataclass(frozen=True)
class Config:
    """Bound what inputs to the systems of a stored oracle can be worth, and store it beside the oracle."""

    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 24
    """Number of systems, of those that an oracle is stored of."""


def main(config: Config) -> None:
    """Bound, store, and say how much of what is possible the oracle certainly has."""
    began = time.perf_counter()
    systems = Systems.of(config.env, config.systems, config.options)
    oracle = Oracle.of(Systems.of(config.env, max(config.systems, Oracle.stored(systems)), config.options))
    count = min(config.systems, len(oracle.values))
    for row in range(count):
        oracle.bounds[row] = Certificate(oracle.systems, row).find(oracle.inputs[row : row + 1])
        oracle.save()
    share = np.exp((oracle.values - oracle.bounds)[:count] / 2.0)
    seconds = time.perf_counter() - began
    print(f"{count} systems in {seconds:.0f} s: certified share {share.mean():.3f}, least {share.min():.3f}")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
