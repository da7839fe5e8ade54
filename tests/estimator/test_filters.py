"""The filter of the physical equation: its memory, its free runs, and whether its intervals hold the truth.

The oscillators are simulated in physical units by solvers that share nothing with the estimator.
"""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom, chi2, norm

from benchmarks import coverage_sigma
from benchmarks.coverage_sigma import FREE, simulate
from duffing_env.silverbox import synthesise_multisine
from estimator import NLARX, SAMPLING_STEP, DuffingODE, JointBelief, OnlineEstimator, Prior

ONLINE = ("linear", "look_ahead")
PRIOR = DuffingODE().prior()
PRIOR_STD = np.sqrt(np.diag(PRIOR.coefficients_cov))

#: An oscillator well off the prior's mean: stiffness, damping, gain, cubic, u0, cubic damping, y0, feedthrough.
TRUTH = PRIOR.coefficients_mean * [0.8, 1.2, 1.25, 0.85, 1, 1, 1, 1] + [0, 0, 0, 0, 8e-3, 0, -5e-3, 0.03]
NOISE = 3e-4  # V


def multisine(samples, rng):
    """A piece of the Silverbox's excitation at three times its amplitude."""
    return 3 * synthesise_multisine(rng, realisations=1)[500 : 500 + samples]


def motion(u):
    """(x, x') of the oscillator from rest (T, 2), by SciPy, with the input linear between samples."""
    k, c, g, b, u0 = TRUTH[:5]
    time, states = SAMPLING_STEP * np.arange(len(u)), np.zeros((len(u), 2))

    def rates(t, state):
        return [state[1], g * (np.interp(t, time, u) - u0) - c * state[1] - k * state[0] - b * state[0] ** 3]

    for t in range(1, len(u)):
        solution = solve_ivp(rates, time[t - 1 : t + 1], states[t - 1], method="DOP853", rtol=1e-10, atol=1e-13)
        states[t] = solution.y[:, -1]
    return states


def outputs(u):
    """Noise-free outputs (T,)."""
    return motion(u)[:, 0] + TRUTH[6] + TRUTH[7] * u


@pytest.fixture(scope="module")
def samples():
    """Inputs, noise-free and noisy outputs of 300 samples."""
    rng = np.random.default_rng(0)
    u = multisine(300, rng)
    y = outputs(u)
    return u, y, y + NOISE * rng.standard_normal(300)


def assert_same(first, second):
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, second.arrays()[name], err_msg=name)


# --- Memory --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ONLINE)
def test_run_is_repeated_update(samples, interpolation, monkeypatch, capsys):
    u, _, y = samples
    whole, single, parts, shown = (OnlineEstimator(DuffingODE(interpolation)) for _ in range(4))
    free_energies = whole.run(u, y)
    each, forecasts = [], []
    for u_t, y_t in zip(u, y, strict=True):
        single.update(u_t, y_t)
        if len(single.forecasts):  # a sample was used, this one or the one before
            each.append(single.free_energies)
            forecasts.append(single.forecasts[0])
    in_parts = [parts.run(u[a:b], y[a:b]) for a, b in ((0, 1), (1, 2), (2, 120), (120, 120), (120, 300))]
    monkeypatch.setattr("estimator.online._SAMPLES_BETWEEN_REPORTS", 70)
    np.testing.assert_array_equal(shown.run(u, y, progress=True), free_energies)
    np.testing.assert_array_equal(each, free_energies)
    np.testing.assert_array_equal(forecasts, whole.forecasts)
    np.testing.assert_array_equal(np.concatenate(in_parts), free_energies)
    for other in (single, parts, shown):
        assert_same(whole, other)
    assert "Identifying" in capsys.readouterr().out


