"""Prediction of the members of a noise grid about one common linearisation, at the mean of their mixture.

State, Jacobian F and process noise Q are integrated once, from the mixture's mean x*. A member's mean is predicted to
first order, M_m = M* + F (x_m - x*), its covariance is F P_m Fᵀ, and its process noise is Q. So a member costs its
covariance algebra only, and none diverges by a cubic stiffness of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import sympy as sp

from estimator.engine import printer_numba, symbolic
from estimator.engine.psd_projection import project_to_psd
from estimator.engine.symbolic import Assignments, Program, Propagation, symbol, symmetric_entry
from estimator.models.model import Model


def shared_propagation(model: Model) -> tuple[Assignments, dict[str, str], Propagation]:
    """Assignments at the end of a sample, their results by row, and the propagation in the symbols of these rows."""
    end_lines, end = symbolic.propagate_sample(model)
    assigned = {symbol(name): symbol(f"{name}_E") for name, _ in end_lines}
    lines = Program(symbolic.substitute(end_lines, {str(name): str(new) for name, new in assigned.items()}))
    results: dict[str, str] = {}
    noise_cov = end.noise_cov if end.is_psd else project_to_psd(lines, end.noise_cov)

    def kept(row: str, value: sp.Expr) -> sp.Expr:
        """The symbol of the row that receives a value; a number needs no row."""
        if value.is_Number:
            return value
        value = value.xreplace(assigned)
        if value != symbol(row):
            results[row] = str(lines.assign(f"END_{row}", value))
        return symbol(row)

    state = tuple(kept(f"M_{i}", value) for i, value in zip(model.states, end.state, strict=True))
    jacobian = tuple(
        tuple(kept(f"F_{i}_{j}", value) for j, value in zip(model.names, row, strict=True))
        for i, row in zip(model.states, end.jacobian, strict=True)
    )
    if not model.held:
        states = list(model.states)
        noise_cov = tuple(
            tuple(kept(str(symmetric_entry("Q", i, k, states)), noise_cov[a][b]) for b, k in enumerate(states))
            for a, i in enumerate(states)
        )
    return lines, results, Propagation(state, jacobian, noise_cov, is_psd=True)


def member_propagation(model: Model, shared: Propagation) -> tuple[Assignments, Propagation]:
    """The predicted mean of a member, to first order about the shared linearisation."""
    lines = Program()
    deviation = {j: symbol(j) - symbol(f"MIXTURE_{j}") for j in model.names}
    used = {j for row in shared.jacobian for j, slope in zip(model.names, row, strict=True) if slope != 0}
    deviation = {j: lines.assign(f"DEVIATION_{j}", deviation[j]) for j in model.names if j in used}
    state = tuple(
        lines.assign(
            f"M_MEMBER_{i}",
            value + sum((s * deviation[j] for j, s in zip(model.names, row, strict=True) if s != 0), sp.S.Zero),
        )
        for i, value, row in zip(model.states, shared.state, shared.jacobian, strict=True)
    )
    return lines, replace(shared, state=state)


def with_forecasts(
    model: Model, iterations: int, lines: Assignments, results: Mapping[str, str]
) -> tuple[Assignments, dict[str, str]]:
    """The results with mean and variance of each forecast in place of the traces."""
    lines, kept = Program(lines), {row: value for row, value in results.items() if not row.startswith("TRACE_")}
    for k, sensor in enumerate(model.outputs):
        parts = (results[f"TRACE_{k}_{what}"] for what in ("variance", f"q_{iterations - 1}", f"r_{iterations - 1}"))
        variance = sum(
            (sp.Float(part) if printer_numba.is_numeral(part) else symbol(part) for part in parts), sp.S.Zero
        )
        kept |= {f"MEAN_{sensor}": results[f"TRACE_{k}_mean"]}
        kept |= {f"VARIANCE_{sensor}": str(lines.assign(f"FORECAST_{k}", variance))}
    return lines, kept
