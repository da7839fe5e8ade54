"""The dynamic programme over the states of Eq. (2) that bounds an information (`research.oracles.certificate`).

A node is (x_t, x_{t-1}, u_{t-1}, u_{t-2}), from which the equation gives x_{t-2} and x_{t-3}: displacements on a grid
of the box within the limit, inputs on levels. Where energy is limited, the energy that is left belongs to the node,
too. An action is an input at a level, or the input that moves the system exactly to the limit. It leads to (x_{t+1},
x_t, u_t, u_{t-1}), where the value is interpolated. Where one of two neighbours cannot stay within the limit, only the
other one counts.

Under an energy limit the best inputs are small most of the time, and lie between levels. Therefore the spacing of
levels, and of nodes of the energy that is left, grows quadratically from 0. The value at the best level is replaced by
the maximum of the parabola through it and its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray
from research.oracles.dynamic_programme import cubic_weights, solve_backward

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class StateGrid:
    """A grid for one system.

    Attributes:
        theta: (4,) the coefficients of Eq. (2).
        limit: limit of |x|.
        amplitude: limit of |u|.
        n: number of displacements along an axis, odd.
        levels: number of levels of each input in a node, odd.
        inputs: number of levels of an action, odd.
        energy: limit of Σ u²; infinite without a limit.
        energies: nodes of the energy that is left: 1 without a limit, at least 4 with one.
    """

    theta: FloatArray
    limit: float
    amplitude: float
    n: int
    levels: int
    inputs: int
    energy: float = np.inf
    energies: int = 1

    @property
    def refined(self) -> StateGrid:
        """The grid with twice as many intervals of displacements.

        Where energy is limited, it has 1.5 times as many intervals of displacements and of energies, and twice as many
        of inputs.
        """
        if self.energies == 1:
            return replace(self, n=2 * self.n - 1)
        n, energies = (nodes + (nodes - 1) // 2 for nodes in (self.n, self.energies))
        return replace(self, n=n, energies=energies, inputs=2 * self.inputs - 1)

    @property
    def nodes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """x_t (n, 1, 1, 1), x_{t-1} (1, n, 1, 1), x_{t-2} (n, n, levels, 1) and x_{t-3} (n, n, levels, levels).

        Displacements from the equation are cut at the limit, beyond which no admissible path has been.
        """
        t1, t2, t3, eta = self.theta
        x = np.linspace(-self.limit, self.limit, self.n)
        u = self._level_values(self.levels)
        now, last = x[:, None, None, None], x[None, :, None, None]
        second = np.clip((now - t1 * last - t2 * last**3 - eta * u[:, None]) / t3, -self.limit, self.limit)
        third = np.clip((last - t1 * second - t2 * second**3 - eta * u) / t3, -self.limit, self.limit)
        return now, last, second, third

    def actions(self, now: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inputs (..., inputs + 2) from states (..., 1), and the displacements after them; NaN where inadmissible."""
        t1, t2, t3, eta = self.theta
        free = t1 * now + t2 * now**3 + t3 * last
        held = [np.broadcast_to(u, free.shape) for u in self._level_values(self.inputs)]
        u = np.concatenate([*held, (self.limit - free) / eta, (-self.limit - free) / eta], axis=-1)
        after = free + eta * u
        within = (np.abs(u) <= self.amplitude * (1 + 1e-12)) & (np.abs(after) <= self.limit * (1 + 1e-12))
        nothing = np.where(within, 0.0, np.nan)
        u, after = np.clip(u, -self.amplitude, self.amplitude), np.clip(after, -self.limit, self.limit)
        return u + nothing, after + nothing

    def _level_values(self, count: int) -> FloatArray:
        even = np.linspace(-1.0, 1.0, count)
        return self.amplitude * (even if self.energies == 1 else even * np.abs(even))

    def displacement_cell(self, x: FloatArray) -> tuple[Indices, FloatArray]:
        """The lower neighbours of displacements, and the weights of the upper ones."""
        return _interpolation_place((x / self.limit + 1.0) / 2.0, self.n)

    def level_weights(self, u: FloatArray) -> tuple[Indices, FloatArray]:
        """The first of the three levels next to inputs, and the weights (..., 3) of the parabola through them."""
        nodes = self._level_values(self.levels)
        first = np.clip(np.abs(u[..., None] - nodes).argmin(axis=-1) - 1, 0, self.levels - 3)
        away = u[..., None] - nodes[first[..., None] + np.arange(3)]
        span = nodes[first + 1] - nodes[first], nodes[first + 2] - nodes[first + 1]
        weights = [
            away[..., 1] * away[..., 2] / (span[0] * (span[0] + span[1])),
            -away[..., 0] * away[..., 2] / (span[0] * span[1]),
            away[..., 0] * away[..., 1] / (span[1] * (span[0] + span[1])),
        ]
        return first, np.stack(weights, axis=-1)

    def energy_cell(self, energy: FloatArray) -> tuple[Indices, FloatArray]:
        """The lower neighbours of energies that are left, and the weights of the upper ones."""
        if self.energies == 1:
            return np.zeros(energy.shape, dtype=np.int64), np.zeros(energy.shape)
        return _interpolation_place(np.sqrt(np.maximum(energy, 0.0) / self.energy), self.energies)

    def interpolate(
        self, V: FloatArray, after: FloatArray, now: FloatArray, u: FloatArray, older: FloatArray, left: FloatArray
    ) -> FloatArray:
        """Values (points,) at points between nodes, x_{t+1}, x_t, u_t, u_{t-1} and energy left; -1e12 for dead points.

        The interpolation uses four nodes of displacements and energies, as in the programme, and two where one of the
        four is dead. A dead node of two does not count.
        """
        inputs = [
            (first[:, None] + np.arange(3), weights)
            for first, weights in (self.level_weights(u), self.level_weights(older))
        ]
        places = (
            (*self.displacement_cell(after), self.n),
            (*self.displacement_cell(now), self.n),
            (*self.energy_cell(left), self.energies),
        )

        def weighed(k: int) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
            one, two, three = (_neighbouring_nodes(*place, k) for place in places)
            return _weighted_sum(V, [one, two, *inputs, three])

        (smooth, _, whole), (rough, weight, _) = weighed(4), weighed(2)
        return np.where(whole, smooth, np.where(weight > 1e-9, rough / np.maximum(weight, 1e-9), -1e12))

    def solve(self, costs: FloatArray, samples: int, layers: int) -> FloatArray:
        """The largest sum of costs from every node on.

        Args:
            costs: (n, n, levels, levels, inputs + 2); any value at inadmissible actions. They must be the same after a
                change of sign of x and u.
            samples: length of the path.
            layers: number of layers that are kept, 2 or samples + 1.

        Returns:
            The values (layers, n, n, levels, levels, energies), with sample t in layer t modulo layers; -inf where no
            path stays within the limits.
        """
        now, last, _, _ = self.nodes
        u, after = self.actions(now[..., 0], last[..., 0])
        dead = np.isnan(u)
        low, share = self.displacement_cell(np.nan_to_num(after))
        level, parts = self.level_weights(np.nan_to_num(u))
        held = self._level_values(self.inputs)
        spent = np.nan_to_num(u) ** 2 / self.energy
        spent[..., : self.inputs] = held**2 / self.energy
        V = np.zeros((layers, self.n, self.n, self.levels, self.levels, self.energies))
        solve_backward(costs, np.where(dead, -1, low), share, level, parts, spent, held, samples, V)
        return V


