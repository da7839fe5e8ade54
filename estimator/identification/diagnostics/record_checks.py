"""Checks of the recorded signals: outliers, clipping, dropouts, limits, sampling rate and short impacts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.identification.data.record import Record
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig

#: Smallest deviation of a gross outlier, in 99 % quantiles of the deviations.
_OUTLIER_TO_QUANTILE = 10.0

#: The same in deviations of its two neighbours.
_OUTLIER_TO_NEIGHBOURS = 5.0

#: An input is at rest below this fraction of its largest value.
_RESTING_INPUT_FRACTION = 0.02

#: Impacts act during less than this fraction of the samples.
_MAX_IMPACT_DUTY = 0.1

#: Samples in an impact up to which its impulse is uncertain.
_MAX_IMPACT_SAMPLES = 5

#: Samples in an impact that the message recommends.
_SUFFICIENT_IMPACT_SAMPLES = 10

#: Samples in a period below which the sampling is too slow.
MIN_SAMPLES_PER_PERIOD = 5.0

#: Samples in a period that the message recommends.
RECOMMENDED_SAMPLES_PER_PERIOD = 6


def check_records(problem: ScaledRecords, records: Sequence[Record]) -> list[CheckFinding]:
    """Findings about the recorded signals alone.

    Args:
        problem: the records, scaled.
        records: the records as they were read.
    """
    rig = problem.rig
    warnings = [*_check_outliers(rig.output, records), *_check_short_impacts(rig, records)]
    n_clipped = sum(one.n_clipped for one in records)
    if n_clipped:
        message = f"{n_clipped} outputs are clipped and count as missing; widen the range, or reduce the input"
        warnings.append(CheckFinding("clipped", message))
    warnings += _check_stale_outputs(records)
    largest_input = max(np.abs(one.u).max() for one in records)
    largest_output = max(np.nanmax(np.abs(one.y)) for one in records)
    source, sink = rig.only_input, rig.output
    if source.limit and largest_input > source.limit * (1 + 1e-6):
        message = (
            f"inputs of {largest_input:.3g} {source.unit} exceed the rig's limit of {source.limit:g} {source.unit}"
        )
        warnings.append(CheckFinding("limit", message))
    if sink.range and largest_output > sink.range * (1 + 1e-6):
        message = f"outputs of {largest_output:.3g} {sink.unit} leave the rig's range of {sink.range:g} {sink.unit}"
        warnings.append(CheckFinding("range", message))
    samples_per_period = 2 * np.pi / problem.mean_frequency
    if samples_per_period < MIN_SAMPLES_PER_PERIOD:
        message = (
            f"a period has {samples_per_period:.1f} samples; sample faster, with "
            f"{RECOMMENDED_SAMPLES_PER_PERIOD} or more"
        )
        warnings.append(CheckFinding("sampling_too_slow", message))
    return warnings


def _check_stale_outputs(records: Sequence[Record]) -> list[CheckFinding]:
    """Findings about outputs that stand still while the oscillator moves."""
    warnings = []
    bursts, count = sum(one.n_bursts for one in records), sum(one.n_stale for one in records if one.n_bursts)
    if bursts:
        message = (
            f"{count} outputs in {bursts} bursts stand still while the oscillator moves, as when a sensor loses its "
            f"signal; they count as missing"
        )
        warnings.append(CheckFinding("dropouts", message))
    repeats = max(one.samples_per_value for one in records)
    if repeats > 1:
        message = (
            f"each output is repeated {repeats} times, as when a slow sensor is sampled faster than it measures; the "
            f"first counts and the others count as missing. Sample at the sensor's own rate: its delay is unknown"
        )
        warnings.append(CheckFinding("repeated", message))
    return warnings


def _check_short_impacts(rig: Rig, records: Sequence[Record]) -> list[CheckFinding]:
    """A finding where the input is impacts of few samples, whose impulse is uncertain; not of steps that are held."""
    lengths, is_held, acting_samples = list[int](), list[bool](), 0
    largest = max(float(np.abs(one.u - np.median(one.u)).max()) for one in records)
    for one in records:
        u = one.u - np.median(one.u)
        is_acting = np.concatenate([[False], np.abs(u) > _RESTING_INPUT_FRACTION * largest, [False]])
        acting_samples += int(is_acting.sum())
        for begin, end in np.flatnonzero(is_acting[1:] != is_acting[:-1]).reshape(-1, 2):
            lengths.append(int(end - begin))
            is_held.append(
                rig.interpolation == "zero_order" and float(np.ptp(u[begin:end])) < _RESTING_INPUT_FRACTION * largest
            )
    if (
        not lengths
        or all(is_held)
        or np.median(lengths) > _MAX_IMPACT_SAMPLES
        or acting_samples > _MAX_IMPACT_DUTY * sum(len(one.u) for one in records)
    ):
        return []
    message = (
        f"the input is impacts of {np.median(lengths):.0f} samples: their impulse, and with it m, c, a and b, is known "
        "to a few percent only, and the intervals do not show it; sample faster, "
        f"{_SUFFICIENT_IMPACT_SAMPLES} times in an impact or more"
    )
    return [CheckFinding("short_blows", message)]


def _check_outliers(channel: Channel, records: Sequence[Record]) -> list[CheckFinding]:
    """A finding about single outputs far from all others, which spoil the fit that the other checks judge.

    Accelerations have none: they respond to an impulse at once.
    """
    if channel.kind == "acceleration":
        return []
    outputs = np.concatenate([one.y for one in records])
    middle = np.nanmedian(outputs)
    quantile_99 = float(np.nanquantile(np.abs(outputs - middle), 0.99))
    outliers = []
    for one in records:
        deviations = np.nan_to_num(np.abs(one.y - middle))
        neighbours = np.maximum(np.append(deviations[1:], 0.0), np.append(0.0, deviations[:-1]))
        outliers += [
            (deviations[k], k, one)
            for k in np.flatnonzero(
                deviations > np.maximum(_OUTLIER_TO_QUANTILE * quantile_99, _OUTLIER_TO_NEIGHBOURS * neighbours)
            )
        ]
    if not outliers or quantile_99 == 0:
        return []
    _, k, one = max(outliers, key=lambda place: float(place[0]))
    count = "1 output is an outlier" if len(outliers) == 1 else f"{len(outliers)} outputs are outliers"
    message = (
        f"{count}: sample {k} of {one.name} is {one.y[k]:.3g} {channel.unit}, and 99 % of the outputs are within "
        f"{quantile_99:.3g} {channel.unit} of the median; make them missing (NaN), and identify again before all else"
    )
    return [CheckFinding("outliers", message)]
