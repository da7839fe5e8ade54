"""Kalman update of the joint belief in states and coefficients with unknown noise variances, as assignments.

With M, F, Q of a sample (`estimator.engine.symbolic`) the predicted covariance of states and coefficients is
P⁻ = F P Fᵀ. The sensors are taken one after another. With h the gradient of a sensor's output,

    S = hᵀ P⁻ h + q + r,   ν = y - prediction,   q = hᵀ Q h / E[γ],   r = 1/E[ξ],

the step for fixed E[γ] and E[ξ] is a Kalman step with the gain K = (P⁻ + Q/E[γ]) h / S. The free energy is minimised
over q(γ) and q(ξ) by the second moments of both noises under the posterior of that step, which are scalar functions:

    E[w²] = (q ν/S)² + q (1 - q/S),   E[v²] = (r ν/S)² + r (1 - r/S).

γ is updated by the first sensor whose output depends on the process noise of the same sample; without one, γ stays.

Rounding may leave an indefinite matrix after a sample with 10⁸ times the prior information. So every variance is
increased by its rounding error, `ROUNDING` times its terms: the rounded matrix is the exact one plus an error E,
|E_ij| ≤ a_i a_j ROUNDING/d, to which ROUNDING diag(a²) is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import sympy as sp

from estimator.engine.branch_functions import select
from estimator.engine.inputs_at_end import inputs_at_end
from estimator.engine.noise_iterations import iterate_noise_beliefs, sensor_free_energy
from estimator.engine.printer_numba import is_numeral, print_expression
from estimator.engine.psd_projection import project_to_psd
from estimator.engine.symbolic import (
    ONE,
    ZERO,
    Assignments,
    Program,
    Propagation,
    differentiate,
    is_present,
    symbol,
    symmetric_entry,
    zero_if_finite,
)
from estimator.models.model import Model

#: Bound of a variance's rounding error, as a fraction of its terms [1]: 64 units of 2⁻⁵³, for sums of 36 products.
ROUNDING = 2.0**-47


class GaussianUpdate:
    """The joint Gaussian of a sample, from the prediction on: symbols or expressions of its mean and covariance.

    Args:
        model: the equation.
        propagation: the dynamics over the sample.
    """

    def __init__(self, model: Model, propagation: Propagation) -> None:
        self.model, self.propagation = model, propagation
        self.names, self.states = list(model.names), list(model.states)
        self.lines = Program()
        self.assign = self.lines.assign
        if not propagation.is_psd:
            self.propagation = replace(propagation, noise_cov=project_to_psd(self.lines, propagation.noise_cov))
        self.mean: dict[str, sp.Expr] = {
            **dict(zip(self.states, propagation.state, strict=True)),
            **{c: symbol(c) for c in model.coefficients},
        }
        self.cov: dict[tuple[str, str], sp.Expr] = {}
        self.transition_cov: dict[str, dict[str, sp.Expr]] = {}  # rows of F P, by state
        self._predict()

    def __getitem__(self, key: tuple[str, str]) -> sp.Expr:
        i, j = key
        return self.cov[(i, j) if self.names.index(i) <= self.names.index(j) else (j, i)]

    def _predict(self) -> None:
        """F P Fᵀ in the states' rows, or the given ``P_PRED_i_j`` if there is no F; the coefficients' block stays."""
        names, jacobian, rows = self.names, self.propagation.jacobian, self.transition_cov
        for a, i in enumerate(names):
            for j in names[a:]:
                self.cov[i, j] = symmetric_entry("P" if i not in self.states else "P_PRED", i, j, names)
        if not jacobian:
            return
        for i, slopes in zip(self.states, jacobian, strict=True):
            row = {}
            for j in names:
                total = sum((a * symmetric_entry("P", k, j, names) for k, a in zip(names, slopes, strict=True)), ZERO)
                row[j] = self.assign(f"FP_{i}_{j}", total)
            rows[i] = row
        n = len(self.states)
        for a, i in enumerate(self.states):
            for b in range(a, n):
                total = sum((s * rows[i][k] for k, s in zip(names, jacobian[b], strict=True)), ZERO)
                if a == b and not total.is_Symbol:
                    terms = (s**2 * symmetric_entry("P", k, k, names) for k, s in zip(names, jacobian[b], strict=True))
                    total += ROUNDING * sum(terms, ZERO)
                self.cov[i, self.states[b]] = self.assign(f"P_PRED_{i}_{self.states[b]}", total)
            for j in names[n:]:
                self.cov[i, j] = rows[i][j]

    def predicted_output(self, sensor: int, degree: int) -> tuple[sp.Expr, list[sp.Expr]]:
        """Predicted output of a sensor at the current mean, and its gradient h by all quantities."""
        c = differentiate(self.model)
        at = {symbol(name): value for name, value in self.mean.items()} | inputs_at_end(self.model, degree)
        return c.outputs[sensor].xreplace(at), [slope.xreplace(at) for slope in c.output_slopes[sensor]]

    def pending_output_variance(self, output_slope: Sequence[sp.Expr], sensor_variance: sp.Expr) -> sp.Expr:
        """Variance by which the output of the sample before, not measured yet, will shift a sensor's prediction.

        With P after that output it is (hᵀ F P h)² / (r - hᵀ P h): the gain is P h / r, and the innovation's variance
        r² / (r - hᵀ P h). The divisor is kept above 0, since the P of a prior may exceed the P after an output.
        """
        h = {i: slope for i, slope in zip(self.names, output_slope, strict=True) if slope != 0}
        before = {(i, j): symmetric_entry("P", i, j, self.names) for i in h for j in h}
        shift = sum(
            (
                h[i] * h[j] * (self.transition_cov[i][j] if i in self.transition_cov else before[i, j])
                for i, j in before
            ),
            ZERO,
        )
        remaining = self.assign(
            "PENDING_LEFT", sensor_variance - sum((h[i] * h[j] * known for (i, j), known in before.items()), ZERO)
        )
        smallest = self.assign("PENDING_FLOOR", ROUNDING * sensor_variance)
        return self.assign("PENDING_SHIFT", shift) ** 2 / self.assign(
            "PENDING_DIVISOR", select(remaining - smallest, remaining, smallest)
        )

    def output_process_noise(self, output_slope: Sequence[sp.Expr]) -> sp.Expr:
        """hᵀ Q h: variance of a sensor's output by process noise of unit strength."""
        n = len(self.states)
        total = sum(
            (output_slope[a] * output_slope[b] * self.propagation.noise_cov[a][b] for a in range(n) for b in range(n)),
            ZERO,
        )
        return sp.expand(total) if not total.free_symbols else total

    def innovation_covariance(self, output_slope: Sequence[sp.Expr], tag: str) -> tuple[dict[str, sp.Expr], sp.Expr]:
        """Covariances P⁻ h with a sensor's output, and its variance hᵀ P⁻ h."""
        cross_cov = {}
        for i in self.names:
            total = sum((h * self[i, j] for j, h in zip(self.names, output_slope, strict=True)), ZERO)
            cross_cov[i] = self.assign(f"PH{tag}_{i}", total)
        s = sum((h * cross_cov[i] for i, h in zip(self.names, output_slope, strict=True)), ZERO)
        return cross_cov, self.assign(f"HPH{tag}", s)

    def add_process_noise(self, process_variance: sp.Expr) -> None:
        """Add the process noise: P⁻ + Q ``process_variance`` in the states' block."""
        for a, i in enumerate(self.states):
            for b in range(a, len(self.states)):
                k, unit_noise = self.states[b], self.propagation.noise_cov[a][b]
                if unit_noise != 0:
                    self.cov[i, k] = self.assign(f"P_NOISY_{i}_{k}", self.cov[i, k] + process_variance * unit_noise)

    def condition(
        self,
        output_slope: Sequence[sp.Expr],
        cross_cov: dict[str, sp.Expr],
        inverse_innovation_cov: sp.Expr,
        scaled_innovation: sp.Expr,
        retained_fraction: sp.Expr,
        tag: str,
        is_observed: sp.Expr = ONE,
    ) -> None:
        """Condition on a sensor, with c = P⁻ h: mean + c ν/S and P⁻ - c cᵀ/S.

        Args:
            output_slope: h.
            cross_cov: c, by quantity.
            inverse_innovation_cov: 1/S.
            scaled_innovation: ν/S.
            retained_fraction: r/S. A quantity that the sensor measures directly keeps this fraction of its row, which
                rounding cannot make negative.
            tag: the sensor's number, in the names of the assignments.
            is_observed: 0 for a missing output, else 1.
        """
        measured = [i for i, h in zip(self.names, output_slope, strict=True) if h == 1]
        measured_quantity = measured[0] if sum(h != 0 for h in output_slope) == 1 and measured else None
        gain = {
            i: self.assign(f"K{tag}_{i}", inverse_innovation_cov * cross_cov[i])
            for i in self.names
            if i != measured_quantity
        }
        for i in self.names:
            if cross_cov[i] != 0 and scaled_innovation != 0:
                self.mean[i] = self.assign(f"MEAN{tag}_{i}", self.mean[i] + cross_cov[i] * scaled_innovation)
        rounding_factor = self.assign(f"ROUNDING{tag}", 1 + sp.Float(ROUNDING) * is_observed)
        for (i, j), value in list(self.cov.items()):
            factor = rounding_factor if i == j else ONE
            if measured_quantity in (i, j):
                other = j if i == measured_quantity else i
                self.cov[i, j] = self.assign(f"P{tag}_{i}_{j}", retained_fraction * cross_cov[other] * factor)
            elif cross_cov[i] != 0 and cross_cov[j] != 0:
                self.cov[i, j] = self.assign(f"P{tag}_{i}_{j}", value * factor - gain[i] * cross_cov[j])

    def row_results(self) -> dict[str, str]:
        """Row of the belief to the name of its new value, for rows that change."""
        row_values = {name: print_expression(value) for name, value in self.mean.items()}
        for i, j in self.cov:
            row_values[f"P_{i}_{j}"] = print_expression(self.cov[i, j])
        return {row: value for row, value in row_values.items() if row != value}


