"""Profile likelihood of the noises: the most probable process noise and sensor noises of a record, and their ratios.

A grid of noise hypotheses (`estimator.inference.noise_grid`) has one factor for all sensors and one for all sources of
process noise: the ratios between several of a kind stay as in the prior. Here each noise is free. For given noises the
coefficients are the most probable ones (`estimator.inference.maximum_a_posteriori`), and for given coefficients the
logarithms of the noises maximise the Kalman filter's likelihood; the two are repeated in turn until neither changes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.engine.input_hold import input_degree
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.inference.record_arrays import inputs_by_channel, outputs_by_sensor
from estimator.inference.record_filter import inputs_by_sample, record_likelihoods
from estimator.models.noise_ratios import scale_noise_sources
from estimator.support.array_types import FloatArray

#: Fits of the coefficients, at most.
_MAX_ROUNDS = 20

#: Change of a log noise below which the search ends.
_LOG_TOLERANCE = 1e-3

#: Largest factor on a standard deviation, either way.
_MAX_FACTOR = 1e3

#: Largest change of a log noise in a round: the likelihood is flat where a noise is far too small.
_MAX_LOG_CHANGE = 1.0

#: Where the search by log noises stops: at this slope [nats]; not for a small change of a loss of thousands of nats.
_STOP = {"ftol": 0.0, "gtol": 1e-4}

#: Step of the finite differences by a log noise.
_LOG_STEP = 1e-4


def profile_noises(prior: Belief, u: npt.ArrayLike, y: npt.ArrayLike, interpolation: str = "zero_order") -> Belief:
    """A prior with its noises centred at the most probable ones of a record.

    Args:
        prior: belief in the coefficients and in the state about rest, with the noises to start from.
        u: (T,) inputs, or (T, inputs) of several or none; the t-th acts over the sample that ends with the t-th output.
        y: (T,) outputs, or (T, p) of p sensors; NaN where one is missing.
        interpolation: of the input between samples, as `maximum_a_posteriori` takes it.

    Returns:
        The prior with the same coefficients, states and shapes of the Gamma densities, and with other rates. Where its
        model has independent noise, the ratios of the sources are in the `noise` of the new belief's model. A noise
        that the record does not distinguish from 0 ends up to 1000 times below the start.

    Raises:
        ValueError: for arguments of another shape, or a record that no fit can follow.

    Example:
        >>> import numpy as np
        >>> from estimator import Model, profile_noises, weak_prior
        >>> words = {"states": {"x": "V"}, "coefficients": {"loss": "1"}, "outputs": {"fine": "x", "coarse": "x"}}
        >>> model = Model("leak", noise=("1",), next_state=("loss*x + u",), **words)
        >>> rng = np.random.default_rng(0)
        >>> u, x, y = rng.uniform(-1, 1, 500), 0.0, np.empty((500, 2))
        >>> for t in range(500):
        ...     x = 0.8 * x + u[t] + 0.01 * rng.standard_normal()
        ...     y[t] = x + np.array([0.02, 0.2]) * rng.standard_normal(2)
        >>> prior = weak_prior(model, [0.5], [[0.1]], 0.05, 0.05)  # both sensors alike
        >>> gamma, fine, coarse = profile_noises(prior, u, y).noises.reshape(3, 2)
        >>> bool(8 < np.sqrt(coarse[1] / coarse[0] / (fine[1] / fine[0])) < 12.5)
        True
    """
    from scipy.optimize import minimize

    model = prior.model
    inputs = inputs_by_channel(model, u)
    if inputs.ndim != 2:
        raise ValueError(f"u must be of one record, but has shape {np.shape(u)}; pass u[0]")
    outputs = np.array(outputs_by_sensor(model, inputs, y))
    samples = inputs_by_sample(model, inputs[None], input_degree(model, interpolation))
    ratio_states, n_sensors = list(model.noise_sources)[1:], model.n_outputs
    first_source = np.ones(min(len(model.noise_sources), 1))  # only ratios between the sources are free

    def loss_and_slopes(logs: FloatArray, coefficients: FloatArray) -> tuple[float, FloatArray]:
        steps = _LOG_STEP * np.eye(len(logs))
        variances = np.exp(2 * np.concatenate([logs[None], logs + steps, logs - steps]))
        noises = np.insert(variances, 1 + n_sensors, first_source[:, None], axis=1) if len(first_source) else variances
        count = len(noises)
        losses = record_likelihoods(
            model,
            np.tile(coefficients, (count, 1)),
            np.repeat(samples, count, axis=0),
            np.repeat(outputs[None], count, axis=0),
            noises,
            prior.state_cov,
        ).loss
        losses = np.where(np.isfinite(losses), losses, 1e300)
        up, down = losses[1:].reshape(2, -1)
        return float(losses[0]), (up - down) / (2 * _LOG_STEP)

    starts: list[FloatArray] = []
    logs = np.concatenate([0.5 * np.log(prior.noises[1::2] / prior.noises[::2]), np.zeros(len(ratio_states))])
    lowest, highest = logs - np.log(_MAX_FACTOR), logs + np.log(_MAX_FACTOR)
    for _ in range(_MAX_ROUNDS):
        process, sensors, ratios = np.split(np.exp(logs), [1, 1 + n_sensors])
        found = maximum_a_posteriori(
            model,
            inputs[None] if model.n_inputs != 1 else inputs[None, :, 0],
            outputs[None],
            prior,
            float(process[0]),
            sensors,
            interpolation,
            starts,
            dict(zip(ratio_states, ratios.tolist(), strict=True)),
        )
        if not np.isfinite(found.mean).all() or not np.isfinite(loss_and_slopes(logs, found.mean[0])[1]).all():
            raise ValueError(
                "u and y must be a record that the model can follow, but every fit diverged; check units, the sampling "
                "step and the prior"
            )
        low, high = np.maximum(logs - _MAX_LOG_CHANGE, lowest), np.minimum(logs + _MAX_LOG_CHANGE, highest)
        bounds = list(zip(low, high, strict=True))
        best = minimize(loss_and_slopes, logs, (found.mean[0],), "L-BFGS-B", jac=True, bounds=bounds, options=_STOP)
        change, logs, starts = float(np.abs(best.x - logs).max()), best.x, [found.mean]
        if change < _LOG_TOLERANCE:
            break
    return _with_noises(prior, np.exp(logs))


def _with_noises(prior: Belief, stds: FloatArray) -> Belief:
    """A prior with other noises: the process noise, each sensor's, and the ratio of each source but the first."""
    noises, ratios = np.split(stds, [1 + prior.model.n_outputs])
    factors = dict(zip(list(prior.model.noise_sources)[1:], ratios.tolist(), strict=True))
    model = scale_noise_sources(prior.model, factors) if factors else prior.model
    gammas = [(shape, shape * std**2) for shape, std in zip(prior.noises[::2].tolist(), noises.tolist(), strict=True)]
    return Belief.of(
        model,
        prior.mean,
        prior.cov,
        gammas[0],
        gammas[1:],
        scales=prior.scales,
        factorisation=prior.factorisation,
    )
