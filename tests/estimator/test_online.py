"""The online estimator: every kind against itself sample by sample, plain loops, and the published numbers."""

import copy
import pickle
import re

import numpy as np
import pytest
from estimators import (
    KINDS,
    ODE,
    ONE_TAP,
    OWN_TAPS,
    TRUTH,
    assert_same,
    motion,
    pendulum_estimator,
    pendulum_record,
    record,
)
from tables import table

from estimator import (
    SILVERBOX_TWIN,
    OnlineEstimator,
    Rig,
    difference,
    duffing,
    paper_text_prior,
    published_run_prior,
    recorded_prior,
    silverbox_prior,
)
from estimator.models.pendulum import PENDULUM

FACTORISATIONS = ("structured", "mean_field")

#: Kinds that fit the record.
FITS = ("paper", "published", "own terms, drift", "ode", "ode, look-ahead", "ensemble")

#: Kinds that take no missing outputs, or that fit the record so badly that they run away in a gap.
MISFITS = ("mean field", "published")


@pytest.fixture(scope="module")
def samples():
    return record()


# --- Every kind ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_run_is_repeated_update(kind, samples, monkeypatch, capsys):
    u, y = samples[0][:120], samples[1][:120]
    whole, single, parts, shown = (KINDS[kind]() for _ in range(4))
    free_energies = whole.run(u, y)
    each, forecasts = [], []
    for u_t, y_t in zip(u.tolist(), y.tolist(), strict=True):
        single.update(u_t, y_t)
        if len(single.forecasts):  # a sample was used, this one or the one before
            each.append(single.free_energies)
            forecasts.extend(single.forecasts)
    in_parts = [parts.run(u[a:b], y[a:b]) for a, b in ((0, 1), (1, 2), (2, 50), (50, 50), (50, 120))]
    monkeypatch.setattr("estimator.online._SAMPLES_BETWEEN_REPORTS", 70)
    monkeypatch.setattr("estimator.support.progress.REPORT_INTERVAL", 0.0)
    np.testing.assert_array_equal(shown.run(u, y, progress=True), free_energies)
    np.testing.assert_array_equal(each, free_energies)
    np.testing.assert_array_equal(forecasts, whole.forecasts)
    np.testing.assert_array_equal(np.concatenate(in_parts), free_energies)
    for other in (single, parts, shown):
        assert_same(whole, other)
    assert "Identifying" in capsys.readouterr().err
    assert whole.free_energy == free_energies[-1, -1]
    assert len(free_energies) == 120 - whole.lookahead


@table("kind", KINDS)
@table("bad", [1e200, 1e154])  # after the second the belief may be finite, its free energy is not
def test_unchanged_after_an_update_that_raised(kind, bad, samples):
    estimator, untouched = KINDS[kind](), KINDS[kind]()
    for each in (estimator, untouched):
        each.run(samples[0][:50], samples[1][:50])
    before = estimator.forecasts
    with pytest.raises(ValueError, match=re.escape("u and y must keep the belief finite, but near sample ")):
        estimator.run([0.1, 0.1, 0.1], [0.05, bad, 0.05])
    assert_same(estimator, untouched)
    if not estimator.lookahead:
        with pytest.raises(ValueError, match=re.escape(f"near sample 0 (u = 0.1, y = {bad})")):
            estimator.update(0.1, bad)
    np.testing.assert_array_equal(estimator.forecasts, before)
    for each in (estimator, untouched):
        each.update(0.1, 0.05)
        each.update(0.05, 0.05)
    assert_same(estimator, untouched)


@table("kind", KINDS)
def test_copies_and_pickles_go_on_alike(kind, samples):
    u, y = samples
    estimator = KINDS[kind]()
    estimator.run(u[:100], y[:100])
    others = copy.deepcopy(estimator), pickle.loads(pickle.dumps(estimator))
    estimator.run(u[100:150], y[100:150])
    for other in others:
        other.run(u[100:150], y[100:150])
        assert_same(estimator, other)


