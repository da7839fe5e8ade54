"""The memory of an online estimator: a belief in the form that its kernel updates, and the inputs that still act."""

from __future__ import annotations

from copy import copy
from typing import Protocol, TypeVar

import numpy as np

from estimator.belief import Belief, Prior
from estimator.gaussian import JointBelief
from estimator.inference import update
from estimator.lanes import LANES, kernel
from estimator.models.nlarx import NLARX
from estimator.models.ode import N_STATES, DuffingODE, run_samples, simulate_samples
from estimator.parameters import SAMPLING_STEP, FloatArray
from estimator.record import LAYOUT, N_ROWS, RECORD, RECORD_SIZE, STATES

_U, _Y, _PREDICTED = LAYOUT["u"], LAYOUT["y"], LAYOUT["predicted"]
_VARIANCES = (LAYOUT["predicted_variance"], LAYOUT["process_variance"], LAYOUT["measurement_variance"])

#: Rows of a record that are about the state.
_OF_STATES = [i for i, name in enumerate(RECORD) if set(name.split("_")) & set(STATES)]

#: Shape of a Gamma belief that further samples do not move.
_CERTAIN = 1e15

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

    def __init__(self, model: NLARX, prior: Prior, factorisation: str, as_published: bool) -> None:
        self.model = model
        self._factorisation = factorisation
        self._as_published = as_published
        self._prior_record = prior.to_record(factorisation=factorisation, nonlinear=model.nonlinear)
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
        _run_nlarx(self._block.reshape(-1), acting, y, structured, self._as_published, free_energies, forecasts)
        self._last_input = float(u[-1])
        return len(u)

    def rewind(self) -> None:
        """Forget the state and the inputs."""
        self._block[_OF_STATES] = self._prior_record[_OF_STATES, None]
        self._last_input = 0.0

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


class ODEFilter:
    """Memory for `DuffingODE`: mean and covariance per sample, and the inputs that the next piece needs."""

    def __init__(self, model: DuffingODE, prior: JointBelief) -> None:
        self.model = model
        self._scale = np.concatenate([[1.0, 1 / SAMPLING_STEP], model.scales()])
        self._mean = prior.mean / self._scale
        self._cov = prior.cov / np.outer(self._scale, self._scale)
        if not model.cubic_damping:
            fixed = N_STATES + model.names.index("cubic_damping")
            self._mean[fixed] = self._cov[fixed, :] = self._cov[:, fixed] = 0.0
        self._noises = np.array([prior.gamma_shape, prior.gamma_rate, prior.xi_shape, prior.xi_rate])
        self._first_state = self._mean[:N_STATES].copy(), self._cov[:N_STATES, :N_STATES].copy()
        self._past: FloatArray = np.zeros(0)
        self._waiting_u: FloatArray = np.zeros(0)
        self._waiting_y: FloatArray = np.zeros(0)

    def copy(self) -> ODEFilter:
        """An independent copy."""
        other = copy(self)
        other._mean, other._cov, other._noises = self._mean.copy(), self._cov.copy(), self._noises.copy()
        return other

    def run(self, u: FloatArray, y: FloatArray, free_energies: FloatArray, forecasts: FloatArray) -> int:
        """Take samples; those that wait for a later input are used by the next call."""
        inputs = np.concatenate([self._past, self._waiting_u, u])
        outputs = np.concatenate([self._waiting_y, y])
        begun, used = len(self._past), max(0, len(outputs) - self.model.look_ahead)
        if used:
            new = slice(begun, begun + used)
            run_samples(
                self._mean, self._cov, self._noises, self._pieces(inputs)[new], inputs[new], outputs[:used],
                begun > 0, self.model.substeps, free_energies, forecasts,
            )  # fmt: skip
        self._past = inputs[: begun + used][-2:]
        self._waiting_u, self._waiting_y = inputs[begun + used :], outputs[used:]
        return used

    def rewind(self) -> None:
        """Forget the state and the inputs."""
        self._mean[:N_STATES] = self._first_state[0]
        self._cov[:N_STATES, :] = self._cov[:, :N_STATES] = 0.0
        self._cov[:N_STATES, :N_STATES] = self._first_state[1]
        self._past = self._waiting_u = self._waiting_y = np.zeros(0)

    @property
    def is_finite(self) -> bool:
        """Whether all numbers of the belief are."""
        return all(np.isfinite(array).all() for array in (self._mean, self._cov, self._noises))

    @property
    def belief(self) -> JointBelief:
        """The belief now, in physical units."""
        mean, cov = self._mean * self._scale, self._cov * np.outer(self._scale, self._scale)
        return JointBelief(self.model.names, self.model.units, mean, cov, *self._noises.tolist())

    def predict(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions: of a filter that follows the record with everything fixed but the state."""
        return self._follow(self._pieces(u), u, y)[1]

    def simulate(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run from the state that the first outputs leave such a filter with."""
        pieces, given = self._pieces(u), len(y_init)
        (x, v), _ = self._follow(pieces[:given], u[:given], y_init)
        simulated = np.concatenate([y_init, np.empty(len(u) - given)])
        simulate_samples(
            x, v, self._mean[N_STATES:], pieces[given:], u[given:], self.model.substeps, simulated[given:]
        )  # fmt: skip
        return simulated

    def _pieces(self, u: FloatArray) -> FloatArray:
        """(T, 4) the input on the way to each sample; nothing moves to the first."""
        return np.concatenate([np.zeros((1, 4)), self.model.pieces(u)])

    def _follow(self, pieces: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Follow a record with parameters and noises fixed at their means: the last state, and the forecasts (T,)."""
        mean, cov = self._mean.copy(), np.zeros_like(self._cov)
        mean[:N_STATES], cov[:N_STATES, :N_STATES] = self._first_state
        noises = self._noises * np.repeat(_CERTAIN / self._noises[::2], 2)
        forecasts = np.empty((len(y), 2))
        run_samples(
            mean, cov, noises, pieces, u, y, False, self.model.substeps, np.empty((len(y), 1)), forecasts
        )  # fmt: skip
        return mean[:N_STATES], forecasts[:, 0]


@kernel
def _run_nlarx(W, u, y, is_structured, as_published, free_energies, forecasts):
    """Update lane 0 with every sample. The other lanes do the same work, so that none of them runs wild."""
    for t in range(len(u)):
        for j in range(LANES):
            W[_U * LANES + j] = u[t]
            W[_Y * LANES + j] = y[t]
        update(W, is_structured, free_energies.shape[1], as_published, free_energies[t])
        forecasts[t, 0] = W[_PREDICTED * LANES] if is_structured else np.nan
        forecasts[t, 1] = 0.0 if is_structured else np.nan
        for row in _VARIANCES:
            forecasts[t, 1] += W[row * LANES]
