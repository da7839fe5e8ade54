"""`OnlineEstimator`: a posterior over the oscillator's coefficients, updated sample by sample."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief, Prior
from estimator.inference import DEFAULT_ITERATIONS, update
from estimator.lanes import LANES, kernel
from estimator.models.nlarx import NLARX
from estimator.parameters import FloatArray
from estimator.record import LAYOUT, N_ROWS, RECORD_SIZE

_U = LAYOUT["u"]
_Y = LAYOUT["y"]
_SAMPLES_BETWEEN_REPORTS = 5_000


class OnlineEstimator:
    """Online identification of an oscillator by free energy minimisation.

    Recorded u and y are paired by array index: ``update(u_t, y_t)`` takes the two values of sample t, and the model's
    ``input_delay`` says which input acts on y_t. An environment, which knows that its u_t leads to y_{t+1}, pairs
    those two; feed such pairs to a model with ``input_delay=0``.

    Args:
        model: the model, `NLARX`.
        prior: belief before the first sample; `Prior.silverbox_twin` where it is not given.
        factorisation: ``structured`` (states and coefficients jointly Gaussian) or ``mean_field`` (the paper's).
        iterations: variational iterations per sample; 3 structured, 10 mean field where it is not given.
        as_published: mean field with the two departures of the published run, to reproduce its numbers.

    Raises:
        ValueError: naming the argument, the value and the remedy.

    Example:
        >>> import numpy as np
        >>> from estimator import OnlineEstimator, PhysicalParameters, SILVERBOX_TWIN, to_coefficients
        >>> truth = to_coefficients(SILVERBOX_TWIN)
        >>> rng = np.random.default_rng(0)
        >>> u = rng.uniform(-0.15, 0.15, 500)
        >>> x = np.zeros(501)
        >>> for t in range(1, 500):
        ...     x[t + 1] = truth.theta1 * x[t] + truth.theta2 * x[t] ** 3 + truth.theta3 * x[t - 1]
        ...     x[t + 1] += truth.eta * u[t] + 5e-4 * rng.standard_normal()
        >>> y = x[:500] + 5e-4 * rng.standard_normal(500)
        >>> estimator = OnlineEstimator()
        >>> free_energy = estimator.run(u, y)
        >>> bool(abs(estimator.belief.eta_mean / truth.eta - 1) < 0.01)
        True
    """

    def __init__(
        self,
        model: NLARX | None = None,
        prior: Prior | None = None,
        factorisation: str = "structured",
        iterations: int | None = None,
        as_published: bool = False,
    ) -> None:
        if factorisation not in DEFAULT_ITERATIONS:
            raise ValueError(f"factorisation must be one of {list(DEFAULT_ITERATIONS)}, but is {factorisation!r}")
        if iterations is None:
            iterations = DEFAULT_ITERATIONS[factorisation]
        if not isinstance(iterations, int | np.integer) or iterations < 1:
            raise ValueError(f"iterations must be a whole number of at least 1, but is {iterations!r}")
        if as_published and factorisation != "mean_field":
            raise ValueError(
                f"as_published goes with factorisation='mean_field', but factorisation is {factorisation!r}; "
                f"the published run was mean field"
            )
        self.model = model if model is not None else NLARX()
        self.prior = prior if prior is not None else Prior.silverbox_twin()
        self.factorisation = factorisation
        self.iterations = int(iterations)
        self.as_published = as_published
        self._last_input = 0.0
        self._free_energies = np.full(self.iterations, np.nan)
        record = self.prior.to_record(factorisation=factorisation, nonlinear=self.model.nonlinear)
        self._block = np.zeros((N_ROWS, LANES))
        self._block[:RECORD_SIZE] = record[:, None]

    @property
    def belief(self) -> Belief:
        """The posterior after the last sample."""
        return Belief(self._block[:RECORD_SIZE, 0], self.factorisation, self.model.nonlinear)

    @property
    def free_energy(self) -> float:
        """Free energy of the last sample after its last iteration [nats]; NaN before the first sample."""
        return float(self._free_energies[-1])

    @property
    def free_energies(self) -> FloatArray:
        """(iterations,) free energy of the last sample after each iteration [nats]."""
        return self._free_energies.copy()

    def update(self, u: float, y: float) -> None:
        """Update the posterior with the sample (u, y), both in volts.

        Raises:
            ValueError: if u or y is not a finite number, or drives the belief out of the range of floating-point
                numbers. The estimator is then as it was before.
        """
        self.run(np.array([_scalar("u", u)]), np.array([_scalar("y", y)]))

    def run(self, u: npt.ArrayLike, y: npt.ArrayLike, progress: bool = False) -> FloatArray:
        """Update the posterior with T samples, in order. The same as `update` with each of them.

        Args:
            u: (T,) inputs [V].
            y: (T,) outputs [V], paired with u by index.
            progress: show a progress bar.

        Returns:
            Free energy (T, iterations) of each sample after each iteration [nats].

        Raises:
            ValueError: as `update`; the estimator is then as it was before the first of the samples.
        """
        u, y = _series("u", u), _series("y", y)
        if u.shape != y.shape:
            raise ValueError(f"u and y must have one length, but have {len(u)} and {len(y)}; cut the longer one")
        if not len(u):
            return np.empty((0, self.iterations))
        acting = u
        if self.model.input_delay:
            acting = np.concatenate(([self._last_input], u[:-1]))
        block = self._block.copy()
        free_energies = np.empty((len(u), self.iterations))
        for start, stop in _chunks(len(u), progress):
            _run(
                block.reshape(-1),
                acting[start:stop],
                y[start:stop],
                self.factorisation == "structured",
                self.as_published,
                free_energies[start:stop],
            )
        if not np.isfinite(block[:RECORD_SIZE, 0]).all():
            bad = int(np.argmin(np.isfinite(free_energies).all(axis=1)))
            raise ValueError(
                f"u and y must keep the belief finite, but near sample {bad} (u = {u[bad]}, y = {y[bad]}) it overflowed; "
                f"the estimator is unchanged: check the sample's scale (volts), or use a prior nearer to the system"
            )
        self._block = block
        self._last_input = float(u[-1])
        self._free_energies = free_energies[-1]
        return free_energies

    def predict(self, u: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """One-step predictions at the posterior means: each output from the two measured before it.

        Args:
            u: (T,) inputs [V].
            y: (T,) outputs [V], paired with u by index; T >= 2.

        Returns:
            Predictions (T,) [V]; the first two entries repeat y.
        """
        u, y = _series("u", u), _series("y", y)
        if u.shape != y.shape or len(y) < 2:
            raise ValueError(f"u and y must have one length of at least 2, but have {len(u)} and {len(y)}")
        return self.model.predict(self.belief.coefficients_mean, u, y)

    def simulate(self, u: npt.ArrayLike, y_init: npt.ArrayLike) -> FloatArray:
        """Free run at the posterior means over all of u: each output from the two simulated before it.

        Args:
            u: (T,) inputs [V].
            y_init: the first outputs, which are given and start the run; between 2 and T of them [V].

        Returns:
            Simulated outputs (T,) [V]; inf or NaN from where the model diverges.
        """
        u, y_init = _series("u", u), _series("y_init", y_init)
        if not 2 <= len(y_init) <= len(u):
            raise ValueError(f"y_init must hold between 2 and len(u) = {len(u)} outputs, but holds {len(y_init)}")
        return self.model.simulate(self.belief.coefficients_mean, u, y_init)


@kernel
def _run(W, u, y, is_structured, as_published, free_energies):
    """Update lane 0 with every sample. The other lanes do the same work, so that none of them runs wild."""
    for t in range(len(u)):
        for j in range(LANES):
            W[_U * LANES + j] = u[t]
            W[_Y * LANES + j] = y[t]
        update(W, is_structured, free_energies.shape[1], as_published, free_energies[t])


def _chunks(samples: int, progress: bool):
    """Ranges that cover all samples; one range without progress, else many with a bar that counts them."""
    if not progress:
        yield 0, samples
        return
    from rich.progress import track

    starts = range(0, samples, _SAMPLES_BETWEEN_REPORTS)
    for start in track(starts, description="Identifying"):
        yield start, min(start + _SAMPLES_BETWEEN_REPORTS, samples)


def _scalar(name: str, value: float) -> float:
    number = np.asarray(value, dtype=np.float64)
    if number.size != 1:
        raise ValueError(f"{name} must be one number, but has shape {number.shape}; use run() for many samples")
    return float(number.reshape(()))


def _series(name: str, values: npt.ArrayLike) -> FloatArray:
    """A contiguous finite series (T,)."""
    series = np.ascontiguousarray(values, dtype=np.float64)
    if series.ndim != 1:
        raise ValueError(f"{name} must have shape (T,), but has {series.shape}; pass one channel, e.g. {name}.ravel()")
    finite = np.isfinite(series)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise ValueError(f"{name} must be finite, but {name}[{bad}] is {series[bad]}; remove or interpolate the sample")
    return series
