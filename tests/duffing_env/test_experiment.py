"""What an experiment may be, and what the kernel is told of it."""

import dataclasses
import json

import numpy as np
import pytest

from duffing_env.experiment import ContinuousExperiment, SimulatedExperiment, make_experiment
from duffing_env.layout import SETTINGS
from duffing_env.replay import ReplayExperiment
from estimator import CONTINUOUS_TWIN, SAMPLING_STEP, SILVERBOX_TWIN, Belief, ContinuousBelief, Prior, continuous_prior

BAD = [
    ("factorisation", ["meanfield", None, [], 1]),
    ("iterations", [0, -1, 2.5, True, "3"]),
    ("reward", ["information", None, []]),
    ("max_input", [0, -0.1, np.inf, np.nan, "0.1", None, True]),
    ("max_output", [0, -0.1, np.inf, np.nan, "0.1", None, True]),
    ("horizon", [0, -5, 10.0, True, None, "10"]),
    ("process_noise", [0, -1e-4, np.inf, np.nan, None]),
    ("measurement_noise", [0, -1e-4, np.inf, np.nan, None]),
    ("spread", [0, -0.1, 1, 1.5, np.nan, None]),
    ("noise_shape", [0, -2, np.inf, np.nan]),
    ("plant_spread", [-0.1, 1, np.nan, "0.1", False]),
    ("hold", [0, -1, 2.0, True, None, "2"]),
    ("terminal", [0, 1, None, "yes"]),
    ("terminated_return", [np.nan, np.inf, "-10", True]),
]
BAD_REPLAY = [
    ("regime", ["sine", None, []]),
    ("prior", ["uniform", None, "to_record"]),
    ("input_delay", [2, -1, None]),
    ("nonlinear", ["no", 1, None]),
    ("as_published", ["yes", 0, True]),
    ("hold", [2, 0, None]),
    ("max_input", [0, 0.12]),
]


def told(experiment):
    return dict(zip(SETTINGS, experiment.settings, strict=True))


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in BAD for value in values])
def test_bad_values_are_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be .*but is"):
        SimulatedExperiment(**{name: value})


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in BAD_REPLAY for value in values])
@pytest.mark.usefixtures("record")
def test_bad_values_of_a_replay_are_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} (must|goes)"):
        ReplayExperiment(**{name: value})


def test_unknown_options_name_the_nearest():
    with pytest.raises(ValueError, match=r"horizn=3 is no option .*; did you mean 'horizon'"):
        make_experiment(SimulatedExperiment, {"horizn": 3})
    with pytest.raises(ValueError, match=r"xyz=1 is no option .*, which has \['factorisation', .*\]$"):
        make_experiment(SimulatedExperiment, {"xyz": 1})
    assert make_experiment(SimulatedExperiment, {"horizon": 3}) == SimulatedExperiment(horizon=3)


def test_options_are_json_and_frozen():
    experiment = SimulatedExperiment(iterations=4, plant_spread=0.0)
    options = json.loads(json.dumps(dataclasses.asdict(experiment)))
    assert SimulatedExperiment(**options) == experiment
    with pytest.raises(dataclasses.FrozenInstanceError):
        experiment.horizon = 3


def test_settings_are_the_options():
    experiment = SimulatedExperiment(
        factorisation="mean_field", iterations=4, reward="free_energy", max_input=0.1, max_output=0.5, horizon=9,
        process_noise=1e-3, measurement_noise=2e-3, spread=0.2, noise_shape=3.0, plant_spread=0.1,
    )  # fmt: skip
    settings = told(experiment)
    assert (experiment.plant_kind, experiment.estimator_kind) == ("difference", "mean_field")
    expected = {
        "iterations": 4, "reward": 3, "max_input": 0.1, "max_output": 0.5,
        "horizon": 9, "process_noise": 1e-3, "measurement_noise": 2e-3, "spread": 0.1, "nonlinear": 1,
        "delay": 0, "as_published": 0, "step": SAMPLING_STEP,
        "center_m": SILVERBOX_TWIN.m, "center_c": SILVERBOX_TWIN.c, "center_a": SILVERBOX_TWIN.a,
        "center_b": SILVERBOX_TWIN.b,
    }  # fmt: skip
    assert {name: settings[name] for name in expected} == expected
    np.testing.assert_allclose(settings["prior_log_gamma"], -2 * np.log(1e-3), rtol=1e-14)
    np.testing.assert_allclose(settings["prior_log_xi"], -2 * np.log(2e-3), rtol=1e-14)