def test_look_ahead_waits_for_the_next_input(samples):
    u, _, y = samples
    estimator, shorter, untouched = (OnlineEstimator(DuffingODE("look_ahead")) for _ in range(3))
    estimator.update(u[0], y[0])
    assert np.isnan(estimator.free_energy)
    assert estimator.forecasts.shape == (0, 2)
    np.testing.assert_array_equal(estimator.belief.mean, untouched.belief.mean)
    assert estimator.run(u[1:200], y[1:200]).shape == (199, 3)
    shorter.run(u[:200], y[:200])
    assert_same(estimator, shorter)
    # The belief does not know the last output yet, and knows the last input: it acts on the sample before.
    other_output, other_input = OnlineEstimator(DuffingODE("look_ahead")), OnlineEstimator(DuffingODE("look_ahead"))
    other_output.run(u[:200], np.append(y[:199], 9.9))
    np.testing.assert_array_equal(estimator.belief.mean, other_output.belief.mean)
    other_input.run(np.append(u[:199], 0.9), y[:200])
    assert not np.array_equal(estimator.belief.mean, other_input.belief.mean)


def test_linear_does_not_see_the_future(samples):
    u, _, y = samples
    first, second = OnlineEstimator(DuffingODE()), OnlineEstimator(DuffingODE())
    assert first.run(u[:200], y[:200]).shape == (200, 3)
    second.run(u, y)
    np.testing.assert_array_equal(first.forecasts, second.forecasts[:200])


def test_spline_takes_records_and_no_samples(samples, monkeypatch):
    u, _, y = samples
    estimator, shown = OnlineEstimator(DuffingODE("spline")), OnlineEstimator(DuffingODE("spline"))
    message = "interpolation must not be 'spline' for single samples; use run() or 'look_ahead'"
    with pytest.raises(ValueError, match=re.escape(message)):
        estimator.update(u[0], y[0])
    assert estimator.run(u, y).shape == (300, 3)
    monkeypatch.setattr("estimator.online._SAMPLES_BETWEEN_REPORTS", 70)
    shown.run(u, y, progress=True)  # in one piece: a spline through a part of the record is another one
    assert_same(estimator, shown)


@pytest.mark.parametrize("interpolation", [*ONLINE, "spline"])
def test_rewind_forgets_the_state_and_keeps_what_was_learned(samples, interpolation):
    u, _, y = samples
    estimator = OnlineEstimator(DuffingODE(interpolation))
    estimator.run(u, y)
    before = estimator.belief
    estimator.rewind()
    after = estimator.belief
    np.testing.assert_array_equal(after.coefficients_mean, before.coefficients_mean)
    np.testing.assert_array_equal(after.coefficients_cov, before.coefficients_cov)
    assert (after.gamma_rate, after.xi_shape, after.xi_rate) == (before.gamma_rate, before.xi_shape, before.xi_rate)
    assert np.abs(after.state_mean / np.sqrt(np.diag(PRIOR.state_cov))).max() < 0.1
    np.testing.assert_allclose(np.diag(after.state_cov), np.diag(PRIOR.state_cov), rtol=0.05)
    np.testing.assert_array_equal(estimator.arrays()["cov"][:2, 2:], 0.0)
    # The last input is forgotten too: another record is like a first one for a new estimator with this belief.
    fresh = OnlineEstimator(DuffingODE(interpolation), after)
    other = u[::-1].copy()
    np.testing.assert_allclose(estimator.run(other, y), fresh.run(other, y), rtol=1e-6)
    np.testing.assert_allclose(estimator.belief.mean, fresh.belief.mean, rtol=1e-7)


def test_process_noise_is_an_acceleration_over_a_sample():
    model = DuffingODE()
    estimator = OnlineEstimator(model, model.prior(process_noise=0.2))
    estimator.run([0.0], [np.nan], missing=True)
    direction = np.array([1.0, 2 / SAMPLING_STEP])  # of w: a δ²/2 in x, a δ in x'
    added = (estimator.belief.state_cov - PRIOR.state_cov) / np.outer(direction, direction)
    np.testing.assert_allclose(added, 0.2**2, rtol=1e-10)


