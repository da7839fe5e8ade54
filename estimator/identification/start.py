"""Where a search begins, when nothing is guessed: the equation, tested with smooth bumps.

Integrated against a bump φ that vanishes with its derivatives at both ends, x'' becomes ∫φ'' x: no derivative of a
noisy record is taken. What is left is linear in the coefficients,

    ∫φ'' x = gain ∫φ u - damping ∫φ v - stiffness ∫φ x - cubic ∫φ x³ + force ∫φ,

an equation for each place of the bump, solved by least squares. Narrow bumps are noisy, wide ones forget the fast part
of the motion, so several widths are tried (Messenger and Bortz 2021 name this weak-form identification).
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.identification.problem import Problem, bridged
from estimator.models.duffing import KINDS
from estimator.parameters import FloatArray

#: Half widths of the bumps, in parts of the period of the mean frequency.
_WIDTHS = (0.12, 0.25, 0.5, 1.0)

#: (1 - s²)^n has n - 1 derivatives that vanish at the ends.
_POWER = 6

#: A gap of so many periods is bridged: what comes of it is a start, and no more.
_BRIDGED = 1 / 6

#: Periods over which an integrated signal loses its drift.
_PERIODS = (3.0, 10.0, 30.0)

#: A record that begins with so many samples of inputs and outputs below so much of its largest begins at rest.
_WAITS, _AT_REST = 8, 0.05

#: Coefficients that are drawn lie between so much and so many of their natural sizes: these are those of a motion that
#: is a sine, of the mean frequency. One that goes from well to well is slower, and has harmonics.
_SMALLEST, _LARGEST = 0.003, 2.0

#: Coefficients that are drawn; the others begin at 0.
_DRAWN = ("gain", "damping", "stiffness", "cubic")


def _inputs(problem: Problem) -> FloatArray:
    """(T, rows) inputs with the nearest whole delay: only what is held may act a whole sample early."""
    rig = problem.rig
    least = -1 if rig.interpolation == "zero_order" else 0
    return problem.samples_of(rig.interpolation, max(round(rig.delay), least)).inputs


def starts(problem: Problem) -> list[FloatArray]:
    """Coefficients (K,) to begin with: one set for each width of the bumps, and each way to lose the drift.

    Where outputs are counted from an origin, also one for each place that may be the spring's middle: the origin, 0,
    and the rig's offset. None where the records are too short.
    """
    names = list(problem.model.coefficients)
    problem = problem.evened()
    inputs = _inputs(problem)
    found = []
    integrates = KINDS[problem.rig.output.kind] > 0
    middles = _middles(problem)
    widths, drifts = (_WIDTHS[:2], _PERIODS) if integrates else (_WIDTHS, (0.0,))
    for offset, part, periods in product(middles, widths, drifts):
        half = max(3, round(part * 2 * np.pi / problem.frequency))
        rows = [_equations(problem, u, y - offset, half, periods) for u, y in zip(inputs, problem.y, strict=True)]
        kept = [row for row in rows if row is not None]
        if not kept:
            continue
        equations = np.concatenate(kept)
        if len(equations) < 4 * equations.shape[1]:
            continue
        scale = np.sqrt(np.mean(equations**2, axis=0))
        scale[scale == 0] = 1.0
        unit = equations / scale
        solution = np.linalg.lstsq(unit[:, 1:], unit[:, 0], rcond=1e-8)[0] * scale[0] / scale[1:]
        gain, damping, stiffness, cubic, force, square = solution
        gain = 1.0 if problem.is_free else gain
        values = dict.fromkeys(names, 0.0) | {"gain": gain, "damping": damping, "cubic": cubic, "force": force}
        # An integrated signal may be displaced: stiffness x + square x² + cubic x³ is a cubic about another middle.
        middle = square / (3 * cubic) if abs(cubic) > 0 else 0.0
        inside = abs(middle) < 3 * problem.displacement and integrates
        values["stiffness"] = stiffness - (3 * cubic * middle**2 if inside else 0.0)
        values["force"] += offset * stiffness
        values["output_offset"] = offset
        if np.isfinite(list(values.values())).all() and gain != 0:
            found.append(np.array([values[name] for name in names]))
    return found


def scattered(problem: Problem, count: int, seed: int) -> list[FloatArray]:
    """Coefficients (K,) of all sizes and signs, the same for a seed: to begin with where `starts` lead nowhere.

    A spring that pushes away from its middle hardens, because nothing would hold the oscillator else.
    """
    names, natural, rng = list(problem.model.coefficients), problem.natural(), np.random.default_rng(seed)
    found = []
    for offset in np.resize(_middles(problem), count):
        sizes = {name: natural[name] * np.exp(rng.uniform(*np.log([_SMALLEST, _LARGEST]))) for name in _DRAWN}
        sizes["stiffness"] *= rng.choice([-1.0, 1.0])
        if sizes["stiffness"] > 0:
            sizes["cubic"] *= rng.choice([-1.0, 1.0])
        sizes["gain"] = 1.0 if problem.is_free else sizes["gain"] * rng.choice([-1.0, 1.0])
        values = dict.fromkeys(names, 0.0) | sizes
        values |= {"force": offset * values["stiffness"], "output_offset": offset}
        found.append(np.array([values[name] for name in names]))
    return found


def effect(problem: Problem, mean: FloatArray) -> float:
    """Root mean square of what the inputs do to the motion at coefficients (K,), in the unit of the process noise."""
    return abs(float(mean[list(problem.model.coefficients).index("gain")])) * problem.strength


def rests(problem: Problem, points: FloatArray) -> FloatArray:
    """(n, P) displacements at which the spring of some of the coefficients (P, K) is without force, beside its middle.

    None where no spring has two wells; 0 for one that has not.
    """
    names = list(problem.model.coefficients)
    stiffness, cubic = points[:, names.index("stiffness")], points[:, names.index("cubic")]
    two = (stiffness < 0) & (cubic > 0)
    if not two.any():
        return np.empty((0, len(points)))
    away = np.sqrt(np.divide(-stiffness, cubic, out=np.zeros(len(points)), where=two))
    return np.stack([away, -away])


def _middles(problem: Problem) -> list[float]:
    """Places, counted as the outputs are, where the spring may be without force; just 0 where these have no origin."""
    if not problem.origin:
        return [0.0]
    given = problem.rig.output.offset / problem.scales.output
    return sorted({0.0, -problem.origin, given - problem.origin})


def misfits(problem: Problem, delays: NDArray[np.intp]) -> FloatArray:
    """What the equation leaves of the acceleration at best, in parts of it, over bumps of some widths.

    For every one of some delays by which the input acts later, or earlier where they are negative. Only the input's
    column depends on the delay, so the others are projected out of it and of the acceleration once.
    """
    inputs, longest = _inputs(problem), int(np.abs(delays).max())
    periods = _PERIODS[1] if KINDS[problem.rig.output.kind] > 0 else 0.0
    least = np.ones(len(delays))
    for part in _WIDTHS[:2]:
        half = max(3, round(part * 2 * np.pi / problem.frequency))
        pairs = zip(inputs, problem.y, strict=True)
        kept = [found for u, y in pairs if (found := _framed(problem, u, y, half, periods)) is not None]
        if not kept:
            continue
        rows = np.concatenate([found.rows[found.clean] for found in kept])
        if len(rows) < 4 * rows.shape[1]:
            continue
        forces = []
        for found in kept:
            dense = np.convolve(np.pad(found.acting, longest), found.bump, "valid")
            starts = np.flatnonzero(found.clean) * found.stride + longest
            forces.append(dense[starts[:, None] - delays])
        force, acceleration, others = np.concatenate(forces), rows[:, 0], rows[:, 2:]
        others = others / np.maximum(np.sqrt(np.mean(others**2, axis=0)), 1e-300)
        left, sizes, _ = np.linalg.svd(others, full_matrices=False)
        basis = left[:, sizes > 1e-8 * sizes[0]]
        force = force - basis @ (basis.T @ force)
        rest = acceleration - basis @ (basis.T @ acceleration)
        square = np.sum(force**2, axis=0)
        explained = np.divide((rest @ force) ** 2, square, out=np.zeros(len(delays)), where=square > 0)
        least = np.minimum(least, (rest @ rest - explained) / max(acceleration @ acceleration, 1e-300))
    return least


class _Framed(NamedTuple):
    """Equations integrated against bumps.

    Attributes:
        rows: (n, 7) columns x'', u, -x', -x, -x³, 1 and -x².
        clean: (n,) which rows hold no gap and no drift.
        acting: (T,) the input that acts at every output.
        bump: (w,) what they are integrated against.
        stride: samples between two rows.
    """

    rows: FloatArray
    clean: NDArray[np.bool_]
    acting: FloatArray
    bump: FloatArray
    stride: int


def _equations(problem: Problem, inputs: FloatArray, y: FloatArray, half: int, periods: float) -> FloatArray | None:
    """(n, 7) the rows of `_Framed` that are clean; None for a record that is too short."""
    found = _framed(problem, inputs, y, half, periods)
    return None if found is None else found.rows[found.clean]


def _framed(problem: Problem, inputs: FloatArray, y: FloatArray, half: int, periods: float) -> _Framed | None:
    """The equations of a record; None for one that is too short."""
    count = len(y)
    if count < 4 * half:
        return None
    s = np.arange(-half, half + 1) / half
    base = np.clip(1 - s**2, 0, None)
    bump = base**_POWER
    first = -2 * _POWER * s * base ** (_POWER - 1) / half
    second = (-2 * _POWER * base ** (_POWER - 1) + 4 * _POWER * (_POWER - 1) * s**2 * base ** (_POWER - 2)) / half**2
    stride = max(1, half // 4)
    over = lambda test, values: sliding_window_view(values, len(test))[::stride] @ test  # noqa: E731
    seen = bridged(y, _BRIDGED * 2 * np.pi / problem.frequency)
    missing = ~np.isfinite(seen)
    seen = np.where(missing, np.nanmean(y), seen)
    order = KINDS[problem.rig.output.kind]
    shown, x = seen, seen
    for _ in range(order):
        x = _integrated(x, problem.frequency / periods)
    # The input's mean over the sample before each output belongs to the middle of that sample.
    powers = np.arange(inputs.shape[1])
    mean = np.nan_to_num(inputs[:count]) @ (1.0 / (1 + powers))
    acting = 0.5 * (mean + np.append(mean[1:], mean[-1]))
    acceleration, velocity = (
        (over(second, x), -over(first, x)),
        (-over(first, shown), over(bump, shown)),
        (over(bump, shown), -over(first, x)),
    )[order]
    square = over(bump, x**2) if order else np.zeros(len(velocity))
    forces = -over(bump, x), -over(bump, x**3), over(bump, np.ones(count)), -square
    columns = (acceleration, over(bump, acting), -velocity, *forces)
    clean = over(np.ones(2 * half + 1), missing.astype(float)) < 0.5
    if order and not _quiet(acting, shown):
        clean[: int(np.ceil(min(2 * np.pi * periods / problem.frequency, count / 4) / stride))] = False
    return _Framed(np.stack(columns, axis=1), clean, acting, bump, stride)


def _quiet(u: FloatArray, y: FloatArray) -> bool:
    """Whether a record begins at rest, before anything acts: then an integrated signal has no drift to lose."""
    onset = int(np.argmax(np.abs(u - u[0]) > _AT_REST * np.abs(u).max()))
    return onset >= _WAITS and float(np.sqrt(np.mean(y[:onset] ** 2))) < _AT_REST * float(y.std())


def _integrated(values: FloatArray, lowest: float) -> FloatArray:
    """The integral by the sample, without what is slower than an angular frequency."""
    from scipy.signal import butter, sosfiltfilt

    total = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))])
    return np.asarray(
        sosfiltfilt(butter(2, min(lowest / np.pi, 0.9), btype="high", output="sos"), total - total.mean())
    )
