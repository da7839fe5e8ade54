"""The D-optimality of inputs to any model and its gradient: against the Fisher information, differences and limits."""

import sys
from pathlib import Path

import numpy as np
import pytest
from tables import table

from agents.planning.d_optimality import NominalSystem, compile_d_optimality, half_log_det, invert_from_cholesky
from agents.planning.projected_gradient import DesignLimits, compile_projected_gradient
from estimator import SILVERBOX_TWIN, silverbox_prior
from estimator.engine.information_gradient import compile_adjoint
from estimator.inference.fisher_information import fisher_information
from estimator.models.difference_equation import difference
from estimator.rigs.physical_parameters import coefficients_of

sys.path.append(str(Path(__file__).parents[1] / "estimator"))
from reference.plants import CASES

Q, R, LIMIT, AMPLITUDE = 5e-4, 3e-4, 0.3, 0.1
PAPER = difference()
THETA = coefficients_of(PAPER, {name: getattr(SILVERBOX_TWIN, name) for name in "mcab"})
PRECISION = np.linalg.inv(silverbox_prior(PAPER).coefficients_cov)
TWIN = NominalSystem(THETA, PRECISION, (Q**2, R**2))


def evaluated(u, start=None, penalty=0.0, climbs=False, limit=LIMIT, known=TWIN, found=None):
    """Criterion and peak, or criterion, peak and gradient."""
    found = found or compile_d_optimality(PAPER)
    start, memory = np.zeros(found.start_size) if start is None else start, found.workspace(len(u))
    arguments = (known, limit, penalty, start, u, memory)
    return (*found.criterion_and_gradient(*arguments), memory.gradient) if climbs else found.criterion(*arguments)


def improved(inputs, energy=np.inf):
    inputs, values = inputs.copy(), np.empty(len(inputs))
    compile_projected_gradient(PAPER).ascend_batch(
        TWIN, DesignLimits(LIMIT, LIMIT, AMPLITUDE, energy), 0.3, 100, inputs, values
    )
    return inputs, values


def case_of(name):
    """Model, interpolation, and the nominal system with an informative prior."""
    model, interpolation, c, size = CASES[name]
    c = np.array(c, dtype=np.float64)
    precision = np.diag(1 / (0.1 * np.maximum(np.abs(c), 0.01)) ** 2)
    return model, interpolation, size, NominalSystem(c, precision, (4e-6, *[1e-6] * model.n_outputs))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ("motion", "tanks"))) for name in CASES]
)
def test_the_criterion_is_half_the_log_determinant_of_the_precision(name):
    model, interpolation, size, known = case_of(name)
    u = size * np.random.default_rng(0).choice([-0.5, 0.5], 60)
    value, _ = evaluated(
        u, limit=np.inf, known=known, found=compile_d_optimality(model, int(interpolation == "linear"))
    )
    information = fisher_information(model, known.coefficients, u, 2e-3, 1e-3, interpolation=interpolation)
    assert value == pytest.approx(0.5 * np.linalg.slogdet(known.precision + information)[1], rel=1e-12)


@table("size", [1, 4, 7])
def test_factor_and_inverse(size):
    rng = np.random.default_rng(1)
    A = rng.standard_normal((size, size + 2))
    A = A @ A.T + np.eye(size)
    L, inverse = A.copy(), np.empty((size, size))
    assert half_log_det(L) == pytest.approx(0.5 * np.linalg.slogdet(A)[1], rel=1e-12)
    invert_from_cholesky(L, inverse)
    np.testing.assert_allclose(inverse @ A, np.eye(size), atol=1e-12)
    assert half_log_det(-np.eye(size)) == -np.inf


@pytest.mark.parametrize("name", CASES)
@table("moving", [False, True])
def test_the_gradient_is_that_of_differences(name, moving):
    model, interpolation, size, known = case_of(name)
    found = compile_d_optimality(model, int(interpolation == "linear"))
    rng = np.random.default_rng(2)
    u, n = size * rng.uniform(-1, 1, 40), model.n_states
    start = np.zeros(found.start_size)
    if moving:
        spread = np.array([[2e-6, 5e-7], [5e-7, 1e-6]])
        start[:n] = 0.1, -0.05
        start[n : n + 3] = spread[np.triu_indices(n)]
        start[n + 3 : found.n_path] = rng.normal(0, 0.2, found.n_path - n - 3)
        start[found.n_path :] = 0.3 * size
    peak = evaluated(u, start, limit=np.inf, known=known, found=found)[1]
    settings = {
        "penalty": 100.0,
        "limit": 0.9 * peak,
        "known": known,
        "found": found,
    }  # so that the penalty has its part
    value, _, gradient = evaluated(u, start, climbs=True, **settings)
    assert value == evaluated(u, start, **settings)[0]
    assert value < evaluated(u, start, **{**settings, "penalty": 0.0})[0]
    h = 2e-5 * size
    slopes = np.empty(40)
    for t in range(40):
        step = h * (np.arange(40) == t)
        ahead, behind = ([evaluated(u + s * m * step, start, **settings)[0] for s in (1, -1)] for m in (1, 2))
        # Of order 4, so that the third derivative does not count.
        slopes[t] = (8 * (ahead[0] - ahead[1]) - (behind[0] - behind[1])) / (12 * h)
    np.testing.assert_allclose(gradient, slopes, rtol=0, atol=1e-6 * np.abs(gradient).max())


def test_a_trajectory_that_is_lost_counts_until_then():
    u = np.full(60, 0.3)
    value, peak, gradient = evaluated(u, climbs=True)
    assert LIMIT * 1.2 <= peak < 1.0
    used = np.flatnonzero(gradient)[-1] + 1
    assert 0 < used < 60
    assert value == evaluated(u[:used])[0]


def test_improvement_keeps_the_limits_and_gains():
    rng = np.random.default_rng(3)
    begun = AMPLITUDE * rng.uniform(-0.3, 0.3, (3, 48))
    inputs, values = improved(begun)
    assert np.abs(inputs).max() <= AMPLITUDE
    for u, start, value in zip(inputs, begun, values, strict=True):
        found, peak = evaluated(u)
        assert peak <= LIMIT
        assert value == pytest.approx(found, abs=1e-9)
        assert value > evaluated(start)[0] + 1.0


def test_improvement_keeps_an_energy():
    rng = np.random.default_rng(4)
    energy = 0.02**2 * 48
    inputs, values = improved(AMPLITUDE * rng.uniform(-1, 1, (2, 48)), energy)
    assert np.all((inputs**2).sum(axis=1) <= energy)
    assert np.all((inputs**2).sum(axis=1) > 0.99 * energy)
    assert np.isfinite(values).all()


def test_a_spline_is_refused():
    with pytest.raises(ValueError, match="degree must be 0 or 1"):
        compile_adjoint(PAPER, 5)
