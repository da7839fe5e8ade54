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

from estimator.engine import cache as stored
from estimator.lanes import LANES

#: Noises of a belief: of the process and of a sensor.
NOISES = 2


@cache
def moments(names: int) -> Any:
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
    return stored.load("mixture", "moments", str(names), lambda: _source(names), {})


def _source(names: int) -> str:
    pairs = list(combinations_with_replacement(range(names), 2))
    shapes = [names + len(pairs) + 2 * k for k in range(NOISES)]
    size = names + len(pairs) + 2 * NOISES

    def own(i: int) -> str:
        return f"B[{i * LANES} + at + LANE]"

    def mixed(i: int) -> str:
        return f"X[{i * LANES} + LANE]"

    def adding(i: int, told: str) -> str:
        return f"{mixed(i)} = {mixed(i)} + ({told} if share > 0.0 else 0.0)"

    def loop(name: str, arguments: str, lines: list[str]) -> str:
        head = f"@straight\ndef {name}(B, at, S, s, {arguments}n):\n    for LANE in range(n):\n"
        return head + "".join(f"        {line}\n" for line in lines)

    share = "share = S[s + LANE]"
    check = [f"S[s + LANE] = {' + '.join(f'0.0 * {own(i)}' for i in range(size))}"]
    means = [share, *(adding(i, f"share * ({own(i)} - A[{i * LANES} + LANE])") for i in range(names))]
    spreads = [share, *(f"off_{i} = {own(i)} - {mixed(i)}" for i in range(names))]
    spreads += [adding(names + p, f"share * ({own(names + p)} + off_{i} * off_{j})") for p, (i, j) in enumerate(pairs)]
    spreads += [adding(i + 1, f"share * ({own(i + 1)} / {own(i)})") for i in shapes]
    tails = [share]
    for k, i in enumerate(shapes):
        tails += [
            f"inverse_{k} = 1.0 / {own(i)}",
            f"away_{k} = {own(i + 1)} * inverse_{k} / {mixed(i + 1)} - 1.0",
            adding(i, f"share * ((away_{k} + 1.0) * (away_{k} + 1.0) * inverse_{k} + away_{k} * away_{k})"),
        ]
    return (
        loop("check", "", check) + loop("means", "A, X, ", means)
        + loop("spreads", "X, ", spreads) + loop("tails", "X, ", tails)
    )  # fmt: skip
