"""The memory of an online estimator: a belief in the form that its kernel updates, and the inputs that still act."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from typing import Protocol, TypeVar

import numpy as np

from estimator.belief import Belief, Prior, from_moments, to_moments
from estimator.gaussian import JointBelief
from estimator.inference import sigma_points, update_alone, walk
from estimator.lanes import LANES, kernel
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
from estimator.record import LAYOUT, N_ROWS, RECORD, RECORD_SIZE, STATES

_U, _Y, _PREDICTED = LAYOUT["u"], LAYOUT["y"], LAYOUT["predicted"]
_VARIANCES = (LAYOUT["predicted_variance"], LAYOUT["process_variance"], LAYOUT["measurement_variance"])

#: Rows of a record that are about the state.
_OF_STATES = [i for i, name in enumerate(RECORD) if set(name.split("_")) & set(STATES)]

#: How a `JointFilter` finds out what a step does to its Gaussian belief.
EXPECTATIONS = ("first_order", "sigma_points")

#: Shape of a Gamma belief that further samples do not move.
_CERTAIN = 1e15

#: What a `JointFilter` consists of.
_JOINT_ARRAYS = ("mean", "cov", "noises", "walk", "first_mean", "first_cov", "past", "waiting_u", "waiting_y")

Self = TypeVar("Self")


class Filter(Protocol):
    """What `OnlineEstimator` needs of a model's memory."""

    def copy(self: Self) -> Self:
        """An independent copy."""
        ...

    def run(self, u: FloatArray, y: FloatArray, free_energies: FloatArray, forecasts: FloatArray) -> int:
        """Take samples (T,); fill (T, iterations) and (T, 2) from the front; the number of samples that were used."""
        ...

    def rewind(self) -> None:
        """Forget the state and the inputs, keep the coefficients and noises."""
        ...

    def arrays(self) -> dict[str, FloatArray]:
        """Everything that the future depends on, by name."""
        ...

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Become what `arrays` said of another filter of the same model."""
        ...

    @property
    def belief(self) -> Belief | JointBelief:
        """The belief now."""
        ...

    @property
    def is_finite(self) -> bool:
        """Whether all of its numbers are."""
        ...

    def predict(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions (T,) with the coefficients fixed at their means."""
        ...

    def simulate(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run (T,) with the coefficients fixed at their means."""
        ...


class NLARXFilter:
    """Memory for `NLARX`: a block whose lanes all hold the same belief, and the last input."""

    def __init__(self, model: NLARX, prior: Prior, factorisation: str, as_published: bool, drift: float) -> None:
        self.model = model
        self._factorisation = factorisation
        self._as_published = as_published
        self._prior_record = prior.to_record(factorisation=factorisation, nonlinear=model.nonlinear)
        assert prior.coefficients_cov is not None
        self._walk = drift**2 * np.diag(prior.coefficients_cov)
        if not model.nonlinear:
            self._walk[1] = 0.0
        self._last_input = 0.0
        self._block = np.zeros((N_ROWS, LANES))
        self._block[:RECORD_SIZE] = self._prior_record[:, None]

    def copy(self) -> NLARXFilter:
        """An independent copy."""
        other = copy(self)
        other._block = self._block.copy()
        return other

    def run(self, u: FloatArray, y: FloatArray, free_energies: FloatArray, forecasts: FloatArray) -> int:
        """Take samples; all of them are used."""
        acting = u
        if self.model.input_delay:
            acting = np.concatenate(([self._last_input], u[:-1]))
        structured = self._factorisation == "structured"
        _run_nlarx(
            self._block.reshape(-1), acting, y, self._walk, structured, self._as_published, free_energies, forecasts
        )  # fmt: skip
        self._last_input = float(u[-1])
        return len(u)

    def rewind(self) -> None:
        """Forget the state and the inputs."""
        self._block[_OF_STATES] = self._prior_record[_OF_STATES, None]
        self._last_input = 0.0

    def arrays(self) -> dict[str, FloatArray]:
        """Everything that the future depends on."""
        last_input = np.array(self._last_input)
        return {
            "record": self._block[:RECORD_SIZE, 0],
            "prior_record": self._prior_record,
            "walk": self._walk,
            "last_input": last_input,
        }

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Become another filter."""
        self._block[:RECORD_SIZE] = arrays["record"][:, None]
        self._prior_record = arrays["prior_record"]
        self._walk = arrays["walk"]
        self._last_input = float(arrays["last_input"])

    @property
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (7,), covariance (7, 7), and the noises' shapes and rates (4,) of the record."""
        return to_moments(self._block[:RECORD_SIZE, 0])

    def with_moments(self, mean: FloatArray, cov: FloatArray, noises: FloatArray) -> NLARXFilter:
        """A copy with another belief."""
        other = self.copy()
        other._block[:RECORD_SIZE] = from_moments(mean, cov, noises)[:, None]
        return other

    @property
    def is_finite(self) -> bool:
        """Whether all numbers of the record are."""
        return bool(np.isfinite(self._block[:RECORD_SIZE, 0]).all())

    @property
    def belief(self) -> Belief:
        """The belief now."""
        return Belief(self._block[:RECORD_SIZE, 0], self._factorisation, self.model.nonlinear)

    def predict(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions from the last two outputs."""
        return self.model.predict(self.belief.coefficients_mean, u, y)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run from the first outputs."""
        return self.model.simulate(self.belief.coefficients_mean, u, y_init)


class JointFilter(ABC):
    """Memory of a structured estimator with matrices: mean and covariance in the model's own coordinates, past inputs.

    Args:
        prior: belief before the first sample.
        drift: standard deviation of each coefficient's step per sample, in parts of that of its prior.
        expectations: a name of `EXPECTATIONS`.
        movers: how many dimensions of the joint state decide where the state moves; they stand first.
        look_ahead: inputs after a sample that must be known before it is used.
    """

    def __init__(self, prior: JointBelief, drift: float, expectations: str, movers: int, look_ahead: int) -> None:
        self._by_points, self._movers = expectations == "sigma_points", movers
        self._names, self._units, self._look_ahead = prior.names, prior.units, look_ahead
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
        self._past = inputs[: begun + used][-LONGEST_DELAY:]
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
        return {name: getattr(self, f"_{name}") for name in _JOINT_ARRAYS}

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Become another filter."""
        for name in _JOINT_ARRAYS:
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
        super().__init__(prior, drift, expectations, N_MOTION, model.look_ahead)
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
        super().__init__(prior, drift, expectations, len(prior.mean), look_ahead=0)
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


@kernel
def _run_nlarx(W, u, y, variances, is_structured, as_published, free_energies, forecasts):
    """Update lane 0 with every sample."""
    changes = variances.max() > 0.0
    for t in range(len(u)):
        if changes:
            walk(W, variances[0], variances[1], variances[2], variances[3])
        W[_U * LANES] = u[t]
        W[_Y * LANES] = y[t]
        update_alone(W, is_structured, free_energies.shape[1], as_published, free_energies[t])
        forecasts[t, 0] = W[_PREDICTED * LANES] if is_structured else np.nan
        forecasts[t, 1] = 0.0 if is_structured else np.nan
        for row in _VARIANCES:
            forecasts[t, 1] += W[row * LANES]
