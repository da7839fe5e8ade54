"""What a plan would teach and cost, imagined on a belief of any model, compiled across lanes.

What it teaches is `estimator.engine.imagination`'s: belief propagation along the plan's trajectory. Here stands what a
plan is judged by besides. Plans lie in the lanes of a block, so that the compiler imagines several at a time.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from agents.planner.design import half_log_det, invert
from estimator.engine.imagination import LOST, imagination
from estimator.engine.rows import belief_names
from estimator.lanes import LANES, jit, lanewise, part
from estimator.models.model import Model
from estimator.parameters import FloatArray

#: Nats that an output beyond its limit costs, per limit that it is beyond: more than any plan can teach.
_BEYOND = 1e4

#: Nats that an output within the margin costs, times the fourth power of how many standard deviations it is within it.
#: That rises as the chance of an early end does. Were it a wall, noise that led a bit too near would be answered by all
#: the braking there is, which costs more than the chance; and a plan would be the worse the better it is searched for.
NEAR_COST = 0.05

#: A margin is no wider than this part of the limit: where noise alone leads beyond it, no plan is safe.
MOST_MARGIN = 0.5

#: Chance that an episode leaves the limit if every output were at the margin from it.
RISK = 0.001


#: What the degrees of freedom of Student's t at sample t are made of: the variance of an output is taken as known with
#: the relative variance 2/(`_VAGUE` + t/`_LEARNED`)². Chosen on the branch `validation` of tracks with unknown noises.
_VAGUE, _LEARNED = 2.0, 16.0


def margin(samples: int, risk: float = RISK) -> FloatArray:
    """Predictive standard deviations to keep from the limit at each sample of an episode, (samples,).

    Outputs that are all at this margin leave the limit with the chance ``risk``, as Student's t: coefficients that are
    not known well, and noises that are not known at all, make outputs far off more frequent than a Gaussian has them.
    They become known, so its degrees of freedom grow: 4 + 2/w at samples where the variance of an output is known with
    the relative variance w.

    Example:
        >>> margin(256)[[0, 32, 255]].round(1)
        array([10.1,  6. ,  4.5])
    """
    known = _VAGUE + np.arange(samples) / _LEARNED
    return np.asarray(-stdtrit(4.0 + known**2, risk / samples))


class Terms(NamedTuple):
    """What a plan is judged by besides the belief, and what bounds its inputs.

    Attributes:
        amplitude: largest input.
        slew: largest change of the input from sample to sample; inf where there is none.
        limit: of the first sensor.
        margin: predictive standard deviations that a plan keeps from it; of an episode, those at each of its
            samples (samples,), of which `terms_of` takes one.
        walk: (K,) variances of the coefficients' random walk in a sample; zeros for constants.
        scales: (n,) sizes of the states when the first sensor is at its limit.
        pace: samples that a planned input is held for, at most.
        shaken: times the process noise's variance that a plan keeps from the limit besides (`agents.planner.motion`),
            where that is more than what the output of the sample before may tell.
        price: nats for the square of an input.
        goal: mean of the goal prior of what the first sensor shows.
        goal_weight: half its precision; 0 for no goal.
        firm: 1 where the margin is as the limit itself, which a shield needs that calls unsafe what leads into it; 0
            where it yields.
        faded: moves later in a plan that what it teaches counts e times less, with a sensor without noise
            (`agents.planner.fading`).
        cells: of the map of the state along each axis, from minus a state's scale to plus (`agents.planner.mapped`).
        reach: by how much an input of 1 over a sample moves what the first sensor shows after it, as far as that can be
            counted on to make up for what the output before tells; 0 where it cannot.
    """

    amplitude: float
    slew: float
    limit: float
    margin: float | FloatArray
    walk: FloatArray
    scales: FloatArray
    pace: int = 1
    shaken: float = 0.0
    price: float = 0.0
    goal: float = 0.0
    goal_weight: float = 0.0
    firm: float = 0.0
    faded: float = 6.0
    cells: int = 24
    reach: float = 0.0


@jit
def terms_of(episode, left):
    """The terms of a plan from those of an episode of which so many samples are left: with the margin of the next."""
    e, size = episode, len(episode.margin)
    margin = e.margin[min(max(0, size - left), size - 1)]
    judged = e.walk, e.scales, e.pace, e.shaken, e.price, e.goal, e.goal_weight, e.firm, e.faded, e.cells, e.reach
    return Terms(e.amplitude, e.slew, e.limit, margin, *judged)


class Mind(NamedTuple):
    """Compiled functions of one model, on a block ``W`` of `LANES` plans.

    Attributes:
        size: numbers in a block.
        kept: of these, from the first on, that stand for a plan between two samples.
        u: where the row of the newest input begins; before a sample, the input to apply.
        score: where the row of the scores begins.
        margin: where the row begins of what an output should keep from the limit.
        near: where the row begins of how many standard deviations it is within that; 0 where the margin is firm.
        spread: where the row begins of the predictive variance of what the first sensor shows.
        noise: where a record has the shape of the first sensor's precision; its rate is the next number.
        fill: ``fill(W, record, lasts)``: put a belief into every lane, and the last inputs, newest first (2,).
        collect: ``collect(W, record)``: take the belief of the first lane.
        advance: ``advance(W, record, terms)``: one expected sample in every lane, and its cost; coefficients and noises
            are those of a record.
        appraise: ``appraise(W, M, scale)``: the scores, minus the expected free energy up to a constant, with (scale M)
            (scale M)ᵀ (K, K) of information still to come.
        precision: ``precision(W, lane, inverse)``: inverse (K, K) of the coefficients' covariance in a lane.
    """

    size: int
    kept: int
    u: int
    score: int
    margin: int
    near: int
    spread: int
    noise: int
    fill: Any
    collect: Any
    advance: Any
    appraise: Any
    precision: Any


def _charge(
    INPUT, SHOWN, SPREAD, SURPRISE, COST, noise, shaken, limit, margin, firm, price, goal, goal_weight, amplitude, reach
):  # fmt: skip
    """What has been charged after a sample, its margin, and how near it leads; ``noise`` is the sensor's variance."""
    deviation = np.sqrt(SPREAD + max(SURPRISE, shaken))
    # What the output before tells is made up for by braking harder than planned, where there is harder.
    spared = abs(reach) * amplitude + (reach * INPUT if SHOWN > 0.0 else -reach * INPUT)
    wide = min(max(margin * np.sqrt(SPREAD), margin * deviation - spared), MOST_MARGIN * limit)
    near = (1.0 - firm) * (abs(SHOWN) + wide - limit) / deviation
    over = abs(SHOWN) + firm * wide - limit
    over, square = (over if over > 0.0 else 0.0), (near * near if near > 0.0 else 0.0)
    off = SHOWN - goal
    kept = COST + _BEYOND / limit * over + NEAR_COST * square * square
    return kept + price * INPUT * INPUT + goal_weight * (off * off + SPREAD - noise), wide, near


