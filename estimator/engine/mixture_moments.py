"""The first two moments of mixtures of beliefs, one member after another, for several systems at once.

With shares s_m, means x_m and covariances P_m, and x* the mean of one of the members,

    x = x* + Σ_m s_m (x_m - x*),   P = Σ_m s_m (P_m + (x_m - x)(x_m - x)ᵀ):

so what all members know stays as it is, to the last bit. The noises' Gamma densities get the mean V and the variance
of the noises' variances: that of a member is v_m = rate/shape, as it acts in an update, with the relative variance
1/shape, and Σ_m s_m [(v_m/V)²/shape_m + (v_m/V - 1)²] is that of the mixture.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement
from typing import Any

from estimator.compilation.simd import LANES
from estimator.engine.source_cache import load_generated

#: Noises of a belief: of the process and of a sensor.
N_NOISES = 2


@cache
def compile_mixture_moments(n_quantities: int) -> Any:
    """The moments of beliefs in so many states and coefficients, of one sensor.

    The functions are of one member of each of n systems. Their records lie in lanes ``at`` to ``at + n`` of a block B,
    number i in row i (`estimator.Belief`), and their shares are S[s] to S[s + n]; what has no share does not count,
    whatever its numbers. The mixtures' records lie in another block X, from lane 0 on.

    Returns:
        A namespace of

        - ``check(B, at, S, s, n)``: S becomes 0 where all numbers of the record are finite, and NaN elsewhere;
        - ``means(B, at, S, s, A, X, n)``: adds s (x - x*) to X, with x* in the rows of a block A;
        - ``spreads(B, at, S, s, X, n)``: adds s (P + (x - X)(x - X)ᵀ) and, in the rows of the rates, s v;
        - ``tails(B, at, S, s, X, n)``: adds the relative variances of the noises in the rows of the shapes.
    """
    return load_generated("mixture", "moments", str(n_quantities), lambda: _source(n_quantities), {})


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
