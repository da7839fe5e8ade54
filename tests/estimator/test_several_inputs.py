"""Several inputs, and none: everything of the estimator against the filters with matrices."""

from dataclasses import replace

import numpy as np
import pytest
from playing import assert_refused
from reference.filters import EPS, Plant, acting, central, input_seen, moved, path
from reference.plants import TWO_MASSES
from reference.structured import Belief as ReferenceBelief
from reference.structured import update
from scipy.interpolate import make_interp_spline
from tables import table

from estimator import Channel, OnlineEstimator, Rig
from estimator.inference.batch_posteriors import posteriors
from estimator.inference.fisher_information import fisher_information
from estimator.inference.free_run import free_run, output_at
from estimator.inference.input_interpolation import input_stencil
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.model import Model
from estimator.priors import weak_prior
from estimator.rigs.stated_units import prior_in_units
from estimator.rigs.units import Scales
from estimator.saving import load_estimator, save_estimator

#: Two pumps, of which one acts later, and a sensor that sees an input.
PUMPS = Model(
    name="pumps", states={"upper": "m", "lower": "m"}, inputs={"p": "m³", "q": "m³"},
    coefficients={"flow": "1", "leak": "1", "gain": "1"}, noise=("1", "0.5"),
    next_state=("upper - flow*tanh(upper) + gain*p", "lower + flow*tanh(upper) - leak*tanh(lower) + q[-2]"),
    outputs={"level": "lower + 0.1*p"},
)  # fmt: skip

#: A mass on a spring that nothing drives but its noise.
FREE = Model(
    name="free_mass", states={"x": "m", "v": "m"}, inputs={}, coefficients={"stiffness": "1", "drag": "1"},
    rates=("v", "-stiffness*x - drag*v*abs(v)"), noise=("0", "sqrt(3)"), outputs={"y": "x"}, substeps=2,
)  # fmt: skip

#: Model, interpolation, coefficients.
CASES = {
    "held": (TWO_MASSES, "zero_order", [0.3, 0.1, 0.1, 0.3]),
    "linear": (TWO_MASSES, "linear", [0.3, 0.1, 0.1, 0.3]),
    "difference": (PUMPS, "zero_order", [0.3, 0.2, 0.4]),
    "none": (FREE, "zero_order", [0.3, 0.2]),
}
Q, R = 2e-3, 1e-3


def record(case, samples=30, seed=0):
    """Inputs (T, inputs) and outputs (T, sensors) with noise, from a state that is not at rest."""
    model, interpolation, coefficients = CASES[case]
    rng = np.random.default_rng(seed)
    u = rng.uniform(-0.4, 0.4, (samples, model.n_inputs))
    plant, z = Plant.of(model), rng.normal(0, 0.1, model.n_states)
    y = np.empty((samples, model.n_outputs))
    for t in range(samples):
        inputs = acting(plant, u, t, interpolation)
        z = moved(plant, z, coefficients, inputs) + Q * np.array(plant.noise(z, coefficients)) * rng.standard_normal()
        y[t] = plant.show(z, coefficients, input_seen(plant, inputs))
    return u, y + R * rng.standard_normal(y.shape)


def rig_of(case, **options):
    """The rig whose t-th input acts over the sample that ends with the t-th output."""
    model, interpolation, _ = CASES[case]
    held = model.is_continuous and interpolation == "zero_order"
    inputs = {name: Channel("N") for name in model.inputs} or Channel()
    return Rig(0.01, interpolation, -1 if held else 0, inputs, **options)


def prior_of(case, scales=None):
    model, _, coefficients = CASES[case]
    mean = 1.05 * np.array(coefficients)
    cov = np.diag(0.2 * mean) ** 2
    scales = scales or Scales(0.01)
    return weak_prior(model, mean, cov, Q, R, state_std=[0.1] * model.n_states, scales=scales)


def one_of(model, y):
    """Outputs as a user of one sensor has them."""
    return y[:, 0] if model.n_outputs == 1 else y


# --- Against the references ----------------------------------------------------------------------------------------


