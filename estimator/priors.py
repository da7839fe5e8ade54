"""Priors of a model's coefficients, states and noises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief, couple_initial_states
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.expression import older_input
from estimator.models.model import Model
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.silverbox_constants import SILVERBOX_ODE_TWIN, SILVERBOX_TWIN
from estimator.rigs.units import VOLT_SCALES, Scales
from estimator.support.argument_checks import (
    check_bool,
    check_mapping,
    check_number,
    is_finite_number,
    short_repr,
    to_float_array,
)
from estimator.support.array_types import FloatArray

#: Upper limit of the quadrature nodes along each parameter. With 20 along each of four parameters, the moments converge
#: to 1e-10 for every spread up to 0.999.
_MAX_NODES_PER_AXIS = 20

#: Upper limit of the quadrature nodes in all.
_MAX_NODES = 160_000

#: Smallest and largest standard deviation, in the unit of the quantity: the squares are rates of precisions.
_STD_RANGE = 1e-60, 1e60


def log_uniform_moments(
    model: Model, center: Mapping[str, float], spread: float, scales: Scales = VOLT_SCALES
) -> tuple[FloatArray, FloatArray]:
    """Moments of the coefficients of a plant with log-uniform parameters.

    The physical parameters (the coefficients, where the model has none) are independent, each log-uniform on
    [center (1 - spread), center (1 + spread)]. The integral is a tensor Gauss-Legendre quadrature over the logarithms.

    Args:
        model: the model.
        center: parameter to its middle; of any sign, but not 0.
        spread: relative half-width of the intervals, in [0, 1).
        scales: units of the parameters.

    Returns:
        Mean (K,) and covariance (K, K).

    Raises:
        ValueError: for a spread out of range, or a center that is 0, missing or not finite.
    """
    names = list(Model.require_model(model).physical or model.coefficients)
    check_mapping("center", center)
    check_number("spread", spread, 0, 1 - 1e-9, "log-uniform intervals do not reach 0")
    for name in names:
        if name not in center or not is_finite_number(center[name]) or center[name] == 0:
            raise ValueError(f"center must have a finite {name} other than 0, but is {short_repr(center)}")
    mean, cov = _log_uniform_moments(model, tuple(float(center[name]) for name in names), float(spread), scales)
    return mean.copy(), cov.copy()


@lru_cache(maxsize=256)  # every environment and evaluation takes the same
def _log_uniform_moments(
    model: Model, center: tuple[float, ...], spread: float, scales: Scales
) -> tuple[FloatArray, FloatArray]:
    """The integral of `log_uniform_moments`, with the parameters in the model's order."""
    names = list(model.physical or model.coefficients)
    nodes_per_axis = max(2, min(_MAX_NODES_PER_AXIS, int(_MAX_NODES ** (1 / len(names)) + 1e-9)))
    nodes, weights = np.polynomial.legendre.leggauss(nodes_per_axis)
    # log(1 ± spread) = log(1 - spread²) / 2 ± artanh(spread)
    factors = np.sqrt(1 - spread**2) * np.exp(np.arctanh(spread) * nodes)
    # The weights sum to 2, the length of [-1, 1].
    axes = {name: (axis_center * factors, weights / 2) for name, axis_center in zip(names, center, strict=True)}
    return quadrature_moments(model, axes, scales)


def gaussian_moments(
    model: Model, mean: Mapping[str, float], std: Mapping[str, float], scales: Scales = VOLT_SCALES
) -> tuple[FloatArray, FloatArray]:
    """Moments of the coefficients of a plant with independent Gaussian parameters.

    The integral is a tensor Gauss-Hermite quadrature, which is exact for coefficients linear in the parameters.

    Args:
        model: the model.
        mean: parameter to its mean.
        std: parameter to its standard deviation; 0 for a known one.
        scales: units of the parameters.

    Returns:
        Mean (K,) and covariance (K, K).
    """
    names = list(Model.require_model(model).physical or model.coefficients)
    for name, given in (("mean", mean), ("std", std)):
        check_mapping(name, given)
        for parameter in names if name == "mean" else given:
            check_number(
                f"{name} of {parameter}", given.get(parameter), 0 if name == "std" else -_STD_RANGE[1], _STD_RANGE[1]
            )
    nodes = max(2, min(7, int(_MAX_NODES ** (1 / len(names)))))
    return quadrature_moments(
        model, {name: gauss_hermite(mean[name], std.get(name, 0.0), nodes) for name in names}, scales
    )


