"""Rollout of a belief under a plan, compiled across lanes: the information that a plan gains, less its costs.

`estimator.engine.expected_update` predicts the information by belief propagation along the plan's trajectory. This
module adds the costs of `agents.planning.plan_objective`. Each lane of a block holds one plan, so that several are
rolled out at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.d_optimality import half_log_det, invert_from_cholesky
from agents.planning.model_probe import only_input_rows
from agents.planning.plan_objective import MAX_MARGIN_FRACTION
from estimator.compilation.simd import LANES, jit_closure, lanewise
from estimator.engine.expected_update import DIVERGED_SCORE, compile_expected_update
from estimator.engine.storage_layout import belief_rows
from estimator.models.model import Model

#: Cost [nats] of an output beyond its limit, per limit of excess: more than any plan gains.
_VIOLATION_COST = 1e4

#: Cost [nats] of an output within the margin, times the fourth power of the excess in standard deviations. It grows as
#: the probability of an early end does. A wall instead would answer noise near the margin by all available braking,
#: which costs more than that probability.
MARGIN_COST = 0.05


class BeliefRollout(NamedTuple):
    """Compiled functions of one model, on a block ``W`` of `LANES` plans.

    Attributes:
        size: numbers in a block.
        n_carried: leading numbers of a block that a plan carries from sample to sample.
        input_row: where the row of the newest input begins; before a sample, the input to apply.
        score_row: where the row of the scores begins.
        margin_row: where the row of the margins from the limit begins.
        margin_excess: where the row of the excesses into the margin begins, in standard deviations; 0 for a hard
            margin.
        variance_row: where the row of the first sensor's predictive variance begins.
        noise_index: where a record has the shape of the first sensor's precision; its rate is the next number.
        load_belief: ``load_belief(W, record, previous_inputs)`` puts a belief and the last inputs, newest first (2,),
            into every lane.
        store_belief: ``store_belief(W, record)`` takes the belief of the first lane.
        advance: ``advance(W, record, objective)`` advances every lane by one expected sample, and adds its cost;
            coefficients and noises are taken from a record.
        evaluate: ``evaluate(W, M, scale)`` fills in the scores, minus the expected free energy up to a constant, with
            (scale M)(scale M)ᵀ (K, K) of information after the plan.
        coefficient_precision: ``coefficient_precision(W, lane, inverse)`` fills in the inverse (K, K) of the
            coefficients' covariance in a lane.
    """

    size: int
    n_carried: int
    input_row: int
    score_row: int
    margin_row: int
    margin_excess: int
    variance_row: int
    noise_index: int
    load_belief: Callable[..., Any]
    store_belief: Callable[..., Any]
    advance: Callable[..., Any]
    evaluate: Callable[..., Any]
    coefficient_precision: Callable[..., Any]


def _stage_cost(
    INPUT, Y_PRED, S_PRED, PENDING_VARIANCE, COST, sensor_variance, accumulated_noise, limit, margin, hard_margin,
    input_weight, goal, goal_weight, amplitude, recoverable_step,
):  # fmt: skip
    """The cost after a sample, the margin, and the standard deviations by which the output is within it.

    One function, as it is one loop over the lanes: four loops make decisions slower by some percent.
    """
    deviation = np.sqrt(S_PRED + max(PENDING_VARIANCE, accumulated_noise))
    # Harder braking than planned, where the input has room for it, makes up for the information of the output before.
    recoverable = abs(recoverable_step) * amplitude + (
        recoverable_step * INPUT if Y_PRED > 0.0 else -recoverable_step * INPUT
    )
    margin_width = min(max(margin * np.sqrt(S_PRED), margin * deviation - recoverable), MAX_MARGIN_FRACTION * limit)
    excess = (1.0 - hard_margin) * (abs(Y_PRED) + margin_width - limit) / deviation
    over = abs(Y_PRED) + hard_margin * margin_width - limit
    over, square = (over if over > 0.0 else 0.0), (excess * excess if excess > 0.0 else 0.0)
    limit_cost = COST + _VIOLATION_COST / limit * over + MARGIN_COST * square * square
    goal_error = Y_PRED - goal
    return (
        limit_cost + input_weight * INPUT * INPUT + goal_weight * (goal_error * goal_error + S_PRED - sensor_variance),
        margin_width,
        excess,
    )


def _net_information(INFORMATION, COST):
    """The information after a plan, less its cost; also of a plan whose numbers are no longer finite."""
    score = INFORMATION - COST
    return score if score > DIVERGED_SCORE else DIVERGED_SCORE


@cache
def compile_belief_rollout(model: Model, degree: int = 0, lag: int = 0) -> BeliefRollout:
    """Compile the rollout of a model; arguments as `estimator.engine.expected_update.compile_expected_update`."""
    expected_update = compile_expected_update(model, degree, lag)
    place, names = expected_update.layout, belief_rows(model)
    size, n_carried = len(place) * LANES, expected_update.kept * LANES
    k, n_record = model.n_coefficients, model.n_states + model.n_coefficients
    n_states = model.n_states
    # A block holds a record's states and covariances, and not the means of the coefficients, which are the same in all.
    n_loaded = n_states + sum(name.startswith("P_") for name in names)
    inputs = tuple(place[name] * LANES for name in only_input_rows(model) if name in place)
    u, cost, score = inputs[0], place["COST"] * LANES, place["SCORE"] * LANES
    started_row, margin_row, excess_row, variance_row = (
        place[name] * LANES for name in ("HAS_PENDING", "MARGIN", "NEAR", "S_PRED")
    )
    first = next(iter(model.coefficients))
    covariance = place[f"P_{first}_{first}"] * LANES
    noise_index = names.index("GAMMA_SHAPE") + 2
    advance_belief, judge = expected_update.advance, expected_update.final_information
    uniform = (
        "sensor_variance accumulated_noise limit margin hard_margin input_weight goal goal_weight amplitude "
        "recoverable_step"
    )
    stage_cost = lanewise({**place, "INPUT": place[only_input_rows(model)[0]]}, "COST MARGIN NEAR", uniform=uniform)(
        _stage_cost
    )
    net_information = lanewise(place, "SCORE")(_net_information)
    compile_inner = jit_closure(f"{model.name}_{model.digest}_{degree}_{lag}")

    @compile_inner
    def load_belief(W, record, previous_inputs):
        for row in range(n_loaded):
            value = record[row if row < n_states else row - n_states + n_record]
            for j in range(LANES):
                W[row * LANES + j] = value
        for row in range(len(inputs)):
            value = previous_inputs[max(0, row - 1)]
            for j in range(LANES):
                W[inputs[row] + j] = value
        for j in range(LANES):
            W[cost + j] = 0.0
            W[started_row + j] = 0.0

    @compile_inner
    def store_belief(W, record):
        for row in range(n_loaded):
            record[row if row < n_states else row - n_states + n_record] = W[row * LANES]

    @compile_inner
    def advance(W, record, objective):
        advance_belief(W, record, objective.walk)
        o = objective
        r, q = record[noise_index + 1] / record[noise_index], record[noise_index - 1] / record[noise_index - 2]
        weights = o.input_weight, o.goal, o.goal_weight, o.amplitude, o.recoverable_step
        stage_cost(W, r, o.accumulated_noise * q, o.limit, o.margin, o.hard_margin, *weights)

    @compile_inner
    def evaluate(W, M, scale):
        judge(W, M, scale)
        net_information(W)

    @compile_inner
    def coefficient_precision(W, lane, inverse):
        work = np.empty((k, k))
        place = covariance + lane
        for j in range(k):
            for i in range(j, k):
                work[i, j] = W[place]
                place += LANES
        half_log_det(work)
        invert_from_cholesky(work, inverse)

    rows = size, n_carried, u, score, margin_row, excess_row, variance_row, noise_index
    return BeliefRollout(*rows, load_belief, store_belief, advance, evaluate, coefficient_precision)
