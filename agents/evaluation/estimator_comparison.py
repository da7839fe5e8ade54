"""Other estimators on the inputs and outputs of a policy: errors and calibration, also of an offline fit."""

from __future__ import annotations

import numpy as np

from agents.evaluation import metrics
from agents.evaluation.plant_model import plant_model_of
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.storage.kernel_spec import parameter_names
from estimator.belief import Belief
from estimator.inference.batch_posteriors import posteriors
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.models.difference_equation import difference
from estimator.models.named_parameters import Parameters
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray

#: Name of the offline maximum a posteriori fit.
AUDITOR = "auditor"

#: Factorisations of the posterior of the difference equation, each an estimator.
FACTORISATIONS = ("structured", "mean_field")


def estimate_with_other_estimators(
    inputs: FloatArray, outputs: FloatArray, truth: Parameters, experiment: SimulatedExperiment
) -> dict[str, dict[str, FloatArray]]:
    """Metrics of every estimator of the plant, and of the auditor, on the inputs and outputs of a policy.

    The auditor fits the plant's own equation, starting from the prior's mean and from the results of the estimators of
    this equation: with a wide guess, the prior's mean alone may lead to a distant local minimum. On a plant whose input
    is linear between samples, the paper's equation takes the input at the sample before, as an environment does.

    Args:
        inputs: (T, n).
        outputs: (T, n) or (T, n, sensors).
        truth: true parameters (n,).
        experiment: of the environments.

    Returns:
        Name of the estimator to `agents.evaluation.metrics.posterior_metrics`.
    """
    u, y = inputs.T, np.swapaxes(outputs, 0, 1)
    plant, interpolation, own_prior, process_noise, sensor_noises = plant_model_of(experiment, truth)
    rig = Rig(experiment.step, interpolation=interpolation, delay=0 if interpolation == "linear" else -1)
    estimators: dict[str, tuple[Belief, FloatArray]] = {}
    if plant == difference():
        estimators = {name: (experiment.prior_for_model(plant, name), u) for name in FACTORISATIONS}
    else:
        name = "ode" if plant.is_continuous else "structured"
        # The environment's own estimator, without its noise hypotheses.
        estimators[f"{name}_alone" if experiment.noise_hypotheses != 1 else name] = own_prior, u
        if set(parameter_names(plant)) == set(parameter_names(difference())):
            previous_inputs = (
                u if not experiment.degree else np.where(np.isnan(u), np.nan, np.pad(u, ((0, 0), (1, 0)))[:, :-1])
            )
            estimators |= {
                f"nlarx_{name}": (experiment.prior_for_model(difference(), name), previous_inputs)
                for name in FACTORISATIONS
            }
    estimator_metrics: dict[str, dict[str, FloatArray]] = {}
    starts: list[FloatArray] = []
    for name, (prior, applied) in estimators.items():
        beliefs = posteriors(applied, y, prior, rig if prior.model.is_continuous else None)
        means, covs = (np.array([getattr(b, f"coefficients_{part}") for b in beliefs]) for part in ("mean", "cov"))
        estimator_metrics[name] = metrics.posterior_metrics(means, covs, truth, prior.model, prior.scales)
        starts += [means] if prior.model == plant else []
    fit = maximum_a_posteriori(plant, u, y, own_prior, process_noise, sensor_noises, interpolation, starts)
    estimator_metrics[AUDITOR] = metrics.posterior_metrics(fit.mean, fit.cov, truth, plant, experiment.scales)
    return estimator_metrics
