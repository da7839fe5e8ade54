"""The mean-field update and its free energy against their equations with matrices."""

import re

import numba
import numpy as np
import pytest
from reference.mean_field import (
    LAYOUT,
    Moments,
    assert_same_moments,
    block_of,
    draw_variances,
    mean_field_step,
    random_prior,
    records_of,
)
from scipy.stats import norm
from targets import has_fused_multiply_add

from estimator.inference import mean_field

LANES, DRAWS = mean_field.LANES, 20_000
PIECES, ONE = mean_field.compile_mean_field(LAYOUT), mean_field.compile_mean_field(LAYOUT, lanes=1)


def samples(rng, count):
    return rng.normal(0.0, 0.1, count), rng.normal(0.0, 0.2, count)


def updated(block, iterations, as_published=False, pieces=PIECES):
    """Update a block; the free energies of its first lane after every iteration."""
    trace = []
    pieces.begin(block)
    for _ in range(iterations):
        pieces.iterate(block, as_published)
        trace.append(pieces.free_energy(block, 0))
    pieces.end(block)
    return np.array(trace)


@pytest.mark.parametrize("nonlinear", [True, False])
@pytest.mark.parametrize("as_published", [False, True])
def test_update_equals_its_equations(as_published, nonlinear):
    rng = np.random.default_rng(0)
    for iterations in (1, 2, 3, 10):
        priors = [random_prior(rng, nonlinear) for _ in range(LANES)]
        for _ in range(2):
            u, y = samples(rng, LANES)
            block = block_of([prior.to_record() for prior in priors], u, y, LANES)
            trace = updated(block, iterations, as_published)
            posteriors = [Moments.of_record(record) for record in records_of(block, LANES)]
            for j in range(LANES):
                expected, free_energies = mean_field_step(priors[j], u[j], y[j], iterations, as_published, nonlinear)
                assert_same_moments(posteriors[j], expected)
                # The reference's lnΓ of shapes up to 1e3, and its squares times 1e12, round at 1e-12 nats.
                assert PIECES.free_energy(block, j) == pytest.approx(free_energies[-1], rel=1e-9, abs=1e-9)
                if j == 0:
                    np.testing.assert_allclose(trace, free_energies, rtol=1e-9, atol=1e-9)
            priors = posteriors


def test_free_energy_falls_and_bounds_the_surprise_where_the_first_order_is_exact():
    # With θ known and no cubic term nothing is linearised: the iterations are coordinate descent on F, and
    # F >= -log p(y), here by Monte Carlo over η and the noises.
    rng = np.random.default_rng(2)
    for _ in range(20):
        prior, u = random_prior(rng, nonlinear=False), rng.normal(0.0, 0.1)
        prior.cov[2:5, 2:5] *= 1e-18
        theta = prior.mean[[2, 4]]
        eta = prior.mean[5] + np.sqrt(prior.cov[5, 5]) * rng.standard_normal(DRAWS)
        std = np.sqrt(
            theta @ prior.cov[:2, :2] @ theta
            + draw_variances(rng, prior.gamma, DRAWS)
            + draw_variances(rng, prior.xi, DRAWS)
        )
        prediction = theta @ prior.mean[:2] + eta * u
        y = rng.normal(prediction[0], std[0])
        trace = updated(block_of([prior.to_record()], u, y, 1), 10, pieces=ONE)
        assert (
            np.diff(trace).max() <= 1e-12
        )  # some twenty terms, each of them to 5e-14 as `test_elementary_functions` has it
        density = norm.pdf(y, prediction, std)
        evidence, error = density.mean(), density.std() / np.sqrt(DRAWS)
        assert trace[-1] >= -np.log(evidence) - 5 * error / evidence


@pytest.mark.parametrize("as_published", [False, True])
def test_lanes_are_independent(as_published):
    rng = np.random.default_rng(3)
    priors = np.array([random_prior(rng).to_record() for _ in range(LANES)])
    u, y = samples(rng, LANES)
    mixed = block_of(priors, u, y, LANES)
    updated(mixed, 10, as_published)
    for j in range(LANES):
        uniform = block_of([priors[j]] * LANES, u[j], y[j], LANES)
        updated(uniform, 10, as_published)
        expected = np.broadcast_to(records_of(mixed, LANES)[j], (LANES, len(priors[j])))
        np.testing.assert_array_equal(records_of(uniform, LANES), expected)


def test_the_loop_holds_packed_vector_instructions():
    wide = "[yz]mm" if has_fused_multiply_add() else "xmm"  # without AVX2 two doubles are all that a register holds
    signature = (numba.float64[::1], numba.boolean)
    PIECES.iterate.compiled.compile(signature)
    assembly = PIECES.iterate.compiled.inspect_asm(signature)
    packed = re.findall(rf"^\s+(?:v?mulpd|vfn?m(?:add|sub)\d+pd)\s.*%{wide}", assembly, flags=re.MULTILINE)
    scalar = re.findall(r"^\s+(?:v?mulsd|vfn?m(?:add|sub)\d+sd)\s", assembly, flags=re.MULTILINE)
    # Scalar code has none of the first kind; of the second, a uniform argument may bring a few.
    assert len(packed) > 20
    assert len(scalar) < len(packed) / 10