def _weigh(KNOWN, COST):
    """What is known, less the cost; also of a plan whose numbers are no longer finite."""
    score = KNOWN - COST
    return score if score > LOST else LOST


@cache
def mind(model: Model, degree: int = 0, lag: int = 0) -> Mind:
    """The imagination of a model; arguments as `estimator.engine.imagination.imagination`."""
    imagined = imagination(model, degree, lag)
    place, names = imagined.layout, belief_names(model)
    size, kept = len(place) * LANES, imagined.kept * LANES
    k, n_record = model.n_coefficients, model.n_states + model.n_coefficients
    n_states = model.n_states
    # A block holds a record's states and covariances, and not the means of the coefficients, which are the same in all.
    n_loaded = n_states + sum(name.startswith("P_") for name in names)
    inputs = tuple(place[name] * LANES for name in ("INPUT", "LAST_INPUT", "OLDER_INPUT") if name in place)
    u, cost, score = inputs[0], place["COST"] * LANES, place["SCORE"] * LANES
    begun, kept_off, near, spread = (place[name] * LANES for name in ("BEGUN", "MARGIN", "NEAR", "SPREAD"))
    first = next(iter(model.coefficients))
    covariance = place[f"P_{first}_{first}"] * LANES
    noise = names.index("GAMMA_SHAPE") + 2
    advance_belief, judge = imagined.advance, imagined.judge
    uniform = "noise shaken limit margin firm price goal goal_weight amplitude reach"
    charge = lanewise(place, "COST MARGIN NEAR", uniform=uniform)(_charge)
    weigh = lanewise(place, "SCORE")(_weigh)
    inner = part(f"{model.name}_{model.digest}_{degree}_{lag}")

    @inner
    def fill(W, record, lasts):
        for row in range(n_loaded):
            value = record[row if row < n_states else row - n_states + n_record]
            for j in range(LANES):
                W[row * LANES + j] = value
        for row in range(len(inputs)):
            value = lasts[max(0, row - 1)]
            for j in range(LANES):
                W[inputs[row] + j] = value
        for j in range(LANES):
            W[cost + j] = 0.0
            W[begun + j] = 0.0

    @inner
    def collect(W, record):
        for row in range(n_loaded):
            record[row if row < n_states else row - n_states + n_record] = W[row * LANES]

    @inner
    def advance(W, record, terms):
        advance_belief(W, record, terms.walk)
        r, q = record[noise + 1] / record[noise], record[noise - 1] / record[noise - 2]
        told = terms.price, terms.goal, terms.goal_weight, terms.amplitude, terms.reach
        charge(W, r, terms.shaken * q, terms.limit, terms.margin, terms.firm, *told)

    @inner
    def appraise(W, M, scale):
        judge(W, M, scale)
        weigh(W)

    @inner
    def precision(W, lane, inverse):
        work = np.empty((k, k))
        place = covariance + lane
        for j in range(k):
            for i in range(j, k):
                work[i, j] = W[place]
                place += LANES
        half_log_det(work)
        invert(work, inverse)

    rows = size, kept, u, score, kept_off, near, spread, noise
    return Mind(*rows, fill, collect, advance, appraise, precision)
