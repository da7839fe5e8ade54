"""The dynamic programme over the states of Eq. (2) that bounds an information (`agents.evaluation.certificate`).

A node is (x_t, x_{t-1}, u_{t-1}, u_{t-2}), from which the equation gives x_{t-2} and x_{t-3}: displacements on a grid
of the box within the limit, inputs on levels. An action is an input at a level, or one that leads to the very limit. It
leads to (x_{t+1}, x_t, u_t, u_{t-1}), where the value is interpolated between neighbours; of two neighbours one of
which cannot stay within the limit, the other counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.lanes import kernel
from estimator.parameters import FloatArray


@dataclass(frozen=True)
class StateGrid:
    """A grid for one system.

    Attributes:
        theta: (4,) the coefficients of Eq. (2).
        limit: of |x|.
        amplitude: of |u|.
        n: displacements along an axis, an odd number.
        levels: of the input, an odd number.
    """

    theta: FloatArray
    limit: float
    amplitude: float
    n: int
    levels: int

    @property
    def nodes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """x_t (n, 1, 1, 1), x_{t-1} (1, n, 1, 1), x_{t-2} (n, n, levels, 1) and x_{t-3} (n, n, levels, levels).

        Those that the equation gives are cut at the limit, beyond which no admissible path has been.
        """
        t1, t2, t3, eta = self.theta
        x = np.linspace(-self.limit, self.limit, self.n)
        u = np.linspace(-self.amplitude, self.amplitude, self.levels)
        now, last = x[:, None, None, None], x[None, :, None, None]
        second = np.clip((now - t1 * last - t2 * last**3 - eta * u[:, None]) / t3, -self.limit, self.limit)
        third = np.clip((last - t1 * second - t2 * second**3 - eta * u) / t3, -self.limit, self.limit)
        return now, last, second, third

    def actions(self, now: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inputs (..., levels + 2) from states (..., 1), and where they lead; NaN for those that are not admissible."""
        t1, t2, t3, eta = self.theta
        free = t1 * now + t2 * now**3 + t3 * last
        held = [np.broadcast_to(u, free.shape) for u in np.linspace(-self.amplitude, self.amplitude, self.levels)]
        u = np.concatenate([*held, (self.limit - free) / eta, (-self.limit - free) / eta], axis=-1)
        after = free + eta * u
        within = (np.abs(u) <= self.amplitude * (1 + 1e-12)) & (np.abs(after) <= self.limit * (1 + 1e-12))
        nothing = np.where(within, 0.0, np.nan)
        u, after = np.clip(u, -self.amplitude, self.amplitude), np.clip(after, -self.limit, self.limit)
        return u + nothing, after + nothing

    def place(self, value: FloatArray, bound: float, count: int) -> tuple[np.ndarray, FloatArray]:
        """The lower neighbour of values, among ``count`` from minus to plus a bound; and the share of the upper one."""
        where = (value + bound) / (2 * bound) * (count - 1)
        low = np.clip(np.floor(where + 1e-9), 0, count - 2).astype(np.int64)
        return low, np.clip(where - low, 0.0, 1.0)

    def values(self, costs: FloatArray, samples: int, layers: int) -> FloatArray:
        """The most that costs add up to from every node on.

        Args:
            costs: (n, n, levels, levels, actions); whatever at actions that are not admissible.
            samples: of the path.
            layers: that are kept, 2 or samples + 1.

        Returns:
            (layers, n, n, levels, levels), that of sample t in layer t modulo layers; -inf where no path stays within.
        """
        now, last, _, _ = self.nodes
        u, after = self.actions(now[..., 0], last[..., 0])
        dead = np.isnan(u)
        low, share = self.place(np.nan_to_num(after), self.limit, self.n)
        level, part = self.place(np.nan_to_num(u), self.amplitude, self.levels)
        V = np.zeros((layers, self.n, self.n, self.levels, self.levels))
        _backward(costs, np.where(dead, -1, low), share, level, part, samples, V)
        return V


@kernel
def _backward(costs, low, share, level, part, samples, V):
    n, levels, actions = costs.shape[0], costs.shape[2], costs.shape[4]
    later = np.empty(actions)
    V[samples % len(V), :, :, :, :] = 0.0
    for t in range(samples - 1, -1, -1):
        after, here = V[(t + 1) % len(V)], V[t % len(V)]
        for i in range(n):
            for j in range(n):
                for a in range(levels):
                    for m in range(actions):
                        k = low[i, j, m]
                        if k < 0:
                            later[m] = -np.inf
                            continue
                        c, w = level[i, j, m], part[i, j, m]
                        if w == 1.0:
                            c, w = c + 1, 0.0
                        down, up = after[k, i, c, a], after[k + 1, i, c, a]
                        if w > 0.0:
                            down = (1.0 - w) * down + w * after[k, i, c + 1, a]
                            up = (1.0 - w) * up + w * after[k + 1, i, c + 1, a]
                        if down == -np.inf:
                            later[m] = up
                        elif up == -np.inf:
                            later[m] = down
                        else:
                            e = share[i, j, m]
                            later[m] = down + e * (up - down)
                            if e > 0.0 and k > 0 and k + 2 < n:
                                first, fourth = after[k - 1, i, c, a], after[k + 2, i, c, a]
                                if w > 0.0:
                                    first = (1.0 - w) * first + w * after[k - 1, i, c + 1, a]
                                    fourth = (1.0 - w) * fourth + w * after[k + 2, i, c + 1, a]
                                if first > -np.inf and fourth > -np.inf:
                                    later[m] = (
                                        -e * (e - 1.0) * (e - 2.0) / 6.0 * first
                                        + (e + 1.0) * (e - 1.0) * (e - 2.0) / 2.0 * down
                                        - (e + 1.0) * e * (e - 2.0) / 2.0 * up
                                        + (e + 1.0) * e * (e - 1.0) / 6.0 * fourth
                                    )
                    for b in range(levels):
                        best = -np.inf
                        for m in range(actions):
                            best = max(best, costs[i, j, a, b, m] + later[m])
                        here[i, j, a, b] = best
