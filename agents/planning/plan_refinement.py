"""Refinement of plans of inputs: Newton steps on the whole plan, and random mutations, compiled for a model.

A plan is improved in rounds. A round tries steps that change all of its first inputs (`agents.planning.newton_steps`)
and mutated copies (`agents.planning.plan_mutations`), and keeps the best candidate. The information that a move adds
is discounted by its place in the plan (`agents.planning.discount`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.belief_rollout import compile_belief_rollout
from agents.planning.discount import discount_weight_drop
from agents.planning.newton_steps import fill_finite_differences, fill_newton_candidates
from agents.planning.plan_mutations import limit_slew, mutate_plan
from estimator.compilation.array_operations import copy, fill, index_of_max
from estimator.compilation.simd import LANES, jit_closure
from estimator.models.model import Model

#: Gain [nats] of a round below which it is a plan's last.
_MIN_GAIN = 0.00005

#: Rounds as good as the last one after which a plan must be the best; otherwise it is given up.
_PATIENCE_ROUNDS = 0.7

#: Part of a plan's information per sample that enters the running mean.
_RATE_UPDATE_FRACTION = 0.05

#: Last moves of a plan by which that information is measured. Before them the oscillation may still build up.
_N_RATE_MOVES = 25


class Refinement(NamedTuple):
    """Compiled functions of one model; ``W`` is a block of plans (`agents.planning.belief_rollout.BeliefRollout`).

    Attributes:
        select_starts: ``select_starts(W, problem, batch, starts, scores, end_precisions, rng_state)`` replaces each
            start by the best of its mutated copies, and fills in its score and the precision at its end.
        refine_plan: ``refine_plan(W, problem, batch, plan, score, end_precision, rounds, best_score, rng_state)``
            improves a plan (horizon,) in rounds, and returns its score.
        update_information_rate: ``update_information_rate(W, problem, plan, end_precision, information_rate)`` updates
            the running mean of the information per sample.
        advance_record: ``advance_record(W, record, u, previous_inputs, objective)`` advances a record by an input.
    """

    select_starts: Callable[..., Any]
    refine_plan: Callable[..., Any]
    update_information_rate: Callable[..., Any]
    advance_record: Callable[..., Any]


def _compile_key(model: Model, degree: int, lag: int) -> str:
    return f"{model.name}_{model.digest}_{degree}_{lag}"


@cache
def _compile_evaluation(model: Model, degree: int, lag: int) -> Any:
    """``evaluate_plans(W, problem, batch)``."""
    rollout = compile_belief_rollout(model, degree, lag)
    U, SCORE, NEAR = rollout.input_row, rollout.score_row, rollout.margin_excess
    load_belief, advance, evaluate = rollout.load_belief, rollout.advance, rollout.evaluate

    @jit_closure(_compile_key(model, degree, lag))
    def evaluate_plans(W, problem, batch):
        """Fill in the scores and margin excesses of the candidates.

        A score is the mean of the net information after each move, with the discount's weights.
        """
        n_moves, (candidates, scores_of_lanes, margin_excess, weights, _, _) = problem.n_moves, batch
        record, objective, information_factor, hold = (
            problem.record,
            problem.objective,
            problem.information_factor,
            problem.hold_samples,
        )  # once: Numba counts references at each access
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

    return evaluate_plans


@cache
def _compile_rounds(model: Model, degree: int, lag: int) -> tuple[Any, Any]:
    """``select_starts`` and ``refine_plan``, as `Refinement`."""
    evaluate_plans = _compile_evaluation(model, degree, lag)
    coefficient_precision = compile_belief_rollout(model, degree, lag).coefficient_precision
    compile_inner = jit_closure(_compile_key(model, degree, lag))

    @compile_inner
    def select(W, problem, batch, first, best, score, end_precision, rng_state):
        """Evaluate the candidates, of which those from lane ``first`` on mutate the best; return the winner's score.

        A new winner overwrites ``best``, and the precision (K, K) at its end ``end_precision``.
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
        """Improve a plan (horizon,) until a round gains little or the plan is given up; return its score."""
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
        """Replace each start by the best of its mutated copies; fill in its score and the precision at its end."""
        candidates = batch.candidates
        for j in range(LANES):
            copy(candidates[j], 0, starts[j % len(starts)], len(starts[0]))
            if j >= len(starts):
                mutate_plan(candidates[j], problem.n_moves, problem.objective.amplitude, rng_state)
        fill(candidates[LANES - 1], 0.0)  # zero input keeps the limit where other plans may not
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

    return select_starts, refine_plan


@cache
def compile_plan_refinement(model: Model, degree: int = 0, lag: int = 0) -> Refinement:
    """Compile for a model; arguments as `estimator.engine.expected_update.compile_expected_update`."""
    rollout = compile_belief_rollout(model, degree, lag)
    U, k, load_belief, advance = rollout.input_row, model.n_coefficients, rollout.load_belief, rollout.advance
    store_belief, coefficient_precision = rollout.store_belief, rollout.coefficient_precision
    compile_inner = jit_closure(_compile_key(model, degree, lag))

    @compile_inner
    def update_information_rate(W, problem, plan, end_precision, information_rate):
        """Update the running mean of the information per sample; the first value is taken as it is."""
        start_precision, built = np.empty((k, k)), max(0, problem.n_moves - _N_RATE_MOVES)
        load_belief(W, problem.record, problem.previous_inputs)
        for h in range(built):
            for j in range(LANES):
                W[U + j] = plan[h]
            for _ in range(problem.hold_samples):
                advance(W, problem.record, problem.objective)
        coefficient_precision(W, 0, start_precision)
        samples = (problem.n_moves - built) * problem.hold_samples
        share, is_finite = _RATE_UPDATE_FRACTION if information_rate[0, 0] > 0.0 else 1.0, True
        for a in range(k):
            for b in range(k):
                is_finite = is_finite and np.isfinite(end_precision[a, b] - start_precision[a, b])
        for a in range(k):
            for b in range(k):
                if is_finite:
                    information_rate[a, b] += share * (
                        (end_precision[a, b] - start_precision[a, b]) / samples - information_rate[a, b]
                    )

    @compile_inner
    def advance_record(W, record, u, previous_inputs, objective):
        """Advance the record by an input over a sample; the input becomes the newest of the last ones."""
        load_belief(W, record, previous_inputs)
        for j in range(LANES):
            W[U + j] = u
        advance(W, record, objective)
        store_belief(W, record)
        previous_inputs[1], previous_inputs[0] = previous_inputs[0], u

    return Refinement(*_compile_rounds(model, degree, lag), update_information_rate, advance_record)
