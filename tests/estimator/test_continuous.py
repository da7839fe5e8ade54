"""The physical equation's prior and belief: moments against draws and quadrature, maps there and back."""

import numpy as np
import pytest

from estimator import CONTINUOUS_TWIN, SAMPLING_STEP, Belief, ContinuousBelief, PhysicalParameters, continuous_prior

CENTER = np.array([CONTINUOUS_TWIN.m, CONTINUOUS_TWIN.c, CONTINUOUS_TWIN.a, CONTINUOUS_TWIN.b])


def test_the_prior_has_the_moments_of_oscillators_known_up_to_a_factor():
    # Plain sums over a grid of the four logarithms.
    spread, points = 0.3, 24
    low, high = np.log(1 - spread), np.log(1 + spread)
    factors = np.exp(low + (high - low) * (np.arange(points) + 0.5) / points)
    m, c, a, b = np.stack(np.meshgrid(*[factors] * 4, indexing="ij")).reshape(4, -1) * CENTER[:, None]
    drawn = np.stack([a / m, b / m, c / m, 1 / m]) * SAMPLING_STEP ** np.array([[2], [2], [1], [2]])
    prior = continuous_prior(spread=spread)
    np.testing.assert_allclose(prior.coefficients_mean, drawn.mean(axis=1), rtol=1e-3)
    scale = np.sqrt(np.diag(prior.coefficients_cov))
    np.testing.assert_allclose((prior.coefficients_cov - np.cov(drawn)) / np.outer(scale, scale), 0, atol=5e-3)


@pytest.mark.parametrize("spread", [1e-6, 0.999])
def test_the_prior_is_positive_definite_at_the_ends_of_the_range(spread):
    prior = continuous_prior(spread=spread)
    std = np.sqrt(np.diag(prior.coefficients_cov))
    assert np.linalg.eigvalsh(prior.coefficients_cov / np.outer(std, std))[0] > 1e-4
    if spread == 1e-6:  # the relative variance is spread² / 3, of quotients twice that
        ratios = (std / prior.coefficients_mean) ** 2 / spread**2
        np.testing.assert_allclose(ratios, [2 / 3, 2 / 3, 2 / 3, 1 / 3], rtol=1e-2)


def test_noises_and_state_are_centred():
    prior = continuous_prior(process_noise=1e-3, measurement_noise=2e-3, noise_shape=5.0, state_std=0.01)
    assert (prior.gamma_shape, prior.xi_shape) == (5, 5)
    assert prior.gamma_mean == pytest.approx(1e6)
    assert prior.xi_mean == pytest.approx(2.5e5)
    np.testing.assert_array_equal(prior.state_mean, [0, 0])
    np.testing.assert_array_equal(prior.state_cov, 1e-4 * np.eye(2))


@pytest.mark.parametrize(
    ("name", "value"),
    [("spread", 0), ("spread", 1), ("process_noise", -1), ("measurement_noise", np.inf), ("noise_shape", 0),
     ("state_std", np.nan)],
)  # fmt: skip
def test_bad_values_are_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be .*but is"):
        continuous_prior(**{name: value})


def test_physical_parameters_there_and_back():
    rng = np.random.default_rng(0)
    truth = PhysicalParameters(*(CENTER[:, None] * rng.uniform(0.7, 1.3, (4, 5))))
    coefficients = ContinuousBelief.coefficients_of(truth)
    np.testing.assert_allclose(coefficients[:, 3], SAMPLING_STEP**2 / truth.m)
    factor = rng.standard_normal((4, 6))
    cov = 1e-6 * factor @ factor.T
    physical, physical_cov = ContinuousBelief.propagate(coefficients, np.broadcast_to(cov, (5, 4, 4)))
    np.testing.assert_allclose(physical, np.stack([truth.m, truth.c, truth.a, truth.b], axis=-1), rtol=1e-14)
    for i in range(5):
        slopes = np.empty((4, 4))
        for j in range(4):
            step = 1e-6 * np.eye(4)[j]
            ends = [ContinuousBelief.propagate(coefficients[i] + sign * step, cov)[0] for sign in (1, -1)]
            slopes[:, j] = (ends[0] - ends[1]) / 2e-6
        expected = slopes @ cov @ slopes.T
        std = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(physical_cov[i] / np.outer(std, std), expected / np.outer(std, std), atol=1e-8)


def test_a_belief_tells_its_parameters_in_physical_units():
    told = continuous_prior(spread=1e-5).parameters()
    assert [unit for *_, unit in told.values()] == ["s⁻²", "V⁻² s⁻²", "s⁻¹", "s⁻²"]
    means = {name: mean for name, (mean, *_) in told.items()}
    assert means == pytest.approx({"stiffness": 184255, "cubic": 730155, "damping": 41.8992, "gain": 186015}, rel=1e-8)
    assert told["gain"][1] == pytest.approx(186015 * 1e-5 / np.sqrt(3), rel=1e-3)


def test_beliefs_of_two_kinds_are_not_equal():
    belief = continuous_prior()
    assert belief == continuous_prior()
    assert hash(belief) == hash(continuous_prior())
    assert belief != continuous_prior(spread=0.2)
    assert belief != Belief(belief.record)
    assert Belief(belief.record) != belief
