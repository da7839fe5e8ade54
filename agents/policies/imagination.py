"""What a plan would teach, imagined: belief propagation along its trajectory, compiled across lanes.

A plan is imagined by the structured update (`estimator.inference.structured`) with E[γ] and E[ξ] fixed and every output
as it is expected: the means follow the trajectory without noise, and the joint covariance of (x_t, x_{t-1}) and (θ, η)
contracts as it would. So what one sample teaches is not counted again by the next.

Plans lie in the lanes of a block, so that the compiler imagines several at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agents.design import half_log_det, invert
from estimator.elementary import log
from estimator.lanes import LANES, inlined, jit, lanewise, rows
from estimator.record import COEFFICIENTS, RECORD

_JOINT = ("x0", "x1", *COEFFICIENTS)
_PAIRS = [(i, j) for n, i in enumerate(_JOINT) for j in _JOINT[n:]]
_COVARIANCES = " ".join(f"P_{i}_{j}" for i, j in _PAIRS)
LAYOUT = rows("x0 x1", _COVARIANCES, "u cost score")

# Where the record's entries go in a block.
_LOADED = np.array([(RECORD.index(name), LAYOUT[name]) for name in ("x0", "x1", *_COVARIANCES.split())])
_COEFFICIENTS = RECORD.index("t1")
_NOISES = RECORD.index("g_shape")
_FIRST, _COST = LAYOUT["P_t1_t1"] * LANES, LAYOUT["cost"] * LANES

#: Numbers in a block, and where its rows begin that a search touches by index.
SIZE = len(LAYOUT) * LANES
X0, X1, U, SCORE = (LAYOUT[name] * LANES for name in ("x0", "x1", "u", "score"))

#: Nats that a displacement beyond its limit costs, per limit that it is beyond: more than any plan can teach.
_BEYOND = 1e4


class Terms(NamedTuple):
    """What a plan is judged by besides the belief, and what bounds its inputs.

    Attributes:
        amplitude: largest input [V].
        slew: largest change of the input from sample to sample [V]; inf where there is none.
        limit: of the displacement [V].
        margin: predictive standard deviations that a plan keeps from it.
        walk_t1: variance of the random walk of θ1 in a sample; 0 for a constant. The others likewise.
        walk_t2: of θ2 [1/V⁴].
        walk_t3: of θ3.
        walk_e: of η.
        price: nats for a V² of input energy.
        goal: mean of the goal prior of the displacement [V].
        goal_weight: half its precision [1/V²]; 0 for no goal.
    """

    amplitude: float
    slew: float
    limit: float
    margin: float
    walk_t1: float = 0.0
    walk_t2: float = 0.0
    walk_t3: float = 0.0
    walk_e: float = 0.0
    price: float = 0.0
    goal: float = 0.0
    goal_weight: float = 0.0


@lanewise(
    LAYOUT,
    f"x0 x1 {_COVARIANCES} cost",
    uniform=("t1 t2 t3 e q r limit margin walk_t1 walk_t2 walk_t3 walk_e price goal goal_weight"),
)
def imagine(
    x0, x1, u,
    P_x0_x0, P_x0_x1, P_x0_t1, P_x0_t2, P_x0_t3, P_x0_e,
    P_x1_x1, P_x1_t1, P_x1_t2, P_x1_t3, P_x1_e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e, cost,
    t1, t2, t3, e, q, r, limit, margin, walk_t1, walk_t2, walk_t3, walk_e, price, goal, goal_weight,
):  # fmt: skip
    """One expected sample: the structured update of an output that is what was predicted, and what it costs."""
    P_t1_t1, P_t2_t2, P_t3_t3, P_e_e = P_t1_t1 + walk_t1, P_t2_t2 + walk_t2, P_t3_t3 + walk_t3, P_e_e + walk_e
    cube = x0 * x0 * x0
    a = t1 + 3 * t2 * x0 * x0
    c_x0 = a * P_x0_x0 + t3 * P_x0_x1 + x0 * P_x0_t1 + cube * P_x0_t2 + x1 * P_x0_t3 + u * P_x0_e
    c_x1 = a * P_x0_x1 + t3 * P_x1_x1 + x0 * P_x1_t1 + cube * P_x1_t2 + x1 * P_x1_t3 + u * P_x1_e
    c_t1 = a * P_x0_t1 + t3 * P_x1_t1 + x0 * P_t1_t1 + cube * P_t1_t2 + x1 * P_t1_t3 + u * P_t1_e
    c_t2 = a * P_x0_t2 + t3 * P_x1_t2 + x0 * P_t1_t2 + cube * P_t2_t2 + x1 * P_t2_t3 + u * P_t2_e
    c_t3 = a * P_x0_t3 + t3 * P_x1_t3 + x0 * P_t1_t3 + cube * P_t2_t3 + x1 * P_t3_t3 + u * P_t3_e
    c_e = a * P_x0_e + t3 * P_x1_e + x0 * P_t1_e + cube * P_t2_e + x1 * P_t3_e + u * P_e_e
    predicted = t1 * x0 + t2 * cube + t3 * x1 + e * u
    variance = a * c_x0 + t3 * c_x1 + x0 * c_t1 + cube * c_t2 + x1 * c_t3 + u * c_e + q
    w = 1.0 / (variance + r)
    keep = r * w
    over = abs(predicted) + margin * np.sqrt(variance + r) - limit
    over = over if over > 0.0 else 0.0
    off = predicted - goal
    cost += _BEYOND / limit * over + price * u * u + goal_weight * (off * off + variance)
    return (
        predicted, x0,
        keep * variance, keep * c_x0, keep * c_t1, keep * c_t2, keep * c_t3, keep * c_e,
        P_x0_x0 - w * c_x0 * c_x0, P_x0_t1 - w * c_x0 * c_t1, P_x0_t2 - w * c_x0 * c_t2,
        P_x0_t3 - w * c_x0 * c_t3, P_x0_e - w * c_x0 * c_e,
        P_t1_t1 - w * c_t1 * c_t1, P_t1_t2 - w * c_t1 * c_t2, P_t1_t3 - w * c_t1 * c_t3, P_t1_e - w * c_t1 * c_e,
        P_t2_t2 - w * c_t2 * c_t2, P_t2_t3 - w * c_t2 * c_t3, P_t2_e - w * c_t2 * c_e,
        P_t3_t3 - w * c_t3 * c_t3, P_t3_e - w * c_t3 * c_e, P_e_e - w * c_e * c_e, cost,
    )  # fmt: skip


@inlined
def determinant(a11, a12, a13, a14, a22, a23, a24, a33, a34, a44):
    """Of a symmetric positive definite matrix."""
    l2, l3, l4 = a12 / a11, a13 / a11, a14 / a11
    d2 = a22 - l2 * a12
    b23, b24 = a23 - l2 * a13, a24 - l2 * a14
    k3, k4 = b23 / d2, b24 / d2
    d3 = a33 - l3 * a13 - k3 * b23
    b34 = a34 - l3 * a14 - k3 * b24
    return a11 * d2 * d3 * (a44 - l4 * a14 - k4 * b24 - b34 * b34 / d3)


@lanewise(LAYOUT, "score", uniform="m11 m21 m22 m31 m32 m33 m41 m42 m43 m44")
def judge(
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e, cost,
    m11, m21, m22, m31, m32, m33, m41, m42, m43, m44,
):  # fmt: skip
    """Minus the expected free energy, up to a constant: ½ log det(C⁻¹ + M Mᵀ), less the cost.

    C is the coefficients' covariance, and M, lower triangular, the factor of the information that is still to come. The
    determinant is that of I + Mᵀ C M, divided by that of C.
    """
    c21, c22 = P_t2_t2 * m21 + P_t2_t3 * m31 + P_t2_e * m41, P_t2_t2 * m22 + P_t2_t3 * m32 + P_t2_e * m42
    c31, c32 = P_t2_t3 * m21 + P_t3_t3 * m31 + P_t3_e * m41, P_t2_t3 * m22 + P_t3_t3 * m32 + P_t3_e * m42
    c41, c42 = P_t2_e * m21 + P_t3_e * m31 + P_e_e * m41, P_t2_e * m22 + P_t3_e * m32 + P_e_e * m42
    c11 = P_t1_t1 * m11 + P_t1_t2 * m21 + P_t1_t3 * m31 + P_t1_e * m41
    c21, c31, c41 = c21 + P_t1_t2 * m11, c31 + P_t1_t3 * m11, c41 + P_t1_e * m11
    c33, c43 = P_t3_t3 * m33 + P_t3_e * m43, P_t3_e * m33 + P_e_e * m43
    to_come = determinant(
        1.0 + m11 * c11 + m21 * c21 + m31 * c31 + m41 * c41,
        m22 * c21 + m32 * c31 + m42 * c41, m33 * c31 + m43 * c41, m44 * c41,
        1.0 + m22 * c22 + m32 * c32 + m42 * c42, m33 * c32 + m43 * c42, m44 * c42,
        1.0 + m33 * c33 + m43 * c43, m44 * c43,
        1.0 + m44 * P_e_e * m44,
    )  # fmt: skip
    now = determinant(P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e)
    return 0.5 * log(to_come / now) - cost if now > 0.0 else -1e300


@jit
def fill(W, record):
    """Put a belief into every lane."""
    for place in range(len(_LOADED)):
        value = record[_LOADED[place, 0]]
        first = _LOADED[place, 1] * LANES
        for j in range(LANES):
            W[first + j] = value
    for j in range(LANES):
        W[_COST + j] = 0.0


@jit
def collect(W, record):
    """Take the belief of the first lane."""
    for place in range(len(_LOADED)):
        record[_LOADED[place, 0]] = W[_LOADED[place, 1] * LANES]


@jit
def advance(W, record, terms):
    """One expected sample in every lane, whose inputs stand in row ``u``; noises and means are those of a record."""
    t1, t2, t3, e = record[_COEFFICIENTS : _COEFFICIENTS + 4]
    imagine(
        W, t1, t2, t3, e, record[_NOISES + 1] / record[_NOISES], record[_NOISES + 3] / record[_NOISES + 2],
        terms.limit, terms.margin, terms.walk_t1, terms.walk_t2, terms.walk_t3, terms.walk_e,
        terms.price, terms.goal, terms.goal_weight,
    )  # fmt: skip


@jit
def appraise(W, M, scale):
    """The lanes' scores, with (scale M) (scale M)ᵀ (4, 4) still to come."""
    m = scale * M
    judge(W, m[0, 0], m[1, 0], m[1, 1], m[2, 0], m[2, 1], m[2, 2], m[3, 0], m[3, 1], m[3, 2], m[3, 3])


@jit
def precision(W, inverse):
    """Inverse (4, 4) of the coefficients' covariance in the first lane."""
    work = np.empty((4, 4))
    place = _FIRST
    for j in range(4):
        for k in range(j, 4):
            work[k, j] = W[place]
            place += LANES
    half_log_det(work)
    invert(work, inverse)
