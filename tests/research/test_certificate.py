"""Certificates: above the best of all inputs of a tiny problem, above the oracles, and the programme's reference."""

from itertools import product

import numpy as np
import pytest

from agents.evaluation.oracle import Oracle, TrackSystems
from estimator.inference.free_run import free_run
from estimator.models.difference_equation import difference
from research.oracles.certificate import Certificate
from research.oracles.input_mixture import BoundMultipliers, improve_mixture
from research.oracles.state_grid import StateGrid

SHORT = "duffing_env/Short-v0"


@pytest.mark.parametrize("energies", [1, 5])
def test_the_programme_is_the_plain_recursion(energies):
    energy = 0.04 if energies > 1 else np.inf
    grid = StateGrid(np.array([1.5, -1.3, -0.94, 0.35]), 0.6, 0.15, 5, 3, 5, energy, energies)
    rng = np.random.default_rng(0)
    costs = rng.normal(size=(5, 5, 3, 3, 7))
    costs += costs[::-1, ::-1, ::-1, ::-1, [4, 3, 2, 1, 0, 6, 5]]  # the same after a change of all signs
    x, even = np.linspace(-0.6, 0.6, 5), np.linspace(-1.0, 1.0, 5)
    held = 0.15 * (even * np.abs(even) if energies > 1 else even)
    nodes, roots = held[[0, 2, 4]], np.linspace(0.0, 1.0, energies)
    after = np.zeros((5, 5, 3, 3, energies))
    for _ in range(4):
        here = np.full((5, 5, 3, 3, energies), -np.inf)
        for i, j, a, k in product(range(5), range(5), range(3), range(energies)):
            free = 1.5 * x[i] - 1.3 * x[i] ** 3 - 0.94 * x[j]
            tried = [*held, (0.6 - free) / 0.35, (-0.6 - free) / 0.35]
            later = np.full(7, -np.inf)
            for m, u in enumerate(tried):
                left = 1.0 if energies == 1 else roots[k] ** 2 - u**2 / energy
                if abs(u) > 0.15 * (1 + 1e-12) or abs(free + 0.35 * u) > 0.6 * (1 + 1e-12) or left < -1e-12:
                    continue
                lines = np.array(
                    [[interpolated(nodes, after[p, i, :, a, e], u) for e in range(energies)] for p in range(5)]
                )
                alive = np.isfinite(after[:, i, 0, 0, 0])
                line = np.array([between(x, lines[:, e], free + 0.35 * u, alive) for e in range(energies)])
                later[m] = line[0] if energies == 1 else spent(roots, line, np.sqrt(max(left, 0.0)))
            for b in range(3):
                here[i, j, a, b, k] = highest(costs[i, j, a, b] + later, held, energies > 1)
        after = here
    np.testing.assert_allclose(grid.solve(costs, 4, 2)[0], after, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(grid.solve(costs, 4, 5)[0], grid.solve(costs, 4, 2)[0])
    assert np.isneginf(after).any()
    assert np.isfinite(after).any()


def interpolated(nodes, values, u):
    """Interpolation along the inputs, through three levels; whether a node is dead does not depend on the inputs."""
    return np.polyval(np.polyfit(nodes, values, 2), u) if np.isfinite(values).all() else -np.inf


def between(x, line, where, alive):
    """Interpolation through four nodes where all are alive at every energy, else two; of two a dead one is left out."""
    k = min(int(np.floor((where - x[0]) / (x[1] - x[0]) + 1e-9)), len(x) - 2)
    share = min(max((where - x[k]) / (x[1] - x[0]), 0.0), 1.0)
    down, up = line[k], line[k + 1]
    if share > 0.0 and 0 < k < len(x) - 2 and alive[k - 1 : k + 3].all():
        return np.polyval(np.polyfit([-1.0, 0.0, 1.0, 2.0], line[k - 1 : k + 3], 3), share)
    if alive[k] and share == 0.0:
        return down
    if not np.isfinite([down, up]).all():
        return up if down == -np.inf else down
    return down + share * (up - down)


def spent(roots, line, root):
    """Interpolation along the roots of the energies left: through four nodes where they are alive, else two."""
    low = min(int(root * (len(roots) - 1) + 1e-9), len(roots) - 2)
    first = min(max(low - 1, 0), len(roots) - 4)
    if np.isfinite(line[first]):
        return np.polyval(np.polyfit(roots[first : first + 4], line[first : first + 4], 3), root)
    down, up = line[low], line[low + 1]
    if down == -np.inf:
        return up
    return down + (root - roots[low]) / (roots[1] - roots[0]) * (up - down)


def highest(values, held, limited):
    """The largest value; under an energy limit the maximum of the parabola through it and its neighbours."""
    m = int(values.argmax())
    if limited and 0 < m < len(held) - 1 and np.isfinite(values[m - 1 : m + 2]).all():
        parabola = np.polyfit(held[m - 1 : m + 2] - held[m], values[m - 1 : m + 2], 2)
        return np.polyval(parabola, -parabola[1] / (2.0 * parabola[0]))
    return values[m]


def test_no_matrix_is_below_the_information():
    systems = TrackSystems.of(SHORT, 1)
    certificate = Certificate(systems, 0)
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.15, 0.15, 48)
    C, N, M = certificate.moments(u)
    information = certificate.units.T @ systems.information(u[None])[0] @ certificate.units
    for W in (np.linalg.solve(M, N), 0.01 * rng.normal(size=N.shape), np.zeros(N.shape)):
        above = C - W.T @ N - N.T @ W + W.T @ M @ W - information
        assert np.linalg.eigvalsh(above).min() > -2e-3 * np.linalg.norm(
            information
        )  # F takes the filter as if at its limit
    W = np.linalg.solve(M, N)
    assert np.linalg.slogdet(np.eye(4) + C - N.T @ W)[1] < np.linalg.slogdet(np.eye(4) + information)[1] + 1.0