def gauss_hermite(mean: float, std: float, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights (nodes,) of the quadrature over a Gaussian."""
    points, weights = np.polynomial.hermite_e.hermegauss(nodes)
    return mean + std * points, weights / weights.sum()


def quadrature_moments(
    model: Model, axes: Mapping[str, tuple[FloatArray, FloatArray]], scales: Scales
) -> tuple[FloatArray, FloatArray]:
    """Mean (K,) and covariance (K, K) of the coefficients of a plant with independent parameters.

    The sums avoid BLAS, whose last digits depend on its number of threads.

    Args:
        model: the model.
        axes: parameter to the nodes and weights of a quadrature along it.
        scales: units of the parameters.
    """
    grid = np.meshgrid(*(points for points, _ in axes.values()), indexing="ij")
    probabilities = np.ones(1)
    for _, weights in axes.values():
        probabilities = np.outer(probabilities, weights).ravel()
    points = coefficients_of(model, dict(zip(axes, map(np.ravel, grid), strict=True)), scales)
    mean = np.array([(probabilities * column).sum() for column in points.T])
    deviations = points - mean
    cov = np.array([[(probabilities * (one * other)).sum() for one in deviations.T] for other in deviations.T])
    return mean, cov


def weak_prior(
    model: Model,
    mean: npt.ArrayLike,
    cov: npt.ArrayLike,
    process_noise: float = 5e-4,
    measurement_noise: float | Sequence[float] = 5e-4,
    noise_shape: float = 2.0,
    state_std: float | Sequence[float] = 1e-3,
    scales: Scales = VOLT_SCALES,
) -> Belief:
    """A prior of given coefficient moments, with weak Gamma priors of the noises and the plant near rest.

    Args:
        model: the model.
        mean: (K,) means of the coefficients.
        cov: (K, K) their covariance.
        process_noise: standard deviation at which γ is centred, of the first sensor's output by one sample's process
            noise.
        measurement_noise: standard deviation at which ξ is centred: one number, or one for each sensor.
        noise_shape: shape of the Gamma priors: 2 is the information of four observed noises. Noises are never observed
            alone, so that even such a prior binds for thousands of samples (docs/evidence/coverage.md): centre it with
            care.
        state_std: standard deviation of the states about 0: one number, or one for each. States of
            `Model.initial_states` have the moments of their coefficients.
        scales: units of the parameters.

    Raises:
        ValueError: for a value out of its range, or as for `Belief`.
    """
    Model.require_model(model)
    check_number("process_noise", process_noise, *_STD_RANGE)
    check_number("noise_shape", noise_shape, *_STD_RANGE)
    n, k = model.n_states, model.n_coefficients
    for name, value, size in (("measurement_noise", measurement_noise, model.n_outputs), ("state_std", state_std, n)):
        for one in np.ravel(np.asarray(value, dtype=object)):
            check_number(name, one, *_STD_RANGE)
        if np.shape(value) not in ((), (size,)):
            raise ValueError(f"{name} must be one number or {size}, but has shape {np.shape(value)}")
    joint_mean, joint = np.zeros(n + k), np.zeros((n + k, n + k))
    given = to_float_array("mean", mean), to_float_array("cov", cov)
    if given[0].shape != (k,) or given[1].shape != (k, k):
        raise ValueError(f"mean and cov must have shapes {(k,)} and {(k, k)}, but have {[one.shape for one in given]}")
    joint_mean[n:], joint[n:, n:] = given
    joint[:n, :n] = np.diag(np.broadcast_to(np.asarray(state_std, dtype=np.float64) ** 2, n))
    couple_initial_states(model, joint_mean, joint)
    sensors = np.broadcast_to(np.asarray(measurement_noise, dtype=np.float64), model.n_outputs)
    xi = [(noise_shape, noise_shape * float(std) ** 2) for std in sensors]
    return Belief.of(model, joint_mean, joint, (noise_shape, noise_shape * process_noise**2), xi, scales=scales)


#: Equation to the Silverbox circuit's m, c, a and b (``python -m duffing_env.plants.silverbox_twin`` identifies them).
_SILVERBOX_TWINS = {"difference": SILVERBOX_TWIN, "duffing": SILVERBOX_ODE_TWIN}


def silverbox_prior(
    model: Model | None = None,
    spread: float = 0.3,
    process_noise: float = 5e-4,
    measurement_noise: float = 5e-4,
    noise_shape: float = 2.0,
    state_std: float = 1e-3,
) -> Belief:
    """The prior of the environments: an oscillator near the Silverbox circuit, at rest.

    Args:
        model: with the parameters m, c, a, and b unless it is linear; by default `difference`, the paper's.
        spread: m, c, a and b are log-uniform on [1 - spread, 1 + spread] times the twin's values; in (0, 1).
        process_noise: standard deviation [V] at which γ is centred, of the output by one sample's process noise.
        measurement_noise: standard deviation [V] at which ξ is centred.
        noise_shape: see `weak_prior`.
        state_std: standard deviation of the states about rest [V].

    Raises:
        ValueError: for a model with other parameters, or a value out of its range.
    """
    model = difference() if model is None else Model.require_model(model)
    if model.name not in _SILVERBOX_TWINS or not {"m", "c", "a"} <= set(model.physical) <= {"m", "c", "a", "b"}:
        raise ValueError(f"model must have the parameters m, c, a and b, but {model.name} has {list(model.physical)}")
    check_number("spread", spread, 1e-9, 1 - 1e-9, "pass the range's relative half width")
    moments = log_uniform_moments(model, _SILVERBOX_TWINS[model.name], spread)
    return weak_prior(model, *moments, process_noise, measurement_noise, noise_shape, state_std)


def published_run_prior(nonlinear: bool = True, model: Model | None = None) -> Belief:
    """The prior of the paper's published numbers, which differs from the paper's text.

    Args:
        nonlinear: False fixes θ2 at 0: the paper's FEM-LARX.
        model: `difference("linear")`, which has no θ2; by default the paper's model.
    """
    return _paper_prior(nonlinear, model, (2.0, 1e-2), (1e8, 1e3), (1e8, 1e1))


def paper_text_prior(nonlinear: bool = True, model: Model | None = None) -> Belief:
    """The prior of the paper's section 4, with the state's prior from the published run.

    Arguments as for `published_run_prior`.
    """
    return _paper_prior(nonlinear, model, (1.0, 10.0), (1e3, 1e1), (1e8, 1e3))


def _paper_prior(
    nonlinear: bool, model: Model | None, eta: tuple[float, float], gamma: tuple[float, float], xi: tuple[float, float]
) -> Belief:
    """Means of 1 (0 for the states) and variances of 10, except for η."""
    model = difference() if model is None else Model.require_model(model)
    check_bool("nonlinear", nonlinear)
    mean, variance = np.ones(len(model.names)), np.full(len(model.names), 10.0)
    mean[: model.n_states], (mean[-1], variance[-1]) = 0.0, eta
    if not nonlinear:
        place = model.names.index("theta2")
        mean[place] = variance[place] = 0.0
    return Belief.of(model, mean, np.diag(variance), gamma, xi)


def recorded_prior(
    model: Model,
    spread: float = 0.3,
    process_noise: float = 5e-6,
    measurement_noise: float = 1e-3,
    noise_shape: float = 2.0,
) -> Belief:
    """A weak prior about the Silverbox twin, for records that begin in motion: states have a deviation of 0.1 V.

    Args:
        model: `estimator.models.duffing.duffing` with any terms, or `estimator.models.difference_equation.difference`.
        spread: for `duffing`, relative standard deviation of stiffness, cubic, damping and gain; offsets have mean 0
            and standard deviation 20 mV, feedthrough and cubic damping (per sample) 0 and 0.1. For a difference
            equation, standard deviation of the coefficients of lags and inputs, centred on Eq. (2) or 0; products have
            1 + spread about 0, an offset a tenth of spread in volts.
        process_noise: see `silverbox_prior`.
        measurement_noise: see `silverbox_prior`.
        noise_shape: see `weak_prior`.

    Raises:
        ValueError: for another model, or a value out of its range.
    """
    check_number("spread", spread, 0)
    if Model.require_model(model).name not in _SILVERBOX_TWINS:
        raise ValueError(f"model must be a duffing or difference equation, but is {model.name}; use weak_prior")
    moments = _recorded_duffing(model, spread) if model.name == "duffing" else _recorded_difference(model, spread)
    prior = weak_prior(model, *moments, process_noise, measurement_noise, noise_shape, 0.1)
    if "output_offset" not in model.coefficients:
        return prior
    mean, cov = prior.mean, prior.cov
    add_output_offset(model, mean, cov)
    return Belief.of(model, mean, cov, tuple(prior.noises[:2]), tuple(prior.noises[2:]))


def add_output_offset(model: Model, mean: FloatArray, cov: FloatArray) -> None:
    """Add the output offset to the first state, in moments (d,) and (d, d), in place."""
    place = model.names.index("output_offset")
    mean[0] += mean[place]
    cov[0, :] += cov[place, :]
    cov[:, 0] += cov[:, place]


def _recorded_duffing(model: Model, spread: float) -> tuple[FloatArray, FloatArray]:
    twin = coefficients_of(duffing(), SILVERBOX_TWIN)
    main = dict(zip(duffing().coefficients, twin, strict=True))
    mean = np.array([main.get(name, 0.0) for name in model.coefficients])
    others = {"force": 0.0, "output_offset": 0.02, "cubic_damping": 0.1, "feedthrough": 0.1}
    cov = np.diag([(spread * main[name] if name in main else others[name]) ** 2 for name in model.coefficients])
    if "force" in model.coefficients:  # force = stiffness y0 - gain u0, with independent u0 and y0
        force, offset = (list(model.coefficients).index(name) for name in ("force", "output_offset"))
        cov[force, force] = (0.02 * main["stiffness"]) ** 2 + (0.02 * main["gain"]) ** 2
        cov[force, offset] = cov[offset, force] = main["stiffness"] * 0.02**2
    return mean, cov


def _recorded_difference(model: Model, spread: float) -> tuple[FloatArray, FloatArray]:
    twin = coefficients_of(difference(), SILVERBOX_TWIN)
    centers = dict(zip(("x1", "x1**3", "x2"), twin[:3], strict=True))
    centers[older_input("u", min(model.taps["u"] - 1, 1))] = twin[3]
    terms = [part.split("*", 1)[1] for part in model.next_state[0].split(" + ")]
    stds = {"V": 0.1 * spread, "1": spread}
    std = [stds.get(unit, 1 + spread) for unit in model.coefficients.values()]
    return np.array([centers.get(term, 0.0) for term in terms]), np.diag(np.square(std))
