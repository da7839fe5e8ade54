"""The memory of an online estimator: a belief in the form that its kernel updates, and the inputs that still act."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Protocol, TypeVar

import numpy as np

from estimator.belief import Belief, from_moments, to_moments
from estimator.gaussian import JointBelief
from estimator.inference import update_alone, walk
from estimator.lanes import LANES, kernel
from estimator.models.nlarx import NLARX
from estimator.parameters import FloatArray
from estimator.prior import Prior
from estimator.record import LAYOUT, N_ROWS, RECORD, RECORD_SIZE, STATES

_U, _Y, _PREDICTED = LAYOUT["u"], LAYOUT["y"], LAYOUT["predicted"]
_VARIANCES = (LAYOUT["predicted_variance"], LAYOUT["process_variance"], LAYOUT["measurement_variance"])

#: Rows of a record that are about the state.
_OF_STATES = [i for i, name in enumerate(RECORD) if set(name.split("_")) & set(STATES)]

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
