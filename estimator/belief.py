"""The belief: a Gaussian over a model's states and coefficients, and Gamma densities of its noise precisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np
import numpy.typing as npt

from estimator.engine.storage_layout import belief_rows
from estimator.models.model import Model
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.rigs.units import MAGNITUDE_BOUNDS, VOLT_SCALES, Scales
from estimator.support.argument_checks import check_choice, check_number, short_repr, to_float_array
from estimator.support.array_types import FloatArray
from estimator.support.update_options import DEFAULT_ITERATIONS


@cache
def covariance_indices(model: Model) -> npt.NDArray[np.intp]:
    """(d, d) indices of the covariance's entries in a record, for d states and coefficients."""
    d = len(model.names)
    places = np.empty((d, d), dtype=np.intp)
    upper = np.triu_indices(d)
    places[upper] = places.T[upper] = d + np.arange(len(upper[0]))
    return places


def couple_initial_states(model: Model, mean: FloatArray, cov: FloatArray) -> None:
    """Set the states of `Model.initial_states` to their coefficients, in moments (d,) and (d, d), in place.

    Such a state has the coefficient's mean, variance and covariances: before the first sample they are the same number.
    """
    for state, coefficient in model.initial_state_coefficients:
        place = model.n_states + coefficient
        mean[state] = mean[place]
        cov[state, :] = cov[place, :]
        cov[:, state] = cov[:, place]


@cache
def record_size(model: Model) -> int:
    """Number of entries in a record."""
    return len(belief_rows(model))


def check_belief_record(argument_name: str, model: Model, record: FloatArray, eigenvalue_tolerance: float) -> None:
    """Check that a record (size,) is a belief of a model.

    Args:
        argument_name: name of the record in messages.
        model: the model.
        record: the numbers.
        eigenvalue_tolerance: largest magnitude of a negative eigenvalue of the correlations, per quantity [1].

    Raises:
        ValueError: for numbers that are not finite, or beyond 1e30 (of the covariance, shapes and rates: 1e60), whose
            products overflow; a shape or rate that is not positive; or a covariance that is not positive
            semi-definite.
    """
    if not np.isfinite(record).all():
        bad = belief_rows(model)[int(np.argmin(np.isfinite(record)))]
        raise ValueError(f"{argument_name} must be finite, but {bad} is not; replace it")
    d = len(model.names)
    limit = np.where(np.arange(len(record)) < d, MAGNITUDE_BOUNDS[1], MAGNITUDE_BOUNDS[1] ** 2)
    if (beyond := np.abs(record) > limit).any():
        place = int(np.argmax(beyond))
        raise ValueError(
            f"{argument_name} must be within ±{limit[place]:g}, but {belief_rows(model)[place]} is {record[place]:g}; "
            "choose scales that bring the numbers near 1"
        )
    noises = record[-2 - 2 * model.n_outputs :]
    if (noises <= 0).any():
        raise ValueError(
            f"{argument_name} must have positive shapes and rates of the noises, but has {noises.tolist()}"
        )
    cov = record[covariance_indices(model)]
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    unit = np.where(std > 0, std, 1.0)
    with np.errstate(over="ignore"):
        correlations = cov / unit[:, None] / unit
    is_indefinite = (np.diag(cov) < 0).any() or (cov[std == 0] != 0).any() or not (np.abs(correlations) < 2).all()
    if is_indefinite or np.linalg.eigvalsh(correlations)[0] < -eigenvalue_tolerance * len(cov):
        raise ValueError(f"{argument_name} must have a positive semi-definite covariance, but has {cov.tolist()}")