def _interpolation_place(where: FloatArray, count: int) -> tuple[Indices, FloatArray]:
    """The lower neighbour among ``count`` nodes between 0 and 1, and the weight of the upper one."""
    scaled = where * (count - 1)
    low = np.clip(np.floor(scaled + 1e-9), 0, count - 2).astype(np.int64)
    return low, np.clip(scaled - low, 0.0, 1.0)


def _neighbouring_nodes(low: Indices, share: FloatArray, count: int, k: int) -> tuple[Indices, FloatArray]:
    """The k nodes next to points, 4 or 2 (1 on an axis with one node), and their weights, (points, k) each."""
    if count == 1:
        return low[:, None], np.ones((len(low), 1))
    if k == 2:
        return low[:, None] + np.arange(2), np.stack([1.0 - share, share], axis=1)
    first = np.clip(low - 1, 0, count - 4)
    return first[:, None] + np.arange(4), np.stack(cubic_weights(low - first + share), axis=1)


def _weighted_sum(
    V: FloatArray, nodes: list[tuple[Indices, FloatArray]]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Per point, the weighted sum over the live nodes, the sum of their weights, and whether all are alive."""

    def along(axis: int, part: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return part.reshape(len(part), *(-1 if axis == other else 1 for other in range(V.ndim)))

    found = V[tuple(along(axis, index) for axis, (index, _) in enumerate(nodes))]
    weights = prod(along(axis, weight) for axis, (_, weight) in enumerate(nodes))
    alive, over = np.isfinite(found), tuple(range(1, found.ndim))
    weights = np.broadcast_to(weights, found.shape)
    return (np.where(alive, found, 0.0) * weights).sum(over), (alive * weights).sum(over), alive.all(over)