def belief_update(
    model: Model,
    propagation: Propagation,
    degree: int,
    iterations: int,
    keep_trace: bool,
    may_be_missing: bool,
    free_energies: Sequence[int] = (),
) -> tuple[Assignments, dict[str, str]]:
    """Update the belief by the outputs ``Y_<sensor>``, with the noises: assignments and results by row.

    Args:
        model: the equation.
        propagation: the dynamics over the sample.
        degree: degree of the input's polynomial, or the number of taps less one.
        iterations: variational iterations.
        keep_trace: write the terms of every iteration's free energy into rows ``TRACE_<number of the sensor>_<term>``.
        may_be_missing: an output that is NaN is missing: the state is predicted, and nothing is updated.
        free_energies: iterations whose free energy [nats] goes into the row ``FREE_ENERGY_<iteration>``, NaN where the
            belief is not finite.
    """
    g = GaussianUpdate(model, propagation)
    results: dict[str, str] = {}
    totals: dict[int, sp.Expr] = dict.fromkeys(free_energies, ZERO)
    informative_sensor = [
        k for k in range(model.n_outputs) if g.output_process_noise(g.predicted_output(k, degree)[1]) != 0
    ][:1]
    if not informative_sensor:  # no sensor informs γ: its prior mean acts
        g.add_process_noise(g.assign("PROCESS_VARIANCE_UNSEEN", symbol("GAMMA_RATE") / symbol("GAMMA_SHAPE")))
    for k, sensor in enumerate(model.outputs):
        tag, y = str(k), symbol(f"Y_{sensor}")
        expected, output_slope = g.predicted_output(k, degree)
        expected = g.assign(f"Y_PRED{tag}", expected)
        cross_cov, s = g.innovation_covariance(output_slope, tag)
        output_noise = g.assign(f"HQH{tag}", g.output_process_noise(output_slope)) if k in informative_sensor else ZERO
        is_observed = g.assign(f"OBSERVED{tag}", is_present(y)) if may_be_missing else ONE
        e = g.assign(f"INNOVATION{tag}", select(is_observed, y - expected, ZERO) if may_be_missing else y - expected)
        noise_iterations = iterate_noise_beliefs(g.lines, tag, sensor, (s, e, output_noise, is_observed), iterations)
        last = noise_iterations[-1]
        for i in free_energies:
            scalars = s, e, output_noise, is_observed
            totals[i] += sensor_free_energy(g.lines, f"{tag}_{i}", sensor, scalars, noise_iterations[i])
        if output_noise != 0:
            noise_cross_cov = {i: sum((output_slope[b] * n for b, n in enumerate(row)), ZERO)
                     for i, row in zip(g.states, g.propagation.noise_cov, strict=True)}  # fmt: skip
            cross_cov |= {
                i: g.assign(f"PH_NOISY{tag}_{i}", cross_cov[i] + last.process_variance * part)
                for i, part in noise_cross_cov.items()
                if part != 0
            }
            g.add_process_noise(last.process_variance)
            results |= {
                "GAMMA_SHAPE": print_expression(last.gamma_shape),
                "GAMMA_RATE": print_expression(last.gamma_rate),
            }
        results |= {
            f"XI_SHAPE_{sensor}": print_expression(last.xi_shape),
            f"XI_RATE_{sensor}": print_expression(last.xi_rate),
        }
        retained_fraction = last.r * last.inverse_innovation_cov
        inverse_innovation_cov = g.assign(f"S_INVERSE_OBSERVED{tag}", is_observed * last.inverse_innovation_cov)
        retained_fraction = g.assign(
            f"R_OVER_S{tag}", select(is_observed, retained_fraction, ONE) if may_be_missing else retained_fraction
        )
        g.condition(
            output_slope, cross_cov, inverse_innovation_cov, last.scaled_innovation, retained_fraction, tag, is_observed
        )
        if keep_trace:
            traced = {"mean": expected, "innovation": e, "variance": s, "shown": output_noise}
            for i, one in enumerate(noise_iterations):
                traced |= {f"q_{i}": one.q, f"r_{i}": one.r}
            results |= {f"TRACE_{tag}_{what}": print_expression(value) for what, value in traced.items()}
    results |= g.row_results()
    if totals:
        values = [symbol(value) for value in results.values() if not is_numeral(value)]
        invalid = zero_if_finite(g.assign("SUM_OF_BELIEF", sum(values, ZERO)))
        for i, total in totals.items():
            results[f"FREE_ENERGY_{i}"] = print_expression(g.assign(f"FREE_ENERGY_{i}_E", total + invalid))
    return g.lines, results


