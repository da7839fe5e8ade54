"""Kalman filter of a model linearised along its own trajectory, with likelihood, gradient and Fisher information."""

from __future__ import annotations

import sympy as sp

from estimator.engine.branch_functions import positive_part
from estimator.engine.inputs_at_end import inputs_at_end
from estimator.engine.printer_numba import print_expression
from estimator.engine.psd_projection import project_to_psd
from estimator.engine.storage_layout import likelihood_total_rows
from estimator.engine.symbolic import (
    HALF,
    ZERO,
    Assignments,
    Program,
    Propagation,
    differentiate,
    symbol,
    symmetric_entry,
)
from estimator.models.model import Model


def linearised_filter_step(
    model: Model, propagation: Propagation, degree: int, follows_outputs: bool
) -> tuple[Assignments, dict[str, str]]:
    """One sample of the filter at known coefficients, as assignments and results by row.

    With X the sensitivities of the state's mean to the coefficients c, F the Jacobian of the next state with respect to
    the state and B with respect to the coefficients, q the variance of the process noise and I the Fisher information,

        P⁻ = F P Fᵀ + q Q,   X⁻ = F X + B;   per sensor  s = h X⁻ + ∂y/∂c,  I += s sᵀ/S,  X = X⁻ - K s.

    Rows are `linearised_filter_rows` and `likelihood_total_rows` of `estimator.engine.storage_layout`, the variances
    ``PROCESS_VARIANCE`` and ``R_<sensor>``, and ``IS_COUNTED``, which is 0 where the sample does not count.

    Args:
        model: the equation.
        propagation: the dynamics over the sample.
        degree: degree of the input's polynomial.
        follows_outputs: update by the outputs ``Y_<sensor>``, or else follow the noise-free response.
            The latter writes the predicted outputs into ``Y_PRED_<sensor>``, and the first one's variance into
            ``S_PRED``.
    """
    states, coefficients = list(model.states), list(model.coefficients)
    n, lines = len(states), Program()
    assign = lines.assign
    mean = dict(zip(states, propagation.state, strict=True))
    cov = _predicted_covariance(lines, model, propagation, follows_outputs)
    state_sensitivity = {
        (i, c): assign(
            f"DX_PRED_{i}_{c}",
            sum(
                (propagation.jacobian[a][m] * symbol(f"DX_{states[m]}_{c}") for m in range(n)),
                propagation.jacobian[a][n + b],
            ),
        )
        for a, i in enumerate(states)
        for b, c in enumerate(coefficients)
    }
    at = lambda i, k: cov[(i, k) if states.index(i) <= states.index(k) else (k, i)]  # noqa: E731
    found = differentiate(model)
    results: dict[str, str] = {}
    totals = {name: symbol(name) for name in likelihood_total_rows(model)}
    for k, sensor in enumerate(model.outputs):
        tag = str(k)
        at_mean = {symbol(i): value for i, value in mean.items()} | inputs_at_end(model, degree)
        predicted_output = assign(f"Y_PRED{tag}", found.outputs[k].xreplace(at_mean))
        h = [slope.xreplace(at_mean) for slope in found.output_slopes[k]]
        cross_cov = {i: assign(f"PH{tag}_{i}", sum((h[m] * at(i, states[m]) for m in range(n)), ZERO)) for i in states}
        state_part_variance = assign(f"HPH{tag}", sum((h[m] * cross_cov[states[m]] for m in range(n)), ZERO))
        if follows_outputs:  # rounding may leave a negative variance of a covariance that diverged
            state_part_variance = assign(f"HPH_POSITIVE{tag}", positive_part(state_part_variance))
        innovation_variance = assign(f"S{tag}", state_part_variance + symbol(f"R_{sensor}"))
        inverse_innovation_variance = assign(f"S_INVERSE{tag}", 1 / innovation_variance)
        output_sensitivity = {
            name: assign(
                f"DY{tag}_{name}", sum((h[m] * state_sensitivity[states[m], name] for m in range(n)), h[n + b])
            )
            for b, name in enumerate(coefficients)
        }
        counted = assign(f"S_INVERSE_COUNTED{tag}", symbol("IS_COUNTED") * inverse_innovation_variance)
        weighted_sensitivity = {
            name: assign(f"DY_OVER_S{tag}_{name}", counted * output_sensitivity[name]) for name in coefficients
        }
        for b, name in enumerate(coefficients):
            for other in coefficients[b:]:
                totals[f"INFORMATION_{name}_{other}"] += weighted_sensitivity[name] * output_sensitivity[other]
        innovation = assign(f"INNOVATION{tag}", symbol(f"Y_{sensor}") - predicted_output) if follows_outputs else ZERO
        if follows_outputs:
            misfit = assign(f"NIS{tag}", counted * innovation**2)
            totals["LOSS"] += HALF * (misfit - symbol("IS_COUNTED") * sp.log(inverse_innovation_variance))
            totals["NIS"] += misfit
            for name in coefficients:
                totals[f"GRADIENT_{name}"] -= weighted_sensitivity[name] * innovation
            results[f"HPH_{sensor}"] = print_expression(state_part_variance)
        elif k == 0:
            results["S_PRED"] = print_expression(innovation_variance)
        results[f"Y_PRED_{sensor}"] = print_expression(predicted_output)
        gain = {i: assign(f"K{tag}_{i}", inverse_innovation_variance * cross_cov[i]) for i in states}
        mean = {i: assign(f"MEAN{tag}_{i}", mean[i] + gain[i] * innovation) for i in states}
        state_sensitivity = {
            (i, name): assign(f"DX{tag}_{i}_{name}", state_sensitivity[i, name] - gain[i] * output_sensitivity[name])
            for i, name in state_sensitivity
        }
        cov = {(i, j): assign(f"P{tag}_{i}_{j}", value - gain[i] * cross_cov[j]) for (i, j), value in cov.items()}
    results |= {i: print_expression(mean[i]) for i in states}
    results |= {f"P_{i}_{j}": print_expression(value) for (i, j), value in cov.items()}
    results |= {f"DX_{i}_{name}": print_expression(value) for (i, name), value in state_sensitivity.items()}
    for name, total in totals.items():
        if total != symbol(name):
            results[name] = print_expression(assign(f"{name}_e", total))
    return lines, results


def _predicted_covariance(
    lines: Program, model: Model, propagation: Propagation, follows_outputs: bool
) -> dict[tuple[str, str], sp.Expr]:
    """The upper triangle of F P Fᵀ + q Q, by the states' names.

    Integration steps that are too long make Q indefinite, and S smaller than R: a hole in the likelihood. So Q is
    projected where outputs are followed.
    """
    states = list(model.states)
    n, jacobian, noise_cov = len(states), propagation.jacobian, propagation.noise_cov
    if follows_outputs and not propagation.is_psd:
        noise_cov = project_to_psd(lines, noise_cov)
    cov: dict[tuple[str, str], sp.Expr] = {}
    for a, i in enumerate(states):
        row = {}
        for k in states:
            total = sum((jacobian[a][m] * symmetric_entry("P", states[m], k, states) for m in range(n)), ZERO)
            row[k] = lines.assign(f"FP_{i}_{k}", total)
        for b in range(a, n):
            noise = symbol("PROCESS_VARIANCE") * noise_cov[a][b]
            total = sum((jacobian[b][m] * row[states[m]] for m in range(n)), noise)
            cov[i, states[b]] = lines.assign(f"P_PRED_{i}_{states[b]}", total)
    return cov
