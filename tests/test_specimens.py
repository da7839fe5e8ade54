"""What holds for every specimen: the likelihood is that with matrices, and intervals cover as often as they say."""

import numpy as np
import pytest
from reference.likelihoods import assert_likelihood_is_that_with_matrices
from scipy.stats import norm
from specimens import SPECIMENS

from duffing_env.tracks.model_env import ModelExperiment, ModelVectorEnv
from estimator.rigs.physical_parameters import coefficients_of

#: Limits that hardly an episode reaches, in the output's unit.
WIDE = dict.fromkeys(SPECIMENS, 5.0) | {
    "paper": 10.0, "offsets": 10.0, "Wiener-Hammerstein": 20.0, "double pendulum": 3.0,
}  # fmt: skip
#: Torques in N m that move the double pendulum without ever turning it over.
TORQUES = {"t1": 4.0, "t2": 2.0}


@pytest.mark.parametrize("name", SPECIMENS)
def test_the_compiled_likelihood_is_that_with_matrices(name):
    experiment = ModelExperiment(**SPECIMENS[name])
    model = experiment.model
    coefficients = np.ravel(coefficients_of(model, SPECIMENS[name]["mean"], experiment.scales))
    assert_likelihood_is_that_with_matrices(model, coefficients, "zero_order")


@pytest.mark.slow
@pytest.mark.parametrize("name", SPECIMENS)
def test_intervals_cover_under_a_binary_signal_with_noises_unknown_within_a_factor_of_ten(name):
    systems, samples, hold = 300, 256, 4
    options = SPECIMENS[name] | {"horizon": samples, "max_output": WIDE[name]}
    if name == "double pendulum":
        options |= {"max_input": TORQUES}
    envs = ModelVectorEnv(systems, autoreset_mode="SameStep", **options)
    model, scales = envs.experiment.model, envs.experiment.scales
    envs.reset(seed=0)
    rng = np.random.default_rng(1)
    running, deviations = np.ones(systems, bool), []
    for sample in range(samples):
        if sample % hold == 0:
            actions = rng.choice([-1.0, 1.0], (systems, model.n_inputs)).astype(np.float32)
        _, _, terminated, truncated, infos = envs.step(actions)
        for row in np.flatnonzero(truncated & running):
            belief, truth = (infos["final_info"][key][row] for key in ("belief", "truth"))
            parameters = {parameter: truth[parameter] for parameter in model.physical or model.coefficients}
            error = belief.coefficients_mean - np.ravel(coefficients_of(model, parameters, scales))
            deviations.append(error / np.sqrt(np.diag(belief.coefficients_cov)))
        running &= ~(terminated | truncated)
    assert len(deviations) >= 240
    covered = np.mean(np.abs(deviations) < norm.ppf(0.95), axis=0)
    print(f"\n{name}: {len(deviations)} episodes, 90 % intervals cover {covered.mean():.3f}, each {covered.round(3)}")
    assert 0.86 <= covered.mean() <= 0.94
    assert ((covered >= 0.82) & (covered <= 0.97)).all()
