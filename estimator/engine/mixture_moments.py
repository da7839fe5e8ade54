"""Mean and covariance of mixtures of beliefs, compiled for several systems at once.

With shares s_m, means x_m and covariances P_m, and x* the mean of one of the members,

    x = x* + Σ_m s_m (x_m - x*),   P = Σ_m s_m (P_m + (x_m - x)(x_m - x)ᵀ):

a mean that all members share keeps its bits. The Gamma densities of the precisions match mean V and variance of the
noise variances. A member has the noise variance v_m = rate/shape, as in an update, with relative variance 1/shape; the
mixture has the relative variance Σ_m s_m [(v_m/V)²/shape_m + (v_m/V - 1)²].
"""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

from estimator.compilation.simd import LANES
from estimator.engine.source_cache import load_generated

#: Number of noises of a belief: process and sensor.
N_NOISES = 2


class MomentSums(NamedTuple):
    """Compiled sums over the members of mixtures, each for one member of n systems.

    The members' records lie in lanes ``at`` to ``at + n`` of a block B, number i of a record in row i
    (`estimator.Belief`), and their shares are S[s] to S[s + n]. A member without share adds nothing, whatever its
    numbers. The mixtures' records lie in another block X, from lane 0 on.

    Attributes:
        check: ``check(B, at, S, s, n)``: sets S to 0 where all numbers of the record are finite, else to NaN.
        means: ``means(B, at, S, s, A, X, n)``: adds s (x - x*) to X, with x* in the rows of a block A.
        spreads: ``spreads(B, at, S, s, X, n)``: adds s (P + (x - X)(x - X)ᵀ) and, in the rows of the rates, s v.
        tails: ``tails(B, at, S, s, X, n)``: adds the noises' relative variances in the rows of the shapes.
    """

    check: Any
    means: Any
    spreads: Any
    tails: Any


@cache
def compile_mixture_moments(n_quantities: int) -> MomentSums:
    """Compile the sums for beliefs in ``n_quantities`` states and coefficients, of one sensor."""
    code = load_generated("mixture", "moments", str(n_quantities), lambda: _source(n_quantities), {})
    return MomentSums(code.check, code.means, code.spreads, code.tails)


def _source(n_quantities: int) -> str:
    pairs = list(combinations_with_replacement(range(n_quantities), 2))
    shapes = [n_quantities + len(pairs) + 2 * k for k in range(N_NOISES)]
    size = n_quantities + len(pairs) + 2 * N_NOISES

    def member_entry(i: int) -> str:
        return f"B[{i * LANES} + at + LANE]"

    def mixture_entry(i: int) -> str:
        return f"X[{i * LANES} + LANE]"

    def accumulate(i: int, term: str) -> str:
        return f"{mixture_entry(i)} = {mixture_entry(i)} + ({term} if share > 0.0 else 0.0)"

    def loop(name: str, arguments: str, lines: list[str]) -> str:
        head = f"@scalar_jit\ndef {name}(B, at, S, s, {arguments}n):\n    for LANE in range(n):\n"
        return head + "".join(f"        {line}\n" for line in lines)

    share = "share = S[s + LANE]"
    check = [f"S[s + LANE] = {' + '.join(f'0.0 * {member_entry(i)}' for i in range(size))}"]
    means = [
        share,
        *(accumulate(i, f"share * ({member_entry(i)} - A[{i * LANES} + LANE])") for i in range(n_quantities)),
    ]
    spreads = [share, *(f"off_{i} = {member_entry(i)} - {mixture_entry(i)}" for i in range(n_quantities))]
    spreads += [
        accumulate(n_quantities + p, f"share * ({member_entry(n_quantities + p)} + off_{i} * off_{j})")
        for p, (i, j) in enumerate(pairs)
    ]
    spreads += [accumulate(i + 1, f"share * ({member_entry(i + 1)} / {member_entry(i)})") for i in shapes]
    tails = [share]
    for k, i in enumerate(shapes):
        tails += [
            f"inverse_{k} = 1.0 / {member_entry(i)}",
            f"away_{k} = {member_entry(i + 1)} * inverse_{k} / {mixture_entry(i + 1)} - 1.0",
            accumulate(i, f"share * ((away_{k} + 1.0) * (away_{k} + 1.0) * inverse_{k} + away_{k} * away_{k})"),
        ]
    return (
        loop("check", "", check) + loop("means", "A, X, ", means)
        + loop("spreads", "X, ", spreads) + loop("tails", "X, ", tails)
    )  # fmt: skip
