"""`PEMNARX`, the paper's offline baseline: a sigmoid NARX network fitted by prediction-error minimisation.

The network is MATLAB's ``idnlarx`` with a ``sigmoidnet`` of K units,

    f(r) = (r - r0)' L + d + sum_k a_k σ((r - r0)' b_k + c_k),    σ(s) = 1 / (1 + exp(-s)),

with the regressors r = (y_{t-1}, y_{t-2}, u_{t-delay}) and their mean r0. MATLAB's square projections P and Q only
rotate and scale the regressors, so they are part of L and b_k here.

The 4 + 5K parameters lie in one vector, in the order L (3), d, a (K), c (K), b (3K, a row per regressor).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from estimator.compilation.simd import kernel
from estimator.support.argument_checks import check_integer, to_finite_series
from estimator.support.array_types import FloatArray

#: Relative decrease of the cost at which a fit has converged [1]. A tolerance ten times smaller changes the training
#: error on the Silverbox record by less than 0.02 %, and the gain over a linear model there is 0.8 %.
COST_TOLERANCE = 1e-6

#: Upper limit of the evaluations of the network over the record, per restart.
MAX_EVALUATIONS = 200

#: Output beyond which a free run counts as diverged [V].
DIVERGED_OUTPUT = 1e6


@dataclass(eq=False)
class PEMNARX:
    """Nonlinear autoregression y_t = f(y_{t-1}, y_{t-2}, u_{t-delay}), fitted offline by prediction-error minimisation.

    `fit` minimises the mean squared one-step prediction error with Levenberg-Marquardt (MINPACK) and the analytic
    Jacobian, on standardised regressors and outputs. Every restart begins at the least-squares linear model, with
    silent units (a = 0) of random direction and bias; the fit with the lowest training error is kept.

    The fit is better than the published one, which is no minimum of the criterion (docs/evidence/reproduction.md).

    Args:
        units: number K >= 0 of sigmoid units; with 0 the model is a linear ARX model with an offset.
        input_delay: samples between an input and the output it acts on, 0 (as published) or 1 (Eq. (2) of the paper),
            where u and y are paired by array index.
        seed: seed of the random initial directions and biases.
        restarts: number of searches, at least 1.

    Attributes:
        parameters: (4 + 5K,) fitted network, for regressors and outputs in volts; None before `fit`.
        regressor_mean: (3,) r0, the mean of the training regressors [V]; None before `fit`.
        training_mse: mean squared one-step error over the training samples [V²]; NaN before `fit`.

    Raises:
        ValueError: naming the argument, the value and the remedy.

    Example:
        >>> import numpy as np
        >>> from estimator.inference.pem_narx import PEMNARX
        >>> u = 0.05 * np.random.default_rng(0).standard_normal(500)
        >>> y = np.zeros(500)
        >>> for t in range(2, 500):
        ...     y[t] = 1.5 * y[t - 1] - 0.9 * y[t - 2] - 0.5 * y[t - 1] ** 3 + 0.2 * u[t]
        >>> model = PEMNARX(units=2).fit(u, y)
        >>> bool(np.abs(model.simulate(u, y[:2]) - y).max() < 0.01 * np.abs(y).max())
        True
    """

    units: int = 4
    input_delay: int = 0
    seed: int = 0
    restarts: int = 4
    parameters: FloatArray | None = field(default=None, init=False, repr=False)
    regressor_mean: FloatArray | None = field(default=None, init=False, repr=False)
    training_mse: float = field(default=math.nan, init=False)

    def __post_init__(self) -> None:
        for name, least in (("units", 0), ("seed", 0), ("restarts", 1)):
            check_integer(name, getattr(self, name), 10**9 if name == "seed" else 1000, least)
        check_integer("input_delay (the published run had 0)", self.input_delay, 1, 0)

    def fit(self, u: npt.ArrayLike, y: npt.ArrayLike) -> PEMNARX:
        """Fit the network to one record, and return this model. An earlier fit is replaced.

        Args:
            u: (T,) inputs [V].
            y: (T,) outputs [V], paired with u by index; T - 2 must exceed the number of parameters 4 + 5K.

        Raises:
            ValueError: If u or y is not a finite series, they differ in length, are too short, or do not vary.
        """
        from scipy.optimize import least_squares

        u, y = _checked_pair(u, y)
        n_parameters = 4 + 5 * self.units
        if len(y) - 2 <= n_parameters:
            raise ValueError(
                f"u and y must have more than {n_parameters + 2} samples to fit {n_parameters} parameters, but have "
                f"{len(y)}; use a longer record or fewer units"
            )
        regressors, target = self._regressors(u, y), y[2:]
        mean, scale = regressors.mean(axis=0), regressors.std(axis=0)
        for name, samples in (("y", y[:-2]), ("y", y[1:-1]), ("y", target), ("u", regressors[:, 2])):
            if np.ptp(samples) == 0:
                raise ValueError(f"{name} must vary, but is constant over the samples of the fit; excite the system")

        z = (regressors - mean) / scale
        target_mean, target_scale = target.mean(), target.std()
        standard_target = (target - target_mean) / target_scale
        linear = np.linalg.lstsq(np.column_stack([z, np.ones(len(z))]), standard_target, rcond=None)[0]
        rng = np.random.default_rng(self.seed)
        solutions = []
        for _ in range(self.restarts):
            start = np.concatenate([linear, np.zeros(self.units), rng.standard_normal(4 * self.units)])
            solution = least_squares(
                lambda parameters: evaluate_network(parameters, z) - standard_target,
                start,
                lambda parameters: network_jacobian(parameters, z),
                method="lm",
                ftol=COST_TOLERANCE,
                max_nfev=MAX_EVALUATIONS,
            )
            solutions.append(solution)
        best = min(solutions, key=lambda solution: solution.cost)

        self.parameters = _in_volts(best.x, scale, target_mean, target_scale)
        self.regressor_mean = mean
        self.training_mse = float(np.mean((evaluate_network(self.parameters, regressors - mean) - target) ** 2))
        return self

    def predict(self, u: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """One-step predictions (T,) [V]: each output from the two measured before it; the first two repeat y.

        Args:
            u: (T,) inputs [V].
            y: (T,) outputs [V], paired with u by index; T >= 2.

        Raises:
            ValueError: If u or y is not a finite series, they differ in length, or T < 2.
            RuntimeError: Before `fit`.
        """
        parameters, mean = self._fitted()
        u, y = _checked_pair(u, y)
        predicted = y.copy()
        predicted[2:] = evaluate_network(parameters, self._regressors(u, y) - mean)
        return predicted

    def simulate(self, u: npt.ArrayLike, y_init: npt.ArrayLike) -> FloatArray:
        """Free run over all of u: each output from the two simulated before it.

        The units are bounded, so a free run diverges only if the linear part is unstable. From the first output beyond
        1e6 V on, all outputs are NaN, and so are errors computed from them.

        Args:
            u: (T,) inputs [V].
            y_init: between 2 and T first outputs, from which the run starts [V].

        Returns:
            (T,) simulated outputs [V], beginning with y_init; NaN after the model diverges.

        Raises:
            ValueError: If u or y_init is not a finite series, or y_init has fewer than 2 or more than T entries.
            RuntimeError: Before `fit`.
        """
        parameters, mean = self._fitted()
        u, y_init = to_finite_series("u", u), to_finite_series("y_init", y_init)
        if not 2 <= len(y_init) <= len(u):
            raise ValueError(f"y_init must hold between 2 and len(u) = {len(u)} outputs, but holds {len(y_init)}")
        simulated = np.empty(len(u))
        simulated[: len(y_init)] = y_init
        _free_run(parameters, mean, u, self.input_delay, simulated, len(y_init))
        return simulated

    def _regressors(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """(T - 2, 3) regressors of y_2, ..., y_{T-1}."""
        first = 2 - self.input_delay
        return np.column_stack([y[1:-1], y[:-2], u[first : first + len(y) - 2]])

    def _fitted(self) -> tuple[FloatArray, FloatArray]:
        if self.parameters is None or self.regressor_mean is None:
            raise RuntimeError("the model has no parameters yet; call fit(u, y) first")
        return self.parameters, self.regressor_mean


def evaluate_network(parameters: FloatArray, centred_regressors: FloatArray) -> FloatArray:
    """Outputs f (N,) of the network at N centred regressors z = r - r0 (N, 3)."""
    linear, offset, amplitude, bias, direction = _split_parameters(parameters)
    return centred_regressors @ linear + offset + _sigmoid(centred_regressors @ direction + bias) @ amplitude


def network_jacobian(parameters: FloatArray, centred_regressors: FloatArray) -> FloatArray:
    """Derivatives (N, 4 + 5K) of `evaluate_network` with respect to its parameters."""
    _, _, amplitude, bias, direction = _split_parameters(parameters)
    unit = _sigmoid(centred_regressors @ direction + bias)
    slope = amplitude * unit * (1 - unit)
    return np.hstack(
        [
            centred_regressors,
            np.ones((len(centred_regressors), 1)),
            unit,
            slope,
            *(centred_regressors[:, i : i + 1] * slope for i in range(3)),
        ]
    )


def _sigmoid(z: FloatArray) -> FloatArray:
    """The sigmoid 1 / (1 + exp(-z)) of a unit."""
    from scipy.special import expit

    return np.asarray(expit(z))


def _split_parameters(parameters: FloatArray) -> tuple[FloatArray, np.float64, FloatArray, FloatArray, FloatArray]:
    """Views of L (3,), d, a (K,), c (K,) and b (3, K)."""
    units = (len(parameters) - 4) // 5
    amplitude, bias, direction = np.split(parameters[4:], [units, 2 * units])
    return parameters[:3], parameters[3], amplitude, bias, direction.reshape(3, units)


def _in_volts(parameters: FloatArray, scale: FloatArray, target_mean: float, target_scale: float) -> FloatArray:
    """Parameters for regressors and outputs in volts, from the parameters for standardised ones."""
    linear, offset, amplitude, bias, direction = _split_parameters(parameters)
    return np.concatenate(
        [
            target_scale * linear / scale,
            [target_scale * offset + target_mean],
            target_scale * amplitude,
            bias,
            (direction / scale[:, None]).ravel(),
        ]
    )


@kernel(fastmath=False)
def _free_run(parameters, regressor_mean, u, input_delay, y, start):
    """Continue y in place from sample ``start`` on."""
    units = (len(parameters) - 4) // 5
    amplitude, bias = parameters[4 : 4 + units], parameters[4 + units : 4 + 2 * units]
    direction = parameters[4 + 2 * units :].reshape(3, units)
    for t in range(start, len(y)):
        z0 = y[t - 1] - regressor_mean[0]
        z1 = y[t - 2] - regressor_mean[1]
        z2 = u[t - input_delay] - regressor_mean[2]
        output = parameters[0] * z0 + parameters[1] * z1 + parameters[2] * z2 + parameters[3]
        for k in range(units):
            ridge = direction[0, k] * z0 + direction[1, k] * z1 + direction[2, k] * z2 + bias[k]
            output += amplitude[k] / (1 + math.exp(-ridge))
        if not abs(output) <= DIVERGED_OUTPUT:
            y[t:] = np.nan
            return
        y[t] = output


def _checked_pair(u: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Two finite series of equal length of at least 2."""
    inputs, outputs = to_finite_series("u", u), to_finite_series("y", y)
    if inputs.shape != outputs.shape or len(outputs) < 2:
        raise ValueError(
            f"u and y must have one length of at least 2, but have {len(inputs)} and {len(outputs)}; cut the longer one"
        )
    return inputs, outputs