@table("case", CASES)
def test_an_online_update_is_that_with_matrices(case):
    model, interpolation, _ = CASES[case]
    (u, y), prior, plant = record(case, 12), prior_of(case), Plant.of(model)
    estimator = OnlineEstimator(prior=prior, rig=rig_of(case))
    noises = prior.noises.reshape(-1, 2).tolist()
    belief = ReferenceBelief(prior.mean.copy(), prior.cov.copy(), tuple(noises[0]), [tuple(xi) for xi in noises[1:]])
    for t in range(len(u)):
        estimator.update(u[t] if model.inputs else None, y[t] if model.n_outputs > 1 else y[t, 0])
        found = update(plant, model.n_states, belief, acting(plant, u, t, interpolation), y[t], 3)
        belief = found.belief
        # The rounding of the samples so far, each of some hundred operations on terms that cancel by the condition.
        allowed = 200 * (t + 1) * EPS * found.condition
        scale = found.scale
        np.testing.assert_allclose((estimator.belief.mean - belief.mean) / scale, 0, atol=allowed)
        np.testing.assert_allclose((estimator.belief.cov - belief.cov) / np.outer(scale, scale), 0, atol=allowed)
        last = sum(energies[-1] for energies in found.free_energies)
        assert estimator.free_energy == pytest.approx(last, abs=allowed * (1 + abs(last)))


@table("case", CASES)
def test_likelihood_and_information_are_those_with_matrices(case):
    model, interpolation, coefficients = CASES[case]
    (u, y), n = record(case), model.n_states
    plant = Plant.of(model)
    inputs = [acting(plant, u, t, interpolation) for t in range(len(u))]
    noises, degree = noise_variances(model, Q, R), int(interpolation == "linear")
    points, cov = np.array([coefficients]), 0.1**2 * np.eye(n)
    for outputs in (y, None):
        expected = path(plant, np.zeros(n), cov, points[0], inputs, Q**2, [R**2] * model.n_outputs, outputs)
        rows = inputs_by_sample(model, u[None], degree)
        found = record_likelihoods(model, points, rows, None if outputs is None else y[None], noises, cov)
        # Some hundred operations a sample, whose rounding grows with the state's, in parts of the parameters' own.
        allowed = 300 * len(u) * EPS * expected.growth
        scale = np.sqrt(np.diag(expected.information))
        scale[scale == 0] = 1.0  # a mass at rest that nothing drives shows nothing, without outputs
        difference = (found.information[0] - expected.information) / np.outer(scale, scale)
        np.testing.assert_allclose(difference, 0, atol=allowed)
        np.testing.assert_allclose(found.loss[0], expected.loss, rtol=allowed, atol=allowed * len(u))
        given = None if outputs is None else one_of(model, y)
        information = fisher_information(
            model, coefficients, u, Q, R, y=given, interpolation=interpolation, state_std=0.1
        )
        np.testing.assert_array_equal(information, found.information[0])


@table("case", CASES)
def test_a_free_run_is_that_with_matrices(case):
    model, interpolation, coefficients = CASES[case]
    u, _ = record(case)
    plant, start = Plant.of(model), np.linspace(0.1, 0.2, model.n_states)
    z, expected = start, []
    for t in range(len(u)):
        inputs = acting(plant, u, t, interpolation)
        z = moved(plant, z, coefficients, inputs)
        expected.append(plant.show(z, coefficients, input_seen(plant, inputs))[0])
    found = free_run(model, coefficients, u, start, interpolation)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
    both = free_run(model, [coefficients] * 2, np.stack([u, 0 * u]), start, interpolation)
    np.testing.assert_array_equal(both[0], found)
    assert both.shape == (2, len(u))
    assert bool((both[0] == both[1]).all()) == (not model.inputs)
    last = plant.show(start, coefficients, u[0])[0]
    assert output_at(model, np.array(coefficients), start, u[0]) == pytest.approx(last, rel=1e-15)


@table("case", CASES)
def test_a_fit_is_where_the_slope_vanishes(case):
    """Of the likelihood with matrices and of the prior, by central differences."""
    model, interpolation, coefficients = CASES[case]
    u, y = record(case, 60)
    prior, plant = prior_of(case), Plant.of(model)
    fit = maximum_a_posteriori(model, u[None], one_of(model, y)[None], prior, Q, R, interpolation)
    assert fit.converged.all()
    inputs = [acting(plant, u, t, interpolation) for t in range(len(u))]
    std, precision = np.sqrt(np.diag(fit.cov[0])), np.linalg.inv(prior.coefficients_cov)

    def followed(at):
        return path(plant, np.zeros(model.n_states), prior.state_cov, at, inputs, Q**2, [R**2] * model.n_outputs, y)

    def loss(z):
        pull = fit.mean[0] + std * z - prior.coefficients_mean
        return followed(fit.mean[0] + std * z).loss + 0.5 * pull @ precision @ pull

    assert np.abs(central(loss, np.zeros(len(std)), 0.01)).max() < 1e-6
    found = followed(fit.mean[0])
    np.testing.assert_allclose(np.linalg.inv(fit.cov[0]), found.information + precision, rtol=1e-6, atol=1e-6)
    assert (np.abs(fit.mean[0] - coefficients) < 5 * np.sqrt(np.diag(fit.cov[0]))).all()


