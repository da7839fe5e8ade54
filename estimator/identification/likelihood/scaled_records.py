"""`ScaledRecords`: scaled records, and their samples for the filter under a hypothesis of the input path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.identification.data.nonuniform_sampling import resample_on_knots
from estimator.identification.likelihood.problem_signals import (
    filter_input_rows,
    interpolate_gaps,
    mask_unexplained_outputs,
    shift_output_origin,
    sliding_sums,
    stack_padded,
)
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR, PARAMETER_DIMENSIONS, duffing
from estimator.models.interpolation import INTERPOLATION_DEGREES
from estimator.models.model import Model
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig
from estimator.rigs.units import Scales
from estimator.support.array_types import FloatArray

#: Samples by which the input may be later than the rig says, within the reach of a check.
MAX_UNSTATED_DELAY = 3

#: Parameters of Eq. (1); the others are offsets of the channels.
TARGET_PARAMETERS = tuple(PARAMETER_DIMENSIONS)

#: Terms beyond Eq. (1) and the offsets, for which a check tests the records.
OPTIONAL_TERMS = ("cubic_damping", "quintic", "dry_friction")

#: Speed below which dry friction fades, relative to the usual speed.
_CREEP_SPEED_FRACTION = 0.05

#: Longest gap that is bridged before the period is known [samples].
_MAX_BRIDGED_GAP = 16

#: Power of a weakly driven segment, as a fraction of the strongest, at most.
_WEAK_INPUT_POWER = 0.25

#: Power of a segment that holds the strongest inputs, as a fraction of the strongest, at least.
_STRONG_INPUT_POWER = 0.98


class Segment(NamedTuple):
    """A segment of a record.

    Attributes:
        record: number of the record.
        first_sample: first sample of the segment.
    """

    record: int
    first_sample: int


class FilterSamples(NamedTuple):
    """Records as samples of the filter; a shorter record ends with NaN.

    Attributes:
        inputs: (records, N, rows) input over each sample.
        outputs: (records, N, 1) output at its end.
        spans: (records, N) its length in sampling steps; None where all are one step.
        output_indices: per record, (T,) index of the sample that ends with each output.
    """

    inputs: FloatArray
    outputs: FloatArray
    spans: FloatArray | None
    output_indices: tuple[npt.NDArray[np.intp], ...]


@dataclass(frozen=True, eq=False)
class ScaledRecords:
    """The records of a rig, scaled, and the equation that they are fitted by.

    Attributes:
        rig: the rig of the records.
        scales: scales of the records.
        u: inputs of each record, in units of their scale.
        y: outputs of each record from the origin, in units of their scale; NaN where one is missing.
        origin: origin of the outputs, in units of their scale: near their mean, where that is far from 0.
        substeps: integration steps per sample.
        optional_terms: terms beyond Eq. (1) and the offsets, from `OPTIONAL_TERMS`.
        times: times of the samples of each record, in sampling steps from its first; None for even times.
        record_noise_scales: (records,) noises of each record relative to the noises of all; None where they are equal.
    """

    rig: Rig
    scales: Scales
    u: tuple[FloatArray, ...]
    y: tuple[FloatArray, ...]
    origin: float = 0.0
    substeps: int = 2
    optional_terms: tuple[str, ...] = ()
    times: tuple[FloatArray, ...] | None = None
    record_noise_scales: FloatArray | None = None

    @cached_property
    def model(self) -> Model:
        """The rig's model with the optional terms."""
        return _duffing_with_terms(self.rig.output.kind, self.optional_terms, self.substeps)

    @property
    def belief_model(self) -> Model:
        """The rig's model, for the belief; with the substeps of `model`, where these are more."""
        model = self.rig.model
        return replace(model, substeps=self.substeps) if self.substeps > model.substeps else model

    @property
    def n_observed_outputs(self) -> int:
        """Number of outputs that are not missing."""
        return int(sum(np.isfinite(y).sum() for y in self.y))

    @property
    def lag(self) -> float:
        """Time constant of the input's lag that the rig states, in sampling steps."""
        return (self.rig.only_input.lag or 0.0) / self.rig.step

    def noises_of_records(self, noises: FloatArray) -> FloatArray:
        """(n · records, 2) noise variances of every record, record by record, from the overall variances (n, 2)."""
        record_scales = np.ones(len(self.u)) if self.record_noise_scales is None else self.record_noise_scales
        return (noises[:, None] * record_scales[:, None] ** 2).reshape(-1, noises.shape[1])

    def filter_samples(self, interpolation: str, delay: float, lag: float = 0.0) -> FilterSamples:
        """The records as samples of the filter, under a hypothesis of the input path.

        Every sample is one step long where the times are even, the delay is an integer and there is no lag.

        Args:
            interpolation: of the input.
            delay: of the input [samples].
            lag: time constant of the input's lag [samples].
        """
        rows = 1 + max(INTERPOLATION_DEGREES[name] for name in ("linear", self.rig.interpolation, interpolation))
        if self.times is None and delay == int(delay) and not lag:
            # The first output of a record precedes the effect of its first input, for every input path.
            rig = replace(self.rig, interpolation=interpolation, delay=int(delay), input=Channel())
            inputs = stack_padded([filter_input_rows(self.model, rig, u) for u in self.u], rows)
            places = tuple(np.arange(len(y)) for y in self.y)
            return FilterSamples(inputs, stack_padded([y[:, None] for y in self.y], 1), None, places)
        laid_records = [
            resample_on_knots(times, u, y, interpolation, delay, lag)
            for times, u, y in zip(self.times_in_steps, self.u, self.y, strict=True)
        ]
        rows = max(rows, *(one.inputs.shape[1] for one in laid_records))
        spans = stack_padded([one.spans[:, None] for one in laid_records], 1)[:, :, 0]
        return FilterSamples(
            stack_padded([one.inputs for one in laid_records], rows),
            stack_padded([one.outputs[:, None] for one in laid_records], 1),
            spans,
            tuple(one.output_indices for one in laid_records),
        )

    @property
    def times_in_steps(self) -> tuple[FloatArray, ...]:
        """Times of the samples of each record, in sampling steps."""
        return self.times or tuple(np.arange(len(u), dtype=np.float64) for u in self.u)

    def resampled_evenly(self) -> ScaledRecords:
        """The same with inputs and outputs interpolated to even steps, which is enough to find a start."""
        if self.times is None:
            return self
        u, y = [], []
        for times, inputs, outputs in zip(self.times_in_steps, self.u, self.y, strict=True):
            at, seen = np.arange(int(times[-1]) + 1.0), np.isfinite(outputs)
            u.append(inputs[np.clip(np.searchsorted(times, at, side="right") - 1, 0, None)])
            y.append(np.interp(at, times[seen], outputs[seen]))
        return replace(self, u=tuple(u), y=tuple(y), times=None)

    def moments_about_origin(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments (K,) and (K, K) of the coefficients for outputs from the origin, given those for outputs from 0."""
        return shift_output_origin(self.model, mean, cov, self.origin)

    def moments_about_zero(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The inverse of `moments_about_origin`."""
        return shift_output_origin(self.model, mean, cov, -self.origin)

    def truncated(self, max_samples: int) -> ScaledRecords:
        """The same with the first ``max_samples`` samples of each record alone."""
        return self.with_segments([Segment(record, 0) for record in range(len(self.u))], max_samples)

    def with_segments(self, segments: Sequence[Segment], max_samples: int) -> ScaledRecords:
        """The same with segments in place of the records.

        Args:
            segments: the segments.
            max_samples: samples of each, at most.
        """
        u, y, times = [], [], []
        for record, first_sample in segments:
            inside = slice(first_sample, first_sample + max_samples)
            u.append(self.u[record][inside])
            y.append(
                mask_unexplained_outputs(self.y[record][inside], self.rig, MAX_UNSTATED_DELAY)
                if first_sample
                else self.y[record][inside]
            )
            times.append(self.times_in_steps[record][inside])
        evenly = None if self.times is None else tuple(one - one[0] for one in times)
        return replace(self, u=tuple(u), y=tuple(y), times=evenly)

    def most_driven_segments(self, segment_length: int) -> list[Segment]:
        """Of each record, the segment of ``segment_length`` samples that shows the effect of the input.

        This is the first, unless the input is far stronger elsewhere: then the last segment with the strongest inputs,
        from a little before them.
        """
        segments = []
        for record, (u, y) in enumerate(zip(self.u, self.y, strict=True)):
            power = sliding_sums((u - u.mean()) ** 2, segment_length) * sliding_sums(
                np.isfinite(y).astype(float), segment_length
            )
            begin = 0
            if power[0] < _WEAK_INPUT_POWER * power.max():
                begin = max(0, int(np.flatnonzero(power > _STRONG_INPUT_POWER * power.max())[-1]) - segment_length // 8)
            segments.append(Segment(record, begin))
        return segments

    def largest_output_segment(self, segment_length: int) -> Segment:
        """The segment of ``segment_length`` samples with the largest outputs of all records."""
        powers = [sliding_sums(np.nan_to_num(y) ** 2, segment_length) for y in self.y]
        record = int(np.argmax([power.max() for power in powers]))
        return Segment(record, int(powers[record].argmax()))

    @cached_property
    def is_free_decay(self) -> bool:
        """Whether no input acts; m is then undetermined, and counts as 1 in the unit of the scales."""
        return not any(u.any() for u in self.u)

    @cached_property
    def output_rms(self) -> float:
        """Root mean square of the outputs about their mean."""
        seen = np.concatenate([y[np.isfinite(y)] for y in self.y])
        return float(max(seen.std(), 1e-12))

    @cached_property
    def input_rms(self) -> float:
        """Root mean square of the inputs."""
        return float(max(np.sqrt(np.mean(np.concatenate(self.u) ** 2)), 1e-12))

    @cached_property
    def mean_frequency(self) -> float:
        """Mean angular frequency of the outputs by power [rad per sample], robust to white noise."""
        power = total = 0.0
        for y in self.resampled_evenly().y:
            whole = interpolate_gaps(y, _MAX_BRIDGED_GAP)
            whole = np.where(np.isfinite(whole), whole, np.nanmean(y))
            spectrum = np.abs(np.fft.rfft(whole - whole.mean())) ** 2
            floor = 2 * np.median(spectrum)
            spectrum = np.where(spectrum > 20 * floor, spectrum, 0.0)
            power += float(spectrum.sum())
            total += float(spectrum @ np.linspace(0, np.pi, len(spectrum)))
        return float(np.clip(total / power if power > 0 else 0.1, 2e-3, 2.5))

    @cached_property
    def displacement(self) -> float:
        """Root mean square of the scaled displacement, estimated by the mean frequency."""
        return self.output_rms / self.mean_frequency ** DERIVATIVE_ORDER_OF_SENSOR[self.rig.output.kind]

    @cached_property
    def max_state(self) -> FloatArray:
        """(2,) largest displacement and velocity of a sample, estimated by the mean frequency."""
        x = (
            max(float(np.nanmax(np.abs(y))) for y in self.y)
            / self.mean_frequency ** DERIVATIVE_ORDER_OF_SENSOR[self.rig.output.kind]
        )
        return np.array([x, x * max(self.mean_frequency, 0.1)])

    @property
    def initial_state_cov(self) -> FloatArray:
        """(2, 2) covariance of the state before a record, which may begin in any motion."""
        return np.diag((3 * self.max_state) ** 2)

    def natural_coefficient_sizes(self) -> dict[str, float]:
        """Coefficient to the size at which its term is as large as the others."""
        w, x = self.mean_frequency, self.displacement
        sizes = {
            "stiffness": w**2,
            "cubic": w**2 / x**2,
            "damping": w,
            "gain": 1.0 if self.is_free_decay else w**2 * x / self.input_rms,
        }
        sizes |= {"force": w**2 * x, "output_offset": self.output_rms}
        return sizes | {"cubic_damping": w / (w * x) ** 2, "quintic": w**2 / x**4, "friction": w**2 * x}

    def term_prior(self, term: str) -> list[tuple[float, float]]:
        """Mean and standard deviation of each coefficient that a term of `OPTIONAL_TERMS` brings."""
        if term != "dry_friction":
            return [(0.0, self.natural_coefficient_sizes()[term])]
        # The records do not determine the speed below which friction fades: it is a small part of the usual speed.
        creep = _CREEP_SPEED_FRACTION * self.mean_frequency * self.displacement
        return [(0.0, self.natural_coefficient_sizes()["friction"]), (creep, 0.01 * creep)]


@cache
def _duffing_with_terms(sensor: str, optional_terms: tuple[str, ...], substeps: int) -> Model:
    """Eq. (1) with offsets and optional terms; cached, because the search makes problems by the dozen."""
    terms = {name: name in optional_terms for name in OPTIONAL_TERMS}
    model = duffing(
        offsets=True,
        sensor=sensor,
        cubic_damping=terms["cubic_damping"],
        quintic=terms["quintic"],
        dry_friction=terms["dry_friction"],
    )
    return replace(model, substeps=substeps)