def update_without_data(model: Model, propagation: Propagation, degree: int) -> tuple[Assignments, dict[str, str]]:
    """`belief_update` with every output equal to its prediction, and given noise variances.

    The noise variances are in ``PROCESS_VARIANCE`` and ``R_<sensor>``. The results are the predicted output of the
    first sensor in ``Y_PRED``, its variance in ``S_PRED``, and `GaussianUpdate.pending_output_variance`
    in ``PENDING_VARIANCE``, which is 0 for the first sample: ``HAS_PENDING`` is 1 after it.
    """
    g = GaussianUpdate(model, propagation)
    results: dict[str, str] = {}
    g.add_process_noise(symbol("PROCESS_VARIANCE"))
    for k, sensor in enumerate(model.outputs):
        tag, r = str(k), symbol(f"R_{sensor}")
        expected, output_slope = g.predicted_output(k, degree)
        cross_cov, s = g.innovation_covariance(output_slope, tag)
        inverse_innovation_cov = g.assign(f"S_INVERSE{tag}", 1 / (s + r))
        if k == 0:
            pending_variance = g.assign(
                "PENDING_PRODUCT", symbol("HAS_PENDING") * g.pending_output_variance(output_slope, r)
            )
            results |= {
                "Y_PRED": print_expression(g.assign("Y_PRED0", expected)),
                "S_PRED": print_expression(g.assign("S0", s + r)),
            }
            results |= {"PENDING_VARIANCE": print_expression(pending_variance), "HAS_PENDING": "1.0"}
        g.condition(
            output_slope,
            cross_cov,
            inverse_innovation_cov,
            ZERO,
            g.assign(f"R_OVER_S{tag}", r * inverse_innovation_cov),
            tag,
        )
    found = g.row_results()
    return g.lines, results | {row: value for row, value in found.items() if row not in model.coefficients}
