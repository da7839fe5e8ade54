"""The reward ``simulation_error``: how far the believed oscillator runs from the true one, on its own.

Both are put at rest and given the same test input, without noise; what they do is compared:

    misfit = min(sqrt(Σ (x_believed - x_true)² / Σ x_true²), 1).

The believed one has the posterior's means for its coefficients. One that runs away, or is NaN, has a misfit of 1.

The test input is a Schroeder multisine of `SAMPLES` samples: the first 20 multiples of 9.5 Hz, so up to 191 Hz as the
Silverbox's, all of one size. Its peak is half of ``max_input``, with which oscillators of the standard tracks come to
0.35 V at most.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from duffing_env.layout import Kind, layout_of
from duffing_env.rewards import Hooks, nothing
from estimator.arrays import copy_lanes
from estimator.engine.feeding import feeder
from estimator.engine.rows import input_rows
from estimator.lanes import LANES, part
from estimator.parameters import FloatArray

#: Length of the test input: 105 ms.
SAMPLES = 64

_HARMONICS, _PEAK = 20, 0.5


def _schroeder() -> FloatArray:
    """The test input (SAMPLES,), in parts of ``max_input``."""
    harmonics = np.arange(1, _HARMONICS + 1)
    phases = -np.pi * harmonics * (harmonics - 1) / _HARMONICS
    times = np.arange(SAMPLES)[:, None] / SAMPLES
    waves: FloatArray = np.cos(2 * np.pi * harmonics * times + phases).sum(axis=1)
    return _PEAK * waves / np.abs(waves).max()


TEST_INPUT = _schroeder()


def source(kind: Kind, loop: Any) -> str:
    """``model_move`` and ``twin_move``: the believed and the true plant; ``compare`` adds up, ``conclude`` ends."""
    import sympy as sp

    from estimator.engine.derive import calculus, renamed, state_step, symbol

    model = kind.belief
    believed = {x: f"MODEL_{x}" for x in model.states} | {c: c for c in model.coefficients}
    true = {x: f"TWIN_{x}" for x in model.states} | {c: f"TRUE_{c}" for c in model.coefficients}
    at = ("T",) if model.is_continuous else ()
    text = loop("model_move", "The believed plant moves.", *state_step(model, kind.degree, believed), *at)
    text += loop("twin_move", "The true plant moves.", *state_step(model, kind.degree, true), *at)
    shown = calculus(model).outputs[0].subs(symbol("u"), 0)
    ours, theirs = (renamed([("", shown)], names)[0][1] for names in (believed, true))
    lines = [("E_d", symbol("DEVIATION") + (ours - theirs) ** 2), ("E_p", symbol("POWER") + theirs**2)]
    text += loop("compare", "Add up what differs.", lines, {"DEVIATION": "E_d", "POWER": "E_p"})
    misfit = sp.sqrt(symbol("DEVIATION") / symbol("POWER"))
    # ``reaches`` is 0 for NaN, which so counts as 1.
    kept = sp.Function("select")(sp.Function("reaches")(sp.S.One, symbol("RATIO")), symbol("RATIO"), sp.S.One)
    lines = [("RATIO", misfit), ("KEPT", kept), ("FALL", symbol("MISFIT") - symbol("KEPT"))]
    return text + loop("conclude", "The misfit, and its decrease.", lines, {"WORK": "FALL", "MISFIT": "KEPT"})


def hooks(kind: Kind, code: Any) -> Hooks:
    """It compares where an episode begins, and after every update."""
    place, model = layout_of(kind), kind.belief
    first, last = place[f"MODEL_{next(iter(model.states))}"] * LANES, (place["POWER"] + 1) * LANES
    rows = [place[row] for row in input_rows(model, kind.degree)]
    inputs, feed = tuple(row * LANES for row in rows), feeder(model, kind.degree, rows, LANES)
    work, misfit = place["WORK"] * LANES, place["MISFIT"] * LANES
    model_move, twin_move, compare, conclude = code.model_move, code.twin_move, code.compare, code.conclude
    steps, continuous = model.substeps, model.is_continuous

    @part(kind.name)
    def run(W, max_input):
        """The misfits of a block's beliefs."""
        kept = np.empty(len(inputs) * LANES)
        for k in range(len(inputs)):
            copy_lanes(kept, k * LANES, W, inputs[k], LANES)
        for i in range(first, last):
            W[i] = 0.0
        for t in range(SAMPLES):
            now = max_input * TEST_INPUT[t]
            before = max_input * TEST_INPUT[t - 1] if t > 0 else 0.0
            older = max_input * TEST_INPUT[t - 2] if t > 1 else 0.0
            for j in range(LANES):
                feed(W, j, now, before, older)
            if continuous:
                for s in range(steps):
                    model_move(W, s / steps)
                    twin_move(W, s / steps)
            else:
                model_move(W)
                twin_move(W)
            compare(W)
        conclude(W)
        for k in range(len(inputs)):
            copy_lanes(W, inputs[k], kept, k * LANES, LANES)

    @part(kind.name)
    def begin(W, j, setup):
        """Of lane j alone: the other lanes keep what they had."""
        works, misfits = np.empty(LANES), np.empty(LANES)
        copy_lanes(works, 0, W, work, LANES)
        copy_lanes(misfits, 0, W, misfit, LANES)
        run(W, setup.max_input)
        misfits[j] = W[misfit + j]
        copy_lanes(W, work, works, 0, LANES)
        copy_lanes(W, misfit, misfits, 0, LANES)

    @part(kind.name)
    def after(W, setup):
        run(W, setup.max_input)

    return Hooks(begin, nothing, nothing, after)
