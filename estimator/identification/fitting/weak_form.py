"""Weak-form identification (Messenger and Bortz 2021): starting coefficients without a guess, by least squares.

A test function φ is a smooth bump that vanishes with its derivatives at both ends. Integrated against it, x'' becomes
∫φ'' x, so that no noisy record is differentiated. The result is linear in the coefficients,

    ∫φ'' x = gain ∫φ u - damping ∫φ v - stiffness ∫φ x - cubic ∫φ x³ + force ∫φ,

one equation for each position of the bump, solved by least squares. Narrow bumps are noisy, wide bumps lose the fast
part of the motion, so several widths are tried.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.identification.likelihood.problem_signals import interpolate_gaps
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.support.array_types import FloatArray

#: Half widths of the test functions, in periods of the mean frequency.
_TEST_FUNCTION_WIDTHS = (0.12, 0.25, 0.5, 1.0)

#: Power n of the test function (1 - s²)^n, of which n - 1 derivatives vanish at the ends.
_TEST_FUNCTION_POWER = 6

#: Longest gap that is bridged, in periods: enough for a start.
_MAX_BRIDGED_PERIODS = 1 / 6

#: Periods of the high-pass that removes the drift of an integrated signal.
_HIGH_PASS_PERIODS = (3.0, 10.0, 30.0)

#: Resting samples at the start of a record that begins at rest, at least.
_MIN_RESTING_SAMPLES = 8

#: Inputs and outputs are at rest below this fraction of their size.
_RESTING_FRACTION = 0.05

#: Smallest random coefficient, in the natural sizes of a sine of the mean frequency. A motion between two wells
#: is slower and has harmonics.
_MIN_RANDOM_SIZE = 0.003

#: Largest random coefficient, in natural sizes.
_MAX_RANDOM_SIZE = 2.0

#: Coefficients with random starts; the others start at 0.
_RANDOM_COEFFICIENTS = ("gain", "damping", "stiffness", "cubic")


def _whole_delay_inputs(problem: ScaledRecords) -> FloatArray:
    """(T, rows) inputs with the nearest integer delay; only a held input may act a whole sample early."""
    rig = problem.rig
    least = -1 if rig.interpolation == "zero_order" else 0
    return problem.filter_samples(rig.interpolation, max(round(rig.delay), least)).inputs


def weak_form_starts(problem: ScaledRecords) -> list[FloatArray]:
    """Starting coefficients (K,), one set for each width of the test functions and each high-pass.

    Where the outputs have an origin, there is also one set for each possible inflection of the spring: the origin, 0,
    and the rig's offset. The list is empty where the records are too short.
    """
    names = list(problem.model.coefficients)
    problem = problem.resampled_evenly()
    inputs = _whole_delay_inputs(problem)
    coefficient_sets = []
    integrates = DERIVATIVE_ORDER_OF_SENSOR[problem.rig.output.kind] > 0
    spring_centres = _spring_centres(problem)
    widths, drifts = (_TEST_FUNCTION_WIDTHS[:2], _HIGH_PASS_PERIODS) if integrates else (_TEST_FUNCTION_WIDTHS, (0.0,))
    for offset, part, periods in product(spring_centres, widths, drifts):
        half_width = max(3, round(part * 2 * np.pi / problem.mean_frequency))
        rows = [
            _clean_equations(problem, u, y - offset, half_width, periods)
            for u, y in zip(inputs, problem.y, strict=True)
        ]
        record_equations = [row for row in rows if row is not None]
        if not record_equations:
            continue
        equations = np.concatenate(record_equations)
        if len(equations) < 4 * equations.shape[1]:
            continue
        scale = np.sqrt(np.mean(equations**2, axis=0))
        scale[scale == 0] = 1.0
        unit = equations / scale
        solution = np.linalg.lstsq(unit[:, 1:], unit[:, 0], rcond=1e-8)[0] * scale[0] / scale[1:]
        gain, damping, stiffness, cubic, force, square = solution
        gain = 1.0 if problem.is_free_decay else gain
        values = dict.fromkeys(names, 0.0) | {"gain": gain, "damping": damping, "cubic": cubic, "force": force}
        # An integrated signal may be shifted: stiffness x + square x² + cubic x³ is a cubic about another inflection.
        centre_shift = square / (3 * cubic) if abs(cubic) > 0 else 0.0
        is_near = abs(centre_shift) < 3 * problem.displacement and integrates
        values["stiffness"] = stiffness - (3 * cubic * centre_shift**2 if is_near else 0.0)
        values["force"] += offset * stiffness
        values["output_offset"] = offset
        if np.isfinite(list(values.values())).all() and gain != 0:
            coefficient_sets.append(np.array([values[name] for name in names]))
    return coefficient_sets


def random_starts(problem: ScaledRecords, count: int, seed: int) -> list[FloatArray]:
    """Random starting coefficients (K,) of all sizes and signs, for records at which `weak_form_starts` fail.

    A spring with negative stiffness hardens, because nothing else would hold the oscillator.

    Args:
        problem: the records.
        count: number of sets.
        seed: of the random numbers.
    """
    names, natural = list(problem.model.coefficients), problem.natural_coefficient_sizes()
    rng = np.random.default_rng(seed)
    coefficient_sets = []
    for offset in np.resize(_spring_centres(problem), count):
        sizes = {
            name: natural[name] * np.exp(rng.uniform(*np.log([_MIN_RANDOM_SIZE, _MAX_RANDOM_SIZE])))
            for name in _RANDOM_COEFFICIENTS
        }
        sizes["stiffness"] *= rng.choice([-1.0, 1.0])
        if sizes["stiffness"] > 0:
            sizes["cubic"] *= rng.choice([-1.0, 1.0])
        sizes["gain"] = 1.0 if problem.is_free_decay else sizes["gain"] * rng.choice([-1.0, 1.0])
        values = dict.fromkeys(names, 0.0) | sizes
        values |= {"force": offset * values["stiffness"], "output_offset": offset}
        coefficient_sets.append(np.array([values[name] for name in names]))
    return coefficient_sets


def input_effect_rms(problem: ScaledRecords, coefficients: FloatArray) -> float:
    """Root mean square effect of the inputs on the motion at coefficients (K,), in the unit of the process noise."""
    return abs(float(coefficients[list(problem.model.coefficients).index("gain")])) * problem.input_rms


def _spring_centres(problem: ScaledRecords) -> list[float]:
    """Possible inflections of the spring, from the origin of the outputs; 0 alone where they have no origin."""
    if not problem.origin:
        return [0.0]
    stated_offset = problem.rig.output.offset / problem.scales.output
    return sorted({0.0, -problem.origin, stated_offset - problem.origin})


def delay_misfits(problem: ScaledRecords, delays: NDArray[np.intp]) -> FloatArray:
    """Relative residuals of the weak-form acceleration for each delay, the lowest over several widths.

    Only the input's column depends on the delay; the other columns are projected out once.

    Args:
        problem: the records, at even steps.
        delays: delays of the input beyond the rig's [samples]; negative where the input acts earlier.
    """
    inputs, longest = _whole_delay_inputs(problem), int(np.abs(delays).max())
    periods = _HIGH_PASS_PERIODS[1] if DERIVATIVE_ORDER_OF_SENSOR[problem.rig.output.kind] > 0 else 0.0
    lowest_misfit = np.ones(len(delays))
    for part in _TEST_FUNCTION_WIDTHS[:2]:
        half_width = max(3, round(part * 2 * np.pi / problem.mean_frequency))
        pairs = zip(inputs, problem.y, strict=True)
        kept = [
            found for u, y in pairs if (found := _weak_form_equations(problem, u, y, half_width, periods)) is not None
        ]
        if not kept:
            continue
        rows = np.concatenate([found.rows[found.is_clean] for found in kept])
        if len(rows) < 4 * rows.shape[1]:
            continue
        forces = []
        for found in kept:
            dense = np.convolve(np.pad(found.input_at_outputs, longest), found.test_function, "valid")
            starts = np.flatnonzero(found.is_clean) * found.stride + longest
            forces.append(dense[starts[:, None] - delays])
        force, acceleration, others = np.concatenate(forces), rows[:, 0], rows[:, 2:]
        others = others / np.maximum(np.sqrt(np.mean(others**2, axis=0)), 1e-300)
        left_vectors, sizes, _ = np.linalg.svd(others, full_matrices=False)
        basis = left_vectors[:, sizes > 1e-8 * sizes[0]]
        force = force - basis @ (basis.T @ force)
        rest = acceleration - basis @ (basis.T @ acceleration)
        square = np.sum(force**2, axis=0)
        explained = np.divide((rest @ force) ** 2, square, out=np.zeros(len(delays)), where=square > 0)
        lowest_misfit = np.minimum(lowest_misfit, (rest @ rest - explained) / max(acceleration @ acceleration, 1e-300))
    return lowest_misfit


class _WeakFormEquations(NamedTuple):
    """Weak-form equations of a record.

    Attributes:
        rows: (n, 7) columns x'', u, -x', -x, -x³, 1 and -x², integrated against the test function.
        is_clean: (n,) whether a row holds no gap and no drift.
        input_at_outputs: (T,) input that acts at every output.
        test_function: (w,) samples of the test function.
        stride: samples between two rows.
    """

    rows: FloatArray
    is_clean: NDArray[np.bool_]
    input_at_outputs: FloatArray
    test_function: FloatArray
    stride: int


def _clean_equations(
    problem: ScaledRecords, inputs: FloatArray, y: FloatArray, half_width: int, high_pass_periods: float
) -> FloatArray | None:
    """(n, 7) the clean rows of `_WeakFormEquations`; None for a record that is too short."""
    found = _weak_form_equations(problem, inputs, y, half_width, high_pass_periods)
    return None if found is None else found.rows[found.is_clean]


def _weak_form_equations(
    problem: ScaledRecords, inputs: FloatArray, y: FloatArray, half_width: int, high_pass_periods: float
) -> _WeakFormEquations | None:
    """The weak-form equations of a record; None for a record that is too short."""
    count = len(y)
    if count < 4 * half_width:
        return None
    s = np.arange(-half_width, half_width + 1) / half_width
    base = np.clip(1 - s**2, 0, None)
    test_function = base**_TEST_FUNCTION_POWER
    first = -2 * _TEST_FUNCTION_POWER * s * base ** (_TEST_FUNCTION_POWER - 1) / half_width
    second = (
        -2 * _TEST_FUNCTION_POWER * base ** (_TEST_FUNCTION_POWER - 1)
        + 4 * _TEST_FUNCTION_POWER * (_TEST_FUNCTION_POWER - 1) * s**2 * base ** (_TEST_FUNCTION_POWER - 2)
    ) / half_width**2
    stride = max(1, half_width // 4)
    integrate = lambda test, values: sliding_window_view(values, len(test))[::stride] @ test  # noqa: E731
    bridged_output = interpolate_gaps(y, _MAX_BRIDGED_PERIODS * 2 * np.pi / problem.mean_frequency)
    missing = ~np.isfinite(bridged_output)
    bridged_output = np.where(missing, np.nanmean(y), bridged_output)
    order = DERIVATIVE_ORDER_OF_SENSOR[problem.rig.output.kind]
    shown, x = bridged_output, bridged_output
    for _ in range(order):
        x = _integrate_high_passed(x, problem.mean_frequency / high_pass_periods)
    # The mean of the input over the sample before each output belongs to the middle of that sample.
    powers = np.arange(inputs.shape[1])
    mean = np.nan_to_num(inputs[:count]) @ (1.0 / (1 + powers))
    acting = 0.5 * (mean + np.append(mean[1:], mean[-1]))
    acceleration, velocity = (
        (integrate(second, x), -integrate(first, x)),
        (-integrate(first, shown), integrate(test_function, shown)),
        (integrate(test_function, shown), -integrate(first, x)),
    )[order]
    square = integrate(test_function, x**2) if order else np.zeros(len(velocity))
    forces = (
        -integrate(test_function, x),
        -integrate(test_function, x**3),
        integrate(test_function, np.ones(count)),
        -square,
    )
    columns = (acceleration, integrate(test_function, acting), -velocity, *forces)
    clean = integrate(np.ones(2 * half_width + 1), missing.astype(float)) < 0.5
    if order and not _begins_at_rest(acting, shown):
        clean[: int(np.ceil(min(2 * np.pi * high_pass_periods / problem.mean_frequency, count / 4) / stride))] = False
    return _WeakFormEquations(np.stack(columns, axis=1), clean, acting, test_function, stride)


def _begins_at_rest(u: FloatArray, y: FloatArray) -> bool:
    """Whether a record begins at rest before the input acts, so that an integrated signal has no drift."""
    onset = int(np.argmax(np.abs(u - u[0]) > _RESTING_FRACTION * np.abs(u).max()))
    return onset >= _MIN_RESTING_SAMPLES and float(np.sqrt(np.mean(y[:onset] ** 2))) < _RESTING_FRACTION * float(
        y.std()
    )


def _integrate_high_passed(values: FloatArray, corner_frequency: float) -> FloatArray:
    """The integral over samples, high-passed at an angular frequency [rad per sample]."""
    from scipy.signal import butter, sosfiltfilt

    total = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))])
    return np.asarray(
        sosfiltfilt(butter(2, min(corner_frequency / np.pi, 0.9), btype="high", output="sos"), total - total.mean())
    )
