"""Upper bounds of the information of admissible inputs to Eq. (2), stored beside each oracle.

    python -m research.oracles.certificate --env duffing_env/Amplitude-v0 --systems 24

**The bound.** With w = A z the linearised motion without noise (w_t = z_t - (θ1 + 3 θ2 x_{t-1}²) z_{t-1} - θ3 z_{t-2}),
Φ the regressors (x, x³, x', u) along the path, q and r the variances of the noises, the information is

    F = Φᵀ (q + r A Aᵀ)⁻¹ Φ  ⪯  (Φ - A V)ᵀ (Φ - A V) / q + Vᵀ V / r        for any V (T, 4),

with equality for one V. Let v_t = Wᵀ f(x_t, x_{t-1}, x_{t-2}), with odd monomials f. For any positive definite G

    log det M ≤ tr(G M) - log det G - 4,

so that the criterion of every input is at most ½ [tr(G Λ0) - log det G - 4 + the maximum of Σ |φ_t - (A V)_t|²_G / q +
|v_t|²_G / r]. Each term depends on five consecutive displacements, so a dynamic programme finds the maximum
(`research.oracles.state_grid`). Under an energy limit, the energy that is left is one more state. A price of energy
would bound mixtures of inputs too, and a mixture of rest and of a strong input has much more information.

**G and W** are optimal for the best mixture of the paths that the programme has found so far; W is then a least squares
fit. Each programme adds a path to the mixture (Frank-Wolfe, fully corrective), until bound and mixture meet. The bound
holds for any G and W. A path keeps the displacements that it was found with, because its rounded inputs may cause other
ones. A path between nodes may enter a region from which no input stays within the limit, and is cut there.

Where energy is limited, the best inputs lie between the levels of the grid, and the programme's path is only near the
best one. Gradient steps therefore improve it. Where the grid's bound is smaller than the information of that path, or
of the mixture, this information is the bound.

**The grid.** The programme interpolates between nodes. Stored is the larger of the bounds on the grid and on a finer
one (`StateGrid.refined`), plus their difference. This allowance is no proof, and it is weak where energy is limited:
there the bound does not converge as the number of intervals grows, and a finer grid can give more or less.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement

import numpy as np

from agents.cli import run_script
from agents.console_output import print_texts_and_tables
from agents.evaluation.oracle import Oracle, TrackSystems
from agents.json_options import JsonOptions
from estimator.inference.free_run import free_run
from estimator.models.difference_equation import difference
from estimator.support.array_types import FloatArray
from estimator.support.progress import iterate_with_progress
from research.oracles.input_mixture import BoundMultipliers, InformationMoments, improve_mixture
from research.oracles.state_grid import StateGrid

#: Degrees of the monomials f.
_MONOMIAL_DEGREES = (1, 3, 5)

#: Nodes along an axis of the displacements.
_N_NODES = 33

#: Levels of the input in a node.
_N_LEVELS = 5

#: Nodes of the energy left, where it is limited.
_N_ENERGIES = 65

#: Levels of an action, where energy is limited.
_N_INPUTS = 17

#: Ratio of the number of levels of an action in a path to their number in the programme, where energy is limited.
_PATH_REFINEMENT = 8

#: Largest number of gradient steps of a path, where energy is limited.
_N_GRADIENT_STEPS = 30

#: Length of the first of these steps, relative to the root of the energy.
_FIRST_STEP = 0.02

#: Perturbation of an input for finite differences, relative to the largest input.
_DIFFERENCE_FRACTION = 1e-4

#: Programmes over which progress is measured, where energy is limited.
_PATIENCE = 3

#: Progress [nats] over these programmes below which the iteration ends.
_MIN_PROGRESS = 2e-3

#: Largest number of programmes.
_MAX_PROGRAMMES = 16

#: Distance between bound and mixture [nats] at which the iteration ends.
_MAX_GAP = 0.01


class Certificate:
    """The bound of one system.

    Args:
        systems: systems of a track whose plant is Eq. (2).
        row: index of the system.
        n: nodes along an axis, an odd number.

    Raises:
        ValueError: for another plant.
    """

    def __init__(self, systems: TrackSystems, row: int, n: int = _N_NODES) -> None:
        if systems.plant.model != difference():
            raise ValueError("systems must obey Eq. (2); no others have certificates yet")
        self.theta, self.samples, self.limits = systems.theta[row], systems.samples, systems.limits
        self.q, self.r = systems.variances[row]
        self.grid = StateGrid(self.theta, self.limits.output, self.limits.amplitude, n, _N_LEVELS, _N_LEVELS)
        if np.isfinite(self.limits.energy):
            self.grid = replace(self.grid, energy=self.limits.energy, energies=_N_ENERGIES, inputs=_N_INPUTS)
        self.powers = [c for d in _MONOMIAL_DEGREES for c in combinations_with_replacement(range(3), d)]
        self.units = np.linalg.cholesky(np.linalg.inv(systems.precision))
        self.base = 0.5 * float(np.linalg.slogdet(systems.precision)[1])

    def features(self, *x: FloatArray) -> FloatArray:
        """(..., features) of x_t, x_{t-1} and x_{t-2}."""
        parts = np.broadcast_arrays(*(one / self.limits.output for one in x))
        return np.stack([np.prod([parts[i] for i in power], axis=0) for power in self.powers], axis=-1)

    def regressors(self, now: FloatArray, last: FloatArray, u: FloatArray) -> FloatArray:
        """Regressors φ (..., 4) of the sample from (x_t, x_{t-1}) under u_t, in units in which Λ0 is the identity."""
        phi: FloatArray = np.stack(np.broadcast_arrays(now, now**3, last, u), axis=-1) @ self.units
        return phi

    def slope(self, x: FloatArray) -> FloatArray:
        """θ1 + 3 θ2 x²."""
        slope: FloatArray = self.theta[0] + 3 * self.theta[1] * x**2
        return slope

    def regressors_along(self, u: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Φ (..., T, 4), and the features (..., T, f) of V and of A V.

        ``x`` (..., T) are the displacements that follow each of the inputs ``u`` (..., T).
        """
        x = np.concatenate([np.zeros((*x.shape[:-1], 4)), x], axis=-1)
        back = [x[..., 4 - lag : x.shape[-1] - lag] for lag in range(5)]  # x_{t+1}, x_t, ...
        f, f1, f2 = (self.features(*back[lag : lag + 3]) for lag in range(3))
        return self.regressors(back[1], back[2], u), f, f - self.slope(back[1])[..., None] * f1 - self.theta[2] * f2

    def moments(self, u: FloatArray, x: FloatArray | None = None) -> InformationMoments:
        """The moments of an input (T,); the displacements ``x`` (T,) are calculated where they are not given."""
        phi, f, moved = self.regressors_along(u, free_run(difference(), self.theta, u) if x is None else x)
        return phi.T @ phi / self.q, moved.T @ phi / self.q, moved.T @ moved / self.q + f.T @ f / self.r

    def attained_sum(self, multipliers: BoundMultipliers, u: FloatArray, x: FloatArray) -> FloatArray:
        """The sum (n,) that the programme maximises, for inputs and displacements (n, T) from rest."""
        root = np.linalg.cholesky(multipliers.G)
        phi, f, moved = self.regressors_along(u, x)
        residual, v = phi @ root - moved @ (multipliers.W @ root), f @ (multipliers.W @ root)
        total: FloatArray = (residual**2).sum(axis=(-2, -1)) / self.q + (v**2).sum(axis=(-2, -1)) / self.r
        return total

    def ascend(self, multipliers: BoundMultipliers, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """An admissible input (T,) near ``u`` with more information, by gradient steps, and its displacements (T,)."""

        def simulate(inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
            x = np.stack([free_run(difference(), self.theta, one) for one in inputs])
            return self.attained_sum(multipliers, inputs, x), x

        limits, rate = self.limits, _FIRST_STEP
        moved = _DIFFERENCE_FRACTION * limits.amplitude
        (best,), (x,) = simulate(u[None])
        for _ in range(_N_GRADIENT_STEPS):
            gradient = (simulate(u + moved * np.eye(len(u)))[0] - best) / moved
            gradient -= u * (gradient @ u) / (u @ u)
            step = gradient * np.sqrt(limits.energy / (gradient @ gradient))
            while rate > _FIRST_STEP / 100:
                tried = np.clip(u + rate * step, -limits.amplitude, limits.amplitude)
                tried *= np.minimum(1.0, np.sqrt(limits.energy / (tried @ tried)))
                (information,), (outputs,) = simulate(tried[None])
                if information > best and np.abs(outputs).max() <= limits.output:
                    u, x, best, rate = tried, outputs, information, 1.5 * rate
                    break
                rate *= 0.4
            else:
                break
        return u, x

    def bound(self, multipliers: BoundMultipliers, grid: StateGrid, layers: int = 2) -> tuple[float, FloatArray]:
        """The bound [nats], and the values of the programme (`StateGrid.solve`)."""
        now, last, second, third = grid.nodes
        root = np.linalg.cholesky(multipliers.G)
        W = multipliers.W @ root
        u, after = (np.nan_to_num(found) for found in grid.actions(now[..., 0], last[..., 0]))
        # v_{t+1} (n, n, inputs + 2, 4), and the terms of A V in v_t and v_{t-1} (n, n, levels, levels, 4)
        next_v = self.features(after, now[..., 0], last[..., 0]) @ W
        wanted = self.regressors(now[..., 0], last[..., 0], u) @ root - next_v
        carried = self.slope(now)[..., None] * (self.features(now, last, second) @ W)
        carried = carried + self.theta[2] * (self.features(last, second, third) @ W)
        costs = np.zeros((*carried.shape[:-1], u.shape[-1]))
        for k in range(4):
            costs += (wanted[:, :, None, None, :, k] + carried[..., None, k]) ** 2 / self.q
        costs += ((next_v**2).sum(axis=-1) / self.r)[:, :, None, None]
        V = grid.solve(costs, self.samples, layers)
        most = V[0, grid.n // 2, grid.n // 2, grid.levels // 2, grid.levels // 2, -1]
        return self._at_most(multipliers, most), V

    def path(self, multipliers: BoundMultipliers, V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The programme's best input (T,) from rest, and its displacements (T,)."""
        grid, root = self.grid, np.linalg.cholesky(multipliers.G)
        if grid.energies > 1:
            grid = replace(grid, inputs=_PATH_REFINEMENT * (grid.inputs - 1) + 1)
        left = grid.energy
        W, u, x = multipliers.W @ root, np.zeros(self.samples), np.zeros(self.samples)
        now, last, older, v, v1 = np.zeros(1), np.zeros(1), np.zeros(1), np.zeros((1, 4)), np.zeros((1, 4))
        for t in range(self.samples):
            inputs, after = grid.actions(now, last)
            allowed = inputs**2 <= left  # and not NaN
            if allowed.any():
                inputs, after = inputs[allowed], after[allowed]
            else:
                t1, t2, t3, _ = self.theta
                beyond = np.sign(t1 * now + t2 * now**3 + t3 * last)
                inputs, after = -beyond * self.limits.amplitude, beyond * self.limits.output
            next_v = self.features(after, now, last) @ W
            residual = self.regressors(now, last, inputs) @ root - next_v + self.slope(now) * v + self.theta[2] * v1
            gains = (residual**2).sum(-1) / self.q + (next_v**2).sum(-1) / self.r
            best = int(np.argmax(gains + self.grid.interpolate(V[t + 1], after, now, inputs, older, left - inputs**2)))
            u[t], x[t] = inputs[best], after[best]
            left -= u[t] ** 2
            v1, v, last, now, older = v, next_v[best : best + 1], now, after[best : best + 1], inputs[best : best + 1]
        return u, x

    def find_bound(self, inputs: FloatArray, rounds: int = _MAX_PROGRAMMES) -> float:
        """The upper bound [nats] of ½ log det(Λ0 + F) over all admissible inputs.

        Args:
            inputs: (k, T) inputs of the first mixture, such as the oracle's.
            rounds: largest number of programmes.
        """
        moments = [self.moments(u) for u in inputs]
        weights = np.full(len(moments), 1.0 / len(moments))
        least_bound, best, progress = np.inf, None, []
        for _ in range(rounds):
            weights, gained, multipliers = improve_mixture(moments, weights)
            mixture_information = self.base + gained
            bound, V = self.bound(multipliers, self.grid, self.samples + 1)
            u, x = self.path(multipliers, V)
            if np.isfinite(self.limits.energy):
                u, x = self.ascend(multipliers, u)
                bound = max(
                    bound,
                    mixture_information,
                    self._at_most(multipliers, self.attained_sum(multipliers, u[None], x[None])[0]),
                )
            if bound < least_bound:
                least_bound, best = bound, multipliers
            progress.append(mixture_information - least_bound)
            stalls = len(progress) > _PATIENCE and progress[-1] < progress[-1 - _PATIENCE] + _MIN_PROGRESS
            if least_bound < mixture_information + _MAX_GAP or (stalls and np.isfinite(self.limits.energy)):
                break
            moments.append(self.moments(u, x))
            weights = np.append(0.9 * weights, 0.1)
        assert best is not None
        refined = self.bound(best, self.grid.refined)[0]
        return max(refined, least_bound) + abs(refined - least_bound)

    def _at_most(self, multipliers: BoundMultipliers, most: float) -> float:
        """The bound [nats] from the maximum of the programme's sum."""
        more = np.trace(multipliers.G) + most - np.linalg.slogdet(multipliers.G)[1] - 4.0
        return self.base + 0.5 * float(more)


@dataclass(frozen=True)
class Config:
    """Bound the information of any input to the systems of a stored oracle, and store the bounds beside the oracle."""

    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 24
    """Number of systems, of those that an oracle is stored of."""


def main(config: Config) -> None:
    """Calculate and store the bounds, and print which share of the attainable information the oracle certainly has."""
    began = time.perf_counter()
    systems = TrackSystems.of(config.env, config.systems, config.options)
    oracle = Oracle.of(TrackSystems.of(config.env, max(config.systems, Oracle.count_stored(systems)), config.options))
    count = min(config.systems, len(oracle.values))
    for row in iterate_with_progress((f"system {row + 1} of {count}", row) for row in range(count)):
        oracle.bounds[row] = Certificate(oracle.systems, row).find_bound(oracle.inputs[row : row + 1])
        oracle.save()
    share = np.exp((oracle.values - oracle.bounds)[:count] / 2.0)
    seconds = time.perf_counter() - began
    print_texts_and_tables(
        f"{count} systems in {seconds:.0f} s: certified share {share.mean():.3f}, least {share.min():.3f}"
    )


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
