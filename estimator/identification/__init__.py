"""System identification of a Duffing oscillator from recorded inputs and outputs: `identify`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from estimator.identification.data.record import Record
from estimator.identification.data.record_reader import read_records
from estimator.identification.diagnostics.validity_checks import run_all_checks
from estimator.identification.fitting.multistart_search import search_coefficients, spread_along_ridge
from estimator.identification.fitting.posterior_belief import contraction_history, one_step_forecasts, posterior_belief
from estimator.identification.identification_result import Result, parameter_moments
from estimator.identification.likelihood.problem_signals import mask_unexplained_outputs
from estimator.identification.likelihood.scaled_records import MAX_UNSTATED_DELAY, TARGET_PARAMETERS, ScaledRecords
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.rigs.rig import Rig
from estimator.rigs.units import Scales
from estimator.support.array_types import FloatArray
from estimator.support.progress import ignore_progress, show_progress


def identify(rig: Rig | Mapping[str, Any] | str | Path, records: Any, progress: bool = False) -> Result:
    """Identify m, c, a and b of Eq. (1), with offsets and noises, from records.

    The coefficients are the most probable ones under the Kalman filter's likelihood of all records, with a Gaussian
    about them (variational Laplace: `estimator.identification.likelihood.laplace_fit`). The two noises are unknown:
    a grid of their ratios, each at its best level, is weighted by the free energies and refined. Without a guess in
    the rig the search starts from the weak form of the equation (`estimator.identification.fitting.weak_form`), and
    where this fails, from random coefficients with a fixed seed.

    Args:
        rig: a `Rig`, a dictionary, or the name of a rig file.
        records: one or a list of pairs (u, y) of arrays (T,) in the rig's units, paired by index, or of names of CSV
            or MAT files. A record may begin in any motion. Its first outputs are left out, because inputs before the
            record may still act: three, the delay of the input, and one more of an accelerometer. An output that is
            NaN is missing; a record is cut where an input is NaN.
        progress: print the progress on stderr, if it takes more than 5 seconds.

    Without a varying input, or without a column of inputs, the record is a free decay: it identifies c/m, a/m and b/m.

    Returns:
        Parameters with intervals, warnings of the checks, forecasts, and the posterior belief.

    Raises:
        ValueError: naming the rig's key or the record (and the line of its file), the value and the remedy.
        FileNotFoundError: for a file that does not exist.

    Example:
        >>> import numpy as np
        >>> from estimator import Channel, Rig, identify
        >>> rng = np.random.default_rng(0)
        >>> u = 6.0 * np.repeat(rng.choice([-1.0, 1.0], 128), 8)  # N, held by the amplifier
        >>> y, v = np.zeros(1024), 0.0  # m: a mass of 0.4 kg on a hardening spring, by explicit steps
        >>> for k in range(1023):
        ...     x = y[k]
        ...     for _ in range(100):
        ...         v += 1e-5 / 0.4 * (u[k] - 0.6 * v - 2500.0 * x - 4e7 * x**3)
        ...         x += 1e-5 * v
        ...     y[k + 1] = x
        >>> rig = Rig(step=1e-3, input=Channel("N"), output=Channel("m"))
        >>> result = identify(rig, (u, y + 5e-6 * rng.standard_normal(1024)))
        >>> m, std = result.parameters["m"]
        >>> bool(abs(m - 0.4) < 0.004), result.units["m"]
        (True, 'kg')
    """
    rig = Rig.from_any(rig)
    parsed_records = read_records(records, rig)
    is_free = not any(one.u.any() for one in parsed_records)
    rig = replace(rig, guess=None) if is_free else rig
    with show_progress("Identifying") if progress else nullcontext(ignore_progress) as on_progress:
        scales = _choose_scales(rig, parsed_records)
        u = tuple(one.u / scales.input for one in parsed_records)
        y = tuple(mask_unexplained_outputs(one.y, rig, MAX_UNSTATED_DELAY) / scales.output for one in parsed_records)
        origin = _output_origin(rig, y)
        times = (
            None
            if all(one.times is None for one in parsed_records)
            else tuple(one.times_in_steps(rig.step) for one in parsed_records)
        )
        search_result = search_coefficients(
            ScaledRecords(rig, scales, u, tuple(one - origin for one in y), origin, times=times), on_progress
        )
        problem = search_result.fitter.problem
        # Forecasts and comparisons of equations use the most probable point of a ridge.
        ridge_result = search_result if is_free else spread_along_ridge(search_result, TARGET_PARAMETERS)
        belief, noises = posterior_belief(problem, ridge_result)
        on_progress(0.9, "checking the result")
        forecasts = one_step_forecasts(search_result, belief)
        parameters = parameter_moments(belief, ridge_result.ridges)
        warnings = run_all_checks(
            problem, search_result, ridge_result.ridges, belief, parameters, noises["input"], parsed_records, forecasts
        )
    history = partial(contraction_history, problem, ridge_result, parameters)
    compute_forecasts = partial(one_step_forecasts, search_result, belief)
    return Result(
        rig, belief, warnings, tuple(parsed_records), forecasts, noises, history, compute_forecasts, ridge_result.ridges
    )


def _choose_scales(rig: Rig, records: list[Record]) -> Scales:
    """The scales of the rig, and the largest recorded values where the rig has none."""
    largest_input = max(float(np.abs(one.u).max()) for one in records)
    is_free = largest_input == 0.0
    largest_input = largest_input or 1.0
    largest_output = max(float(np.nanmax(np.abs(one.y))) for one in records)
    scales = rig.scales
    if is_free:  # in these scales a mass of 1 has the gain 1
        scales = replace(scales, output=scales.output if rig.output.range else largest_output)
        return replace(scales, input=scales.displacement / rig.step**2)
    return replace(
        scales,
        input=scales.input if rig.only_input.limit else largest_input,
        output=scales.output if rig.output.range else largest_output,
    )


def _output_origin(rig: Rig, outputs: Sequence[FloatArray]) -> float:
    """The origin of the outputs: the mean of a displacement whose mean exceeds its standard deviation; else 0."""
    observed = np.concatenate(outputs)
    mean = float(np.nanmean(observed))
    return mean if DERIVATIVE_ORDER_OF_SENSOR[rig.output.kind] == 0 and abs(mean) > np.nanstd(observed) else 0.0
