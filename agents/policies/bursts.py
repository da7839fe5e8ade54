"""Bursts: what to do where the input's energy is limited, from imagining the whole rest of the episode.

Where energy is short, what matters is when to spend it, and a few moves ahead say nothing of that. The best inputs that
are known keep the oscillator moving, drive it up once, and let it ring down; of all ways to drive it up, to push in
proportion to its motion takes least energy. So the ways that are imagined here go on to the end of the episode, and are
told by five numbers:

- *hold*: how hard it is pushed along its motion at first, in parts of what the energy would last for evenly;
- *wait*: when the burst begins, in parts of what is left of the episode;
- *drive*: how hard the burst pushes, in parts of what the oscillator moves by itself in two samples;
- *keep*: the part of the energy that the burst leaves, which is then spent evenly to the end;
- *rise*: the drive before the burst, in parts of the burst's: it counts where it is more than the hold.

A push along the motion turns over where it would lead beyond the limit, and is none where the energy does not suffice.
Each of the ways lies in a lane, and is imagined as the planner imagines its own: by belief propagation
(`agents.planner.imagination`), so a way that leads beyond the limit costs what it costs there. A first block of ways
covers the five numbers evenly, a second one tries changes of the best of the first.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from agents.planner.imagination import mind, terms_of
from agents.planner.motion import MOVES, View, places
from estimator.engine.imagination import LOST, imagination
from estimator.engine.motion import motion
from estimator.lanes import LANES, kernel, part
from estimator.parameters import FloatArray

#: What a way is told by, from and to: some evenly, others evenly in their logarithms.
_HOLD, _WAIT, _DRIVE, _KEEP, _RISE = (0.1, 1.5), (0.0, 0.9), (0.02, 0.8), (0.0, 0.7), (0.02, 1.0)

#: Standard deviation of the changes, in parts of these spans.
_CHANGE = 0.25

#: What is remembered of a motion's peak falls by this in a move; below this part of the limit it is at rest.
_FALL, _REST = 0.9, 0.01

#: The peak of a sine beside what lasts evenly, a bit less than √2 because pushes are held.
_PEAK = 1.3

#: More than the best burst's first push is a quarter more, less is a quarter less.
_MORE, _LESS = 1.25, 0.75


@cache
def drawn() -> tuple[FloatArray, FloatArray]:
    """Two blocks (LANES, 5) of numbers: those of the first ways, and changes; they are always the same."""
    from scipy.stats import qmc

    first = qmc.Sobol(5, seed=3).random(LANES)
    first[::2, 1] = 0.0  # half of the bursts begin at once, or else all would be put off for ever
    changes = _CHANGE * np.random.default_rng(7).standard_normal((LANES, 5))
    changes[0] = 0.0
    return first, changes


@cache
def burster(view: View) -> Any:
    """``plan(records, observations, samples, energy, terms, drawn, pushes, worths)``: the best bursts of n beliefs.

    - ``records``, ``observations``, ``terms``: as of `agents.policies.imagined.imaginer`;
    - ``samples`` of an episode, and its ``energy``, the limit of Σ u²; ``drawn``: `drawn`;
    - ``pushes`` (n,) receives the first input of the best way;
    - ``worths`` (n, 3) receives the most that ways bring in nats, whose first push is at least a quarter more than
      that, that way's own, and the most of those whose first push is at least a quarter less.
    """
    model = view.model
    mine = mind(*view)
    size, U, SCORE, MARGIN = mine.size, mine.u, mine.score, mine.margin
    begin, advance, appraise = mine.fill, mine.advance, mine.appraise
    found, at, place = motion(*view, LANES), places(model), imagination(*view).layout
    row, sense, glance, step = found.layout, found.sense, found.glance, found.step
    width, n, k = len(row) * LANES, model.n_states, model.n_coefficients
    u, now, velocity, later, gain = (row[name] * LANES for name in ("INPUT", "NOW", "VELOCITY", "SHOWN", "GAIN"))
    last = row["LAST_INPUT"] * LANES
    # An array, because an empty tuple has no type.
    olders = np.array([place[x] * LANES for x in ("LAST_INPUT", "OLDER_INPUT") if x in place], dtype=np.int64)
    kind = f"{model.name}_{model.digest}_{view.degree}_{view.lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def between(part, span, is_log):
        """A number between the ends of a span."""
        low, high = span
        return low * (high / low) ** part if is_log else low + (high - low) * part

    @inner
    def move(V):
        """What every lane moves by itself in two samples is left in its rows."""
        for j in range(LANES):
            V[u + j] = 0.0
        sense(V)
        glance(V)

    @inner
    def peak_of(V, record, samples):
        """The most that a believed system moves by itself in two samples; all lanes of V hold it before."""
        for f in range(n + k):
            for j in range(LANES):
                V[f * LANES + j] = record[f]
        peak = 0.0
        for _ in range(samples):
            move(V)
            peak = max(peak, abs(V[velocity] + V[later] - V[now]))
            step(V)
        return peak

    @entry
    def plan(records, observations, samples, energy, whole, drawn, pushes, worths):
        W, V, none, lasts = np.zeros(size), np.zeros(width), np.zeros((k, k)), np.zeros(2)
        told, best = np.zeros((len(drawn), LANES, 5)), np.zeros(5)
        hold, wait, drive, keep, rise, left, phase, peaks = np.zeros((8, LANES))
        firsts, scores = np.zeros((2, len(drawn), LANES))
        fall = _FALL ** (1.0 / whole.pace)
        for i in range(len(observations)):
            record, seen = records[i], observations[i]
            T, E = int(max(1.0, np.round(seen[at.time_left] * samples))), max(0.0, seen[at.budget_left]) * energy
            terms = terms_of(whole, T)
            lasts[0] = lasts[1] = terms.amplitude * seen[at.last_input]
            even, most = np.sqrt(E / T), -np.inf
            peak = peak_of(V, record, MOVES * terms.pace)
            for block in range(len(drawn)):
                for j in range(LANES):
                    for f in range(5):
                        told[block, j, f] = min(max(drawn[block][j, f] + (best[f] if block else 0.0), 0.0), 1.0)
                    mine = told[block, j]
                    hold[j] = even * between(mine[0], _HOLD, True)
                    wait[j] = T * between(mine[1], _WAIT, False)
                    drive[j] = between(mine[2], _DRIVE, True) / terms.pace
                    keep[j] = E * between(mine[3], _KEEP, False)
                    rise[j] = drive[j] * between(mine[4], _RISE, True)
                    left[j], phase[j], peaks[j] = E, 0.0, peak
                begin(W, record, lasts)
                for j in range(LANES):
                    W[MARGIN + j] = 0.0
                for t in range(T):
                    for a in range(n * LANES):
                        V[a] = W[a]
                    for a in range(len(olders)):
                        for j in range(LANES):
                            V[last + a * LANES + j] = W[olders[a] + j]
                    move(V)
                    for j in range(LANES):
                        phase[j] = 1.0 if phase[j] == 0.0 and t >= wait[j] else phase[j]
                        phase[j] = 2.0 if phase[j] == 1.0 and left[j] <= keep[j] else phase[j]
                        moved = V[velocity + j] + V[later + j] - V[now + j]
                        along = moved * V[gain + j] / max(V[gain + j] ** 2, 1e-300)
                        peaks[j] = max(abs(moved), fall * peaks[j])
                        steady = hold[j] if phase[j] < 2.0 else np.sqrt(max(0.0, left[j]) / (T - t))
                        rests = peaks[j] <= _REST * terms.limit
                        steady *= 1.0 if rests else _PEAK * abs(moved) / peaks[j]
                        harder = abs(along) * (rise[j] if phase[j] == 0.0 else drive[j])
                        if phase[j] == 0.0 or (phase[j] == 1.0 and rests):
                            push = max(steady, harder)
                        else:
                            push = harder if phase[j] == 1.0 else steady
                        V[u + j] = np.copysign(min(push, terms.amplitude), along)
                    glance(V)
                    for j in range(LANES):
                        ahead = V[later + j] + (terms.pace - 1) * (V[later + j] - V[now + j])
                        push = -V[u + j] if abs(ahead) > terms.limit - W[MARGIN + j] else V[u + j]
                        W[U + j] = push if push * push <= left[j] else 0.0
                        left[j] -= W[U + j] ** 2
                        if t == 0:
                            firsts[block, j] = W[U + j]
                    advance(W, record, terms)
                appraise(W, none, 0.0)
                for j in range(LANES):
                    scores[block, j] = W[SCORE + j]
                    if scores[block, j] > most:
                        most, pushes[i] = scores[block, j], firsts[block, j]
                        for f in range(5):
                            best[f] = told[block, j, f]
            worths[i, 0], worths[i, 1], worths[i, 2] = LOST, most, LOST
            for block in range(len(drawn)):
                for j in range(LANES):
                    part_of_it = firsts[block, j] * pushes[i] / max(pushes[i] ** 2, 1e-300)
                    if part_of_it >= _MORE:
                        worths[i, 0] = max(worths[i, 0], scores[block, j])
                    elif part_of_it <= _LESS:
                        worths[i, 2] = max(worths[i, 2], scores[block, j])

    return plan
