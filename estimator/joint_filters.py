"""The memory of an online estimator with matrices: for models whose state or terms the record does not hold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy

import numpy as np

from estimator.filters import Self
from estimator.gaussian import JointBelief
from estimator.inference import sigma_points
from estimator.models.nlarx import NLARX
from estimator.models.ode import (
    N_MOTION,
    DuffingODE,
    from_coordinates,
    run_samples,
    simulate_samples,
    to_coordinates,
)
from estimator.models.regressors import LONGEST_DELAY, as_arrays, run_regressors, simulate_regressors
from estimator.parameters import FloatArray

#: How a `JointFilter` finds out what a step does to its Gaussian belief.
EXPECTATIONS = ("first_order", "sigma_points")

#: Shape of a Gamma belief that further samples do not move.
_CERTAIN = 1e15

#: What a `JointFilter` consists of.
_ARRAYS = ("mean", "cov", "noises", "walk", "first_mean", "first_cov", "past", "waiting_u", "waiting_y")


class JointFilter(ABC):
    """Memory of a structured estimator with matrices: mean and covariance in the model's own coordinates, past inputs.

    Args:
        prior: belief before the first sample.
        drift: standard deviation of each coefficient's step per sample, in parts of that of its prior.
        expectations: a name of `EXPECTATIONS`.
        movers: how many dimensions of the joint state decide where the state moves; they stand first.
        look_ahead: inputs after a sample that must be known before it is used.
        reach: inputs before a sample that still act on it.
    """

    def __init__(
        self, prior: JointBelief, drift: float, expectations: str, movers: int, look_ahead: int, reach: int
    ) -> None:
        self._by_points, self._movers = expectations == "sigma_points", movers
        self._names, self._units, self._look_ahead, self._reach = prior.names, prior.units, look_ahead, reach
        self._mean, self._cov = self._to_coordinates(prior.mean, prior.cov)
        self._noises = np.array([prior.gamma_shape, prior.gamma_rate, prior.xi_shape, prior.xi_rate])
        self._states = len(prior.state_mean)
        self._walk = drift**2 * np.diag(self._cov)[self._states :]
        self._first_mean = self._mean[: self._states].copy()
        self._first_cov = self._cov[: self._states, : self._states].copy()
        self._past: FloatArray = np.zeros(0)
        self._waiting_u: FloatArray = np.zeros(0)
        self._waiting_y: FloatArray = np.zeros(0)

    def copy(self: Self) -> Self:
        """An independent copy."""
        other = copy(self)
        for name in ("_mean", "_cov", "_noises"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def run(self, u: FloatArray, y: FloatArray, free_energies: FloatArray, forecasts: FloatArray) -> int:
        """Take samples; those that wait for a later input are used by the next call."""
        inputs = np.concatenate([self._past, self._waiting_u, u])
        outputs = np.concatenate([self._waiting_y, y])
        begun, used = len(self._past), max(0, len(outputs) - self._look_ahead)
        if used:
            self._take(
                self._mean, self._cov, self._noises, self._walk, inputs, begun, outputs[:used], free_energies, forecasts
            )
        self._past = inputs[: begun + used][-self._reach :]
        self._waiting_u, self._waiting_y = inputs[begun + used :], outputs[used:]
        return used

    def _memory(self) -> tuple[FloatArray, FloatArray] | None:
        """What the kernels need for sigma points; None to first order."""
        return sigma_points.memory(len(self._mean), self._movers) if self._by_points else None

    def _to_coordinates(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From what a `JointBelief` holds to the model's own coordinates; copies."""
        return mean.copy(), cov.copy()

    def _from_coordinates(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Back from the model's own coordinates."""
        return mean, cov

    @abstractmethod
    def _take(
        self,
        mean: FloatArray,
        cov: FloatArray,
        noises: FloatArray,
        walk: FloatArray,
        inputs: FloatArray,
        begun: int,
        outputs: FloatArray,
        free_energies: FloatArray,
        forecasts: FloatArray,
    ) -> None:
        """Update mean, covariance and noises with the outputs (T,), whose inputs begin at ``inputs[begun]``."""

    @abstractmethod
    def _free_run(self, state: FloatArray, u: FloatArray, y: FloatArray, start: int) -> None:
        """Continue ``y`` (T,) from sample ``start`` on, in the state that the sample before left."""

    def rewind(self) -> None:
        """Forget the state and the inputs."""
        k = self._states
        self._mean[:k] = self._first_mean
        self._cov[:k, :] = self._cov[:, :k] = 0.0
        self._cov[:k, :k] = self._first_cov
        self._past = self._waiting_u = self._waiting_y = np.zeros(0)

    def arrays(self) -> dict[str, FloatArray]:
        """Everything that the future depends on."""
        return {name: getattr(self, f"_{name}") for name in _ARRAYS}

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Become another filter."""
        for name in _ARRAYS:
            setattr(self, f"_{name}", arrays[name])

    @property
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (n,), covariance (n, n), and the noises' shapes and rates (4,), in the model's own coordinates."""
        return self._mean.copy(), self._cov.copy(), self._noises.copy()

    def with_moments(self: Self, mean: FloatArray, cov: FloatArray, noises: FloatArray) -> Self:
        """A copy with another belief."""
        other = copy(self)
        for name, array in (("_mean", mean), ("_cov", cov), ("_noises", noises)):
            setattr(other, name, array.copy())
        return other

    @property
    def is_finite(self) -> bool:
        """Whether all numbers of the belief are."""
        return all(np.isfinite(array).all() for array in (self._mean, self._cov, self._noises))

    @property
    def belief(self) -> JointBelief:
        """The belief now."""
        mean, cov = self._from_coordinates(self._mean, self._cov)
        return JointBelief(self._names, self._units, mean, cov, *self._noises.tolist())

    def predict(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions: of a filter that follows the record with everything fixed but the state."""
        return self._follow(u, y)[1]

    def simulate(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run from the state that the first outputs leave such a filter with."""
        state, _ = self._follow(u, y_init)
        simulated = np.concatenate([y_init, np.empty(len(u) - len(y_init))])
        self._free_run(state, u, simulated, len(y_init))
        return simulated

    def _follow(self, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Follow a record with parameters and noises fixed at their means: the last state, and the forecasts (T,)."""
        k = self._states
        mean, cov = self._mean.copy(), np.zeros_like(self._cov)
        mean[:k], cov[:k, :k] = self._first_mean, self._first_cov
        noises = self._noises * np.repeat(_CERTAIN / self._noises[::2], 2)
        forecasts = np.empty((len(y), 2))
        self._take(mean, cov, noises, np.zeros_like(self._walk), u, 0, y, np.empty((len(y), 1)), forecasts)
        return mean[:k], forecasts[:, 0]


class ODEFilter(JointFilter):
    """Memory for `DuffingODE`."""

    def __init__(self, model: DuffingODE, prior: JointBelief, drift: float, expectations: str) -> None:
        super().__init__(prior, drift, expectations, N_MOTION, model.look_ahead, model.reach)
        self._model = model
        if not model.cubic_damping:
            fixed = self._states + model.names.index("cubic_damping")
            self._mean[fixed] = self._cov[fixed, :] = self._cov[:, fixed] = 0.0
            self._walk[fixed - self._states] = 0.0

    def _to_coordinates(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        return to_coordinates(mean, cov)

    def _from_coordinates(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        return from_coordinates(mean, cov)

    def _take(
        self,
        mean: FloatArray,
        cov: FloatArray,
        noises: FloatArray,
        walk: FloatArray,
        inputs: FloatArray,
        begun: int,
        outputs: FloatArray,
        free_energies: FloatArray,
        forecasts: FloatArray,
    ) -> None:
        new = slice(begun, begun + len(outputs))
        pieces, moving, substeps = self._pieces(inputs)[new], begun > 0, self._model.substeps
        run_samples(
            mean, cov, noises, walk, pieces, inputs[new], outputs, moving, substeps, free_energies, forecasts,
            self._memory(),
        )  # fmt: skip

    def _free_run(self, state: FloatArray, u: FloatArray, y: FloatArray, start: int) -> None:
        parameters, pieces = self._mean[self._states :], self._pieces(u)[start:]
        simulate_samples(state[0], state[1], parameters, pieces, u[start:], self._model.substeps, y[start:])

    def _pieces(self, u: FloatArray) -> FloatArray:
        """(T, degree + 1) the input on the way to each sample; nothing moves to the first."""
        pieces = self._model.pieces(u)
        return np.concatenate([np.zeros((1, pieces.shape[1])), pieces])


class RegressorFilter(JointFilter):
    """Memory for an `NLARX` with other regressors than the paper's."""

    def __init__(self, model: NLARX, prior: JointBelief, drift: float, expectations: str) -> None:
        super().__init__(prior, drift, expectations, len(prior.mean), look_ahead=0, reach=LONGEST_DELAY)
        self._terms = as_arrays(model.terms)

    def _take(
        self,
        mean: FloatArray,
        cov: FloatArray,
        noises: FloatArray,
        walk: FloatArray,
        inputs: FloatArray,
        begun: int,
        outputs: FloatArray,
        free_energies: FloatArray,
        forecasts: FloatArray,
    ) -> None:
        run_regressors(
            mean, cov, noises, walk, self._terms, inputs, begun, outputs, free_energies, forecasts, self._memory()
        )  # fmt: skip

    def _free_run(self, state: FloatArray, u: FloatArray, y: FloatArray, start: int) -> None:
        given = y[:start].copy()
        y[start - 2 : start] = state[::-1]
        simulate_regressors(self._mean[self._states :], self._terms, u, y, start)
        y[:start] = given