@table("case", CASES)
def test_many_records_have_the_posteriors_of_single_ones(case):
    model, _, _ = CASES[case]
    records = [record(case, 20, seed) for seed in range(3)]
    u, y = (np.stack([one[i] for one in records]) for i in (0, 1))
    prior, rig = prior_of(case), rig_of(case)
    found = posteriors(u, y, prior, rig)
    for i, belief in enumerate(found):
        estimator = OnlineEstimator(prior=prior, rig=rig)
        estimator.run(u[i], one_of(model, y[i]))
        np.testing.assert_allclose(belief.mean, estimator.belief.mean, rtol=1e-9, atol=1e-11)
    ended = u.copy() if model.inputs else y.copy()
    ended[0, 12:] = np.nan
    shorter = posteriors(*((ended, y) if model.inputs else (u, ended)), prior, rig)
    estimator = OnlineEstimator(prior=prior, rig=rig)
    estimator.run(u[0, :12], one_of(model, y[0, :12]))
    np.testing.assert_allclose(shorter[0].mean, estimator.belief.mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(shorter[1].record, found[1].record)


# --- Interpolation, delays, scales ----------------------------------------------------------------------------------


@table(
    ("interpolation", "delay"), [("linear", 2), ("zero_order", 1), ("look_ahead", 0), ("look_ahead", 1), ("spline", 1)]
)
def test_every_input_is_interpolated_as_one_alone(interpolation, delay):
    """Where the second input is 0, or the model's only other, the belief is that of a model with the first alone."""
    u, y = record("held", 40)
    rig = Rig(0.01, interpolation, delay, {"f1": Channel(), "f2": Channel()})
    moments = prior_of("held").coefficients_mean, prior_of("held").coefficients_cov
    for channel, (kept, removed) in enumerate((("f1", "f2"), ("f2", "f1"))):
        rates = tuple(text.replace(removed, "0*x1") for text in TWO_MASSES.rates)
        model = replace(TWO_MASSES, name=f"{kept}_alone", inputs={kept: "N"}, rates=rates)
        alone, both = (
            OnlineEstimator(prior=weak_prior(one, *moments, Q, R, scales=Scales(0.01)), rig=on)
            for one, on in ((model, replace(rig, input=Channel())), (TWO_MASSES, rig))
        )
        driven = np.zeros_like(u)
        driven[:, channel] = u[:, channel]
        np.testing.assert_allclose(both.run(driven, y), alone.run(u[:, channel], y), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(both.belief.mean, alone.belief.mean, rtol=1e-9, atol=1e-12)


def test_a_spline_goes_through_each_input():
    u = np.random.default_rng(3).standard_normal((30, 2))
    way = input_stencil(TWO_MASSES, Rig(0.01, "spline", 0, {"f1": Channel(), "f2": Channel()}))
    pieces = way.spline_coefficients(u)
    assert (pieces.shape, way.stride, way.stencil.shape) == ((30, 2, 6), 12, (12, 12))
    for channel in range(2):
        spline = make_interp_spline(np.arange(30), u[:, channel], k=5)
        at = sum(pieces[5, channel, k] * 0.4**k for k in range(6))
        assert at == pytest.approx(float(spline(4.4)), abs=1e-10)


@table("interpolation", ["linear", "look_ahead"])
def test_samples_one_by_one_give_what_the_record_gives(interpolation):
    u, y = record("linear", 40)
    rig = Rig(0.01, interpolation, 1, {"f1": Channel(), "f2": Channel()})
    whole, single = (OnlineEstimator(prior=prior_of("linear"), rig=rig) for _ in range(2))
    whole.run(u, y)
    for t in range(len(u)):
        single.update(u[t], y[t])
    np.testing.assert_array_equal(single.belief.record, whole.belief.record)
    for name, array in whole.arrays().items():
        np.testing.assert_array_equal(single.arrays()[name], array)


def test_each_input_has_a_scale_and_a_unit():
    rig = Rig(
        0.01, "linear", 0, {"f1": Channel("N", limit=4.0), "f2": Channel("kN", limit=0.5)}, Channel("mm", range=2.0)
    )
    scales = rig.scales
    assert (scales.input, scales.more_inputs, scales.input_units(2)) == (4.0, (0.5,), ("N", "kN"))
    u, y = record("linear", 30)
    plain = OnlineEstimator(prior=prior_of("linear"), rig=rig_of("linear"))
    scaled = OnlineEstimator(prior=prior_of("linear", scales), rig=rig)
    energies = plain.run(u, y)
    np.testing.assert_array_equal(scaled.run(u * [4.0, 0.5], 2.0 * y), energies)
    np.testing.assert_array_equal(scaled.forecasts[..., 0], 2.0 * plain.forecasts[..., 0])
    np.testing.assert_array_equal(scaled.belief.record, plain.belief.record)
    for ability in ("predict", "forecast"):
        of_plain, of_scaled = getattr(plain, ability)(u, y), getattr(scaled, ability)(u * [4.0, 0.5], 2.0 * y)
        np.testing.assert_array_equal(of_scaled.T[0], 2.0 * of_plain.T[0])
    np.testing.assert_array_equal(scaled.simulate(u * [4.0, 0.5], 2 * y[:3]), 2 * plain.simulate(u, y[:3]))
    for wrong in (3, 1):
        with pytest.raises(ValueError, match=r"scales must be of . inputs, but are of 2; give more_inputs"):
            scales.input_scales(wrong)
    assert Scales(1.0, input=3.0).input_scales(2).tolist() == [3.0, 3.0]
    assert Scales(1.0, input=3.0).input_scales(0).tolist() == []


def test_stated_units_have_a_size_for_each_input():
    """A force in newtons and a voltage, each with its own size; parameters come back in their units."""
    motor = Model(
        name="two_drives", time="s", inputs={"force": "N", "volts": "V"}, states={"x": "m", "v": "m/s"},
        coefficients={"m": "kg", "k": "N/m", "constant": "N/V"}, rates=("v", "(force + constant*volts - k*x)/m"),
        outputs={"y": "x"}, noise=("0", "1/m"), substeps=4,
    )  # fmt: skip
    inputs = {"force": Channel("N", limit=5.0), "volts": Channel("V", limit=0.01)}
    rig = Rig(1e-3, "zero_order", -1, inputs, Channel("m", range=1e-3))
    truth = {"m": 0.1, "k": 4e3, "constant": 300.0}
    prior = prior_in_units(
        motor, rig, {"m": 0.12, "k": 5e3, "constant": 200.0}, {"m": 0.03, "k": 1e3, "constant": 100.0},
        process_noise=1e-4, measurement_noise=1e-6,
    )  # fmt: skip
    assert "5.0 * force" in prior.model.rates[1]
    assert "0.01 * volts" in prior.model.rates[1]
    rng, plant = np.random.default_rng(5), Plant.of(replace(motor, time="sample"))
    u = rng.choice([-1.0, 1.0], (400, 2)) * [5.0, 0.01]
    z, y = np.zeros(2), np.empty(400)
    coefficients = [truth[name] for name in motor.coefficients]
    for t in range(400):
        for _ in range(4):  # a quarter of a sample, by the method of order 4
            h = 0.25e-3
            slope = lambda z, t=t: np.array(plant.move(z, coefficients, u[t]))  # noqa: E731
            k1 = slope(z)
            k2 = slope(z + h / 2 * k1)
            k3 = slope(z + h / 2 * k2)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(z + h * k3))
        y[t] = z[0]
    estimator = OnlineEstimator(prior=prior, rig=rig, expectations="sigma_points")
    estimator.run(u, y + 1e-6 * rng.standard_normal(400))
    for name, (mean, std, unit) in estimator.belief.parameters().items():
        assert abs(mean - truth[name]) < 5 * std
        assert std < 0.02 * truth[name]
        assert unit == motor.coefficients[name]


@table("case", CASES)
def test_a_saved_estimator_goes_on_bit_by_bit(case, tmp_path):
    model, _, _ = CASES[case]
    u, y = record(case, 30)
    seen = one_of(model, y)
    rig = replace(rig_of(case), interpolation="look_ahead", delay=0) if case == "linear" else rig_of(case)
    estimator = OnlineEstimator(prior=prior_of(case), rig=rig)
    estimator.run(u[:15], seen[:15])
    save_estimator(estimator, tmp_path / "e.npz")
    loaded = load_estimator(tmp_path / "e.npz")
    assert (loaded.rig, loaded.scales, loaded.model) == (estimator.rig, estimator.scales, estimator.model)
    np.testing.assert_array_equal(loaded.run(u[15:], seen[15:]), estimator.run(u[15:], seen[15:]))
    for name, array in estimator.arrays().items():
        np.testing.assert_array_equal(loaded.arrays()[name], array)
    estimator.rewind()
    assert not estimator.arrays()["inputs"].any()


def test_a_record_without_inputs_needs_no_array():
    u, y = record("none", 20)
    estimators = [OnlineEstimator(prior=prior_of("none"), rig=rig_of("none")) for _ in range(4)]
    estimators[0].run(u, y[:, 0])
    estimators[1].run(None, y[:, 0])
    for value in y[:, 0]:
        estimators[2].update(None, value)
        estimators[3].update([], value)
    for one in estimators[1:]:
        np.testing.assert_array_equal(one.belief.record, estimators[0].belief.record)
    default = OnlineEstimator(prior=prior_of("none"))
    default.run(None, y[:, 0])
    np.testing.assert_array_equal(default.belief.record, estimators[0].belief.record)
    for interpolation in ("look_ahead", "spline", "linear"):  # no sample waits for an input
        rig = Rig(0.01, interpolation)
        other = OnlineEstimator(prior=prior_of("none"), rig=rig)
        other.run(None, y[:, 0])
        np.testing.assert_array_equal(other.belief.record, estimators[0].belief.record)
    hypotheses = OnlineEstimator(prior=prior_of("none"), noise_hypotheses=(3, 3))
    hypotheses.run(None, y[:, 0])
    assert np.isfinite(hypotheses.belief.mean).all()


def test_noise_hypotheses_take_several_inputs():
    """The mixture agrees with the estimator that has the right noises."""
    u, y = record("difference", 60)
    for expectations in ("first_order", "sigma_points"):
        many = OnlineEstimator(prior=prior_of("difference"), rig=rig_of("difference"), noise_hypotheses=3,
                               expectations=expectations)  # fmt: skip
        one = OnlineEstimator(prior=prior_of("difference"), rig=rig_of("difference"), expectations=expectations)
        many.run(u, y[:, 0])
        one.run(u, y[:, 0])
        stds = np.sqrt(np.diag(one.belief.coefficients_cov))
        assert (np.abs(many.belief.coefficients_mean - one.belief.coefficients_mean) < 3 * stds).all()


# --- Refusals ------------------------------------------------------------------------------------------------------


def test_shapes_and_channels_that_do_not_fit_are_refused():
    u, y = record("linear", 20)
    estimator = OnlineEstimator(prior=prior_of("linear"), rig=rig_of("linear"))
    before = estimator.arrays()
    cases = [(lambda wrong=wrong: estimator.run(wrong, y), "u must") for wrong in (u[:, 0], u[:, :1], None, u.T)]
    for wrong in (0.1, [0.1], None, [0.1, 0.2, 0.3]):
        cases.append((lambda wrong=wrong: estimator.update(wrong, y[0]), "u must"))
    assert_refused([*cases, (lambda: estimator.update([0.1, np.nan], y[0]), "u must be finite")])
    for name, array in estimator.arrays().items():
        np.testing.assert_array_equal(array, before[name])

    def on(case, rig):
        return lambda: OnlineEstimator(prior=prior_of(case), rig=rig)

    turned = Rig(0.01, "linear", 0, {"f2": Channel(), "f1": Channel()})
    assert_refused(
        [
            (lambda: free_run(TWO_MASSES, [0.3, 0.1, 0.1, 0.3], u[:, 0]), "u must have shape (T, 2) or (n, T, 2)"),
            (on("linear", Rig(0.01, "linear")), "rig.input must have a channel for each input of 'two_masses'"),
            (on("linear", Rig(0.01, "linear")), "input={'f1': Channel(...), 'f2': Channel(...)}"),
            (on("linear", turned), "in its order ['f1', 'f2'], but has ['f2', 'f1']"),
            (on("none", rig_of("linear")), "but has ['f1', 'f2']"),
            (lambda: OnlineEstimator(prior=prior_of("linear")).run(1e200 * u, y), "(u = ["),
        ]
    )
