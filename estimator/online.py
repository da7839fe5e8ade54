"""`OnlineEstimator`: a posterior over a model's coefficients, updated sample by sample."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.inference.filter import Filter
from estimator.inference.noise_grid import NoiseGridSize, NoiseRatio
from estimator.inference.record_arrays import finite_channels, sample_of_channels
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.priors import recorded_prior, silverbox_prior
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import rig_prior
from estimator.settings import EstimatorSettings, checked_settings
from estimator.support.array_types import FloatArray
from estimator.support.progress import show_progress
from estimator.support.update_options import DEFAULT_ITERATIONS

#: Samples between two reports of progress.
_SAMPLES_BETWEEN_REPORTS = 5_000


class OnlineEstimator:
    """Online identification of any model by free energy minimisation.

    Recorded u and y are paired by array index: ``update(u_t, y_t)`` takes the two values of sample t, and the rig says
    which inputs act on y_t, and how. The prior is the belief one sample before the first.

    Args:
        model: `difference`, `duffing`, or any other `Model` with time in samples. The default is the prior's, or
            `difference`, the paper's difference equation, without a prior.
        prior: a `Belief` of the model before the first sample. The default is `silverbox_prior` for the paper's model
            and `recorded_prior` for other difference equations and for `duffing`; other models need a prior.
        rig: timing and interpolation of the inputs, or the name of a rig file. The default is a linear input between
            samples, or delay 1 for a difference equation. A rig with a guess sets model and prior,
            ``noise_hypotheses`` to (7, 7) and ``expectations`` to ``sigma_points``, since its prior is wide. u, y and
            parameters are in the prior's units.
        factorisation: ``structured`` (states and coefficients jointly Gaussian) or ``mean_field`` (the paper's, for the
            paper's model).
        iterations: variational iterations per sample, 1 to 100; by default 3 structured and 10 mean field.
        as_published: mean field with the two departures of the published run, to reproduce its numbers.
        drift: random walk of the coefficients, to track a changing system: standard deviation of a coefficient's step
            per sample, as a fraction of its prior standard deviation. 0.01 forgets in several hundred samples.
        expectations: propagation of the Gaussian belief: ``first_order``, the default, by the derivative at its mean;
            ``sigma_points``, for wide beliefs, by cubature points.
        noise_hypotheses: number of ratios σ_w/σ_v, weighed by their evidence (`estimator.inference.noise_grid`),
            structured only. With 1, the default, it stays near the ratio of the priors of γ and ξ. 9 resolve it; an odd
            number includes the priors' ratio. Each ratio takes three updates per sample, at three totals. Two numbers,
            such as (5, 5), are the numbers of values of σ_w and of σ_v, a factor of 3 apart, in all combinations, for
            noises that may each be wrong: by 9 times for 5 values and 27 times for 7. Sensors keep their ratios.

    Raises:
        ValueError: naming the argument, the value and the remedy.

    Example:
        >>> import numpy as np
        >>> from estimator import OnlineEstimator, SILVERBOX_TWIN, coefficients_of, difference
        >>> theta1, theta2, theta3, eta = coefficients_of(difference(), SILVERBOX_TWIN)
        >>> rng = np.random.default_rng(0)
        >>> u = rng.uniform(-0.15, 0.15, 500)
        >>> x = np.zeros(501)  # x[-1] is 0 while it stands for the displacement before the first
        >>> for t in range(500):
        ...     x[t + 1] = theta1 * x[t] + theta2 * x[t] ** 3 + theta3 * x[t - 1]
        ...     x[t + 1] += eta * u[t] + 5e-4 * rng.standard_normal()
        >>> y = x[:500] + 5e-4 * rng.standard_normal(500)
        >>> estimator = OnlineEstimator()
        >>> free_energy = estimator.run(u, y)
        >>> mean, std = estimator.belief.coefficients()["eta"]
        >>> bool(abs(mean / eta - 1) < 0.01)
        True
    """

    def __init__(
        self,
        model: Model | None = None,
        prior: Belief | None = None,
        rig: Rig | Mapping[str, object] | str | None = None,
        *,
        factorisation: str = "structured",
        iterations: int | None = None,
        as_published: bool = False,
        drift: float = 0.0,
        expectations: str | None = None,
        noise_hypotheses: NoiseGridSize | None = None,
    ) -> None:
        rig = None if rig is None else Rig.from_any(rig)
        rig_brings_prior = rig is not None and rig.guess is not None and model is None and prior is None
        if rig_brings_prior:
            assert rig is not None
            prior = rig_prior(rig)
            model = prior.model
        if expectations is None:
            expectations = "sigma_points" if rig_brings_prior else "first_order"
        if noise_hypotheses is None:
            noise_hypotheses = (7, 7) if rig_brings_prior else 1
        if not isinstance(model, Model | None):
            raise ValueError(f"model must be a Model, but is {model!r:.60}; use difference() or duffing()")
        self.model = model or (prior.model if isinstance(prior, Belief) else difference())
        if iterations is None:
            iterations = DEFAULT_ITERATIONS["mean_field" if factorisation == "mean_field" else "structured"]
        self.settings = checked_settings(
            self.model,
            EstimatorSettings(factorisation, iterations, as_published, expectations, drift, noise_hypotheses),
        )
        self._free_energies = np.full((1, self.settings.iterations), np.nan)
        self._forecasts = np.empty((0, self.model.n_outputs, 2))
        self._spare_buffers = np.empty_like(self._free_energies), np.empty((1, self.model.n_outputs, 2))
        prior = _checked_prior(self.model, prior, self.settings)
        if rig is None:
            rig = Rig.of_scales(self.model, prior.scales)
        rig.check_inputs_of(self.model)
        if rig.step != prior.step:
            raise ValueError(
                f"rig.step must be the prior's, {prior.step}, but is {rig.step}; make the prior with "
                "scales=rig.scales, or give the rig the prior's step"
            )
        self.rig, self.scales = rig, prior.scales
        self._input_scales = prior.scales.input_scales(self.model.n_inputs)
        self._is_scalar = self.model.n_inputs == self.model.n_outputs == 1
        self._filter = Filter(prior, rig, self.settings)

    @property
    def belief(self) -> Belief:
        """The posterior after the last sample."""
        return self._filter.belief

    @property
    def free_energy(self) -> float:
        """Free energy of the last sample after its last iteration [nats]; NaN before the first sample."""
        return float(self._free_energies[-1, -1])

    @property
    def free_energies(self) -> FloatArray:
        """(iterations,) free energy of the last sample after each iteration [nats]."""
        return self._free_energies[-1].copy()

    @property
    def forecasts(self) -> FloatArray:
        """(T, 2) predictive mean and variance of each output of the last `run`; NaN in mean field.

        (T, sensors, 2) for several sensors, each given the sensors before it of the same sample.
        """
        return self._in_rig_units(self._forecasts, self.scales.output, self.scales.output**2)

    @property
    def noise_ratio(self) -> NoiseRatio:
        """Posterior of the noise ratio over the hypotheses, which shows whether the data distinguishes γ from ξ.

        Raises:
            ValueError: if ``noise_hypotheses`` is 1.
        """
        if self.settings.noise_hypotheses == 1:
            raise ValueError("noise_hypotheses must be above 1 for noise_ratio, but is 1; pass noise_hypotheses=9")
        return self._filter.noise_ratio

    @property
    def lookahead(self) -> int:
        """Number of samples that wait for a later input: 1 if the rig looks ahead, else 0."""
        return int(self._filter.input_stencil.lookahead)

    def update(self, u: float | npt.ArrayLike | None, y: float | npt.ArrayLike) -> None:
        """Update the posterior with the sample (u, y).

        Args:
            u: the input, or (inputs,) several in the model's order; None for a model without inputs.
            y: the output, or (sensors,) several.

        Raises:
            ValueError: if u or y is not a finite number, or the belief overflows. The estimator is then unchanged.
        """
        if self._filter.input_stencil.needs_whole_record:
            raise ValueError("interpolation must not be 'spline' for single samples; use run() or 'look_ahead'")
        if not self._is_scalar:
            inputs = sample_of_channels("u", u, self.model.n_inputs)
            self.run(inputs, sample_of_channels("y", y, self.model.n_outputs))
            return
        # Two finite floats need no further check: this is the inner loop of a user with single samples.
        if not (isinstance(u, float) and isinstance(y, float) and math.isfinite(u + y)):
            u, y = (float(sample_of_channels(name, value, 1)[0]) for name, value in (("u", u), ("y", y)))
        u, y = u / self.scales.input, y / self.scales.output
        used = not self._filter.is_waiting
        free_energies, forecasts = self._spare_buffers
        if self._filter.step(u, y, free_energies, forecasts) >= 0:
            raise ValueError(_overflow_message(0, u * self.scales.input, y * self.scales.output))
        if not used:
            self._forecasts = forecasts[:0]
        else:
            # The buffers of the sample before are reused, once this sample has succeeded.
            previous = self._free_energies, self._forecasts
            self._free_energies, self._forecasts = free_energies, forecasts
            fits = len(previous[0]) == 1 and len(previous[1]) == 1
            self._spare_buffers = previous if fits else (np.empty_like(free_energies), np.empty_like(forecasts))

    def run(
        self, u: npt.ArrayLike | None, y: npt.ArrayLike, progress: bool = False, missing: bool = False
    ) -> FloatArray:
        """Update the posterior with T samples, in order, as `update` does with each.

        Args:
            u: (T,) inputs; (T, inputs) of several, in the model's order; (T, 0) or None for a model without inputs.
            y: (T,) outputs, paired with u by index; (T, sensors) of several sensors.
            progress: show the progress on stderr, if it takes more than 5 seconds.
            missing: outputs that are NaN are missing: the state is predicted, and nothing is updated.

        Returns:
            Free energy (T, iterations) of each sample after each iteration [nats]. With a rig that looks ahead the rows
            begin with the stored sample, if there is one, and the last sample is stored.

        Raises:
            ValueError: as `update`; the estimator is then unchanged.
        """
        if missing and self.settings.factorisation == "mean_field":
            raise ValueError("missing must be False in mean field, which takes all outputs; use structured")
        u, outputs = self._checked_record(u, y, missing)
        free_energies = np.empty((len(u), self.settings.iterations))
        forecasts = np.empty((len(u), self.model.n_outputs, 2))
        if not len(u):
            return free_energies
        memory, used = self._filter.copy(), 0
        for start, stop in self._progress_ranges(len(u), progress):
            new = stop - start - int(memory.is_waiting)
            overflowed_at = memory.run(u[start:stop], outputs[start:stop], free_energies[used:], forecasts[used:])
            if overflowed_at >= 0:
                place = start + overflowed_at
                output = (outputs[place] * self.scales.output).tolist()
                raise ValueError(_overflow_message(place, (u[place] * self._input_scales).tolist(), output))
            used += new
        self._filter = memory
        self._forecasts = forecasts[:used]
        if used:
            self._free_energies = free_energies[used - 1 : used].copy()
        return free_energies[:used]

    def rewind(self) -> None:
        """Reset the state and the inputs, and keep coefficients and noises: for another record or pass."""
        self._filter.rewind()

    def arrays(self) -> dict[str, FloatArray]:
        """The complete state of the estimator, by name, copied; `estimator.save_estimator` writes it to a file."""
        return self._filter.arrays()

    def restore(self, arrays: Mapping[str, npt.ArrayLike]) -> None:
        """Set the state to the `arrays` of another estimator with the same settings.

        Raises:
            ValueError: naming the array, if it is missing, unknown or impossible. The estimator is then unchanged.
        """
        self._filter.restore(arrays)

    def predict(self, u: npt.ArrayLike | None, y: npt.ArrayLike) -> FloatArray:
        """One-step predictions with the coefficients and noises fixed at their means.

        Args:
            u: the inputs, as `run` takes them.
            y: (T,) or (T, sensors) outputs, paired with u by index; T >= 2.

        Returns:
            Predictions in the shape of y, by a filter along the record. The paper's model predicts from the last two
            measured outputs, as in the paper, and its first two predictions repeat y.
        """
        u, outputs = self._checked_record(u, y, False, min_length=2)
        return self._in_rig_units(self._filter.predict(u, outputs), self.scales.output)

    def forecast(self, u: npt.ArrayLike | None, y: npt.ArrayLike) -> FloatArray:
        """Predictive mean and variance of each output, with the coefficients and noises fixed at their means.

        Args:
            u: the inputs, as `run` takes them.
            y: (T,) or (T, sensors) outputs, paired with u by index; NaN where one is missing.

        Returns:
            (T, 2) or (T, sensors, 2).
        """
        u, outputs = self._checked_record(u, y, True)
        return self._in_rig_units(
            self._filter.with_known_parameters().forecast(u, outputs), self.scales.output, self.scales.output**2
        )

    def simulate(self, u: npt.ArrayLike, y_init: npt.ArrayLike) -> FloatArray:
        """Free run with the coefficients fixed at their means, over all of u.

        Args:
            u: (T,) inputs; (T, inputs) of several; (T, 0) for a model without inputs.
            y_init: 2 to T first outputs. The run starts from the last two in the paper's model, else from a filter.

        Returns:
            Simulated outputs (T,) or (T, sensors); inf or NaN after the model diverges.
        """
        u = finite_channels("u", u, self.model.n_inputs, "input") / self._input_scales
        outputs = finite_channels("y_init", y_init, self.model.n_outputs, "sensor") / self.scales.output
        if not 2 <= len(outputs) <= len(u):
            raise ValueError(f"y_init must hold between 2 and len(u) = {len(u)} outputs, but holds {len(outputs)}")
        return self._in_rig_units(self._filter.simulate(u, outputs), self.scales.output)

    def _checked_record(
        self, u: npt.ArrayLike | None, y: npt.ArrayLike, missing: bool, min_length: int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """Inputs (T, inputs) and outputs (T, sensors), checked."""
        if u is None and not self.model.inputs:
            u = np.empty((*np.shape(y)[:1], 0))
        inputs = finite_channels("u", u, self.model.n_inputs, "input")
        outputs = finite_channels("y", y, self.model.n_outputs, "sensor", missing)
        if len(inputs) != len(outputs) or len(inputs) < min_length:
            minimum = f" of at least {min_length}" if min_length else ""
            raise ValueError(
                f"u and y must have one length{minimum}, but have {len(inputs)} and {len(outputs)}; cut the longer one"
            )
        return inputs / self._input_scales, outputs / self.scales.output

    def _in_rig_units(self, values: FloatArray, *scales: float) -> FloatArray:
        """Results of the filter (T, sensors, ...) in the rig's units; (T, ...) of one sensor."""
        return (values[:, 0] if self.model.n_outputs == 1 else values) * np.array(scales)

    def _progress_ranges(self, samples: int, progress: bool) -> Iterator[tuple[int, int]]:
        """Ranges that cover all samples: one without progress, else many, with a report before each."""
        if not progress or self._filter.input_stencil.needs_whole_record:
            yield 0, samples
            return
        with show_progress("Identifying") as report:
            for start in range(0, samples, _SAMPLES_BETWEEN_REPORTS):
                report(start / samples)
                yield start, min(start + _SAMPLES_BETWEEN_REPORTS, samples)


def _overflow_message(place: int, u: object, y: object) -> str:
    return (
        f"u and y must keep the belief finite, but near sample {place} (u = {u}, y = {y}) it overflowed; check the "
        f"sample's scale, or use a prior nearer to the system (the estimator is unchanged)"
    )


def _checked_prior(model: Model, prior: Belief | None, settings: EstimatorSettings) -> Belief:
    """The given or the model's default prior, in the factorisation of the settings."""
    if prior is None:
        if model.name not in ("difference", "duffing"):
            raise ValueError(f"prior must be given for {model.name}; make one with estimator.priors.weak_prior")
        prior = silverbox_prior(model) if model == difference() else recorded_prior(model)
    if not isinstance(prior, Belief) or prior.model != model:
        raise ValueError(
            f"prior must be a Belief of {model.name} {tuple(model.coefficients)}, but is {prior!r:.50}; see weak_prior"
        )
    return prior.with_factorisation(settings.factorisation)
