"""What a plan would teach and cost, imagined on a belief of any model, compiled across lanes.

What it teaches is `estimator.engine.expected_update`'s: belief propagation along the plan's trajectory. Here stands what a
plan is judged by besides. Plans lie in the lanes of a block, so that the compiler imagines several at a time.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from agents.planning.d_optimality import half_log_det, invert_from_cholesky
from estimator.compilation.simd import LANES, jit, jit_closure, lanewise
from estimator.engine.expected_update import DIVERGED_SCORE, compile_expected_update
from estimator.engine.storage_layout import belief_rows
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: Nats that an output beyond its limit costs, per limit that it is beyond: more than any plan can teach.
_VIOLATION_COST = 1e4

#: Nats that an output within the margin costs, times the fourth power of how many standard deviations it is within it.
#: That rises as the chance of an early end does. Were it a wall, noise that led a bit too near would be answered by all
#: the braking there is, which costs more than the chance; and a plan would be the worse the better it is searched for.
MARGIN_COST = 0.05

#: A margin is no wider than this part of the limit: where noise alone leads beyond it, no plan is safe.
MAX_MARGIN_FRACTION = 0.5

#: Chance that an episode leaves the limit if every output were at the margin from it.
DEFAULT_RISK = 0.001


#: What the degrees of freedom of Student's t at sample t are made of: the variance of an output is taken as known with
#: the relative variance 2/(`_INITIAL_CERTAINTY` + t/`_LEARNING_SAMPLES`)². Chosen on the branch `validation` of tracks with unknown noises.
_INITIAL_CERTAINTY, _LEARNING_SAMPLES = 2.0, 16.0


def margin_profile(n_samples: int, risk: float = DEFAULT_RISK) -> FloatArray:
    """Predictive standard deviations to keep from the limit at each sample of an episode, (samples,).

    Outputs that are all at this margin leave the limit with the chance ``risk``, as Student's t: coefficients that are
    not known well, and noises that are not known at all, make outputs far off more frequent than a Gaussian has them.
    They become known, so its degrees of freedom grow: 4 + 2/w at samples where the variance of an output is known with
    the relative variance w.

    Example:
        >>> margin_profile(256)[[0, 32, 255]].round(1)
        array([10.1,  6. ,  4.5])
    """
    known = _INITIAL_CERTAINTY + np.arange(n_samples) / _LEARNING_SAMPLES
    return np.asarray(-stdtrit(4.0 + known**2, risk / n_samples))


class PlanObjective(NamedTuple):
    """What a plan is judged by besides the belief, and what bounds its inputs.

    Attributes:
        amplitude: largest input.
        slew: largest change of the input from sample to sample; inf where there is none.
        limit: of the first sensor.
        margin: predictive standard deviations that a plan keeps from it; of an episode, those at each of its
            samples (samples,), of which `objective_at` takes one.
        walk: (K,) variances of the coefficients' random walk in a sample; zeros for constants.
        scales: (n,) sizes of the states when the first sensor is at its limit.
        hold_samples: samples that a planned input is held for, at most.
        accumulated_noise: times the process noise's variance that a plan keeps from the limit besides (`agents.planning.model_probe`),
            where that is more than what the output of the sample before may tell.
        input_weight: nats for the square of an input.
        goal: mean of the goal prior of what the first sensor shows.
        goal_weight: half its precision; 0 for no goal.
        hard_margin: 1 where the margin is as the limit itself, which a shield needs that calls unsafe what leads into it; 0
            where it yields.
        discount_moves: moves later in a plan that what it teaches counts e times less, with a sensor without noise
            (`agents.planning.discount`).
        cells: of the map of the state along each axis, from minus a state's scale to plus (`agents.planning.grid_beam_search`).
        recoverable_step: by how much an input of 1 over a sample moves what the first sensor shows after it, as far as that can be
            counted on to make up for what the output before tells; 0 where it cannot.
    """

    amplitude: float
    slew: float
    limit: float
    margin: float | FloatArray
    walk: FloatArray
    scales: FloatArray
    hold_samples: int = 1
    accumulated_noise: float = 0.0
    input_weight: float = 0.0
    goal: float = 0.0
    goal_weight: float = 0.0
    hard_margin: float = 0.0
    discount_moves: float = 6.0
    cells: int = 24
    recoverable_step: float = 0.0


@jit
def objective_at(episode, samples_left):
    """The terms of a plan from those of an episode of which so many samples are left: with the margin of the next."""
    e, size = episode, len(episode.margin)
    margin = e.margin[min(max(0, size - samples_left), size - 1)]
    unchanged = (
        e.walk,
        e.scales,
        e.hold_samples,
        e.accumulated_noise,
        e.input_weight,
        e.goal,
        e.goal_weight,
        e.hard_margin,
        e.discount_moves,
        e.cells,
        e.recoverable_step,
    )
    return PlanObjective(e.amplitude, e.slew, e.limit, margin, *unchanged)


class BeliefRollout(NamedTuple):
    """Compiled functions of one model, on a block ``W`` of `LANES` plans.

    Attributes:
        size: numbers in a block.
        n_carried: of these, from the first on, that stand for a plan between two samples.
        input_row: where the row of the newest input begins; before a sample, the input to apply.
        score_row: where the row of the scores begins.
        margin_row: where the row begins of what an output should keep from the limit.
        margin_excess: where the row begins of how many standard deviations it is within that; 0 where the margin is firm.
        variance_row: where the row begins of the predictive variance of what the first sensor shows.
        noise_index: where a record has the shape of the first sensor's precision; its rate is the next number.
        load_belief: ``load_belief(W, record, previous_inputs)``: put a belief into every lane, and the last inputs, newest first (2,).
        store_belief: ``store_belief(W, record)``: take the belief of the first lane.
        advance: ``advance(W, record, objective)``: one expected sample in every lane, and its cost; coefficients and noises
            are those of a record.
        evaluate: ``evaluate(W, M, scale)``: the scores, minus the expected free energy up to a constant, with (scale M)
            (scale M)ᵀ (K, K) of information still to come.
        coefficient_precision: ``coefficient_precision(W, lane, inverse)``: inverse (K, K) of the coefficients' covariance in a lane.
    """

    size: int
    n_carried: int
    input_row: int
    score_row: int
    margin_row: int
    margin_excess: int
    variance_row: int
    noise_index: int
    load_belief: Any
    store_belief: Any
    advance: Any
    evaluate: Any
    coefficient_precision: Any


def _stage_cost(
    INPUT, SHOWN, SPREAD, SURPRISE, COST, sensor_variance, accumulated_noise, limit, margin, hard_margin, input_weight, goal,
    goal_weight, amplitude, recoverable_step,
):  # fmt: skip
    """What has been charged after a sample, its margin, and how near it leads; ``noise_index`` is the sensor's variance."""
    deviation = np.sqrt(SPREAD + max(SURPRISE, accumulated_noise))
    # What the output before tells is made up for by braking harder than planned, where there is harder.
    recoverable = abs(recoverable_step) * amplitude + (
        recoverable_step * INPUT if SHOWN > 0.0 else -recoverable_step * INPUT
    )
    margin_width = min(max(margin * np.sqrt(SPREAD), margin * deviation - recoverable), MAX_MARGIN_FRACTION * limit)
    near = (1.0 - hard_margin) * (abs(SHOWN) + margin_width - limit) / deviation
    over = abs(SHOWN) + hard_margin * margin_width - limit
    over, square = (over if over > 0.0 else 0.0), (near * near if near > 0.0 else 0.0)
    goal_error = SHOWN - goal
    limit_cost = COST + _VIOLATION_COST / limit * over + MARGIN_COST * square * square
    return (
        limit_cost + input_weight * INPUT * INPUT + goal_weight * (goal_error * goal_error + SPREAD - sensor_variance),
        margin_width,
        near,
    )


