"""The options of an experiment, and the kernel's parameters from them."""

import dataclasses
import json
import re

import numpy as np
import pytest

from duffing_env.env_common import make_experiment
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.storage.kernel_spec import compile_unpacker, pack_params
from duffing_env.tracks.differential_equation_tracks import ContinuousExperiment
from duffing_env.tracks.silverbox_replay import ReplayExperiment
from estimator import SILVERBOX_ODE_TWIN, SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.priors import log_uniform_moments, published_run_prior, weak_prior

BAD = [
    ("factorisation", ["meanfield", None, [], 1]),
    ("iterations", [0, -1, 2.5, True, "3", 2**31]),
    ("reward", ["information", None, []]),
    ("max_input", [0, -0.1, np.inf, np.nan, "0.1", None, True, 1e301, 10**400]),
    ("max_output", [0, -0.1, np.inf, np.nan, "0.1", None, True, 1e-300, 10**4000]),
    ("horizon", [0, -5, 10.0, True, None, "10", 10**400]),
    ("process_noise", [0, -1e-4, np.inf, np.nan, None, 1e-200, 1e300]),
    ("measurement_noise", [0, -1e-4, np.inf, np.nan, None, 1e-300]),
    ("spread", [0, -0.1, 1, 1.5, np.nan, None, 1e-300]),
    ("noise_shape", [0, -2, np.inf, np.nan, 1e300]),
    ("noise_range", [0, 0.5, -10, np.inf, np.nan, None, True, "10", 1e300]),
    ("process_noise_guess", [0, -1e-4, np.inf, np.nan, True, "1e-4", 1e-300]),
    ("measurement_noise_guess", [0, -1e-4, np.inf, np.nan, True, "1e-4", 1e-300]),
    ("max_rms", [0, 1e-300, 1e300, "1"]),
    ("max_slew", [0, 1e-300, 1e300, "1"]),
    ("input_cost", [-1, 1e308, None]),
    ("drift", [-1, 1e300, None]),
    ("jump", [-1, 1, None]),
    ("plant_spread", [-0.1, 1, np.nan, "0.1", False]),
    ("hold", [0, -1, 2.0, True, None, "2"]),
    ("terminal", [0, 1, None, "yes"]),
    ("terminated_return", [np.nan, np.inf, "-10", True, 1e308]),
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


def prior_of(
    model, twin, spread=0.3, process_noise=5e-4, measurement_noise=5e-4, noise_shape=2.0, factorisation="structured"
):
    """The weak prior that fits oscillators about a twin."""
    moments = log_uniform_moments(model, {name: getattr(twin, name) for name in "mcab"}, spread)
    return weak_prior(model, *moments, process_noise, measurement_noise, noise_shape).with_factorisation(factorisation)


def assert_named(make, bad, pattern):
    """Every bad value is refused with a message that begins with its option's name; all others are reported."""
    wrong = []
    for name, values in bad:
        for value in values:
            try:
                make(**{name: value})
                wrong.append(f"{name}={value!r:.40} is taken")
            except ValueError as error:
                if not re.match(name + pattern, str(error)):
                    wrong.append(f"{name}={value!r:.40}: {error}")
    assert not wrong, "\n".join(wrong)


def test_bad_values_are_named():
    assert_named(SimulatedExperiment, BAD, " must be .*but is")
    with pytest.raises(ValueError, match=r"max_input must be a number from 1e-12 to 1e\+300, but is -1"):
        SimulatedExperiment(max_input=-1)


@pytest.mark.usefixtures("record")
def test_bad_values_of_a_replay_are_named():
    assert_named(ReplayExperiment, BAD_REPLAY, " (must|goes)")


def test_unknown_options_name_the_nearest():
    with pytest.raises(ValueError, match=r"unexpected keyword argument 'horizn': .*; did you mean 'horizon'"):
        make_experiment(SimulatedExperiment, {"horizn": 3})
    with pytest.raises(ValueError, match=r"'xyz': the options of this environment are \['factorisation', .*\]$"):
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
    kind, setup = experiment.kernel_spec, experiment.kernel_params
    assert (kind.belief_model, kind.plant_model, kind.factorisation) == (difference(), difference(), "mean_field")
    assert (kind.iterations, kind.reward_hooks) == (0, "free_energy")
    expected = {
        "iterations": 4, "has_drift": False, "jump": 0.0, "terminal": False, "has_terminated_return": False,
        "max_input": [0.1], "max_output": 0.5, "horizon": 9.0, "process_noise": 1e-3, "spread": 0.1, "hold": 1,
        "input_delay": 0, "as_published": False, "step": SILVERBOX_SAMPLING_STEP, "budget": np.inf,
        "max_slew": [np.inf],
    }  # fmt: skip
    assert {name: getattr(setup, name) for name in expected} == expected
    assert setup.measurement_noise.tolist() == [2e-3]
    assert setup.parameter_stds.tolist() == [0.0] * 4
    assert setup.reward_weights.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert setup.nominal_parameters.tolist() == [getattr(SILVERBOX_TWIN, name) for name in "mcab"]
    np.testing.assert_allclose(setup.prior_log_precisions, [-2 * np.log(1e-3), -2 * np.log(2e-3)], rtol=1e-14)


def test_kernel_params_survive_packing():
    experiment = SimulatedExperiment(max_rms=0.03, jump=0.2, drift=0.01, terminated_return=-3.0)
    setup = experiment.kernel_params._replace(hold=4)
    unpack = compile_unpacker(experiment.kernel_spec)
    again = unpack.py_func(pack_params(setup))
    assert again._fields == setup._fields
    for name, value in setup._asdict().items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert type(again.hold) is type(again.input_delay) is int
    assert type(again.terminal) is type(again.has_terminated_return) is type(again.as_published) is np.bool_


def test_defaults_are_those_of_the_documentation():
    experiment = SimulatedExperiment()
    kind, setup = experiment.kernel_spec, experiment.kernel_params
    assert (kind.factorisation, kind.iterations, kind.reward_hooks) == ("structured", 3, "")
    assert setup.reward_weights.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert SimulatedExperiment(factorisation="mean_field").kernel_params.iterations == 10
    assert (setup.max_input.tolist(), setup.max_output, setup.horizon) == ([0.15], 0.6, 256)
    assert (setup.process_noise, setup.measurement_noise.tolist(), setup.spread) == (5e-4, [5e-4], 0.3)


@pytest.mark.parametrize("factorisation", ["structured", "mean_field"])
def test_the_first_belief_is_the_prior(factorisation):
    options = {"spread": 0.2, "process_noise": 1e-3, "noise_shape": 5.0}
    experiment = SimulatedExperiment(factorisation=factorisation, **options)
    prior = prior_of(difference(), SILVERBOX_TWIN, **options, factorisation=factorisation)
    assert experiment.prior_belief == prior
    setup = experiment.kernel_params
    np.testing.assert_array_equal(setup.prior, prior.record)
    np.testing.assert_allclose(setup.prior_inverse_std, np.diag(prior.coefficients_cov) ** -0.5, rtol=1e-14)


def test_a_continuous_experiment_passes_its_estimator_to_the_kernel():
    options = {"spread": 0.2, "process_noise": 1e-3, "measurement_noise": 2e-3, "noise_shape": 5.0}
    ode = ContinuousExperiment(**options)
    assert (ode.kernel_spec.plant_model, ode.kernel_spec.belief_model, ode.kernel_spec.degree) == (
        duffing(),
        duffing(),
        0,
    )
    assert ode.kernel_params.nominal_parameters.tolist() == [getattr(SILVERBOX_ODE_TWIN, name) for name in "mcab"]
    assert ode.prior_belief == prior_of(duffing(), SILVERBOX_ODE_TWIN, **options)
    for factorisation in ("structured", "mean_field"):
        nlarx = ContinuousExperiment(estimator="nlarx", factorisation=factorisation, **options)
        assert (nlarx.kernel_spec.plant_model, nlarx.kernel_spec.belief_model) == (duffing(), difference())
        assert nlarx.kernel_spec.factorisation == factorisation
        # Oscillators are drawn about the continuous twin, and so is what the difference equation expects.
        assert nlarx.prior_belief == prior_of(difference(), SILVERBOX_ODE_TWIN, **options, factorisation=factorisation)


def test_an_unknown_estimator_is_named():
    assert_named(
        ContinuousExperiment, [("estimator", ["ODE", None, [], 1])], r" must be one of \['ode', 'nlarx'\], but is"
    )


def test_mean_field_is_for_the_difference_equation():
    with pytest.raises(ValueError, match=r"^factorisation must be 'structured' for estimator='ode'"):
        ContinuousExperiment(factorisation="mean_field")


def test_a_replay_passes_the_record_to_the_kernel(record):
    experiment = ReplayExperiment(input_delay=1, nonlinear=False, prior="published_run")
    kind, setup = experiment.kernel_spec, experiment.kernel_params
    assert (kind.plant_model, kind.belief_model) == (None, difference("linear"))
    assert (setup.input_delay, setup.spread) == (1, 0)
    assert setup.horizon == experiment.samples == len(record.multisine.u) - 1
    assert ReplayExperiment(input_delay=0, regime="arrow").samples == len(record.arrow.u)
    np.testing.assert_array_equal(experiment.replayed_record, (record.multisine.u, record.multisine.y))
    assert experiment.prior_belief == published_run_prior(model=difference("linear"))
    assert ReplayExperiment(factorisation="mean_field", as_published=True).kernel_params.as_published