@pytest.mark.parametrize("interpolation", [*ONLINE, "spline"])
def test_a_second_pass_narrows_the_belief(samples, interpolation):
    u, _, y = samples
    estimator = OnlineEstimator(DuffingODE(interpolation))
    estimator.run(u, y)
    once = estimator.belief.entropy()
    estimator.rewind()
    estimator.run(u, y)
    assert estimator.belief.entropy() < once


# --- Predictions and free runs -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def knowing():
    """An estimator that believes the truth; nearly: the noises must leave room for the state."""
    scale = np.diag(np.concatenate([np.diag(PRIOR.state_cov), 1e-20 * TRUTH**2]))
    noises = (1e6, 1e6 * 5e-6**2, 1e6, 1e6 * NOISE**2)
    mean = np.concatenate([PRIOR.state_mean, TRUTH])
    return OnlineEstimator(DuffingODE(), JointBelief(PRIOR.names, PRIOR.units, mean, scale, *noises))


def test_a_free_run_at_the_truth_is_the_truth(samples, knowing):
    u, y, _ = samples
    simulated = knowing.simulate(u, y[:50])
    np.testing.assert_array_equal(simulated[:50], y[:50])
    # 10 µV is what the filter's noises leave of the unknown first state.
    np.testing.assert_allclose(simulated[50:], y[50:], atol=1e-5)
    np.testing.assert_array_equal(knowing.simulate(u, y), y)


def test_a_free_run_starts_where_the_given_outputs_leave_the_oscillator(samples, knowing):
    u, y, noisy = (values[100:] for values in samples)  # in full motion
    # Two outputs give displacement and velocity as well as the sensor's noise lets them, fifty give them better.
    few, many = (
        np.abs(knowing.simulate(u, noisy[:given]) - y)[given : given + 20].max() for given in (2, 50)
    )  # fmt: skip
    assert NOISE / 2 < few < 10 * NOISE
    assert many < few / 2


def test_predictions_are_forecasts_with_everything_fixed_but_the_state(samples, knowing):
    u, _, y = samples
    predicted = knowing.predict(u, y)
    follower = OnlineEstimator(knowing.model, knowing.belief)
    follower.run(u, y)
    np.testing.assert_allclose(predicted, follower.forecasts[:, 0], atol=1e-9)
    # No more than the sensor's noise, and what the prediction has of the last outputs'.
    assert NOISE / 2 < np.std((predicted - y)[20:]) < 1.5 * NOISE


def test_asking_changes_nothing(samples):
    u, _, y = samples
    asked, untouched = OnlineEstimator(DuffingODE("look_ahead")), OnlineEstimator(DuffingODE("look_ahead"))
    for estimator in (asked, untouched):
        estimator.run(u[:200], y[:200])
    asked.predict(u, y)
    asked.simulate(u, y[:10])
    assert_same(asked, untouched)


def test_a_free_run_may_diverge():
    cov = np.diag(np.concatenate([np.diag(PRIOR.state_cov), PRIOR_STD**2]))
    softening = np.concatenate([PRIOR.state_mean, PRIOR.coefficients_mean * [1, 1, 1, -1, 1, 1, 1, 1]])
    prior = JointBelief(PRIOR.names, PRIOR.units, softening, cov, 2, 1e-10, 2, 1e-6)
    simulated = OnlineEstimator(DuffingODE(), prior).simulate(np.ones(200), [0.0, 0.0])
    assert np.isfinite(simulated[:3]).all()
    assert not np.isfinite(simulated[-1])