@dataclass(frozen=True, eq=False)
class Belief:
    """A prior or posterior: q(states, coefficients) Gaussian, q(γ) and q(ξ) of each sensor Gamma.

    A belief is a copy: later updates do not change it. A coefficient of variance 0 is known. γ is the precision of the
    first sensor's output under the process noise of one sample alone.

    Attributes:
        model: the model of the states and coefficients.
        record: (size,) the numbers in the order of `estimator.engine.storage_layout.belief_rows`: means, the upper
            triangle of the covariance row by row, shape and rate of γ, then of each sensor's ξ. Time is counted in
            samples.
        scales: units of the record, for physical parameters.
        factorisation: factorisation of the inference; ``mean_field`` is the paper's.

    Raises:
        ValueError: naming the part, for a wrong size, a number that is not finite, a covariance that is not positive
            semi-definite, or a shape or rate that is not positive.
    """

    model: Model
    record: FloatArray
    scales: Scales = VOLT_SCALES
    factorisation: str = "structured"

    def __post_init__(self) -> None:
        Model.require_model(self.model)
        check_choice("factorisation", self.factorisation, DEFAULT_ITERATIONS)
        if not isinstance(self.scales, Scales):
            raise ValueError(f"scales must be a Scales, but is {short_repr(self.scales)}; use a rig's")
        record = to_float_array("record", self.record)
        if record.shape != (record_size(self.model),):
            raise ValueError(
                f"record must have shape {(record_size(self.model),)} for the model {self.model.name!r}, but has "
                f"{record.shape}; make it with Belief.of"
            )
        check_belief_record("record", self.model, record, 1e-9)
        record.flags.writeable = False
        object.__setattr__(self, "record", record)

    def __repr__(self) -> str:
        """One line with the model, and mean and standard deviation of its coefficients."""
        estimates = (f"{name} = {mean:.4g} ± {std:.2g}" for name, (mean, std) in self.coefficients().items())
        return f"Belief({self.model.name}: {', '.join(estimates)})"

    @classmethod
    def of(
        cls,
        model: Model,
        mean: npt.ArrayLike,
        cov: npt.ArrayLike,
        gamma: tuple[float, float],
        xi: tuple[float, float] | Sequence[tuple[float, float]],
        *,
        scales: Scales = VOLT_SCALES,
        factorisation: str = "structured",
    ) -> Self:
        """A belief with given moments.

        Args:
            model: the model of the states and coefficients.
            mean: (d,) means of the states, then of the coefficients.
            cov: (d, d) their covariance.
            gamma: shape and rate of the process precision.
            xi: shape and rate of the measurement precision; of several sensors, one pair for each.
            scales: as for the class.
            factorisation: as for the class.

        Raises:
            ValueError: as the class, or for shapes that do not fit.
        """
        d = len(Model.require_model(model).names)
        first, second = to_float_array("mean", mean), to_float_array("cov", cov)
        if first.shape != (d,) or second.shape != (d, d):
            raise ValueError(
                f"mean and cov must have shapes {(d,)} and {(d, d)} for the model {model.name!r}, but have "
                f"{first.shape} and {second.shape}"
            )
        noises = np.concatenate([to_float_array("gamma", gamma).ravel(), to_float_array("xi", xi).ravel()])
        record = np.empty(record_size(model))
        if np.size(gamma) != 2 or len(noises) != 2 + 2 * model.n_outputs:
            raise ValueError(
                f"gamma must be a pair, and xi one for each of {list(model.outputs)}, but are {short_repr(gamma)} and "
                f"{short_repr(xi)}"
            )
        # As correlations: the rounding error of a covariance near 0 exceeds the covariance.
        std = np.sqrt(np.abs(np.diag(second)))
        if np.any(np.abs(second - second.T) > 1e-9 * np.outer(std, std)):
            raise ValueError("cov must be symmetric; pass (C + C.T) / 2")
        record[:d] = first
        record[covariance_indices(model)] = second
        record[-len(noises) :] = noises
        return cls(model, record, scales, factorisation)

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are equal, as Gymnasium's checker requires of two episodes of one seed."""
        if not isinstance(other, Belief):
            return NotImplemented
        return self._identity == other._identity and np.array_equal(self.record, other.record)

    def __hash__(self) -> int:
        return hash((self._identity, self.record.tobytes()))

    @property
    def _identity(self) -> tuple[str, Scales, str]:
        return (self.model.digest, self.scales, self.factorisation)

    def with_records(self, records: FloatArray) -> list[Self]:
        """Beliefs with other records (n, size), which must not be written to later."""
        beliefs = []
        for record in records:
            # Without the checks, which take as long as 20 steps of an environment.
            belief = object.__new__(type(self))
            belief.__dict__.update(self.__dict__)
            belief.__dict__["record"] = record
            beliefs.append(belief)
        return beliefs

    def with_factorisation(self, factorisation: str) -> Self:
        """This belief as the prior of an inference with another factorisation.

        In ``mean_field``, the paper's, states, θ and η are independent: their cross-covariances are set to 0.
        """
        record, places, n = self.record.copy(), covariance_indices(self.model), self.model.n_states
        if factorisation == "mean_field":
            record[places[:n, n:]] = 0.0
            record[places[n:-1, -1]] = 0.0
        return replace(self, record=record, factorisation=factorisation)

    @property
    def step(self) -> float:
        """Sampling step [s]."""
        return self.scales.step

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return tuple(self.model.coefficients)

    @property
    def mean(self) -> FloatArray:
        """(d,) means of states and coefficients."""
        return self.record[: len(self.model.names)].copy()

    @property
    def cov(self) -> FloatArray:
        """(d, d) their covariance."""
        return self.record[covariance_indices(self.model)]

    @property
    def state_mean(self) -> FloatArray:
        """(n,) means of the states."""
        return self.record[: self.model.n_states].copy()

    @property
    def state_cov(self) -> FloatArray:
        """(n, n) covariance of the states."""
        n = self.model.n_states
        return self.record[covariance_indices(self.model)[:n, :n]]

    @property
    def coefficients_mean(self) -> FloatArray:
        """(K,) means of the coefficients."""
        return self.record[self.model.n_states : len(self.model.names)].copy()

    @property
    def coefficients_cov(self) -> FloatArray:
        """(K, K) covariance of the coefficients."""
        n = self.model.n_states
        return self.record[covariance_indices(self.model)[n:, n:]]

    @property
    def noises(self) -> FloatArray:
        """(2 + 2 sensors,) shape and rate of γ, then of each ξ."""
        return self.record[-2 - 2 * self.model.n_outputs :].copy()

    @property
    def gamma_mean(self) -> float:
        """E[γ], the process precision."""
        return float(self.noises[0] / self.noises[1])

    @property
    def xi_mean(self) -> float:
        """E[ξ], the measurement precision of the first sensor."""
        return float(self.noises[2] / self.noises[3])

    def coefficients(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of each coefficient, by name; time is counted in samples."""
        stds = np.sqrt(np.diag(self.coefficients_cov)).tolist()
        return dict(zip(self.names, zip(self.coefficients_mean.tolist(), stds, strict=True), strict=True))

    def entropy(self) -> float:
        """Entropy of the coefficients [nats]; NaN if their covariance is singular."""
        active, cov = self._uncertain_coefficients()
        sign, log_det = np.linalg.slogdet(cov)
        return float(0.5 * (len(active) * np.log(2 * np.pi * np.e) + log_det)) if sign > 0 else float("nan")

    def log_prob(self, coefficients: npt.ArrayLike) -> float | FloatArray:
        """Log density at given coefficients.

        Args:
            coefficients: values (..., K), in the order of ``coefficients_mean``.

        Returns:
            Log density [nats] of shape (...): a float for one point. NaN if the covariance is singular.

        Raises:
            ValueError: for a wrong shape, or values that are not finite.
        """
        points = to_float_array("coefficients", coefficients)
        size = len(self.coefficients_mean)
        if points.ndim == 0 or points.shape[-1] != size:
            raise ValueError(f"coefficients must have shape (..., {size}), but has {points.shape}; pass one per name")
        if not np.isfinite(points).all():
            raise ValueError("coefficients must be finite, but has entries that are not; remove them")
        active, cov = self._uncertain_coefficients()
        try:
            factor = np.linalg.cholesky(cov)
        except np.linalg.LinAlgError:
            factor = np.eye(len(active)) * np.nan
        deviation = (points - self.coefficients_mean)[..., active]
        whitened = np.linalg.solve(factor, deviation[..., None])[..., 0]
        log_det = 2 * np.log(np.diag(factor)).sum()
        value = -0.5 * ((whitened**2).sum(-1) + log_det + len(active) * np.log(2 * np.pi))
        return float(value) if np.ndim(value) == 0 else value

    def _uncertain_coefficients(self) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """Indices of the coefficients with positive variance, and their covariance."""
        cov = self.coefficients_cov
        active = np.flatnonzero(np.diag(cov) != 0)
        return active, cov[np.ix_(active, active)]

    def physical(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of the physical parameters, to first order, in the units of ``scales``.

        A model without physical parameters has its coefficients instead.
        """
        return propagate_to_physical(self.model, self.coefficients_mean, self.coefficients_cov, self.scales)

    def parameters(self) -> dict[str, tuple[float, float, str]]:
        """Mean, standard deviation and unit of each physical parameter, by name."""
        mean, cov = self.physical()
        units = {name: self.scales.unit(d) for name, d in self.model.dimensions.items()} or self.model.coefficients
        rows = zip(self.model.physical or self.model.coefficients, mean.tolist(), np.sqrt(np.diag(cov)), strict=True)
        return {name: (value, float(std), units[name]) for name, value, std in rows}

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Physical parameter to its central credible interval.

        Raises:
            ValueError: for a probability that is not between 0 and 1.
        """
        check_number("probability", probability, 1e-12, 1 - 1e-12, "0.9 is usual")
        from scipy.special import ndtri

        half = float(ndtri(0.5 + probability / 2))
        return {name: (mean - half * std, mean + half * std) for name, (mean, std, _) in self.parameters().items()}