def test_defaults_are_those_of_the_documentation():
    settings = told(SimulatedExperiment())
    assert SimulatedExperiment().estimator_kind == "structured"
    assert (settings["iterations"], settings["reward"]) == (3, 0)
    assert told(SimulatedExperiment(factorisation="mean_field"))["iterations"] == 10
    assert (settings["max_input"], settings["max_output"], settings["horizon"]) == (0.15, 0.6, 256)
    assert (settings["process_noise"], settings["measurement_noise"], settings["spread"]) == (5e-4, 5e-4, 0.3)


@pytest.mark.parametrize("factorisation", ["structured", "mean_field"])
def test_the_first_belief_is_the_prior(factorisation):
    experiment = SimulatedExperiment(factorisation=factorisation, spread=0.2, process_noise=1e-3, noise_shape=5.0)
    prior = Prior.silverbox_twin(0.2, 1e-3, 5e-4, 5.0)
    np.testing.assert_array_equal(experiment.prior_record, prior.to_record(factorisation=factorisation))
    settings = told(experiment)
    assert (settings["prior_t1"], settings["prior_e"]) == (prior.theta_mean[0], prior.eta_mean)
    np.testing.assert_allclose(settings["scale_t3"], prior.theta_cov[2, 2] ** -0.5, rtol=1e-14)


def test_a_continuous_experiment_is_told_of_its_estimator():
    options = {"spread": 0.2, "process_noise": 1e-3, "measurement_noise": 2e-3, "noise_shape": 5.0}
    ode = ContinuousExperiment(**options)
    settings = told(ode)
    assert (ode.plant_kind, ode.estimator_kind) == ("sde", "ode")
    assert (settings["center_m"], settings["center_b"]) == (CONTINUOUS_TWIN.m, CONTINUOUS_TWIN.b)
    prior = continuous_prior(CONTINUOUS_TWIN, 0.2, 1e-3, 2e-3, 5.0)
    assert ode.to_belief(ode.prior_record) == prior
    assert isinstance(ode.to_belief(ode.prior_record), ContinuousBelief)
    assert settings["prior_t2"] == prior.coefficients_mean[1]
    for factorisation in ("structured", "mean_field"):
        nlarx = ContinuousExperiment(estimator="nlarx", factorisation=factorisation, **options)
        assert (nlarx.plant_kind, nlarx.estimator_kind) == ("sde", factorisation)
        expected = Prior.silverbox_twin(0.2, 1e-3, 2e-3, 5.0, center=CONTINUOUS_TWIN)
        np.testing.assert_array_equal(nlarx.prior_record, expected.to_record(factorisation=factorisation))
        assert isinstance(nlarx.to_belief(nlarx.prior_record), Belief)


@pytest.mark.parametrize("value", ["ODE", None, [], 1])
def test_an_unknown_estimator_is_named(value):
    with pytest.raises(ValueError, match=r"^estimator must be one of \['ode', 'nlarx'\], but is"):
        ContinuousExperiment(estimator=value)


def test_mean_field_is_for_the_difference_equation():
    with pytest.raises(ValueError, match=r"^factorisation must be 'structured' for estimator='ode'"):
        ContinuousExperiment(factorisation="mean_field")


def test_a_replay_is_told_of_the_record(record):
    experiment = ReplayExperiment(input_delay=1, nonlinear=False, prior="published_run")
    settings = told(experiment)
    assert (experiment.plant_kind, settings["delay"]) == ("replay", 1)
    assert (settings["nonlinear"], settings["spread"]) == (0, 0)
    assert settings["scale_t2"] == 0.0
    assert settings["horizon"] == experiment.samples == len(record.multisine.u) - 1
    assert ReplayExperiment(input_delay=0, regime="arrow").samples == len(record.arrow.u)
    np.testing.assert_array_equal(experiment.recorded, (record.multisine.u, record.multisine.y))
    expected = Prior.published_run().to_record(nonlinear=False)
    np.testing.assert_array_equal(experiment.prior_record, expected)
    assert told(ReplayExperiment(factorisation="mean_field", as_published=True))["as_published"] == 1