@pytest.mark.parametrize(
    ("model", "prior", "message"),
    [
        (DuffingODE(), Prior.silverbox_twin(), "prior must have the parameters ('stiffness', 'damping'"),
        (DuffingODE(), NLARX(regressors="cubic").prior(), "prior must have the parameters ('stiffness', 'damping'"),
        (
            DuffingODE(),
            JointBelief(PRIOR.names, PRIOR.units, PRIOR.coefficients_mean, PRIOR.coefficients_cov, 2, 1e-10, 2, 1e-6),
            "prior must have the parameters ('stiffness', 'damping'",
        ),
        (NLARX(), PRIOR, "prior must be a Prior for NLARX, but is JointBelief"),
        (NLARX(regressors="offset"), PRIOR, "prior must have the parameters ('x1', 'x1^3', 'x2', 'u1', '1')"),
    ],
    ids=["Prior", "other names", "no state", "NLARX", "regressors"],
)
def test_a_prior_of_another_model_is_refused(model, prior, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        OnlineEstimator(model, prior)


def test_mean_field_is_refused():
    with pytest.raises(ValueError, match="factorisation must be 'structured' for DuffingODE"):
        OnlineEstimator(DuffingODE(), factorisation="mean_field")


# --- Whether it is right -------------------------------------------------------------------------------------------


def test_a_known_system_is_found_in_physical_units(samples):
    u, _, y = samples
    estimator = OnlineEstimator(DuffingODE())
    free_energies = estimator.run(u, y)
    assert np.diff(free_energies, axis=1).max() <= 1e-9
    belief = estimator.belief
    std = np.sqrt(np.diag(belief.coefficients_cov))
    assert (np.abs(belief.coefficients_mean - TRUTH)[FREE] < 3.5 * std[FREE]).all()
    assert (std[:4] < 0.005 * TRUTH[:4]).all()  # from 30 %
    assert belief.parameters()["cubic_damping"] == (0.0, 0.0, "V⁻² s")
    assert belief.xi_mean == pytest.approx(NOISE**-2, rel=0.6)  # its prior says 1 mV, and is not forgotten yet
    x, velocity = motion(u)[-1]  # in volts and volts per second
    assert (np.abs(belief.state_mean - [x, velocity]) < 3.5 * np.sqrt(np.diag(belief.state_cov))).all()
    assert (np.diag(belief.state_cov) < np.square([1e-3, 0.2])).all()


SYSTEMS = 100
SAMPLES = 1500
TAIL = 1e-4  # chance that a calibrated posterior misses one bound


@pytest.fixture(scope="module")
def systems():
    """Parameters (SYSTEMS, 8), inputs and outputs (SYSTEMS, SAMPLES) of oscillators drawn around the prior.

    Stiffness, damping, gain and cubic stiffness are log-uniform within 30 %, the offsets and the feedthrough as the
    prior says.
    """
    rng = np.random.default_rng(1)
    truth = PRIOR.coefficients_mean * np.exp(rng.uniform(np.log(0.7), np.log(1.3), (SYSTEMS, 8)))
    truth[:, 4:] = PRIOR_STD[4:] * rng.standard_normal((SYSTEMS, 4))
    truth[:, 5] = 0.0
    return truth, *simulate(truth, SAMPLES, rng)


def errors(systems, substeps):
    """Errors of the free parameters in standard deviations (SYSTEMS, 7), and their NEES (SYSTEMS,)."""
    normalised, nees = coverage_sigma.errors(DuffingODE(substeps=substeps), PRIOR, "first_order", *systems)
    return normalised, len(FREE) * nees


def test_intervals_hold_the_truth(systems):
    """Hits are binomial with p = 0.9: from 77 to 99 of 100. The sum of the NEES is chi-squared with 7 for each."""
    normalised, nees = errors(systems, DuffingODE().substeps)
    hits = (np.abs(normalised) < norm.ppf(0.95)).sum(axis=0)
    assert (hits >= binom.ppf(TAIL, SYSTEMS, 0.9)).all(), hits
    assert (hits <= binom.isf(TAIL, SYSTEMS, 0.9)).all(), hits
    assert 0.85 <= hits.sum() / (7 * SYSTEMS) <= 0.98
    # From above only: a prior of 1 mV for a sensor of 0.3 mV leaves the intervals a little too wide.
    assert nees.sum() <= chi2.isf(TAIL, 7 * SYSTEMS)


def test_coarse_steps_miss_it(systems):
    """Why there are eight steps per sample: two integrate to 1e-4, but the posterior is narrower than that."""
    normalised, _ = errors(systems, 2)
    hits = (np.abs(normalised) < norm.ppf(0.95)).sum(axis=0)
    assert hits[0] < 50  # the stiffness
