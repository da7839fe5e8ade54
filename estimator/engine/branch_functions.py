"""Functions of expressions that choose a value without a branch, with their derivatives.

`estimator.engine.printer_numba` writes them out. A derivative at a jump of the slope is one of those beside it.
"""

from __future__ import annotations

import sympy as sp


class exceeds(sp.Function):
    """``exceeds(x, y)``: 1 where x > y, else 0; its derivative is 0, at the jump too."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative."""
        return sp.S.Zero


class positive_part(sp.Function):
    """``positive_part(x)``: x, or 0 where x is negative."""

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative."""
        return 1 - exceeds(0, self.args[0])


class clip(sp.Function):
    """``clip(x, low, high)``: x within these limits."""

    nargs = 3

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative."""
        x, low, high = self.args
        above, below = exceeds(x, low), exceeds(high, x)
        return (above * below, 1 - above, above * (1 - below))[argindex - 1]


class select(sp.Function):
    """``select(x, a, b)``: a where x > 0, else b; its derivative is the value's."""

    nargs = 3

    def _eval_derivative(self, by: sp.Symbol) -> sp.Expr:
        x, first, second = self.args
        slopes = sp.diff(first, by), sp.diff(second, by)
        return slopes[0] if slopes[0] == slopes[1] else select(x, *slopes)
