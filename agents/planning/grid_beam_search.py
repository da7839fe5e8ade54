"""Beam search on a grid of a model's state, compiled: a plan of inputs, built move by move.

As in dynamic programming, of all paths that lead into the same cell of the first two states only the best is kept; and
of these the best, up to the beam width. So a long plan is found in the time of a short one. A path continues with the
highest input, the lowest, none, and half of either: near the limit a full push may lead too far, and none not far
enough. In the first moves, which will be played, quarters are tried as well. Far ahead, where plans will be made anew,
only the highest and the lowest input are tried, on fewer beams.
The score of a path is its information together with the information that the rest of the episode is expected to bring,
at the rate of the last plans. Without the latter, a path would be credited with information that every path gains.

The plane is (x_t, x_{t-1}) for Eq. (2), and displacement and velocity for Eq. (1); a model with one state has a line.
States are in units of their sizes when the first sensor is at its limit (`agents.planning.time_scales.TimeScales`).
Other states, and older inputs, belong to a path and do not distinguish cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.belief_rollout import compile_belief_rollout
from agents.planning.plan_mutations import INPUT_FRACTIONS, allowed_input, next_uniform
from agents.planning.plan_objective import PlanObjective
from estimator.compilation.array_operations import aligned_matrix, copy, index_of_max
from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import LANES, jit, jit_closure, lanewise
from estimator.engine.expected_update import compile_expected_update
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: Inputs of a move after those for which all are tried.
_N_INPUTS_NEAR = 5

#: Inputs of a move far ahead.
_N_INPUTS_FAR = 2

#: Sizes of a first input whose direction is given and that is held for one sample, in parts of the largest.
_FIRST_INPUT_SIZES = (1.0, 0.75, 0.5, 0.25)

#: Distance [nats] from the best path of the same length beyond which a path is dropped.
_PRUNE_GAP = 0.5

#: Bisections of that distance for the score that no more paths than the beam width reach.
_N_BISECTIONS = 12


class GridBeamSearch(NamedTuple):
    """Compiled functions of one model.

    Attributes:
        workspace: ``workspace(horizon, beam_width)`` makes a `BeamWorkspace` for plans of ``horizon`` moves; the beam
            width is a multiple of `LANES`.
        find_best_plan: ``find_best_plan(workspace, problem, plan, rng_state)`` fills in the best plan (horizon,). The
            grid has a random offset each time.
    """

    workspace: Callable[..., Any]
    find_best_plan: Callable[..., None]


class BeamWorkspace(NamedTuple):
    """Memory of one search.

    Attributes:
        beams: blocks of the paths that are followed.
        continuations: blocks of their continuations.
        parents: (horizon, beams) the path that each one continues.
        inputs: (horizon, beams) the input with which it does.
        scores: (len(`INPUT_FRACTIONS`) beams,) of the best continuation into each visited cell.
        best_continuations: (len(`INPUT_FRACTIONS`) beams,) these continuations.
        visited_cells: (len(`INPUT_FRACTIONS`) beams,) these cells.
        source_offsets: (beams,) where the continuations that become beams begin.
    """

    beams: Any
    continuations: Any
    parents: Any
    inputs: Any
    scores: Any
    best_continuations: Any
    visited_cells: Any
    source_offsets: Any


class SearchProblem(NamedTuple):
    """The problem of one decision in one environment.

    Attributes:
        record: the belief.
        samples_left: samples left in the episode.
        n_moves: moves of the plan.
        hold_samples: samples of a move.
        objective: `agents.planning.plan_objective.PlanObjective`.
        previous_inputs: (2,) the inputs that were applied last, newest first.
        information_factor: (K, K) factor of the expected information per sample of the rest of the episode.
        cells: of the grid along each axis.
        n_moves_all_inputs: moves for which all inputs are tried.
        n_moves_some_inputs: moves up to which whole and half inputs are tried; then the highest and the lowest alone.
        beam_width: paths that are followed, at most.
        far_beam_width: the same beyond ``n_moves_some_inputs`` moves.
        first_direction: of the first input: 1.0 up, -1.0 down, 0.0 none, NaN any.
        mirror_sign: -1.0 mirrors the grid.
    """

    record: FloatArray
    samples_left: int
    n_moves: int
    hold_samples: int
    objective: PlanObjective
    previous_inputs: FloatArray
    information_factor: FloatArray
    cells: int
    n_moves_all_inputs: int
    n_moves_some_inputs: int
    beam_width: int
    far_beam_width: int
    first_direction: float
    mirror_sign: float


@cache
def _compile_selection(model: Model, degree: int, lag: int) -> tuple[Any, Any]:
    """``workspace``, as `GridBeamSearch`, and ``select_beams``."""
    rollout = compile_belief_rollout(model, degree, lag)
    size, n_carried, U = rollout.size, rollout.n_carried, rollout.input_row
    compile_inner = jit_closure(f"{model.name}_{model.digest}_{degree}_{lag}")

    @compile_inner
    def workspace(horizon, beams):
        blocks = beams // LANES
        beam_blocks, continuations = aligned_matrix(blocks, size), aligned_matrix(len(INPUT_FRACTIONS) * blocks, size)
        parents, inputs = np.empty((horizon, beams), np.int64), np.empty((horizon, beams))
        most = len(INPUT_FRACTIONS) * beams
        scores, best_continuations, visited_cells = np.empty(most), np.empty(most, np.int64), np.empty(most, np.int64)
        return BeamWorkspace(
            beam_blocks,
            continuations,
            parents,
            inputs,
            scores,
            best_continuations,
            visited_cells,
            np.empty(beams, np.int64),
        )

    @compile_inner
    def select_beams(memory, h, most, found):
        """Make the best continuations, of ``found`` visited cells, the new beams; return their number.

        Their parents and inputs are stored, and their scores come first.
        """
        beams, continuations, parents, inputs, scores, best_continuations, _, source_offsets = memory
        threshold = score_threshold(scores[:found], most)
        count = 0
        for i in range(found):
            if scores[i] >= threshold and count < most:
                b, j = best_continuations[i] // LANES, best_continuations[i] % LANES
                parents[h, count] = b // len(INPUT_FRACTIONS) * LANES + j
                inputs[h, count] = continuations[b, U + j]
                scores[count], source_offsets[count] = scores[i], b * size + j
                count += 1
        # Lanes beyond the last beam repeat others, so that their numbers stay finite.
        for lane in range(count, -(-count // LANES) * LANES):
            source_offsets[lane] = source_offsets[lane // LANES * LANES]
        flat_values = continuations.reshape(-1)
        for block in range(-(-count // LANES)):
            for row in range(0, n_carried, LANES):
                for lane in range(LANES):
                    beams[block, row + lane] = flat_values[source_offsets[block * LANES + lane] + row]
        return count

    return workspace, select_beams


@cache
def compile_grid_beam_search(model: Model, degree: int = 0, lag: int = 0) -> GridBeamSearch:
    """Compile for a model; arguments as `estimator.engine.expected_update.compile_expected_update`."""
    rollout = compile_belief_rollout(model, degree, lag)
    n_carried, U, SCORE = rollout.n_carried, rollout.input_row, rollout.score_row
    load_belief, advance, evaluate = rollout.load_belief, rollout.advance, rollout.evaluate
    workspace, select_beams = _compile_selection(model, degree, lag)
    states = {"FIRST": 0, "SECOND": 1, "CELL": compile_expected_update(model, degree, lag).layout["CELL"]}
    CELL = states["CELL"] * LANES
    in_line = lanewise(states, "CELL", uniform="mirror_sign offset_x cells scale")(_cell_on_line)
    in_plane = lanewise(states, "CELL", uniform="mirror_sign offset_x offset_y cells scale scale_y")(_cell_in_plane)
    is_plane = model.n_states > 1
    compile_inner = jit_closure(f"{model.name}_{model.digest}_{degree}_{lag}")

    @compile_inner
    def find_best_plan(memory, problem, found, rng_state):
        """Fill in the best plan, on a grid with a random offset."""
        beams, continuations, parents, inputs, scores, best_continuations, visited_cells, _ = memory
        record, objective, information_factor, hold_samples = (
            problem.record,
            problem.objective,
            problem.information_factor,
            problem.hold_samples,
        )  # once: Numba counts references at each access
        cell_entries = np.full(problem.cells * problem.cells if is_plane else problem.cells, -1)
        offset_x, offset_y = next_uniform(rng_state), next_uniform(rng_state)
        load_belief(beams[0], record, problem.previous_inputs)
        count = 1
        for h in range(problem.n_moves):
            n_reached = 0
            has_direction = h == 0 and problem.first_direction == problem.first_direction
            n_inputs = (
                len(INPUT_FRACTIONS)
                if h < problem.n_moves_all_inputs
                else _N_INPUTS_NEAR
                if h < problem.n_moves_some_inputs
                else _N_INPUTS_FAR
            )
            if has_direction:
                n_inputs = len(_FIRST_INPUT_SIZES) if problem.first_direction != 0.0 and hold_samples == 1 else 1
            for i in range(n_inputs * (-(-count // LANES))):
                block, choice = i // n_inputs, i % n_inputs
                b = block * len(INPUT_FRACTIONS) + choice
                W = continuations[b]
                copy(W, 0, beams[block], n_carried)
                for j in range(LANES):
                    W[U + j] = (
                        first_input(choice, problem) if has_direction else allowed_input(choice, W[U + j], objective)
                    )
                for _ in range(hold_samples):
                    advance(W, record, objective)
                evaluate(W, information_factor, np.sqrt(max(0, problem.samples_left - (h + 1) * hold_samples)))
                if is_plane:
                    in_plane(
                        W,
                        problem.mirror_sign,
                        offset_x,
                        offset_y,
                        problem.cells,
                        objective.scales[0],
                        objective.scales[1],
                    )
                else:
                    in_line(W, problem.mirror_sign, offset_x, problem.cells, objective.scales[0])
                for j in range(min(LANES, count - block * LANES)):
                    cell = np.int64(W[CELL + j])
                    if cell_entries[cell] < 0:
                        cell_entries[cell] = n_reached
                        visited_cells[n_reached], scores[n_reached] = cell, -np.inf
                        n_reached += 1
                    at = cell_entries[cell]
                    if W[SCORE + j] > scores[at]:
                        scores[at], best_continuations[at] = W[SCORE + j], b * LANES + j
            for i in range(n_reached):
                cell_entries[visited_cells[i]] = -1
            count = select_beams(
                memory, h, problem.beam_width if h < problem.n_moves_some_inputs else problem.far_beam_width, n_reached
            )
        beam = index_of_max(scores, count)
        for h in range(problem.n_moves - 1, -1, -1):
            found[h] = inputs[h, beam]
            beam = parents[h, beam]

    return GridBeamSearch(workspace, find_best_plan)


@jit
def first_input(size_index, problem):
    """An input in the direction of the problem, of one of `_FIRST_INPUT_SIZES`."""
    return problem.first_direction * _FIRST_INPUT_SIZES[size_index] * problem.objective.amplitude


@jit
def score_threshold(scores, max_count):
    """A score within `_PRUNE_GAP` of the best that at most ``max_count`` scores reach, unless more tie for the best."""
    high = scores[index_of_max(scores, len(scores))]
    low = high - _PRUNE_GAP
    if _count_reaching(scores, low) <= max_count:
        return low
    for _ in range(_N_BISECTIONS):
        middle = 0.5 * (low + high)
        if _count_reaching(scores, middle) > max_count:
            low = middle
        else:
            high = middle
    return high


@jit
def _count_reaching(scores, threshold):
    """Number of scores at or above the threshold."""
    count = 0
    for i in range(len(scores)):
        count += scores[i] >= threshold
    return count


@scalar_jit
def _axis_cell(x, scale, cells, offset):
    """The cell along one axis; the first one for NaN."""
    position = (x / scale + 1.0) * 0.5 * (cells - 1) + offset
    return math.floor(min(position, cells - 1.0)) if position > 0.0 else 0.0


def _cell_on_line(FIRST, mirror_sign, offset_x, cells, scale):
    """The cell of a single state."""
    return _axis_cell(mirror_sign * FIRST, scale, cells, offset_x)


def _cell_in_plane(FIRST, SECOND, mirror_sign, offset_x, offset_y, cells, scale, scale_y):
    """The cell of the first two states."""
    return _axis_cell(mirror_sign * FIRST, scale, cells, offset_x) * cells + _axis_cell(
        mirror_sign * SECOND, scale_y, cells, offset_y
    )
