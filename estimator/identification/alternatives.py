"""How the input may have gone other than the rig says: between samples, with another delay, with a lag; by evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.identification.fit import Fitter, Hypothesis
from estimator.identification.problem import LATEST, Problem
from estimator.identification.result import Finding
from estimator.identification.search import Found
from estimator.parameters import FloatArray
from estimator.rig import INTERPOLATIONS, LONGEST_DELAY, PARTS

#: Nats by which another hypothesis must be better.
EVIDENCE = 7.0

#: Ratios of the noises at which other hypotheses are tried, in parts of the best: a wrong one takes up noise.
_RATIOS = (1.0, 0.1, 0.01)

#: Samples by which the input may be earlier or later than is thought, and many by which it may be later: these are
#: coarse, and lead to the right one when records are identified again.
_DELAYS, _LATE = range(-LATEST, LATEST + 1), (5, 8, 12, 16, 20, 25, 30, 40)

#: Parts of a sample, and time constants of a lag in samples, that are tried first, and about what is best.
_HALF, _LAG = (-0.5, 0.5), (0.5, 2.0)
_NEAR, _LAGS = (-0.5, -0.25, 0.25, 0.5), (0.25, 0.5, 1.0, 2.0, 4.0)

#: Digits of a delay and of a lag in samples that are told.
_DIGITS = 2

#: An input is smooth where its second differences are this much smaller than itself, as a root mean square.
_SMOOTH = 0.7

#: Steps of a fit of another hypothesis, at most.
_STEPS = 12

#: Samples of a record on which other hypotheses about the input are tried first, and the nats by which one that is
#: given up is worse there.
_SCREENED, _HOPELESS = 1024, 10.0


def of_input(problem: Problem, found: Found) -> list[Finding]:
    """What speaks for another path of the input, and which the rig should say."""
    rig, own = problem.rig, float(found.fits.free_energy.min())
    best = found.best
    paths = [name for name in PARTS[:2] if rig.interpolation in PARTS] or [rig.interpolation]
    others = [
        replace(best, interpolation=path, delay=rig.delay + later)
        for path in paths
        for later in _DELAYS
        if (path, later) != (rig.interpolation, 0)
    ]
    others += [replace(best, delay=rig.delay + later) for later in _LATE]
    # An accelerometer shows a held input itself: that it is sampled after this switches looks like a part of a sample.
    in_parts = rig.interpolation in PARTS and (rig.output.kind != "acceleration" or _is_smooth(problem))
    if in_parts:
        others += [replace(best, interpolation=path, delay=rig.delay + part) for path in paths for part in _HALF]
    if rig.interpolation in PARTS:
        smooth = rig.interpolation != "spline" and not best.lag and _is_smooth(problem)
        others += [replace(best, interpolation="spline")] if smooth else []
    tried = _tried(problem, found, others, own)
    if (tried is None or tried[1] <= EVIDENCE) and rig.interpolation in PARTS[:2]:
        lagging = [replace(best, lag=best.lag + lag) for lag in _LAG]
        if rig.interpolation == "linear" and not best.lag:  # what goes linearly resembles what is held and lags
            lagging += [replace(best, interpolation="zero_order", delay=rig.delay - 1, lag=lag) for lag in _LAG]
        tried = _tried(problem, found, lagging, own)
    if tried is None or tried[1] <= EVIDENCE:
        return []
    better, gain = tried
    # Beside many samples parts of one are no matter, and what lags is not late by more than one.
    if in_parts and abs(better.delay - rig.delay) <= 1:
        better, gain = _refined(problem, found, better, gain, own)
    return [_finding(problem, better, gain)]


def _tried(problem: Problem, found: Found, others: Sequence[Hypothesis], own: float) -> tuple[Hypothesis, float] | None:
    """The best of some hypotheses and its gain in nats; None where none can be."""
    others = _screened(problem, found, [other for other in others if _is_possible(other)])
    if not others:
        return None
    gains = own - energies(found.fitter, others, found, own)
    return others[int(np.argmax(gains))], float(gains.max())


def _is_possible(hypothesis: Hypothesis) -> bool:
    """Whether a rig may have it: an input that is held may act before the sample that it brings, others not."""
    whole = hypothesis.delay == int(hypothesis.delay)
    least = (-1.0 if hypothesis.interpolation == "zero_order" else 0.0) if whole else -0.999
    return least <= hypothesis.delay <= LONGEST_DELAY and hypothesis.lag >= 0.0


def _refined(problem: Problem, found: Found, better: Hypothesis, gain: float, own: float) -> tuple[Hypothesis, float]:
    """The delay in parts of a sample and the lag about a hypothesis, where these say more than whole samples do."""
    paths = [*PARTS[:2], *(["spline"] if _is_smooth(problem) else [])]
    middle = float(round(better.delay))
    others = [replace(better, interpolation=p, delay=middle + d, lag=0.0) for p in paths for d in (*_NEAR, 0.0)]
    others += [
        replace(better, interpolation=p, delay=middle + d, lag=lag)
        for p in PARTS[:2] for d in (-1.0, 0.0) for lag in _LAGS
    ]  # fmt: skip
    tried = _tried(problem, found, others, own)
    if tried is None or tried[1] <= gain + EVIDENCE:
        return better, gain
    for width in (0.12, 0.06, 0.03):
        here = tried[0]
        beside = [replace(here, delay=here.delay + d) for d in (-width, width)]
        if here.lag:
            beside += [replace(here, lag=here.lag * (1 + d)) for d in (-2 * width, 2 * width)]
        again = _tried(problem, found, beside, own)
        if again is not None and again[1] > tried[1]:
            tried = again
    final = replace(tried[0], delay=round(tried[0].delay, _DIGITS), lag=round(tried[0].lag, _DIGITS + 1))
    return final, tried[1]


def _is_smooth(problem: Problem) -> bool:
    """Whether inputs change gently from sample to sample, as what a filter or an amplifier leaves of them."""
    bends = np.concatenate([np.diff(u, 2) for u in problem.u])
    jumps = np.concatenate([np.diff(u) for u in problem.u])
    # What is held for some samples stands still between its jumps.
    stands = np.mean(jumps == 0.0) > 0.1
    return bool(not stands and np.sqrt(np.mean(bends**2)) < _SMOOTH * problem.strength)


def _finding(problem: Problem, better: Hypothesis, gain: float) -> Finding:
    rig = problem.rig
    name = "interpolation" if better.interpolation != rig.interpolation else "delay"
    lag = f", and a lag of {better.lag * rig.step:.3g} s" if better.lag else ""
    into = f"write these into the rig{', the lag into its [input]' if lag else ''}, and identify again"
    message = (
        f"the records speak for interpolation '{better.interpolation}' with delay {better.delay:g}{lag}, by "
        f"{gain:.0f} nats, and not for '{rig.interpolation}' with delay {rig.delay:g}; {into}"
    )
    if rig.output.kind == "acceleration" and (rig.interpolation, better.interpolation) == ("zero_order", "linear"):
        message += "; or make outputs missing where the input switches, if y shows it just after that"
    return Finding("lag" if better.lag and name == "delay" else name, message)


def _screened(problem: Problem, found: Found, others: list[Hypothesis]) -> list[Hypothesis]:
    """Those that the first part of the records does not speak against; all, where that is no small part."""
    part = problem.shortened(_SCREENED)
    if part.samples > problem.samples / 2 or not others:
        return others
    fitter = found.fitter.on(part)
    own = float(energies(fitter, [found.best], found, np.inf)[0])
    worse = energies(fitter, others, found, own) - own
    return [other for other, nats in zip(others, worse, strict=True) if nats < _HOPELESS]


def energies(fitter: Fitter, hypotheses: Sequence[Hypothesis], found: Found, own: float) -> FloatArray:
    """(H,) free energies of other hypotheses, each in the best of some ratios of the noises.

    Those whose samples are alike are fitted side by side: a spline takes more arithmetic than what is held, and parts
    of samples are more samples.
    """
    result = np.full(len(hypotheses), np.inf)
    alike: dict[tuple[int, bool], list[int]] = {}
    for k, one in enumerate(hypotheses):
        degree = INTERPOLATIONS["spline" if one.lag else one.interpolation]
        alike.setdefault((max(degree, 1), one.delay == int(one.delay)), []).append(k)
    start = np.append(found.mean, fitter.prior.mean[len(found.mean) :])
    for group in alike.values():
        tried = [replace(hypotheses[k], ratio=hypotheses[k].ratio * part) for k in group for part in _RATIOS]
        fits = fitter.fit(tried, start, found.level, _STEPS, bar=own)
        result[group] = fits.free_energy.reshape(-1, len(_RATIOS)).min(axis=1)
    return result
