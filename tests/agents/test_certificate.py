"""Certificates: above the best of all inputs of a tiny problem, above the oracles, and the programme's reference."""

from itertools import product

import numpy as np
import pytest

from agents.evaluation.certificate import Certificate, Multipliers
from agents.evaluation.oracle import Oracle, Systems
from agents.evaluation.state_grid import StateGrid
from estimator.free_run import free_run
from estimator.models.difference import difference

SHORT = "duffing_env/Short-v0"


def test_the_programme_is_the_plain_recursion():
    grid = StateGrid(np.array([1.5, -1.3, -0.94, 0.35]), 0.6, 0.15, 5, 3)
    rng = np.random.default_rng(0)
    costs = rng.normal(size=(5, 5, 3, 3, 5))
    x, levels = np.linspace(-0.6, 0.6, 5), np.linspace(-0.15, 0.15, 3)
    after = np.zeros((5, 5, 3, 3))
    for _ in range(4):
        here = np.full((5, 5, 3, 3), -np.inf)
        for i, j, a, b in product(range(5), range(5), range(3), range(3)):
            free = 1.5 * x[i] - 1.3 * x[i] ** 3 - 0.94 * x[j]
            tried = [*levels, (0.6 - free) / 0.35, (-0.6 - free) / 0.35]
            for m, u in enumerate(tried):
                then = free + 0.35 * u
                if abs(u) > 0.15 * (1 + 1e-12) or abs(then) > 0.6 * (1 + 1e-12):
                    continue
                line = np.array([mixed(levels, after[k, i, :, a], u) for k in range(5)])
                here[i, j, a, b] = max(here[i, j, a, b], costs[i, j, a, b, m] + between(x, line, then))
        after = here
    np.testing.assert_allclose(grid.values(costs, 4, 2)[0], after, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(grid.values(costs, 4, 5)[0], grid.values(costs, 4, 2)[0])


def mixed(levels, values, u):
    c = min(int(np.floor((u - levels[0]) / (levels[1] - levels[0]) + 1e-9)), len(levels) - 2)
    share = (u - levels[c]) / (levels[1] - levels[0])
    shares = np.array([1.0 - share, share]).clip(0.0, 1.0)
    alive = shares > 1e-9
    return float(shares[alive] @ values[c : c + 2][alive])


def between(x, line, where):
    """Through four nodes where all are alive, through two otherwise; one that is dead does not count."""
    k = min(int(np.floor((where - x[0]) / (x[1] - x[0]) + 1e-9)), len(x) - 2)
    share = (where - x[k]) / (x[1] - x[0])
    down, up = line[k], line[k + 1]
    if not np.isfinite([down, up]).all():
        return up if down == -np.inf else down
    if share > 1e-9 and 0 < k < len(x) - 2 and np.isfinite(line[k - 1 : k + 3]).all():
        return np.polyval(np.polyfit([-1.0, 0.0, 1.0, 2.0], line[k - 1 : k + 3], 3), share)
    return down + share * (up - down)


def test_no_matrix_is_below_the_information():
    systems = Systems.of(SHORT, 1)
    certificate = Certificate(systems, 0)
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.15, 0.15, 48)
    C, N, M = certificate.moments(u)
    told = certificate.units.T @ systems.information(u[None])[0] @ certificate.units
    for W in (np.linalg.solve(M, N), 0.01 * rng.normal(size=N.shape), np.zeros(N.shape)):
        above = C - W.T @ N - N.T @ W + W.T @ M @ W - told
        assert np.linalg.eigvalsh(above).min() > -2e-3 * np.linalg.norm(told)  # F takes the filter as if at its limit
    W = np.linalg.solve(M, N)
    assert np.linalg.slogdet(np.eye(4) + C - N.T @ W)[1] < np.linalg.slogdet(np.eye(4) + told)[1] + 1.0


@pytest.mark.parametrize("horizon", [6, 8])
def test_it_is_above_every_input_of_a_tiny_problem(horizon):
    systems = Systems.of(SHORT, 1, {"horizon": horizon})
    inputs = 0.15 * np.array(list(product([-1.0, 0.0, 1.0], repeat=horizon)))
    rng = np.random.default_rng(0)
    inputs = np.concatenate([inputs, rng.uniform(-0.15, 0.15, (1024, horizon))])
    worths, peaks = np.array([[part[0] for part in systems.worth(u[None])] for u in inputs]).T
    allowed = np.where(peaks <= 0.6, worths, -np.inf)
    bound = Certificate(systems, 0).find(inputs[[allowed.argmax()]], rounds=32)
    assert allowed.max() < bound < allowed.max() + 2.5


def test_it_is_above_the_oracle_and_not_far():
    oracle = Oracle.of(Systems.of(SHORT, 1))
    certificate = Certificate(oracle.systems, 0)
    bound = certificate.find(oracle.inputs, rounds=8)
    assert oracle.values[0] < bound < oracle.values[0] + 0.5
    finer = StateGrid(certificate.theta, 0.6, 0.15, 97, 9)
    G = np.linalg.inv(np.eye(4) + oracle.systems.information(oracle.inputs)[0])
    _, N, M = certificate.moments(oracle.inputs[0])
    multipliers = Multipliers(G, np.linalg.solve(M, N))
    here, there = (certificate.bound(multipliers, grid)[0] for grid in (certificate.grid, finer))
    assert abs(here - there) < 0.2 * (there - oracle.values[0])


@pytest.mark.slow  # some programmes of 256 samples
def test_a_path_keeps_its_displacements_where_rounding_leads_its_inputs_elsewhere():
    systems = Systems.of("duffing_env/Amplitude-v0", 4)
    oracle, certificate = Oracle.of(systems), Certificate(systems, 3)
    multipliers = certificate.mix([certificate.moments(oracle.inputs[3])], np.ones(1))[2]
    _, V = certificate.bound(multipliers, certificate.grid, 257)
    u, x = certificate.path(multipliers, V)
    with np.errstate(over="ignore", invalid="ignore"):
        assert not np.abs(free_run(difference(), certificate.theta, u)).max() < 1.2
    now, last = np.append(0.0, x[:-1]), np.append([0.0, 0.0], x[:-2])
    moved = np.stack([now, now**3, last, u], axis=1) @ certificate.theta
    np.testing.assert_allclose(x, np.clip(moved, -0.6, 0.6), atol=1e-9)
    assert np.exp((oracle.values[3] - certificate.find(oracle.inputs[3:4], rounds=8)) / 2) > 0.85


@pytest.mark.parametrize(
    ("track", "count", "share"), [("Amplitude", 24, 0.88), ("Short", 24, 0.88), ("Output", 23, 0.85)]
)
def test_stored_bounds_are_above_the_oracles(track, count, share):
    oracle = Oracle.of(Systems.of(f"duffing_env/{track}-v0", count))
    assert np.all(oracle.bounds > oracle.values)
    assert np.exp((oracle.values - oracle.bounds) / 2).mean() > share


def test_other_tracks_have_none_yet():
    with pytest.raises(ValueError, match=r"Eq\. \(2\) without a limit of energy"):
        Certificate(Systems.of("duffing_env/Power-v0", 1), 0)
