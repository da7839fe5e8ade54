"""The first two moments of a mixture of beliefs, whose members lie side by side in the lanes of a block.

With shares s_m, means x_m and covariances P_m, and x* the mean of one of them,

    x = x* + Σ_m s_m (x_m - x*),   P = Σ_m s_m (P_m + (x_m - x)(x_m - x)ᵀ):

so what all members know stays as it is, to the last bit. The noises' Gamma densities get the mean V and the variance
of the noises' variances: that of a member is v_m = rate/shape, as it acts in an update, with the relative variance
1/shape, and Σ_m s_m [(v_m/V)²/shape_m + (v_m/V - 1)²] is that of the mixture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

from estimator.engine import cache as stored
from estimator.lanes import LANES, rows

#: Noises of a belief: of the process and of a sensor.
_NOISES = 2


@dataclass(frozen=True)
class Moments:
    """Sums over the lanes of a block (`estimator.lanes`), which they leave in the first lane of the rows ``T_<k>``.

    Attributes:
        check: ``check(B)``: SHARE becomes 1 where all numbers of a record are finite, and 0 elsewhere.
        means: ``means(B)``: T_i becomes Σ s (X_i - ABOUT_i) of every state and coefficient i.
        spreads: ``spreads(B)``: T_p becomes Σ s (P_p + (X_i - ABOUT_i)(X_j - ABOUT_j)) of every pair p = (i, j) with
            i <= j; the T after them Σ s v of each noise. The rates become v.
        tails: ``tails(B)``: T_k becomes the relative variance of noise k, with its V in the row ``V_<k>``.
        layout: rows of the block: the members' shares ``SHARE``; their records, as `estimator.Belief` keeps them, from
            the row ``X_0`` on; what is the same in all lanes; and the sums.
    """

    check: Any
    means: Any
    spreads: Any
    tails: Any
    layout: Mapping[str, int]


@cache
def moments(names: int) -> Moments:
    """The moments of beliefs in so many states and coefficients, of one sensor."""
    pairs = list(combinations_with_replacement(range(names), 2))
    place = rows(
        "SHARE",
        " ".join(f"X_{i}" for i in range(names)),
        " ".join(f"P_{i}_{j}" for i, j in pairs),
        " ".join(f"SHAPE_{k} RATE_{k}" for k in range(_NOISES)),
        " ".join(f"ABOUT_{i}" for i in range(names)),
        " ".join(f"V_{k}" for k in range(_NOISES)),
        " ".join(f"T_{k}" for k in range(len(pairs) + _NOISES)),
    )
    code = stored.load("mixture", "moments", str(names), lambda: _source(names, pairs, place), {})
    return Moments(code.check, code.means, code.spreads, code.tails, place)


def _source(names: int, pairs: list[tuple[int, int]], place: Mapping[str, int]) -> str:
    import sympy as sp

    from estimator.engine import emit
    from estimator.engine.derive import symbol

    share, record = symbol("SHARE"), list(place)[1 : place["ABOUT_0"]]
    sound = [("sound", sp.Mul(*(sp.Function("finite")(symbol(row)) for row in record)))]
    off = [symbol(f"X_{i}") - symbol(f"ABOUT_{i}") for i in range(names)]
    means = [(f"told_{i}", share * off[i]) for i in range(names)]

    away = [(f"off_{i}", off[i]) for i in range(names)]
    spreads = [
        (f"told_{p}", share * (symbol(f"P_{i}_{j}") + symbol(f"off_{i}") * symbol(f"off_{j}")))
        for p, (i, j) in enumerate(pairs)
    ]
    variances = [(f"variance_{k}", symbol(f"RATE_{k}") / symbol(f"SHAPE_{k}")) for k in range(_NOISES)]
    spreads += [(f"told_{len(pairs) + k}", share * symbol(f"variance_{k}")) for k in range(_NOISES)]

    ratios = [(f"ratio_{k}", symbol(f"RATE_{k}") / symbol(f"V_{k}")) for k in range(_NOISES)]
    tails = [
        (f"told_{k}", share * (symbol(f"ratio_{k}") ** 2 / symbol(f"SHAPE_{k}") + (symbol(f"ratio_{k}") - 1) ** 2))
        for k in range(_NOISES)
    ]

    def summed(name: str, lines: Any, count: int, kept: Mapping[str, str]) -> str:
        """A loop over the lanes, and the sums of what it leaves in the first rows T, half by half."""
        results = {f"T_{k}": f"told_{k}" for k in range(count)}
        source = emit.lane_loop(name, lines, results | dict(kept), place, LANES, doc="Sums over the lanes.")
        width = LANES // 2
        while width:
            source += f"    for LANE in range({width}):\n"
            for k in range(count):
                at = place[f"T_{k}"] * LANES
                source += f"        W[{at} + LANE] = W[{at} + LANE] + W[{at + width} + LANE]\n"
            width //= 2
        return "@straight\n" + source

    rates = {f"RATE_{k}": f"variance_{k}" for k in range(_NOISES)}
    checked = emit.lane_loop("check", sound, {"SHARE": "sound"}, place, LANES, doc="Whose numbers are all finite.")
    return (
        f"@straight\n{checked}"
        + summed("means", means, names, {})
        + summed("spreads", away + variances + spreads, len(pairs) + _NOISES, rates)
        + summed("tails", ratios + tails, _NOISES, {})
    )
