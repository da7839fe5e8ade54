"""The best ways through the map of a model's state, compiled: a plan, built move by move.

As by dynamic programming, of all ways that lead into the same cell of the plane of the first two states only the best
is followed; and of these, so many of the best. So a long plan is found in the time of a short one. A way goes on with
the highest input, the lowest, none, and half of either, since near its limit a signal may be led too far by a whole
push and not far enough by none. In its first moves, which will be played, quarters are tried, too. Far ahead, where the
plan will be made anew, only the highest and the lowest are, and fewer ways are followed.
A way's score is what it has taught together with what the rest of the episode will teach anyway, at the rate of the
last plans. Without the latter a way would be praised for what every way teaches sooner or later.

The plane is that of (x_t, x_{t-1}) for Eq. (2), of displacement and velocity for Eq. (1); a model with one state has a
line. Each state is measured by its size when the first sensor is at its limit (`agents.planner.motion.Swing`). Other
states, and older inputs, are followed with their way, and do not tell ways apart.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.candidates import CHOICES, choose, uniform
from agents.planner.imagination import mind
from estimator.arrays import aligned, copy, highest
from estimator.engine.imagination import imagination
from estimator.lanes import LANES, jit, lanewise, part
from estimator.models.model import Model
from estimator.straight import straight

#: Where not all inputs are tried, so many are, and far ahead so many.
_SOME, _FEW = 5, 2

#: Sizes that are tried of a first input whose direction is given and that is held for one sample, in parts of the
#: largest.
_SIZES = (1.0, 0.75, 0.5, 0.25)

#: A way this much [nats] worse than the best of its length is followed no further.
_HOPELESS = 0.5

#: Halvings of that in which a score is searched that no more than so many ways reach.
_HALVINGS = 12


class Map(NamedTuple):
    """Compiled functions of one model.

    Attributes:
        memory: ``memory(horizon, ways)``: a `Memory` for plans of so many moves and so many ways, which are a multiple
            of `LANES`.
        find: ``find(memory, task, found, words)``: the best way, a plan ``found`` (horizon,). The map is laid anew at
            random every time.
    """

    memory: Any
    find: Any


class Memory(NamedTuple):
    """What is written on.

    Attributes:
        ways: blocks of the ways that are followed.
        continued: blocks of their continuations.
        origins: (horizon, ways) of which way each continues.
        inputs: (horizon, ways) with which input.
        scores: (len(`CHOICES`) ways,) of the best continuations into the cells that any leads into.
        ends: (len(`CHOICES`) ways,) which these are.
        visited: (len(`CHOICES`) ways,) which cells.
        sources: (ways,) where the continuations begin that become ways.
    """

    ways: Any
    continued: Any
    origins: Any
    inputs: Any
    scores: Any
    ends: Any
    visited: Any
    sources: Any


class Task(NamedTuple):
    """What is searched for, of one environment.

    Attributes:
        record: the belief.
        left: samples left in the episode.
        steps: moves of the plan.
        pace: samples of a move.
        terms: `agents.planner.imagination.Terms`.
        lasts: (2,) the inputs that were applied last, newest first.
        M: (K, K) factor of the information per sample that is to come.
        cells: of the map along each axis.
        finest: moves for which all inputs are tried.
        fine: moves up to which whole and half ones are; then the highest and the lowest alone.
        ways: that are followed, at most.
        fewer: of these, beyond ``fine`` moves.
        first: where the first input goes: 1.0 up, -1.0 down, 0.0 there is none, NaN anywhere.
        sign: -1.0 turns the map over.
    """

    record: Any
    left: int
    steps: int
    pace: int
    terms: Any
    lasts: Any
    M: Any
    cells: int
    finest: int
    fine: int
    ways: int
    fewer: int
    first: float
    sign: float


@cache
def mapped(model: Model, degree: int = 0, lag: int = 0) -> Map:
    """The ways through the map of a model; arguments as `estimator.engine.imagination.imagination`."""
    imagined = mind(model, degree, lag)
    size, kept, U, SCORE = imagined.size, imagined.kept, imagined.u, imagined.score
    begin, advance, appraise = imagined.fill, imagined.advance, imagined.appraise
    states = {"FIRST": 0, "SECOND": 1, "CELL": imagination(model, degree, lag).layout["CELL"]}
    CELL = states["CELL"] * LANES
    in_line = lanewise(states, "CELL", uniform="sign right cells scale")(_cell_of_line)
    in_plane = lanewise(states, "CELL", uniform="sign right up cells scale other")(_cell_of_plane)
    is_plane = model.n_states > 1
    inner = part(f"{model.name}_{model.digest}_{degree}_{lag}")

    @inner
    def memory(horizon, ways):
        blocks = ways // LANES
        followed, continued = aligned(blocks, size), aligned(len(CHOICES) * blocks, size)
        origins, inputs = np.empty((horizon, ways), np.int64), np.empty((horizon, ways))
        most = len(CHOICES) * ways
        scores, ends, visited = np.empty(most), np.empty(most, np.int64), np.empty(most, np.int64)
        return Memory(followed, continued, origins, inputs, scores, ends, visited, np.empty(ways, np.int64))

    @inner
    def gather(memory, h, most, found):
        """Make the best of the continuations the new ways, and note where they come from; gives their number.

        Into ``found`` cells leads any; the scores become those of the ways.
        """
        ways, continued, origins, inputs, scores, ends, _, sources = memory
        enough = enough_for(scores[:found], most)
        count = 0
        for i in range(found):
            if scores[i] >= enough and count < most:
                b, j = ends[i] // LANES, ends[i] % LANES
                origins[h, count] = b // len(CHOICES) * LANES + j
                inputs[h, count] = continued[b, U + j]
                scores[count], sources[count] = scores[i], b * size + j
                count += 1
        # Lanes beyond the last way do the same work as the others, so that none of them runs wild.
        for lane in range(count, -(-count // LANES) * LANES):
            sources[lane] = sources[lane // LANES * LANES]
        numbers = continued.reshape(-1)
        for block in range(-(-count // LANES)):
            for row in range(0, kept, LANES):
                for lane in range(LANES):
                    ways[block, row + lane] = numbers[sources[block * LANES + lane] + row]
        return count

    @inner
    def find(memory, task, found, words):
        """Build a plan by the best ways into the cells of the map, which is laid anew at random every time."""
        ways, continued, origins, inputs, scores, ends, visited, _ = memory
        record, terms, M, pace = task.record, task.terms, task.M, task.pace  # once: each time they would be counted
        entered = np.full(task.cells * task.cells if is_plane else task.cells, -1)
        right, up = uniform(words), uniform(words)
        begin(ways[0], record, task.lasts)
        count = 1
        for h in range(task.steps):
            reachable = 0
            is_given = h == 0 and task.first == task.first
            tried = len(CHOICES) if h < task.finest else _SOME if h < task.fine else _FEW
            if is_given:
                tried = len(_SIZES) if task.first != 0.0 and pace == 1 else 1
            for i in range(tried * (-(-count // LANES))):
                block, choice = i // tried, i % tried
                b = block * len(CHOICES) + choice
                W = continued[b]
                copy(W, 0, ways[block], kept)
                for j in range(LANES):
                    W[U + j] = sized(choice, task) if is_given else choose(choice, W[U + j], terms)
                for _ in range(pace):
                    advance(W, record, terms)
                appraise(W, M, np.sqrt(max(0, task.left - (h + 1) * pace)))
                if is_plane:
                    in_plane(W, task.sign, right, up, task.cells, terms.scales[0], terms.scales[1])
                else:
                    in_line(W, task.sign, right, task.cells, terms.scales[0])
                for j in range(min(LANES, count - block * LANES)):
                    cell = np.int64(W[CELL + j])
                    if entered[cell] < 0:
                        entered[cell] = reachable
                        visited[reachable], scores[reachable] = cell, -np.inf
                        reachable += 1
                    at = entered[cell]
                    if W[SCORE + j] > scores[at]:
                        scores[at], ends[at] = W[SCORE + j], b * LANES + j
            for i in range(reachable):
                entered[visited[i]] = -1
            count = gather(memory, h, task.ways if h < task.fine else task.fewer, reachable)
        way = highest(scores, count)
        for h in range(task.steps - 1, -1, -1):
            found[h] = inputs[h, way]
            way = origins[h, way]

    return Map(memory, find)


@jit
def sized(choice, task):
    """One of the first inputs in the direction that is given."""
    return task.first * _SIZES[choice] * task.terms.amplitude


@jit
def enough_for(scores, most):
    """A score that no more than ``most`` of them reach, but where more are the highest, and none that is hopeless."""
    high = scores[highest(scores, len(scores))]
    low = high - _HOPELESS
    if _reached(scores, low) <= most:
        return low
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _reached(scores, middle) > most:
            low = middle
        else:
            high = middle
    return high


@jit
def _reached(scores, enough):
    """How many scores are as high or higher."""
    count = 0
    for i in range(len(scores)):
        count += scores[i] >= enough
    return count


@straight
def _along(x, scale, cells, offset):
    """The cell along one axis; the first for a state that is not a number."""
    where = (x / scale + 1.0) * 0.5 * (cells - 1) + offset
    return math.floor(min(where, cells - 1.0)) if where > 0.0 else 0.0


def _cell_of_line(FIRST, sign, right, cells, scale):
    """The cell of a state of one number."""
    return _along(sign * FIRST, scale, cells, right)


def _cell_of_plane(FIRST, SECOND, sign, right, up, cells, scale, other):
    """The cell of a state, of which the first two numbers count."""
    return _along(sign * FIRST, scale, cells, right) * cells + _along(sign * SECOND, other, cells, up)
