"""`OnlineEstimator`: a posterior over the oscillator's coefficients, updated sample by sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.checks import scalar, series
from estimator.ensemble import EnsembleFilter, Member, NoiseRatio
from estimator.filters import Filter, NLARXFilter
from estimator.gaussian import JointBelief
from estimator.inference import DEFAULT_ITERATIONS
from estimator.joint_filters import EXPECTATIONS, ODEFilter, RegressorFilter
from estimator.models.nlarx import NLARX
from estimator.models.ode import DuffingODE
from estimator.parameters import FloatArray
from estimator.prior import Prior

_SAMPLES_BETWEEN_REPORTS = 5_000
_AS_TERMS = "pass them as terms, regressors=PRESETS['paper'], for an estimator that can"


class OnlineEstimator:
    """Online identification of an oscillator by free energy minimisation.

    Recorded u and y are paired by array index: ``update(u_t, y_t)`` takes the two values of sample t, and the model's
    ``input_delay`` says which input acts on y_t. An environment, which knows that its u_t leads to y_{t+1}, pairs
    those two; feed such pairs to a model with ``input_delay=0``.

    Args:
        model: `NLARX`, the paper's difference equation, where it is not given; or `DuffingODE`, the physical one.
        prior: belief before the first sample. A `Prior` for `NLARX`, `Prior.silverbox_twin()` where it is not given;
            a `JointBelief` for `DuffingODE` and for `NLARX` with other regressors, whose method `prior` makes the one
            that is used where it is not given.
        factorisation: ``structured`` (states and coefficients jointly Gaussian) or ``mean_field`` (the paper's).
        iterations: variational iterations per sample; 3 structured, 10 mean field where it is not given.
        as_published: mean field with the two departures of the published run, to reproduce its numbers.
        drift: lets the coefficients walk at random, to follow a system that changes: standard deviation of a
            coefficient's step per sample, in parts of that of its prior. 0.01 forgets in some hundred samples.
        expectations: what a step does to a `JointBelief`: ``first_order``, by the derivative at its mean; or
            ``sigma_points``, by points that spread as the belief does, for beliefs that are wide.
        noise_hypotheses: number of ratios σ_w/σ_v to weigh by their evidence (`estimator.ensemble`), structured only.
            With 1 the ratio stays nearly what the priors of γ and ξ say. 9 resolve it; an odd number has the priors'
            own ratio among them. Each is there at three levels, so that a sample costs three updates a hypothesis.

    Raises:
        ValueError: naming the argument, the value and the remedy.

    Example:
        >>> import numpy as np
        >>> from estimator import OnlineEstimator, PhysicalParameters, SILVERBOX_TWIN, to_coefficients
        >>> truth = to_coefficients(SILVERBOX_TWIN)
        >>> rng = np.random.default_rng(0)
        >>> u = rng.uniform(-0.15, 0.15, 500)
        >>> x = np.zeros(501)  # x[-1] is 0 while it stands for the displacement before the first
        >>> for t in range(500):
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
        model: NLARX | DuffingODE | None = None,
        prior: Prior | JointBelief | None = None,
        factorisation: str = "structured",
        iterations: int | None = None,
        as_published: bool = False,
        drift: float = 0.0,
        expectations: str = "first_order",
        noise_hypotheses: int = 1,
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
        self.factorisation = factorisation
        self.iterations = int(iterations)
        self.as_published = as_published
        self.drift = float(drift)
        if not 0 <= self.drift < np.inf:
            raise ValueError(f"drift must be at least 0 and finite, but is {drift!r}; 0 is a system that stays")
        if self.drift and factorisation == "mean_field":
            raise ValueError(f"drift must be 0 in mean field, which cannot follow, but is {drift!r}; use structured")
        if expectations not in EXPECTATIONS:
            raise ValueError(f"expectations must be one of {list(EXPECTATIONS)}, but is {expectations!r}")
        self.expectations = expectations
        if not isinstance(noise_hypotheses, int | np.integer) or noise_hypotheses < 1:
            raise ValueError(f"noise_hypotheses must be a whole number of at least 1, but is {noise_hypotheses!r}")
        if noise_hypotheses > 1 and factorisation != "structured":
            raise ValueError(
                f"noise_hypotheses must be 1 for factorisation={factorisation!r}, but is {noise_hypotheses}; use "
                f"factorisation='structured'"
            )
        self.noise_hypotheses = int(noise_hypotheses)
        single = self._make_filter(prior)
        self._filter: Filter = single if noise_hypotheses == 1 else EnsembleFilter(single, self.noise_hypotheses)
        self._free_energies = np.full(self.iterations, np.nan)
        self._forecasts = np.empty((0, 2))

    def _make_filter(self, prior: Prior | JointBelief | None) -> Member:
        if isinstance(self.model, DuffingODE) or not self.model.is_paper:
            if self.factorisation != "structured":
                raise ValueError(
                    f"factorisation must be 'structured' for {self.model}, but is {self.factorisation!r}; mean field "
                    f"is for the paper's regressors"
                )
            own = self.model.prior()
            prior = prior if prior is not None else own
            if not isinstance(prior, JointBelief) or (prior.names, len(prior.mean)) != (own.names, len(own.mean)):
                raise ValueError(f"prior must have the parameters {own.names}, but is {prior!r:.60}; use model.prior()")
            if isinstance(self.model, DuffingODE):
                return ODEFilter(self.model, prior, self.drift, self.expectations)
            return RegressorFilter(self.model, prior, self.drift, self.expectations)
        if self.expectations != "first_order":
            raise ValueError(
                f"expectations must be 'first_order' for regressors='paper', but is {self.expectations!r}; {_AS_TERMS}"
            )
        prior = prior if prior is not None else Prior.silverbox_twin()
        if not isinstance(prior, Prior):
            raise ValueError(f"prior must be a Prior for NLARX, but is {prior!r:.60}; use Prior.silverbox_twin(...)")
        return NLARXFilter(self.model, prior, self.factorisation, self.as_published, self.drift)

    @property
    def belief(self) -> Belief | JointBelief:
        """The posterior after the last sample: `Belief` with the paper's regressors, else `JointBelief`."""
        return self._filter.belief

    @property
    def free_energy(self) -> float:
        """Free energy of the last sample after its last iteration [nats]; NaN before the first sample."""
        return float(self._free_energies[-1])

    @property
    def free_energies(self) -> FloatArray:
        """(iterations,) free energy of the last sample after each iteration [nats]."""
        return self._free_energies.copy()

    @property
    def forecasts(self) -> FloatArray:
        """(T, 2) mean [V] and variance [V²] of each output of the last `run` before it was seen; NaN in mean field."""
        return self._forecasts.copy()

    @property
    def noise_ratio(self) -> NoiseRatio:
        """Posterior of the noises' ratio over the hypotheses, which says whether the data tells γ from ξ.

        Raises:
            ValueError: if ``noise_hypotheses`` is 1.
        """
        if not isinstance(self._filter, EnsembleFilter):
            raise ValueError("noise_hypotheses must be above 1 for noise_ratio, but is 1; pass noise_hypotheses=9")
        return self._filter.noise_ratio

    def update(self, u: float, y: float) -> None:
        """Update the posterior with the sample (u, y), both in volts.

        Raises:
            ValueError: if u or y is not a finite number, or drives the belief out of the range of floating-point
                numbers. The estimator is then as it was before.
        """
        if self.model.needs_all_inputs:
            raise ValueError("interpolation must not be 'spline' for single samples; use run() or 'look_ahead'")
        self.run(np.array([scalar("u", u)]), np.array([scalar("y", y)]))

    def run(self, u: npt.ArrayLike, y: npt.ArrayLike, progress: bool = False, missing: bool = False) -> FloatArray:
        """Update the posterior with T samples, in order. The same as `update` with each of them.

        Args:
            u: (T,) inputs [V].
            y: (T,) outputs [V], paired with u by index.
            progress: show a progress bar.
            missing: outputs that are NaN are missing: the state moves on, nothing is learned from them.

        Returns:
            Free energy (T, iterations) of each sample after each iteration [nats]. A model that looks ahead uses a
            sample when the next input is known: then the rows begin with the sample that waited, if there was one.

        Raises:
            ValueError: as `update`; the estimator is then as it was before the first of the samples.
        """
        u, y = series("u", u), series("y", y, missing)
        if missing and isinstance(self.model, NLARX) and self.model.is_paper:
            raise ValueError(f"missing must be False for regressors='paper'; {_AS_TERMS}")
        if u.shape != y.shape:
            raise ValueError(f"u and y must have one length, but have {len(u)} and {len(y)}; cut the longer one")
        if not len(u):
            return np.empty((0, self.iterations))
        memory = self._filter.copy()
        free_energies = np.empty((len(u), self.iterations))
        forecasts = np.empty((len(u), 2))
        used = 0
        for start, stop in self._chunks(len(u), progress):
            used += memory.run(u[start:stop], y[start:stop], free_energies[used:], forecasts[used:])
        free_energies, forecasts = free_energies[:used], forecasts[:used]
        finite = np.asarray(np.isfinite(free_energies).all(axis=1))
        if used:
            finite[-1] &= memory.is_finite
        if not finite.all():
            bad = int(np.argmin(finite))
            raise ValueError(
                f"u and y must keep the belief finite, but near sample {bad} (u = {u[bad]}, y = {y[bad]}) it "
                f"overflowed; the estimator is unchanged: check the sample's scale (volts), or use a prior nearer to "
                f"the system"
            )
        self._filter = memory
        self._forecasts = forecasts
        if used:
            self._free_energies = free_energies[-1].copy()
        return free_energies

    def rewind(self) -> None:
        """Forget where the oscillator is and what drove it, keep what is known about it: for another record or pass."""
        self._filter.rewind()

    def arrays(self) -> dict[str, FloatArray]:
        """Everything that the future depends on, by name; `estimator.save_estimator` writes it to a file."""
        return self._filter.arrays()

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Become what `arrays` said of another estimator with the same settings."""
        self._filter.restore(arrays)

    def predict(self, u: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """One-step predictions at the posterior means: each output from those measured before it.

        Args:
            u: (T,) inputs [V].
            y: (T,) outputs [V], paired with u by index; T >= 2.

        Returns:
            Predictions (T,) [V]; those of an `NLARX` are from the last two outputs, and the first two repeat y.
        """
        u, y = series("u", u), series("y", y)
        if u.shape != y.shape or len(y) < 2:
            raise ValueError(f"u and y must have one length of at least 2, but have {len(u)} and {len(y)}")
        return self._filter.predict(u, y)

    def simulate(self, u: npt.ArrayLike, y_init: npt.ArrayLike) -> FloatArray:
        """Free run at the posterior means over all of u.

        Args:
            u: (T,) inputs [V].
            y_init: the first outputs, which are given and start the run; between 2 and T of them [V].

        Returns:
            Simulated outputs (T,) [V]; inf or NaN from where the model diverges.
        """
        u, y_init = series("u", u), series("y_init", y_init)
        if not 2 <= len(y_init) <= len(u):
            raise ValueError(f"y_init must hold between 2 and len(u) = {len(u)} outputs, but holds {len(y_init)}")
        return self._filter.simulate(u, y_init)

    def _chunks(self, samples: int, progress: bool) -> Iterator[tuple[int, int]]:
        """Ranges that cover all samples; one range without progress, else many with a bar that counts them."""
        if not progress or self.model.needs_all_inputs:
            yield 0, samples
            return
        from rich.progress import track

        for start in track(range(0, samples, _SAMPLES_BETWEEN_REPORTS), description="Identifying"):
            yield start, min(start + _SAMPLES_BETWEEN_REPORTS, samples)