@table("kind", KINDS)
def test_rewind_forgets_the_state_and_keeps_what_was_learned(kind, samples):
    u, y = samples
    estimator, first = KINDS[kind](), KINDS[kind]().belief
    estimator.run(u, y)
    before, weights = estimator.belief, estimator.arrays()["weights"]
    estimator.rewind()
    after = estimator.belief
    np.testing.assert_allclose(after.coefficients_mean, before.coefficients_mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(after.noises, before.noises)
    np.testing.assert_array_equal(estimator.arrays()["weights"], weights)
    np.testing.assert_allclose(after.state_mean, first.state_mean, atol=1e-15)
    np.testing.assert_allclose(after.state_cov, first.state_cov, rtol=1e-9, atol=1e-20)
    n = len(after.state_mean)
    np.testing.assert_array_equal(after.cov[:n, n:], 0.0)
    once = estimator.belief.entropy()
    estimator.run(u, y)
    assert estimator.belief.entropy() < once or estimator.settings.drift


@table("kind", [kind for kind in KINDS if kind not in MISFITS])
def test_nothing_is_learned_from_a_gap(kind, samples):
    u, y = samples
    estimator = KINDS[kind]()
    estimator.run(u, y)
    estimator.run(u[:1], [np.nan], missing=True)  # uses a sample that waited, if there was one
    before = estimator.belief
    free_energies = estimator.run(u[:20], np.full(20, np.nan), missing=True)
    np.testing.assert_allclose(free_energies, 0, atol=1e-12)
    after = estimator.belief
    # But for members of an ensemble, which may come back.
    assert (after.gamma_mean, after.xi_mean) == pytest.approx((before.gamma_mean, before.xi_mean), rel=0.01)
    variances = np.diag(after.coefficients_cov) / np.diag(before.coefficients_cov)
    if estimator.settings.drift:
        assert (variances > 1).all()
    else:
        np.testing.assert_allclose(variances, 1.0, rtol=1e-3 if estimator.settings.noise_hypotheses == 1 else 1e-2)
    np.testing.assert_array_equal(np.isfinite(estimator.forecasts), True)


@table("kind", KINDS)
def test_reading_the_belief_changes_nothing(kind, samples):
    u, y = samples
    asked, untouched = KINDS[kind](), KINDS[kind]()
    for estimator in (asked, untouched):
        estimator.run(u, y)
    predicted, simulated = asked.predict(u, y), asked.simulate(u, y[:10])
    np.testing.assert_array_equal(simulated[:10], y[:10])
    assert np.isfinite(predicted).all()
    if kind in FITS:
        assert np.std((predicted - y)[20:]) < 0.3 * np.std(y)
        assert np.std((simulated - y)[20:]) < 0.7 * np.std(y)
    asked.arrays()["records"][:] = 0.0
    asked.free_energies[:] = asked.forecasts[:] = 0.0
    assert_same(asked, untouched)


# --- The paper's model ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factorisation", FACTORISATIONS)
def test_delay_is_a_shift_of_the_input(samples, factorisation):
    u, y = samples
    delayed, shifted, unshifted = (
        OnlineEstimator(rig=rig, factorisation=factorisation) for rig in (ONE_TAP, OWN_TAPS, OWN_TAPS)
    )
    delayed.run(u, y)
    shifted.run(np.concatenate(([0.0], u[:-1])), y)
    unshifted.run(u, y)
    np.testing.assert_array_equal(delayed.belief.record, shifted.belief.record)
    eta = list(delayed.belief.names).index("eta")
    assert abs(delayed.belief.coefficients_mean[eta] / TRUTH.eta - 1) < 0.01
    assert abs(unshifted.belief.coefficients_mean[eta] / TRUTH.eta - 1) > 0.1


def test_belief_finds_the_oscillator(samples):
    estimator = OnlineEstimator()
    estimator.run(*samples)
    mean, cov = estimator.belief.physical()
    twin = [SILVERBOX_TWIN.m, SILVERBOX_TWIN.c, SILVERBOX_TWIN.a, SILVERBOX_TWIN.b]
    assert (np.abs(mean - twin) < 4 * np.sqrt(np.diag(cov))).all()
    assert (np.diag(cov) < 0.7 * np.diag(OnlineEstimator().belief.physical()[1])).all()


@pytest.mark.parametrize("options", [{}, {"factorisation": "mean_field"}, {"noise_hypotheses": 3}], ids=str)
def test_what_is_known_stays_known(samples, options):
    estimator = OnlineEstimator(prior=published_run_prior(nonlinear=False), **options)
    estimator.run(*samples)
    belief = estimator.belief
    assert belief.coefficients()["theta2"] == (0.0, 0.0)
    np.testing.assert_array_equal(belief.coefficients_cov[1], 0.0)
    assert np.isfinite(belief.entropy())


def test_defaults():
    estimator = OnlineEstimator()
    assert (estimator.model, estimator.rig) == (difference(), ONE_TAP)
    assert (estimator.settings.factorisation, estimator.settings.iterations) == ("structured", 3)
    assert OnlineEstimator(factorisation="mean_field").settings.iterations == 10
    assert np.isnan(estimator.free_energy)
    assert estimator.belief == silverbox_prior()
    assert OnlineEstimator(ODE).rig == Rig.silverbox("linear")
    assert OnlineEstimator(ODE).belief == recorded_prior(ODE)


@table("delay", [0, 1])
@table("factorisation", FACTORISATIONS)
def test_predict_and_simulate_equal_plain_loops(samples, factorisation, delay):
    u, y = samples
    estimator = OnlineEstimator(rig=Rig.silverbox("zero_order", delay), factorisation=factorisation)
    estimator.run(u, y)
    t1, t2, t3, eta = estimator.belief.coefficients_mean
    predicted, simulated = list(y[:2]), list(y[:5])
    for t in range(2, len(u)):
        predicted.append(t1 * y[t - 1] + t2 * y[t - 1] ** 3 + t3 * y[t - 2] + eta * u[t - delay])
    for t in range(5, len(u)):
        simulated.append(t1 * simulated[-1] + t2 * simulated[-1] ** 3 + t3 * simulated[-2] + eta * u[t - delay])
    np.testing.assert_allclose(estimator.predict(u, y), predicted, rtol=1e-10, atol=1e-14)
    # A free run carries its rounding along, but a stable one forgets it.
    np.testing.assert_allclose(estimator.simulate(u, y[:5]), simulated, atol=1e-9)
    np.testing.assert_array_equal(estimator.simulate(u, y), y)


@pytest.mark.parametrize("model", [difference(), ODE], ids=["paper", "ode"])
def test_a_free_run_may_diverge(model):
    prior = published_run_prior()  # θ = 1, η = 2: no stable oscillator
    if model == ODE:
        weak = recorded_prior(ODE)
        mean = weak.mean
        mean[2:4] *= -1  # stiffness and cubic
        prior = type(weak).of(ODE, mean, weak.cov, (2.0, 1e-10), (2.0, 1e-6))
    simulated = OnlineEstimator(model, prior).simulate(np.ones(200), [0.0, 0.0])
    assert np.isfinite(simulated[:3]).all()
    assert not np.isfinite(simulated[-1])


# --- The physical equation, and others -----------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["linear", "zero_order"])
def test_a_known_oscillator_is_found(interpolation):
    models = {"linear": ODE, "zero_order": duffing(offsets=True)}  # ODE's offsets and feedthrough are 0
    truth = recorded_prior(duffing()).coefficients_mean * [0.8, 0.85, 1.2, 1.25]
    rng = np.random.default_rng(0)
    u = np.convolve(rng.uniform(-0.3, 0.3, 403), np.full(4, 0.5), mode="valid")
    states = motion(u, truth, interpolation)
    y = states[:, 0] + 3e-4 * rng.standard_normal(400)
    estimator = OnlineEstimator(models[interpolation], rig=Rig.silverbox(interpolation))
    free_energies = estimator.run(u, y)
    assert np.diff(free_energies, axis=1).max() <= 1e-9
    belief = estimator.belief
    std = np.sqrt(np.diag(belief.coefficients_cov))
    off = np.abs(belief.coefficients_mean - [*truth, *[0.0] * (len(std) - 4)])
    assert (off < 3.5 * std).all()
    assert (std[:4] < 0.01 * truth).all()  # from 30 %
    assert belief.xi_mean == pytest.approx(3e-4**-2, rel=0.6)  # its prior says 1 mV, and is not forgotten yet
    assert (np.abs(belief.state_mean - states[-1]) < 3.5 * np.sqrt(np.diag(belief.state_cov))).all()
    # Another hold is another input: its intervals do not hold the truth.
    hold = "linear" if interpolation == "zero_order" else "zero_order"
    other = OnlineEstimator(models[hold], rig=Rig.silverbox(hold))
    other.run(u, y)
    wrong = (other.belief.coefficients_mean[:4] - truth) / np.sqrt(np.diag(other.belief.coefficients_cov))[:4]
    assert np.abs(wrong).max() > 10


def test_a_held_noise_is_a_force_over_a_sample():
    prior = recorded_prior(ODE, process_noise=0.2)
    known = type(prior).of(
        ODE, prior.mean * ([1, 1] + [1e-9] * 4 + [1] * 3), 0 * prior.cov, prior.noises[:2], prior.noises[2:]
    )  # without spring and damper
    estimator = OnlineEstimator(ODE, known)
    estimator.run([0.0], [np.nan], missing=True)
    direction = np.array([1.0, 2.0])  # of w: a δ²/2 in x, a δ in x'
    np.testing.assert_allclose(estimator.belief.state_cov, 0.2**2 * np.outer(direction, direction), rtol=1e-6)


def test_look_ahead_waits_for_the_next_input(samples):
    u, y = samples
    rig = Rig.silverbox("look_ahead")
    estimator, shorter, untouched = (OnlineEstimator(ODE, rig=rig, iterations=2) for _ in range(3))
    estimator.update(u[0], y[0])
    assert np.isnan(estimator.free_energy)
    assert estimator.forecasts.shape == (0, 2)
    np.testing.assert_array_equal(estimator.belief.record, untouched.belief.record)
    assert estimator.run(u[1:200], y[1:200]).shape == (199, 2)
    shorter.run(u[:200], y[:200])
    assert_same(estimator, shorter)
    # The belief does not know the last output yet, and knows the last input: it acts on the sample before.
    other_output, other_input = (OnlineEstimator(ODE, rig=rig, iterations=2) for _ in range(2))
    other_output.run(u[:200], np.append(y[:199], 9.9))
    assert estimator.belief == other_output.belief
    other_input.run(np.append(u[:199], 0.9), y[:200])
    assert estimator.belief != other_input.belief


def test_spline_takes_records_and_no_samples(samples, monkeypatch):
    u, y = samples
    estimator, shown = (OnlineEstimator(ODE, rig=Rig.silverbox("spline"), iterations=2) for _ in range(2))
    with pytest.raises(ValueError, match=re.escape("interpolation must not be 'spline' for single samples; use run()")):
        estimator.update(u[0], y[0])
    assert estimator.run(u, y).shape == (300, 2)
    monkeypatch.setattr("estimator.online._SAMPLES_BETWEEN_REPORTS", 70)
    monkeypatch.setattr("estimator.support.progress.REPORT_INTERVAL", 0.0)
    shown.run(u, y, progress=True)  # in one piece: a spline through a part of the record is another one
    assert_same(estimator, shown)


def test_two_sensors():
    truth, u, y = pendulum_record(400, 1e-3)
    estimator, single = pendulum_estimator(), pendulum_estimator()
    free_energies = estimator.run(u, y)
    for u_t, y_t in zip(u, y, strict=True):
        single.update(u_t, y_t)
    assert_same(estimator, single)
    assert np.diff(free_energies, axis=1).max() < 1e-6
    std = np.sqrt(np.diag(estimator.belief.coefficients_cov))
    assert (np.abs(estimator.belief.coefficients_mean - truth) < 4 * std).all()
    assert (std < [4e-4, 1e-3, 4e-4]).all()  # from 1e-3
    assert (estimator.forecasts.shape, estimator.predict(u, y).shape) == ((400, 2, 2), (400, 2))
    assert np.abs(estimator.simulate(u, y[:20]) - y).max() < 0.2 * np.abs(y).max()
    with pytest.raises(ValueError, match=re.escape("y must have shape (T, 2), a column for each sensor")):
        estimator.run(u, y[:, 0])


# --- What is refused -----------------------------------------------------------------------------------------------


@table("factorisation", FACTORISATIONS)
@table(
    ("u", "y", "message"),
    [
        (np.nan, 0.1, "u must be finite, but u[0] is nan; remove or interpolate"),
        (0.1, -np.inf, "y must be finite, but y[0] is -inf; remove or interpolate"),
        ([0.1, 0.2], 0.1, "u must be one number, but has shape (2,); use run() for many samples"),
        (0.1, [], "y must be one number, but has shape (0,)"),
        ("high", 0.1, "u must be numbers, but is 'high'"),
        (np.ma.masked, 0.1, "u must not be a masked array, whose hidden values would be used; pass u.filled(np.nan)"),
    ],
)
def test_invalid_samples_are_refused(samples, factorisation, u, y, message):
    estimator, untouched = (OnlineEstimator(factorisation=factorisation) for _ in range(2))
    with pytest.raises(ValueError, match=re.escape(message)):
        estimator.update(u, y)
    assert_same(estimator, untouched)


@table(
    ("change", "message"),
    [
        (lambda u, y: (u, y[:-1]), "u and y must have one length, but have 300 and 299; cut the longer one"),
        (lambda u, y: (u[:, None], y), "u must have shape (T,), but has (300, 1); pass one channel, e.g. u.ravel()"),
        (lambda u, y: (0.1, 0.1), "u must have shape (T,), but has ()"),
        (lambda u, y: (u, [[0.1], [0.1, 0.2]]), "y must be numbers, but is [[0.1], [0.1, 0.2]]"),
        (lambda u, y: (u, np.where(np.arange(300) == 7, np.nan, y)), "y must be finite, but y[7] is nan"),
        (lambda u, y: (u, np.ma.masked_greater(y, 0)), "y must not be a masked array"),
        (lambda u, y: (np.where(np.arange(300) == 9, np.inf, u), y), "u must be finite, but u[9] is inf"),
        (lambda u, y: (u, np.where(np.arange(300) == 7, 1e200, y)), "near sample 7 (u = "),
        (lambda u, y: (u, np.where(np.arange(300) == 299, 1e200, y)), "near sample 299 (u = "),
    ],
)
def test_unchanged_after_a_run_that_raised(samples, change, message):
    estimator, untouched = OnlineEstimator(), OnlineEstimator()
    for each in (estimator, untouched):
        each.run(*samples)
    with pytest.raises(ValueError, match=re.escape(message)):
        estimator.run(*change(*samples))
    assert_same(estimator, untouched)
    for each in (estimator, untouched):
        each.update(0.1, 0.05)  # the last input, which acts here, is kept as well
    assert_same(estimator, untouched)


@table(
    ("call", "message"),
    [
        (lambda: Rig(1.0, "linear", 2000), "delay (for linear) must be a whole number from 0 to 1000, but is 2000"),
        (lambda: Rig(1.0, "linear", -1), "delay (for linear) must be a whole number from 0 to 1000, but is -1"),
        (lambda: Rig(1.0, interpolation="cubic"), "interpolation must be one of ['zero_order', 'linear', 'look_ahead'"),
        (lambda: Rig(step=0.0), "step must be a number from 1e-30 to 1e+30, but is 0.0"),
        (lambda: OnlineEstimator("duffing"), "model must be a Model, but is 'duffing'; use difference() or duffing()"),
        (lambda: OnlineEstimator(PENDULUM), "prior must be given for pendulum"),
        (lambda: OnlineEstimator(ODE, silverbox_prior()), "prior must be a Belief of duffing ('stiff"),
        (lambda: OnlineEstimator(rig=Rig(step=1.0)), "rig.step must be the prior's, 0.0016384, but is 1.0"),
        (lambda: OnlineEstimator(rig=3), "rig must be a Rig, a dictionary or a file name, but is 3"),
        (
            lambda: OnlineEstimator(factorisation="bethe"),
            "factorisation must be one of ['structured', 'mean_field'], but is 'bethe'",
        ),
        (lambda: OnlineEstimator(factorisation=[]), "factorisation must be one of ['structured', 'mean_field']"),
        (lambda: OnlineEstimator(ODE, factorisation="mean_field"), "factorisation must be 'structured' for duffing"),
        (lambda: OnlineEstimator(iterations=0), "iterations must be a whole number from 1 to 100, but is 0"),
        (lambda: OnlineEstimator(iterations=2.0), "iterations must be a whole number from 1 to 100, but is 2.0"),
        (lambda: OnlineEstimator(iterations=2**31), "from 1 to 100, but is 2147483648"),
        (lambda: OnlineEstimator(drift=None), "drift must be a number from 0 to 1, but is None"),
        (lambda: OnlineEstimator(drift=np.inf), "drift must be a number from 0 to 1, but is inf"),
        (lambda: OnlineEstimator(drift=0.1, factorisation="mean_field"), "drift must be 0 in mean field"),
        (lambda: OnlineEstimator(expectations="exact"), "expectations must be one of ['first_order', 'sigma_points']"),
        (
            lambda: OnlineEstimator(as_published=True),
            "as_published goes with factorisation='mean_field', but factorisation is 'structured'",
        ),
        (
            lambda: OnlineEstimator(factorisation="mean_field").run([0.0], [0.0], missing=True),
            "missing must be False in mean field",
        ),
        (lambda: OnlineEstimator(noise_hypotheses=0), "noise_hypotheses must be a whole number from 1 to 1000"),
        (
            lambda: OnlineEstimator(factorisation="mean_field", noise_hypotheses=9),
            "noise_hypotheses must be 1 for factorisation='mean_field', but is 9",
        ),
        (lambda: OnlineEstimator().noise_ratio, "noise_hypotheses must be above 1 for noise_ratio, but is 1"),
        (lambda: OnlineEstimator().predict([1.0], [1.0]), "one length of at least 2, but have 1 and 1"),
        (lambda: OnlineEstimator().predict([1.0, 2.0], [1.0]), "one length of at least 2, but have 2 and 1"),
        (lambda: OnlineEstimator().predict([1.0, np.nan], [1.0, 2.0]), "u must be finite, but u[1] is nan"),
        (
            lambda: OnlineEstimator().simulate(np.ones(4), [0.0]),
            "y_init must hold between 2 and len(u) = 4 outputs, but holds 1",
        ),
        (
            lambda: OnlineEstimator().simulate(np.ones(4), np.ones(5)),
            "y_init must hold between 2 and len(u) = 4 outputs, but holds 5",
        ),
    ],
)
def test_errors_name_the_argument_and_its_value(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


# --- On the Silverbox record ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("nonlinear", "prediction", "simulation"),
    [(False, 5.9446129987526364e-05, 1.0204335589997665e-03), (True, 5.8304968780121563e-05, 9.256401174690808e-04)],
    ids=["FEM-LARX", "FEM-NLARX"],
)
def test_published_numbers(record, nonlinear, prediction, simulation):
    prior = published_run_prior(nonlinear)
    estimator = OnlineEstimator(None, prior, OWN_TAPS, factorisation="mean_field", as_published=True)
    estimator.run(record.multisine.u, record.multisine.y)
    u, y = record.arrow.u, record.arrow.y
    predicted = estimator.predict(u, y)
    predicted[2] = 0.0  # the published mean begins with a prediction that was never made
    assert np.mean((predicted[2:] - y[2:]) ** 2) == pytest.approx(prediction, rel=1e-9)
    simulated = estimator.simulate(u, y[:2])
    assert np.mean((simulated[2:] - y[2:]) ** 2) == pytest.approx(simulation, rel=1e-9)


@pytest.mark.parametrize("factorisation", FACTORISATIONS)
@pytest.mark.parametrize("prior", [published_run_prior(), paper_text_prior()], ids=["published_run", "paper_text"])
def test_free_energy_over_the_record(record, factorisation, prior):
    estimator = OnlineEstimator(None, prior, factorisation=factorisation)
    free_energies = estimator.run(record.multisine.u, record.multisine.y)
    assert np.isfinite(free_energies).all()
    rises = np.diff(free_energies, axis=1).max(axis=1)
    if factorisation == "structured":
        assert rises.max() <= 1e-9
    else:  # coordinate descent but for the linearisation, which moves with the iterations
        assert np.mean(rises > 1e-9) <= 1e-4
