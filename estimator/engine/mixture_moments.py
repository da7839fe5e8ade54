"""Mean and covariance of mixtures of beliefs, compiled for several systems at once, in one pass over the members.

With weights s_m, means x_m, covariances P_m, and the deviations d_m = x_m - x* from one of the members,

    x = x* + d,   d = Σ_m s_m d_m,   P = Σ_m s_m (P_m + d_m d_mᵀ) - d dᵀ:

a mean that all members share keeps its bits. The Gamma densities of the precisions match mean V and variance of the
noise variances. A member has the noise variance v_m = rate/shape, as in an update, with relative variance 1/shape. With
a_m = v_m/v* - 1 and a = Σ_m s_m a_m,

    V = v* (1 + a),   relative variance = (Σ_m s_m [(1 + a_m)²/shape_m + a_m²] - a²) / (1 + a)².
"""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

from estimator.compilation.simd import LANES
from estimator.engine.source_cache import load_generated


class MomentSums(NamedTuple):
    """Compiled sums over the members of mixtures, for several systems side by side.

    The members' records lie in lanes ``at`` to ``at + n`` of a block B, number i of a record in row i
    (`estimator.Belief`), and their weights are S[s] to S[s + n]. A member without weight adds nothing, whatever its
    numbers. Blocks A and X hold the reference and the mixture of each system, in the same rows, from lane 0 on.

    Attributes:
        add: ``add(B, at, S, s, A, X, n)``: adds one member of each of n systems to the sums in X. A holds x*, and 1/v*
            in the rows of the rates.
        finish: ``finish(A, X, n)``: turns the sums in X into the mixtures' records.
    """

    add: Any
    finish: Any


@cache
def compile_mixture_moments(n_quantities: int, n_noises: int) -> MomentSums:
    """Compile the sums for beliefs in ``n_quantities`` states and coefficients, with process noise and sensors' noises.

    Args:
        n_quantities: number of states and coefficients.
        n_noises: number of noises: one more than sensors.
    """
    key = f"{n_quantities}-{n_noises}"
    code = load_generated("mixture", "moments", key, lambda: _source(n_quantities, n_noises), {})
    return MomentSums(code.add, code.finish)


def _source(n_quantities: int, n_noises: int) -> str:
    pairs = list(combinations_with_replacement(range(n_quantities), 2))
    shapes = [n_quantities + len(pairs) + 2 * k for k in range(n_noises)]

    def member(i: int) -> str:
        return f"B[{i * LANES} + at + LANE]"

    def reference(i: int) -> str:
        return f"A[{i * LANES} + LANE]"

    def total(i: int) -> str:
        return f"X[{i * LANES} + LANE]"

    def accumulate(i: int, term: str) -> str:
        return f"{total(i)} = {total(i)} + ({term} if share > 0.0 else 0.0)"

    def loop(signature: str, lines: list[str]) -> str:
        head = f"@scalar_jit\ndef {signature}:\n    for LANE in range(n):\n"
        return head + "".join(f"        {line}\n" for line in lines)

    add = ["share = S[s + LANE]", *(f"d_{i} = {member(i)} - {reference(i)}" for i in range(n_quantities))]
    add += [accumulate(i, f"share * d_{i}") for i in range(n_quantities)]
    add += [
        accumulate(n_quantities + p, f"share * ({member(n_quantities + p)} + d_{i} * d_{j})")
        for p, (i, j) in enumerate(pairs)
    ]
    finish = [f"d_{i} = {total(i)}" for i in range(n_quantities)]
    finish += [f"{total(i)} = {reference(i)} + d_{i}" for i in range(n_quantities)]
    finish += [
        f"{total(n_quantities + p)} = {total(n_quantities + p)} - d_{i} * d_{j}" for p, (i, j) in enumerate(pairs)
    ]
    for k, i in enumerate(shapes):
        add += [
            f"inverse_{k} = 1.0 / {member(i)}",
            f"a_{k} = {member(i + 1)} * inverse_{k} * {reference(i + 1)} - 1.0",
            accumulate(i, f"share * ((1.0 + a_{k}) * (1.0 + a_{k}) * inverse_{k} + a_{k} * a_{k})"),
            accumulate(i + 1, f"share * a_{k}"),
        ]
        finish += [
            f"a_{k} = {total(i + 1)}",
            f"shape_{k} = (1.0 + a_{k}) * (1.0 + a_{k}) / ({total(i)} - a_{k} * a_{k})",
            f"{total(i)} = shape_{k}",
            f"{total(i + 1)} = shape_{k} * (1.0 + a_{k}) / {reference(i + 1)}",
        ]
    return loop("add(B, at, S, s, A, X, n)", add) + loop("finish(A, X, n)", finish)
