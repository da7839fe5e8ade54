"""The planner's search, compiled for a model: the best ways through the map of its state, and small changes of them.

The teaching of a plan has many summits, and changing a long plan here and there finds a poor one, even of a system that
is known. So the plan is built move by move, as the best way through the map of the model's state
(`agents.planning.grid_beam_search`). An input is held for `agents.planning.plan_objective.PlanObjective.hold_samples` samples, a *move*. Towards the
end of an episode moves become shorter, by whole numbers: so the last plan, which kept the limit, can go on as it was.

The best way, the last plan and the next best one then, both begun one sample ago, each lead to a summit of their own:
by rounds of steps that change all of a plan (`agents.planning.newton_steps`) and of small changes at random, until a round
brings little. The highest summit is followed. Were only the best of the three improved, the last plan would nearly
always be, as it has been improved before, and the search would keep to its summit. Those behind are given up as soon as
they do not catch up at the pace of their last round. Where plans reach the end of the episode there are two maps, and
the best way of each climbs.

What a move teaches counts the less the later it is in the plan (`agents.planning.discount`).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.belief_rollout import compile_belief_rollout
from agents.planning.candidate_inputs import hold_samples_for, limit_slew, mutate_plan, shift_plan
from agents.planning.d_optimality import factorise_information
from agents.planning.discount import discount_weight_drop, fill_discount_weights, filter_delay_in_moves
from agents.planning.grid_beam_search import SearchProblem, compile_grid_beam_search
from agents.planning.model_probe import ModelView
from agents.planning.newton_steps import empty_candidate_batch, fill_finite_differences, fill_newton_candidates
from agents.planning.plan_objective import PlanObjective, objective_at
from estimator.compilation.array_operations import copy, fill, index_of_max
from estimator.compilation.simd import LANES, jit, jit_closure, kernel
from estimator.models.model import Model

#: Of so many cells of the map, one way that leads into them is followed, in so many blocks at least, and at most. Far
#: ahead a block less tells as much. On rigs it does not, and as many ways as may be are followed throughout.
_CELLS_PER_BEAM, _MIN_BEAM_BLOCKS, _MAX_BEAM_BLOCKS = 10, 2, 4

#: Towards the end of an episode, when so many moves are left, no later plan mends what a plan misses: so many ways are
#: followed then, and plans look no further than so many moves.
_FINAL_MOVES, _FINAL_BEAM_WIDTH, _FINAL_HORIZON = 48, 6 * LANES, 24

#: All inputs are tried for so many first moves, over the map's cells along an axis, and some of them for so many: the
#: coarser a map, the fewer ways lead through it, and the more can be tried of each.
_ALL_INPUTS_CELLS, _SOME_INPUTS_CELLS = 125, 250

#: Plans that are improved in a decision, one after the other: so many that are kept, the last one and the next best,
#: and the best way through a map, or through so many maps where plans reach the end of the episode.
_N_PLANS_KEPT, _N_FINAL_SEARCHES = 2, 2

#: One this much [nats] worse than the best of them is not improved at all.
_PRUNE_GAP = 0.05

#: A round of steps and changed copies that brings less [nats] is the last one of a plan.
_MIN_GAIN = 0.00005

#: A plan is given up that so many rounds as good as its last would not make the best.
_PATIENCE_ROUNDS = 0.7

#: The next best plan has an input that differs by so much of the largest, among the first so many moves.
_MIN_PLAN_DISTANCE, _N_MOVES_COMPARED = 0.3, 20

#: Part of what a plan teaches per sample that goes into the running mean; and of how many of its last moves. Before
#: them a swing may still have to be built.
_RATE_UPDATE_FRACTION, _N_RATE_MOVES = 0.05, 25


class PlanSettings(NamedTuple):
    """The settings of a planner.

    Attributes:
        model_view: how the model is taken.
        objective: of plans, for a whole episode.
        horizon: moves of a plan, at most.
        rounds: of improvement of each plan, at most.
    """

    model_view: ModelView
    objective: PlanObjective
    horizon: int
    rounds: int


class RecedingHorizon(NamedTuple):
    """The search for a model, compiled.

    Attributes:
        plan: ``plan(records, samples_left, horizon, rounds, objective, previous_inputs, plans, runner_ups, information_rates, rng_state, actions, holds)``
            searches the best next inputs of n environments:

            - ``records`` (n, size): their beliefs;
            - ``samples_left`` (n,): samples left in their episodes;
            - ``horizon``: moves to plan, at most;
            - ``rounds``: of steps and changed copies of each plan that is improved, at most, two blocks of `LANES`
              each; one that brings little is the last;
            - ``objective``: `agents.planning.plan_objective.PlanObjective` of the whole episode;
            - ``previous_inputs`` (n, 2): the inputs that were applied last, newest first;
            - ``plans`` (n, horizon): the last plans, begun one move ago; overwritten by the new ones;
            - ``runner_ups`` (n, horizon): the next best ones then; overwritten as well;
            - ``information_rates`` (n, K, K): information per sample of the last moves of plans, a running mean; zeros where there
              was none yet; overwritten;
            - ``rng_state`` (n, 4): streams of random numbers; overwritten;
            - ``actions`` (n,): receives the first input of the best plan;
            - ``holds`` (n,): samples of a move of the last plans; overwritten by those of the new ones.
        plan_known_system: ``plan_known_system(record, first, horizon, rounds, objective, u, rng_state)`` plans the inputs u (T,) from sample ``first``
            on, where the means of the belief are the truth. The inputs before it are followed as they are. Arguments as
            of ``plan``, but the terms are of all samples alike; ``rng_state`` is (4,), and the record is overwritten.
        beam_through: ``beam_through(record, first, cells, objective, rate, rng_state, u)`` finds the inputs u (T,) from sample ``first``
            on, where the means of the belief are the truth, as the best way through so many cells along each axis.
            ``rate`` (K, K) is the information per sample that is expected of the rest of the way.
    """

    plan: Any
    plan_known_system: Any
    beam_through: Any


@cache
def compile_receding_horizon(model: Model, degree: int = 0, lag: int = 0) -> RecedingHorizon:
    """The search for a model; arguments as `estimator.engine.expected_update.compile_expected_update`."""
    rollout = compile_belief_rollout(model, degree, lag)
    size, U, SCORE, NEAR, NOISE = (
        rollout.size,
        rollout.input_row,
        rollout.score_row,
        rollout.margin_excess,
        rollout.noise_index,
    )
    load_belief, advance, evaluate = rollout.load_belief, rollout.advance, rollout.evaluate
    store_belief, coefficient_precision = rollout.store_belief, rollout.coefficient_precision
    workspace, find_best_plan = compile_grid_beam_search(model, degree, lag)
    k = model.n_coefficients
    compile_key = f"{model.name}_{model.digest}_{degree}_{lag}"
    compile_inner, compile_entry = jit_closure(compile_key), kernel(variant=compile_key)

    @compile_inner
    def evaluate_plans(W, problem, batch):
        """Find what rivals are worth, and how near to the limit they lead.

        They are worth the mean of what is known after each move, with the weights by which what moves teach fades.
        """
        n_moves, (candidates, scores_of_lanes, margin_excess, weights, _, _) = problem.n_moves, batch
        record, objective, information_factor, hold = (
            problem.record,
            problem.objective,
            problem.information_factor,
            problem.hold_samples,
        )  # once: each time they would be counted
        load_belief(W, record, problem.previous_inputs)
        fill(scores_of_lanes, 0.0)
        for h in range(n_moves):
            for j in range(LANES):
                W[U + j] = candidates[j, h]
                margin_excess[h, j] = -np.inf
            for _ in range(hold):
                advance(W, record, objective)
                for j in range(LANES):
                    margin_excess[h, j] = max(margin_excess[h, j], W[NEAR + j])
            share = discount_weight_drop(weights, h, n_moves)
            if share > 0.0:
                evaluate(W, information_factor, np.sqrt(max(0, problem.samples_left - (h + 1) * hold)))
                for j in range(LANES):
                    scores_of_lanes[j] += share * W[SCORE + j]

    @compile_inner
    def select(W, problem, batch, first, best, score, end_precision, rng_state):
        """Weigh the rivals, from lane ``first`` on changed copies of the best; gives the score of the winner.

        A new winner's precision (K, K) at the end of its plan comes into ``end_precision``.
        """
        candidates, objective = batch.candidates, problem.objective
        for j in range(LANES):
            if j >= first:
                copy(candidates[j], 0, best, len(best))
                mutate_plan(candidates[j], problem.n_moves, objective.amplitude, rng_state)
            limit_slew(candidates[j], problem.n_moves, problem.previous_inputs[0], objective)
        evaluate_plans(W, problem, batch)
        winner = index_of_max(batch.scores, LANES)
        if not batch.scores[winner] > score:
            return score
        copy(best, 0, candidates[winner], len(best))
        coefficient_precision(W, winner, end_precision)
        return batch.scores[winner]

    @compile_inner
    def refine_plan(W, problem, batch, plan, score, end_precision, rounds, best_score, rng_state):
        """Improve a plan (horizon,) in rounds, until one brings little, or it is given up; gives its score."""
        for _ in range(rounds):
            previous_score = score
            first = fill_finite_differences(batch, plan, problem.n_moves, problem.objective.amplitude)
            score = select(W, problem, batch, first, plan, score, end_precision, rng_state)
            first = fill_newton_candidates(batch, problem.n_moves, problem.objective.amplitude)
            score = select(W, problem, batch, first, plan, score, end_precision, rng_state)
            gain = score - previous_score
            if gain < _MIN_GAIN or score + _PATIENCE_ROUNDS * gain < best_score:
                break
        return score

    @compile_inner
    def select_starts(W, problem, batch, starts, scores, end_precisions, rng_state):
        """Replace each start by the best of its changed copies, and find its score and the precision at its end."""
        candidates = batch.candidates
        for j in range(LANES):
            copy(candidates[j], 0, starts[j % len(starts)], len(starts[0]))
            if j >= len(starts):
                mutate_plan(candidates[j], problem.n_moves, problem.objective.amplitude, rng_state)
        fill(candidates[LANES - 1], 0.0)  # rest keeps the limit, where nothing else may
        for j in range(LANES):
            limit_slew(candidates[j], problem.n_moves, problem.previous_inputs[0], problem.objective)
        evaluate_plans(W, problem, batch)
        for s in range(len(starts)):
            leader = s
            for j in range(s, LANES, len(starts)):
                if batch.scores[j] > batch.scores[leader]:
                    leader = j
            scores[s] = batch.scores[leader]
            copy(starts[s], 0, candidates[leader], len(starts[0]))
            coefficient_precision(W, leader, end_precisions[s])

    @compile_inner
    def update_information_rate(W, problem, plan, end_precision, information_rate):
        """Let the information per sample of a plan into the running mean; the first one is taken as it is."""
        before, built = np.empty((k, k)), max(0, problem.n_moves - _N_RATE_MOVES)
        load_belief(W, problem.record, problem.previous_inputs)
        for h in range(built):
            for j in range(LANES):
                W[U + j] = plan[h]
            for _ in range(problem.hold_samples):
                advance(W, problem.record, problem.objective)
        coefficient_precision(W, 0, before)
        samples = (problem.n_moves - built) * problem.hold_samples
        share, is_finite = _RATE_UPDATE_FRACTION if information_rate[0, 0] > 0.0 else 1.0, True
        for a in range(k):
            for b in range(k):
                is_finite = is_finite and np.isfinite(end_precision[a, b] - before[a, b])
        for a in range(k):
            for b in range(k):
                if is_finite:
                    information_rate[a, b] += share * (
                        (end_precision[a, b] - before[a, b]) / samples - information_rate[a, b]
                    )

    @compile_inner
    def decide(
        memory,
        batch,
        record,
        samples_left,
        rounds,
        objective,
        previous_inputs,
        best,
        runner_up,
        information_rate,
        rng_state,
        before,
    ):
        """Improve the plans ``best`` and ``runner_up`` (horizon,), and ``information_rate``; gives the samples of their moves.

        They began one move of so many samples ago.
        """
        W = memory.beams[0]
        moves = min(len(best), _FINAL_HORIZON)
        beam_width, far_beam_width = beam_widths(objective.cells, objective.hard_margin > 0.0)
        hold = hold_samples_for(samples_left, moves, objective.hold_samples)
        n_moves = min(len(best), -(-samples_left // hold))  # to the end, and a bit beyond: no limit is left unseen
        if samples_left <= _FINAL_MOVES * hold:
            beam_width, far_beam_width, n_moves = _FINAL_BEAM_WIDTH, _FINAL_BEAM_WIDTH, min(n_moves, _FINAL_HORIZON)
        information_factor = np.zeros((k, k))
        factorise_information(information_rate, information_factor)
        discount_moves = objective.discount_moves + filter_delay_in_moves(record, NOISE, hold)
        fill_discount_weights(batch.weights, n_moves, np.inf if samples_left <= n_moves * hold else discount_moves)
        beam_settings = (
            objective.cells,
            _ALL_INPUTS_CELLS // objective.cells,
            _SOME_INPUTS_CELLS // objective.cells,
            beam_width,
            far_beam_width,
        )
        problem = SearchProblem(
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
        shift_plan(best, n_moves, before, hold)
        shift_plan(runner_up, n_moves, before, hold)
        n = _N_PLANS_KEPT + (_N_FINAL_SEARCHES if samples_left <= _FINAL_HORIZON * hold else 1)
        starts, scores, end_precisions = np.zeros((n, len(best))), np.empty(n), np.zeros((n, k, k))
        copy(starts[0], 0, best, len(best))
        copy(starts[1], 0, runner_up, len(best))
        for s in range(_N_PLANS_KEPT, n):
            find_best_plan(memory, problem, starts[s], rng_state)
        select_starts(W, problem, batch, starts, scores, end_precisions, rng_state)
        waiting, best_score = scores.copy(), -np.inf
        for _ in range(n):
            s = index_of_max(waiting, n)
            if waiting[s] < best_score - _PRUNE_GAP:
                break
            waiting[s] = -np.inf
            scores[s] = refine_plan(
                W, problem, batch, starts[s], scores[s], end_precisions[s], rounds, best_score, rng_state
            )
            best_score = max(best_score, scores[s])
        winner = index_of_max(scores, n)
        copy(best, 0, starts[winner], len(best))
        fill(runner_up, 0.0)
        second = -np.inf
        for s in range(n):
            if (
                scores[s] > second
                and max_input_difference(starts[s], best, min(n_moves, _N_MOVES_COMPARED))
                > _MIN_PLAN_DISTANCE * objective.amplitude
            ):
                copy(runner_up, 0, starts[s], len(best))
                second = scores[s]
        # Where the coefficients walk, what is learned later does not add to what is learned now.
        if not (objective.walk > 0.0).any():
            update_information_rate(W, problem, best, end_precisions[winner], information_rate)
        return hold

    @compile_inner
    def advance_record(W, record, u, previous_inputs, objective):
        """Let the record follow an input over a sample; the input becomes the newest of the last ones."""
        load_belief(W, record, previous_inputs)
        for j in range(LANES):
            W[U + j] = u
        advance(W, record, objective)
        store_belief(W, record)
        previous_inputs[1], previous_inputs[0] = previous_inputs[0], u

    @compile_entry
    def plan(
        records,
        samples_left,
        horizon,
        rounds,
        objective,
        previous_inputs,
        plans,
        runner_ups,
        information_rates,
        rng_state,
        actions,
        holds,
    ):
        kept_workspace, batch = workspace(horizon, _FINAL_BEAM_WIDTH), empty_candidate_batch(horizon)
        for i in range(len(records)):
            arguments = (
                rounds,
                objective_at(objective, samples_left[i]),
                previous_inputs[i],
                plans[i],
                runner_ups[i],
                information_rates[i],
                rng_state[i],
                holds[i],
            )
            holds[i] = decide(kept_workspace, batch, records[i], max(1, samples_left[i]), *arguments)
            actions[i] = plans[i, 0]

    @compile_entry
    def plan_known_system(record, first, horizon, rounds, objective, u, rng_state):
        kept_workspace, batch = workspace(horizon, _FINAL_BEAM_WIDTH), empty_candidate_batch(horizon)
        best, runner_up, information_rate, W = np.zeros(horizon), np.zeros(horizon), np.zeros((k, k)), np.empty(size)
        previous_inputs, held, hold = np.zeros(2), 0, 1
        for t in range(len(u)):
            if t >= first:
                if held == 0:
                    arguments = rounds, objective, previous_inputs, best, runner_up, information_rate, rng_state, hold
                    held = hold = decide(kept_workspace, batch, record, len(u) - t, *arguments)
                u[t] = best[0]
                held -= 1
            advance_record(W, record, u[t], previous_inputs, objective)

    @compile_entry
    def beam_through(record, first, cells, objective, information_rate, rng_state, u):
        information_factor, W, previous_inputs = np.zeros((k, k)), np.empty(size), np.zeros(2)
        factorise_information(information_rate, information_factor)
        for t in range(first):
            advance_record(W, record, u[t], previous_inputs, objective)
        samples_left = len(u) - first
        beam_width = -(-cells * cells // LANES) * LANES
        problem = SearchProblem(
            record,
            samples_left,
            samples_left,
            1,
            objective,
            previous_inputs,
            information_factor,
            cells,
            0,
            samples_left,
            beam_width,
            beam_width,
            np.nan,
            1.0,
        )
        find_best_plan(workspace(samples_left, beam_width), problem, u[first:], rng_state)

    return RecedingHorizon(plan, plan_known_system, beam_through)


@jit
def beam_widths(cells, is_firm):
    """How many ways are followed through a map with so many cells along an axis, and how many far ahead: whole blocks.

    Example:
        >>> [beam_widths(cells, False) for cells in (22, 25, 35, 38)], beam_widths(25, True)
        ([(64, 32), (64, 32), (128, 96), (128, 96)], (128, 128))
    """
    if is_firm:
        return LANES * _MAX_BEAM_BLOCKS, LANES * _MAX_BEAM_BLOCKS
    blocks = round(cells * cells / (_CELLS_PER_BEAM * LANES))
    width = LANES * max(_MIN_BEAM_BLOCKS, min(blocks, _MAX_BEAM_BLOCKS))
    return width, width - LANES


@jit
def max_input_difference(one, other, n_moves):
    """By how much the inputs of two plans differ, at most, among so many first moves."""
    largest = 0.0
    for h in range(n_moves):
        largest = max(largest, abs(one[h] - other[h]))
    return largest