def test_it_is_above_every_input_of_a_tiny_problem():
    horizon = 6
    systems = TrackSystems.of(SHORT, 1, {"horizon": horizon})
    inputs = 0.15 * np.array(list(product([-1.0, 0.0, 1.0], repeat=horizon)))
    rng = np.random.default_rng(0)
    inputs = np.concatenate([inputs, rng.uniform(-0.15, 0.15, (1024, horizon))])
    worths, peaks = np.array([[part[0] for part in systems.criterion_and_peak(u[None])] for u in inputs]).T
    allowed = np.where(peaks <= 0.6, worths, -np.inf)
    bound = Certificate(systems, 0).find_bound(inputs[[allowed.argmax()]], rounds=32)
    assert allowed.max() < bound < allowed.max() + 2.5


def test_it_is_above_the_oracle_and_not_far():
    oracle = Oracle.of(TrackSystems.of(SHORT, 1))
    certificate = Certificate(oracle.systems, 0)
    bound = certificate.find_bound(oracle.inputs, rounds=8)
    assert oracle.values[0] < bound < oracle.values[0] + 0.5
    finer = StateGrid(certificate.theta, 0.6, 0.15, 97, 9, 9)
    G = np.linalg.inv(np.eye(4) + oracle.systems.information(oracle.inputs)[0])
    _, N, M = certificate.moments(oracle.inputs[0])
    multipliers = BoundMultipliers(G, np.linalg.solve(M, N))
    here, there = (certificate.bound(multipliers, grid)[0] for grid in (certificate.grid, finer))
    assert abs(here - there) < 0.2 * (there - oracle.values[0])


@pytest.mark.slow  # some programmes of 256 samples
def test_a_path_keeps_its_displacements_where_rounding_leads_its_inputs_elsewhere():
    systems = TrackSystems.of("duffing_env/Amplitude-v0", 4)
    oracle, certificate = Oracle.of(systems), Certificate(systems, 3)
    multipliers = improve_mixture([certificate.moments(oracle.inputs[3])], np.ones(1))[2]
    _, V = certificate.bound(multipliers, certificate.grid, 257)
    u, x = certificate.path(multipliers, V)
    with np.errstate(over="ignore", invalid="ignore"):
        assert not np.abs(free_run(difference(), certificate.theta, u)).max() < 1.2
    now, last = np.append(0.0, x[:-1]), np.append([0.0, 0.0], x[:-2])
    moved = np.stack([now, now**3, last, u], axis=1) @ certificate.theta
    np.testing.assert_allclose(x, np.clip(moved, -0.6, 0.6), atol=1e-9)
    assert np.exp((oracle.values[3] - certificate.find_bound(oracle.inputs[3:4], rounds=8)) / 2) > 0.85


@pytest.mark.parametrize(
    ("track", "count", "share"),
    [("Amplitude", 24, 0.88), ("Short", 24, 0.88), ("Output", 24, 0.85), ("Power", 24, 0.9)],
)
def test_stored_bounds_are_above_the_oracles(track, count, share):
    oracle = Oracle.of(TrackSystems.of(f"duffing_env/{track}-v0", count))
    assert np.all(oracle.bounds > oracle.values)
    assert np.exp((oracle.values - oracle.bounds) / 2).mean() > share


def test_it_is_above_every_input_of_a_tiny_problem_with_little_energy():
    horizon = 16
    systems = TrackSystems.of("duffing_env/Power-v0", 1, {"horizon": horizon, "max_rms": 0.05})
    inputs = np.random.default_rng(0).normal(size=(4096, horizon)) * np.random.default_rng(1).random((4096, 1))
    inputs *= np.sqrt(systems.limits.energy) / np.linalg.norm(inputs, axis=1, keepdims=True)
    inputs = inputs.clip(-0.15, 0.15)
    worths = np.array([systems.criterion_and_peak(u[None])[0][0] for u in inputs])
    bound = Certificate(systems, 0).find_bound(inputs[[worths.argmax()]], rounds=32)
    assert worths.max() < bound < worths.max() + 2.5


@pytest.mark.slow  # some programmes with energy left as a state
def test_it_is_above_the_oracle_where_energy_is_limited_and_not_far():
    oracle = Oracle.of(TrackSystems.of("duffing_env/Power-v0", 1))
    certificate = Certificate(oracle.systems, 0)
    bound = certificate.find_bound(oracle.inputs)
    assert 0.9 < np.exp((oracle.values[0] - bound) / 2) < 1.0
    multipliers = improve_mixture([certificate.moments(oracle.inputs[0])], np.ones(1))[2]
    u, _ = certificate.path(multipliers, certificate.bound(multipliers, certificate.grid, 257)[1])
    (before,) = certificate.attained_sum(multipliers, u[None], free_run(difference(), certificate.theta, u)[None])
    climbed, x = certificate.ascend(multipliers, u)
    (after,) = certificate.attained_sum(multipliers, climbed[None], x[None])
    assert after > before
    np.testing.assert_allclose(x, free_run(difference(), certificate.theta, climbed))
    assert climbed @ climbed <= oracle.systems.limits.energy * (1 + 1e-12)
    assert np.abs(climbed).max() <= 0.15
    assert np.abs(x).max() <= 0.6


def test_other_equations_have_no_certificate():
    with pytest.raises(ValueError, match=r"must obey Eq. \(2\)"):
        Certificate(TrackSystems.of("duffing_env/Power-v1", 1), 0)
