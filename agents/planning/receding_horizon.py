"""Receding-horizon planning, compiled for a model: beam search on a grid of its states, and refinement of the best.

The information of a plan has many local maxima, and changing a long plan here and there finds a poor one, even for a
known system. So a plan is built move by move, by a beam search (`agents.planning.grid_beam_search`). An input is held
for `agents.planning.plan_objective.PlanObjective.hold_samples` samples, a *move*. Towards the end of an episode moves
become shorter, by whole divisors, so that the last plan, which kept the limit, remains a plan.

Three starts are refined, each to its own local maximum (`agents.planning.plan_refinement`): the plan of the beam
search, the last plan, and the runner-up of the last decision, both without their first move. The best result is
followed. If only the best start were refined, it would nearly always be the last plan, which has been refined before.
Starts are given up as soon as they do not catch up at the pace of their last round. Where plans reach the end of the
episode there are two beam searches, and both plans are refined.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planning.belief_rollout import compile_belief_rollout
from agents.planning.d_optimality import factorise_information
from agents.planning.discount import fill_discount_weights, filter_delay_in_moves
from agents.planning.grid_beam_search import SearchProblem, compile_grid_beam_search
from agents.planning.model_probe import ModelView
from agents.planning.newton_steps import empty_candidate_batch
from agents.planning.plan_mutations import drop_played_move, hold_samples_for
from agents.planning.plan_objective import PlanObjective, objective_at
from agents.planning.plan_refinement import compile_plan_refinement
from estimator.compilation.array_operations import copy, fill, index_of_max
from estimator.compilation.simd import LANES, jit, jit_closure, kernel
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: Cells of the grid per beam. Far ahead there is a block of beams less; with a hard margin there are always the most.
_CELLS_PER_BEAM = 10

#: Blocks of `LANES` beams, at least.
_MIN_BEAM_BLOCKS = 2

#: Blocks of `LANES` beams, at most.
_MAX_BEAM_BLOCKS = 4

#: Moves left in an episode from which the search is wider: no later plan corrects a mistake.
_FINAL_MOVES = 48

#: Beams of that wider search.
_FINAL_BEAM_WIDTH = 6 * LANES

#: Moves of a plan in that wider search, at most.
_FINAL_HORIZON = 24

#: First moves for which all inputs are tried, times the cells along an axis: the coarser a grid, the fewer paths lead
#: through it, and the more inputs can be tried for each.
_ALL_INPUTS_CELLS = 125

#: First moves for which some inputs are tried, times the cells along an axis.
_SOME_INPUTS_CELLS = 250

#: Plans that are kept from the last decision: the last plan and the runner-up.
_N_PLANS_KEPT = 2

#: Beam searches of a decision whose plans reach the end of the episode.
_N_FINAL_SEARCHES = 2

#: Distance [nats] from the best plan at which a start is not refined.
_PRUNE_GAP = 0.05

#: Difference of an input, in parts of the largest, by which a runner-up differs from the best plan at least.
_MIN_PLAN_DISTANCE = 0.3

#: First moves among which that input is.
_N_MOVES_COMPARED = 20


class PlanSettings(NamedTuple):
    """The settings of a planner.

    Attributes:
        model_view: how the model is taken.
        objective: of plans, for a whole episode.
        horizon: moves of a plan, at most.
        rounds: of refinement of each plan, at most.
    """

    model_view: ModelView
    objective: PlanObjective
    horizon: int
    rounds: int


class PlanArrays(NamedTuple):
    """The plans of n environments between two decisions; a decision overwrites them.

    Attributes:
        plans: (n, horizon) the best plans, begun one move ago.
        runner_ups: (n, horizon) the next best plans.
        information_rates: (n, K, K) running means of the information per sample of the last moves of plans; zeros
            before the first decision.
        rng_states: (n, 4) streams of random numbers.
        actions: (n,) receives the first input of each best plan.
        holds: (n,) samples of a move.
    """

    plans: FloatArray
    runner_ups: FloatArray
    information_rates: FloatArray
    rng_states: npt.NDArray[np.uint64]
    actions: FloatArray
    holds: npt.NDArray[np.int64]


class _PlanStore(NamedTuple):
    """The rows of one environment in `PlanArrays`."""

    best: Any
    runner_up: Any
    information_rate: Any
    rng_state: Any


class RecedingHorizon(NamedTuple):
    """Compiled functions of one model.

    Attributes:
        plan: ``plan(records, samples_left, horizon, rounds, objective, previous_inputs, arrays)`` plans the next inputs
            of n environments:

            - ``records`` (n, size): their beliefs;
            - ``samples_left`` (n,): samples left in their episodes;
            - ``horizon``: moves of a plan, at most;
            - ``rounds``: of refinement of each plan, at most, two blocks of `LANES` candidates each;
            - ``objective``: `agents.planning.plan_objective.PlanObjective` of the whole episode;
            - ``previous_inputs`` (n, 2): the inputs that were applied last, newest first;
            - ``arrays``: `PlanArrays`, overwritten.
        plan_known_system: ``plan_known_system(record, first, horizon, rounds, objective, u, rng_state)`` plans the
            inputs u (T,) from sample ``first`` on for a system at the means of the belief, and keeps the inputs before
            it. Arguments as of ``plan``, but the objective is of one sample, ``rng_state`` is (4,), and the record is
            overwritten.
    """

    plan: Callable[..., None]
    plan_known_system: Callable[..., None]


@cache
def _compile_problem(model: Model, degree: int, lag: int) -> Any:
    """``search_problem(record, samples_left, objective, previous_inputs, information_rate, weights)``."""
    NOISE, k = compile_belief_rollout(model, degree, lag).noise_index, model.n_coefficients

    @jit_closure(f"{model.name}_{model.digest}_{degree}_{lag}")
    def search_problem(record, samples_left, objective, previous_inputs, information_rate, weights):
        """The problem of a decision; fills in the discount's weights (horizon,)."""
        horizon = len(weights)
        beam_width, far_beam_width = beam_widths(objective.cells, objective.hard_margin > 0.0)
        hold = hold_samples_for(samples_left, min(horizon, _FINAL_HORIZON), objective.hold_samples)
        n_moves = min(horizon, -(-samples_left // hold))  # to the end or beyond, so that no sample goes unchecked
        if samples_left <= _FINAL_MOVES * hold:
            beam_width, far_beam_width, n_moves = _FINAL_BEAM_WIDTH, _FINAL_BEAM_WIDTH, min(n_moves, _FINAL_HORIZON)
        information_factor = np.zeros((k, k))
        factorise_information(information_rate, information_factor)
        discount_moves = objective.discount_moves + filter_delay_in_moves(record, NOISE, hold)
        fill_discount_weights(weights, n_moves, np.inf if samples_left <= n_moves * hold else discount_moves)
        beam_settings = (
            objective.cells,
            _ALL_INPUTS_CELLS // objective.cells,
            _SOME_INPUTS_CELLS // objective.cells,
            beam_width,
            far_beam_width,
        )
        return SearchProblem(
            record,
            samples_left,
            n_moves,
            hold,
            objective,
            previous_inputs,
            information_factor,
            *beam_settings,
            np.nan,
            1.0,
        )

    return search_problem


@cache
def _compile_decision(model: Model, degree: int, lag: int) -> Any:
    """``decide(workspace, batch, record, samples_left, rounds, objective, previous_inputs, store, previous_hold)``."""
    search_problem = _compile_problem(model, degree, lag)
    select_starts, refine_plan, update_information_rate, _ = compile_plan_refinement(model, degree, lag)
    find_best_plan = compile_grid_beam_search(model, degree, lag).find_best_plan
    k, compile_inner = model.n_coefficients, jit_closure(f"{model.name}_{model.digest}_{degree}_{lag}")

    @compile_inner
    def refine_in_turn(W, problem, batch, starts, scores, end_precisions, rounds, rng_state):
        """Refine the starts, the best first; return the index of the winner."""
        n, waiting, best_score = len(starts), scores.copy(), -np.inf
        for _ in range(n):
            s = index_of_max(waiting, n)
            if waiting[s] < best_score - _PRUNE_GAP:
                break
            waiting[s] = -np.inf
            scores[s] = refine_plan(
                W, problem, batch, starts[s], scores[s], end_precisions[s], rounds, best_score, rng_state
            )
            best_score = max(best_score, scores[s])
        return index_of_max(scores, n)

    @compile_inner
    def decide(memory, batch, record, samples_left, rounds, objective, previous_inputs, store, previous_hold):
        """Improve the plans of a store, begun one move of ``previous_hold`` samples ago; return the new hold."""
        best, runner_up, information_rate, rng_state = store
        W = memory.beams[0]
        problem = search_problem(record, samples_left, objective, previous_inputs, information_rate, batch.weights)
        n_moves, hold = problem.n_moves, problem.hold_samples
        drop_played_move(best, n_moves, previous_hold, hold)
        drop_played_move(runner_up, n_moves, previous_hold, hold)
        n = _N_PLANS_KEPT + (_N_FINAL_SEARCHES if samples_left <= _FINAL_HORIZON * hold else 1)
        starts, scores, end_precisions = np.zeros((n, len(best))), np.empty(n), np.zeros((n, k, k))
        copy(starts[0], 0, best, len(best))
        copy(starts[1], 0, runner_up, len(best))
        for s in range(_N_PLANS_KEPT, n):
            find_best_plan(memory, problem, starts[s], rng_state)
        select_starts(W, problem, batch, starts, scores, end_precisions, rng_state)
        winner = refine_in_turn(W, problem, batch, starts, scores, end_precisions, rounds, rng_state)
        copy(best, 0, starts[winner], len(best))
        keep_runner_up(
            runner_up, best, starts, scores, min(n_moves, _N_MOVES_COMPARED), _MIN_PLAN_DISTANCE * objective.amplitude
        )
        # Where the coefficients walk, later information does not add to earlier information.
        if not (objective.walk > 0.0).any():
            update_information_rate(W, problem, best, end_precisions[winner], information_rate)
        return hold

    return decide


@cache
def compile_receding_horizon(model: Model, degree: int = 0, lag: int = 0) -> RecedingHorizon:
    """Compile for a model; arguments as `estimator.engine.expected_update.compile_expected_update`."""
    decide = _compile_decision(model, degree, lag)
    advance_record = compile_plan_refinement(model, degree, lag).advance_record
    size, k = compile_belief_rollout(model, degree, lag).size, model.n_coefficients
    workspace = compile_grid_beam_search(model, degree, lag).workspace
    compile_entry = kernel(variant=f"{model.name}_{model.digest}_{degree}_{lag}")

    @compile_entry
    def plan(records, samples_left, horizon, rounds, objective, previous_inputs, arrays):
        kept_workspace, batch = workspace(horizon, _FINAL_BEAM_WIDTH), empty_candidate_batch(horizon)
        plans, runner_ups, information_rates, rng_states, actions, holds = arrays
        for i in range(len(records)):
            holds[i] = decide(
                kept_workspace,
                batch,
                records[i],
                max(1, samples_left[i]),
                rounds,
                objective_at(objective, samples_left[i]),
                previous_inputs[i],
                _PlanStore(plans[i], runner_ups[i], information_rates[i], rng_states[i]),
                holds[i],
            )
            actions[i] = plans[i, 0]

    @compile_entry
    def plan_known_system(record, first, horizon, rounds, objective, u, rng_state):
        kept_workspace, batch = workspace(horizon, _FINAL_BEAM_WIDTH), empty_candidate_batch(horizon)
        W, previous_inputs, held, hold = np.empty(size), np.zeros(2), 0, 1
        store = _PlanStore(np.zeros(horizon), np.zeros(horizon), np.zeros((k, k)), rng_state)
        for t in range(len(u)):
            if t >= first:
                if held == 0:
                    held = hold = decide(
                        kept_workspace, batch, record, len(u) - t, rounds, objective, previous_inputs, store, hold
                    )
                u[t] = store.best[0]
                held -= 1
            advance_record(W, record, u[t], previous_inputs, objective)

    return RecedingHorizon(plan, plan_known_system)


@jit
def beam_widths(cells, has_hard_margin):
    """Beams for a grid with this number of cells along an axis, near and far ahead: whole blocks.

    Example:
        >>> [beam_widths(cells, False) for cells in (22, 25, 35, 38)], beam_widths(25, True)
        ([(64, 32), (64, 32), (128, 96), (128, 96)], (128, 128))
    """
    if has_hard_margin:
        return LANES * _MAX_BEAM_BLOCKS, LANES * _MAX_BEAM_BLOCKS
    blocks = round(cells * cells / (_CELLS_PER_BEAM * LANES))
    width = LANES * max(_MIN_BEAM_BLOCKS, min(blocks, _MAX_BEAM_BLOCKS))
    return width, width - LANES


@jit
def keep_runner_up(runner_up, best, starts, scores, n_compared, min_distance):
    """Keep the best of the starts whose first inputs differ from the best plan's; zeros where none does."""
    fill(runner_up, 0.0)
    second = -np.inf
    for s in range(len(starts)):
        if scores[s] > second and max_input_difference(starts[s], best, n_compared) > min_distance:
            copy(runner_up, 0, starts[s], len(best))
            second = scores[s]


@jit
def max_input_difference(one, other, n_moves):
    """The largest difference between the inputs of two plans in their first moves."""
    largest = 0.0
    for h in range(n_moves):
        largest = max(largest, abs(one[h] - other[h]))
    return largest