def _net_information(KNOWN, COST):
    """What is known, less the cost; also of a plan whose numbers are no longer finite."""
    score = KNOWN - COST
    return score if score > DIVERGED_SCORE else DIVERGED_SCORE


@cache
def compile_belief_rollout(model: Model, degree: int = 0, lag: int = 0) -> BeliefRollout:
    """The imagination of a model; arguments as `estimator.engine.expected_update.compile_expected_update`."""
    expected_update = compile_expected_update(model, degree, lag)
    place, names = expected_update.layout, belief_rows(model)
    size, n_carried = len(place) * LANES, expected_update.kept * LANES
    k, n_record = model.n_coefficients, model.n_states + model.n_coefficients
    n_states = model.n_states
    # A block holds a record's states and covariances, and not the means of the coefficients, which are the same in all.
    n_loaded = n_states + sum(name.startswith("P_") for name in names)
    inputs = tuple(place[name] * LANES for name in ("INPUT", "LAST_INPUT", "OLDER_INPUT") if name in place)
    u, cost, score = inputs[0], place["COST"] * LANES, place["SCORE"] * LANES
    started_row, margin_row, excess_row, variance_row = (
        place[name] * LANES for name in ("BEGUN", "MARGIN", "NEAR", "SPREAD")
    )
    first = next(iter(model.coefficients))
    covariance = place[f"P_{first}_{first}"] * LANES
    noise_index = names.index("GAMMA_SHAPE") + 2
    advance_belief, judge = expected_update.advance, expected_update.final_information
    uniform = "sensor_variance accumulated_noise limit margin hard_margin input_weight goal goal_weight amplitude recoverable_step"
    stage_cost = lanewise(place, "COST MARGIN NEAR", uniform=uniform)(_stage_cost)
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
        r, q = record[noise_index + 1] / record[noise_index], record[noise_index - 1] / record[noise_index - 2]
        weights = (
            objective.input_weight,
            objective.goal,
            objective.goal_weight,
            objective.amplitude,
            objective.recoverable_step,
        )
        stage_cost(
            W, r, objective.accumulated_noise * q, objective.limit, objective.margin, objective.hard_margin, *weights
        )

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
