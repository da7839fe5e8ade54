"""Projection of an integrated noise covariance onto positive semi-definite matrices, as assignments."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from estimator.engine.branch_functions import clip, positive_part, select
from estimator.engine.symbolic import ONE, ZERO, Program


def project_to_psd(program: Program, noise_cov: Sequence[Sequence[sp.Expr]]) -> tuple[tuple[sp.Expr, ...], ...]:
    """Q if it is positive semi-definite; else its variances, with the covariances clipped to the range they allow.

    The integrated Q is wrong where the Jacobian of the rates exceeds about 3 per step, and may then be indefinite.
    """
    n = len(noise_cov)
    entries = {(a, b): noise_cov[a][b] for a in range(n) for b in range(a, n)}
    for a in range(n):
        entries[a, a] = program.assign(f"Q_PSD_{a}_{a}", positive_part(entries[a, a]))
    remaining = dict(entries)  # the Schur complement
    for a in range(n - 1):
        std = program.assign(f"Q_ROOT_{a}_{a}", sp.sqrt(positive_part(remaining[a, a])))
        for b in range(a + 1, n):
            root = program.assign(f"Q_ROOT_{a}_{b}", sp.sqrt(positive_part(remaining[b, b])))
            largest = program.assign(f"Q_LIMIT_{a}_{b}", std * root)
            clipped = program.assign(f"Q_CLIPPED_{a}_{b}", clip(remaining[a, b], -largest, largest))
            entries[a, b] = (
                program.assign(f"Q_PSD_{a}_{b}", entries[a, b] + (clipped - remaining[a, b])) if a else clipped
            )
            remaining[a, b] = clipped
        inverse = (
            program.assign(f"PIVOT_INVERSE_{a}", 1 / select(remaining[a, a], remaining[a, a], ONE))
            if a < n - 2
            else ZERO
        )
        for b in range(a + 1, n if a < n - 2 else 0):
            for c in range(b, n):
                remaining[b, c] = program.assign(
                    f"SCHUR_{a}_{b}_{c}", remaining[b, c] - remaining[a, b] * remaining[a, c] * inverse
                )
    return tuple(tuple(entries[min(a, b), max(a, b)] for b in range(n)) for a in range(n))
