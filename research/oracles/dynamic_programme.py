"""The compiled part of `research.oracles.state_grid`: the dynamic programme, backward in time."""

from __future__ import annotations

import numpy as np

from estimator.compilation.simd import jit, kernel


@jit
def cubic_weights(at):
    """Lagrange weights of the cubic through values at 0, 1, 2 and 3."""
    return (
        -(at - 1.0) * (at - 2.0) * (at - 3.0) / 6.0,
        at * (at - 2.0) * (at - 3.0) / 2.0,
        -at * (at - 1.0) * (at - 3.0) / 2.0,
        at * (at - 1.0) * (at - 2.0) / 6.0,
    )


@jit
def _add_weighted(line, weight, V, k, i, c, parts, a):
    """Add ``weight`` times the values at displacement k, interpolated between three levels from c on."""
    for d in range(3):
        part = weight * parts[d]
        if part != 0.0:
            for e in range(len(line)):
                line[e] += part * V[k, i, c + d, a, e]


@jit
def _interpolate_energies(V, alive, k, share, i, c, parts, a, line):
    """Interpolate for all energies (K,) between displacements k and k + 1, and three levels from c on.

    The interpolation uses four displacements, or two where the others do not exist or are dead. Whether a node is dead
    does not depend on the inputs that led there.
    """
    n = V.shape[0]
    line[:] = 0.0
    if share > 0.0 and 0 < k < n - 2 and alive[k - 1, i] and alive[k, i] and alive[k + 1, i] and alive[k + 2, i]:
        first, second, third, fourth = cubic_weights(1.0 + share)
        _add_weighted(line, first, V, k - 1, i, c, parts, a)
        _add_weighted(line, second, V, k, i, c, parts, a)
        _add_weighted(line, third, V, k + 1, i, c, parts, a)
        _add_weighted(line, fourth, V, k + 2, i, c, parts, a)
    elif alive[k, i] and (alive[k + 1, i] or share == 0.0):
        _add_weighted(line, 1.0 - share, V, k, i, c, parts, a)
        if share > 0.0:
            _add_weighted(line, share, V, k + 1, i, c, parts, a)
    else:
        for e in range(len(line)):
            down, up = V[k, i, c, a, e] > -np.inf, V[k + 1, i, c, a, e] > -np.inf
            if not (down or up):
                line[e] = -np.inf
            for d in range(3):
                if down and parts[d] != 0.0:
                    line[e] += parts[d] * (1.0 - share if up else 1.0) * V[k, i, c + d, a, e]
                if up and parts[d] != 0.0:
                    line[e] += parts[d] * (share if down else 1.0) * V[k + 1, i, c + d, a, e]


@jit
def _locate_energies(spent, at, weights):
    """The energy that is left after an input, for every energy: the first of four nodes (K,), -1 if it is not allowed.

    The columns of ``weights`` (K, 5) are the weights of the four nodes, and the position among all nodes.
    """
    last = len(at) - 1
    for k in range(last + 1):
        left = (k / last) ** 2 - spent
        at[k] = -1
        if left > -1e-12:
            where = np.sqrt(max(left, 0.0)) * last
            low = min(int(where + 1e-9), last - 1)
            at[k] = min(max(low - 1, 0), last - 3)
            weights[k, 0], weights[k, 1], weights[k, 2], weights[k, 3] = cubic_weights(where - at[k])
            weights[k, 4] = where


@jit
def _value_after_spending(line, at, weights, later):
    """The value after an input from every energy, interpolated between the values of all energies after it."""
    last = len(line) - 1
    for k in range(last + 1):
        first = at[k]
        if first < 0:
            later[k] = -np.inf
        elif line[first] > -np.inf:
            later[k] = (
                weights[k, 0] * line[first]
                + weights[k, 1] * line[first + 1]
                + weights[k, 2] * line[first + 2]
                + weights[k, 3] * line[first + 3]
            )
        else:  # with less energy more nodes are dead
            low = min(int(weights[k, 4] + 1e-9), last - 1)
            down, up = line[low], line[low + 1]
            later[k] = down + (weights[k, 4] - low) * (up - down) if down > -np.inf else up


@jit
def _parabola_gain(low, middle, high, x, m):
    """The maximum of the parabola through three values above the middle value, which is the largest."""
    before, after = x[m] - x[m - 1], x[m + 1] - x[m]
    rise, fall = (middle - low) / before, (high - middle) / after
    curvature = (fall - rise) / (before + after)
    slope = rise + curvature * before
    return -slope * slope / (4.0 * curvature) if curvature < 0.0 else 0.0


@kernel
def solve_backward(costs, low, share, level, parts, spent, held, samples, V):
    """Fill the layers of V, the last one first; see `research.oracles.state_grid.StateGrid.solve`."""
    n, levels, actions, energies = costs.shape[0], costs.shape[2], costs.shape[4], V.shape[5]
    line, later, best = np.empty(energies), np.empty((actions, energies)), np.empty(energies)
    chosen, at = np.empty(energies, dtype=np.int64), np.zeros((actions, energies), dtype=np.int64)
    weights, alive = np.zeros((actions, energies, 5)), np.ones((n, n), dtype=np.bool_)
    lives = alive.copy()
    if energies > 1:
        for m in range(len(held)):
            _locate_energies(spent[0, 0, m], at[m], weights[m])
    V[samples % len(V)] = 0.0
    for t in range(samples - 1, -1, -1):
        after, here = V[(t + 1) % len(V)], V[t % len(V)]
        for i in range(n // 2 + 1):  # the other half is the mirror image
            for j in range(n):
                if energies > 1:
                    for m in range(len(held), actions):
                        _locate_energies(spent[i, j, m], at[m], weights[m])
                for a in range(levels):
                    for m in range(actions):
                        if low[i, j, m] < 0:
                            later[m] = -np.inf
                            continue
                        _interpolate_energies(
                            after, alive, low[i, j, m], share[i, j, m], i, level[i, j, m], parts[i, j, m], a, line
                        )
                        if energies > 1:
                            _value_after_spending(line, at[m], weights[m], later[m])
                        else:
                            later[m] = line
                    for b in range(levels):
                        best[:], chosen[:] = -np.inf, -1
                        for m in range(actions):
                            cost = costs[i, j, a, b, m]
                            for k in range(energies):
                                value = cost + later[m, k]
                                chosen[k] = m if value > best[k] else chosen[k]
                                best[k] = value if value > best[k] else best[k]
                        if energies > 1:
                            for k in range(energies):
                                m = chosen[k]
                                if 0 < m < len(held) - 1:
                                    down = costs[i, j, a, b, m - 1] + later[m - 1, k]
                                    up = costs[i, j, a, b, m + 1] + later[m + 1, k]
                                    if down > -np.inf and up > -np.inf:
                                        best[k] += _parabola_gain(down, best[k], up, held, m)
                        here[i, j, a, b] = best
                        here[n - 1 - i, n - 1 - j, levels - 1 - a, levels - 1 - b] = best
                lives[i, j] = lives[n - 1 - i, n - 1 - j] = here[i, j, 0, 0, 0] > -np.inf
        alive[:] = lives
