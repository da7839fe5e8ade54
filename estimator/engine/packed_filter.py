"""The linearised filter of a large model, as loops over packed arrays: `estimator.engine.linearised_filter` in loops.

Straight lines grow with the cube of the states, and LLVM takes longer than that for them. Here they are left for the
model's own expressions.
"""

from __future__ import annotations

from collections.abc import Mapping

import sympy as sp

from estimator.engine import printer_numba, symbolic
from estimator.engine.branch_functions import positive_part
from estimator.engine.inputs_at_end import inputs_at_end
from estimator.engine.packed_arrays import PackedArrays, define, sum_of, upper_triangle_offset
from estimator.engine.packed_rk4 import print_packed_integrator
from estimator.engine.printer_numba import print_expression
from estimator.engine.storage_layout import held_noise_rows, noise_ratio_rows
from estimator.engine.symbolic import ZERO, Assignments, differentiate, symbol
from estimator.models.model import Model


def print_packed_filter(
    model: Model,
    degree: int,
    follows_outputs: bool,
    layout: Mapping[str, int],
    lanes: int,
    variable_step: bool = False,
    noise_ratios: bool = False,
) -> str:
    """Source of ``sample(W, STEPS)``, as `estimator.engine.kernels.compile_linearised_filter` has it.

    Args:
        model: the equation.
        degree: degree of the input's polynomial.
        follows_outputs: as for `estimator.engine.linearised_filter.linearised_filter_step`.
        layout: `linearised_filter_layout` with `packed_rows`.
        lanes: lanes of the block.
        variable_step: whether each sample has its own length.
        noise_ratios: as for `estimator.engine.symbolic.propagate_sample`.
    """
    writer = _FilterWriter(model, degree, follows_outputs, layout, lanes, noise_ratios)
    source = print_packed_integrator(model, degree, layout, lanes, variable_step, noise_ratios)
    source += writer.propagate() + writer.predict()
    for k in range(model.n_outputs):
        source += writer.show(k) + writer.weigh(k) + writer.condition(k)
    return source + writer.finish() + printer_numba.print_sample("sample(W, STEPS)", model, "finish(W)", steps="STEPS")


class _FilterWriter:
    """The parts of `print_packed_filter`, with its arguments."""

    def __init__(
        self, model: Model, degree: int, follows_outputs: bool, layout: Mapping[str, int], lanes: int, ratios: bool
    ) -> None:
        self.model, self.degree, self.follows_outputs, self.noise_ratios = model, degree, follows_outputs, ratios
        self.layout, self.lanes, self.arrays = layout, lanes, PackedArrays(layout, lanes)
        self.states, self.coefficients = list(model.states), list(model.coefficients)
        self.movers = list(model.dynamic_names)
        first, c = self.states[0], self.coefficients[0]
        self.P, self.F, self.DX = f"P_{first}_{first}", f"F_{first}_{first}", f"DX_{first}_{c}"
        self.COV, self.PRODUCT, self.NOISE = (f"{x}_{first}_{first}" for x in ("COV", "PRODUCT", "NOISE"))
        self.MEAN, self.CROSS_COV = f"MEAN_{first}", f"CROSS_COV_{first}"
        self.OUTPUT_BY = f"OUTPUT_BY_{c}"

    def propagate(self) -> str:
        """Source of ``propagate(W)``: the mean, F and Q of the sample in packed rows."""
        model, n = self.model, len(self.states)
        entry, loop = self.arrays.entry, self.arrays.loop
        if not model.is_continuous:
            assigned, propagation = symbolic.propagate_difference_equation(model, self.noise_ratios)
            columns = [model.names.index(j) for j in self.movers]
            values = {f"MEAN_{i}": value for i, value in zip(self.states, propagation.state, strict=True)}
            for a, i in enumerate(self.states):
                values |= {f"F_{i}_{j}": propagation.jacobian[a][b] for b, j in zip(columns, self.movers, strict=True)}
                values |= {f"NOISE_{i}_{k}": q for k, q in zip(self.states, propagation.noise_cov[a], strict=True)}
            # The straight lines have names of their own for what the rows are called.
            renamed = {name: f"{name}_e" for name, _ in assigned if name in self.layout}
            assigned = symbolic.substitute([*assigned, *((f"{row}_r", e) for row, e in values.items())], renamed)
            results = {row: f"{row}_r" for row in values}
            return printer_numba.print_lane_loop(
                "propagate", assigned, results, self.layout, self.lanes, doc="M, F, Q."
            )
        lines = self.arrays.copy(self.MEAN, f"M_{self.states[0]}", n)
        if model.held:
            ratios = noise_ratio_rows(model) if self.noise_ratios else []
            terms = []
            for s, rows in enumerate(held_noise_rows(model)):
                weight = f"{entry(ratios[s])}*" if ratios else ""
                terms.append(f"{weight}{entry(rows[0], 'I')}*{entry(rows[0], 'K')}")
            lines += loop({"I": n, "K": n}, f"{entry(self.NOISE, f'I*{n} + K')} = {sum_of(terms)}")
        elif self.follows_outputs:
            lines += self._project_noise()
        return define("propagate(W)", "The mean and Q.", lines)

    def _project_noise(self) -> list[str]:
        """Lines of `estimator.engine.psd_projection.project_to_psd` of Q; the Schur complement is in ``COV``."""
        n, entry, loop = len(self.states), self.arrays.entry, self.arrays.loop
        q, rest = self.NOISE, self.COV
        at = lambda matrix, row, column: entry(matrix, f"({row})*{n} + {column}")  # noqa: E731
        diagonal = entry(q, f"I*{n + 1}")
        lines = loop({"I": n}, f"Q = {diagonal}", f"{diagonal} = 0.0 if Q < 0.0 else Q")
        lines += self.arrays.copy(rest, q, n * n)
        pivot, other, between = at(rest, "A", "A"), at(rest, "B", "B"), at(rest, "A", "B")
        clip = loop(
            {},
            f"PIVOT, OTHER, BETWEEN = {pivot}, {other}, {between}",
            "LIMIT = sqrt(0.0 if PIVOT < 0.0 else PIVOT)*sqrt(0.0 if OTHER < 0.0 else OTHER)",
            "CLIPPED = -LIMIT if not BETWEEN > -LIMIT else (BETWEEN if BETWEEN < LIMIT else LIMIT)",
            f"{at(q, 'A', 'B')} = {at(q, 'A', 'B')} + (CLIPPED - BETWEEN)",
            f"{between} = CLIPPED",
        )
        inner = ["for D in range(SIZE):", "    B = A + 1 + D", *(f"    {line}" for line in clip)]
        schur = loop(
            {},
            f"PIVOT = {pivot}",
            "INVERSE = 1.0/(PIVOT if PIVOT > 0.0 else 1.0)",
            f"{at(rest, 'B', 'C')} = {at(rest, 'B', 'C')} - {between}*{at(rest, 'A', 'C')}*INVERSE",
        )
        inner += ["for D in range(SIZE):", "    B = A + 1 + D", "    for E in range(SIZE - D):", "        C = B + E"]
        inner += [f"        {line}" for line in schur]
        return [*lines, f"for A in range({n - 1}):", f"    SIZE = {n - 1} - A", *(f"    {line}" for line in inner)]

    def predict(self) -> str:
        """Source of ``predict(W)``: P⁻ = F P Fᵀ + q Q in ``COV``, and the sensitivities X⁻ = F X + B, in place."""
        n, m, k = len(self.states), len(self.movers), len(self.coefficients)
        entry, loop = self.arrays.entry, self.arrays.loop
        cov, product = self.COV, self.PRODUCT
        packed = entry(self.P, upper_triangle_offset(n, "I", "(I + D)"))
        upper, lower = entry(cov, f"I*{n} + I + D"), entry(cov, f"(I + D)*{n} + I")
        lines = loop({"I": n, "D": f"{n} - I"}, f"VALUE = {packed}", f"{upper} = VALUE", f"{lower} = VALUE")
        lines += loop({"K": n}, *self._through_jacobian(cov, product, n, "K"))
        terms = (f"{entry(self.F, f'(I + D)*{m} + {a}')}*{entry(product, f'I*{n} + {a}')}" for a in range(n))
        noise = f"{entry('PROCESS_VARIANCE')}*{entry(self.NOISE, f'I*{n} + I + D')}"
        lines += loop(
            {"I": n, "D": f"{n} - I"}, f"VALUE = {noise} + {sum_of(terms)}", f"{upper} = VALUE", f"{lower} = VALUE"
        )
        lines += loop({"C": k}, *self._through_jacobian(self.DX, self.DX, k, "C"))
        added = []
        for b, name in enumerate(self.movers[n:], n):
            target = entry(self.DX, f"I*{k} + {self.coefficients.index(name)}")
            added.append(f"{target} = {target} + {entry(self.F, f'I*{m} + {b}')}")
        lines += loop({"I": n}, *added) if added else []
        return define("predict(W)", "The predicted covariance and sensitivities.", lines)

    def _through_jacobian(self, from_row: str, to_row: str, stride: int, column: str) -> list[str]:
        """Statements that multiply a column of a matrix by F; it may be stored in its own place."""
        n, m, entry = len(self.states), len(self.movers), self.arrays.entry
        statements = [f"BEFORE_{a} = {entry(from_row, f'{a * stride} + {column}')}" for a in range(n)]
        for a in range(n):
            terms = (f"{entry(self.F, a * m + b)}*BEFORE_{b}" for b in range(n))
            statements.append(f"AFTER_{a} = {sum_of(terms)}")
        return statements + [f"{entry(to_row, f'{a * stride} + {column}')} = AFTER_{a}" for a in range(n)]

    def _output_slopes(self, sensor: int) -> dict[str, sp.Expr]:
        """The entries of the gradient h of a sensor's output that are not 0."""
        slopes = zip(self.model.names, differentiate(self.model).output_slopes[sensor], strict=True)
        return {i: slope for i, slope in slopes if slope != 0}

    def _slope_text(self, sensor: int, name: str) -> str:
        slope = self._output_slopes(sensor)[name]
        return print_expression(slope) if slope.is_Number else self.arrays.entry(f"OUTPUT_SLOPE_{name}")

    def show(self, sensor: int) -> str:
        """Source of ``show_<sensor>(W)``: the predicted output and its gradient at the mean."""
        at: dict[sp.Symbol, sp.Expr] = {symbol(i): symbol(f"MEAN_{i}") for i in self.states}
        at |= inputs_at_end(self.model, self.degree)
        row = f"Y_PRED_{list(self.model.outputs)[sensor]}"
        named = {row: differentiate(self.model).outputs[sensor]}
        slopes = self._output_slopes(sensor)
        named |= {f"OUTPUT_SLOPE_{i}": slope for i, slope in slopes.items() if not slope.is_Number}
        lines: Assignments = [(f"{name}_e", value.xreplace(at)) for name, value in named.items()]
        results = {name: f"{name}_e" for name in named}
        return printer_numba.print_lane_loop(
            f"show_{sensor}", lines, results, self.layout, self.lanes, doc="A predicted output."
        )

    def weigh(self, sensor: int) -> str:
        """Source of ``weigh_<sensor>(W)``: P⁻ h, the innovation and its variance, and the likelihood."""
        n, name = len(self.states), list(self.model.outputs)[sensor]
        entry, loop = self.arrays.entry, self.arrays.loop
        observed = [(a, i) for a, i in enumerate(self.states) if i in self._output_slopes(sensor)]
        terms = (f"{self._slope_text(sensor, i)}*{entry(self.COV, f'I*{n} + {a}')}" for a, i in observed)
        lines = loop({"I": n}, f"{entry(self.CROSS_COV, 'I')} = {sum_of(terms)}")
        slopes = self._output_slopes(sensor)
        hph: sp.Expr = sum(
            ((slopes[i] if slopes[i].is_Number else symbol(f"OUTPUT_SLOPE_{i}")) * symbol(f"CROSS_COV_{i}")
             for _, i in observed), ZERO,
        )  # fmt: skip
        value = {x: symbol(f"{x}_e") for x in ("HPH", "S", "S_INVERSE", "S_INVERSE_COUNTED", "INNOVATION", "MISFIT")}
        counted, variance = symbol("IS_COUNTED"), symbol("HPH_SUM")
        # Rounding may leave a negative variance of a covariance that diverged.
        scalars: Assignments = [
            ("HPH_SUM", hph),
            ("HPH_e", positive_part(variance) if self.follows_outputs else variance),
            ("S_e", value["HPH"] + symbol(f"R_{name}")),
            ("S_INVERSE_e", 1 / value["S"]),
            ("S_INVERSE_COUNTED_e", counted * value["S_INVERSE"]),
        ]
        results = {row: f"{row}_e" for row in ("S_INVERSE", "S_INVERSE_COUNTED")}
        if self.follows_outputs:
            loss = symbol("LOSS") + (value["MISFIT"] - counted * sp.log(value["S_INVERSE"])) / 2
            scalars += [
                ("INNOVATION_e", symbol(f"Y_{name}") - symbol(f"Y_PRED_{name}")),
                ("MISFIT_e", value["S_INVERSE_COUNTED"] * value["INNOVATION"] ** 2),
                ("LOSS_e", loss),
                ("NIS_e", symbol("NIS") + value["MISFIT"]),
            ]
            results |= {row: f"{row}_e" for row in ("INNOVATION", "LOSS", "NIS")} | {f"HPH_{name}": "HPH_e"}
        elif sensor == 0:
            results["S_PRED"] = "S_e"
        doc = "The innovation, its variance and the likelihood."
        source = printer_numba.print_lane_loop(f"innovate_{sensor}", scalars, results, self.layout, self.lanes, doc=doc)
        return source + define(f"weigh_{sensor}(W)", doc, [*lines, f"innovate_{sensor}(W)"])

    def condition(self, sensor: int) -> str:
        """Source of ``condition_<sensor>(W)``: information, gradient, and the moments after it."""
        n, k, entry, loop = len(self.states), len(self.coefficients), self.arrays.entry, self.arrays.loop
        slopes, first = self._output_slopes(sensor), self.coefficients[0]
        terms = (f"{self._slope_text(sensor, i)}*{entry(self.DX, f'{a * k} + C')}"
                 for a, i in enumerate(self.states) if i in slopes)  # fmt: skip
        by = entry(self.OUTPUT_BY, "C")
        lines = loop({"C": k}, f"{by} = {sum_of(terms)}")
        added = []
        for c, name in enumerate(self.coefficients):
            if name in slopes:
                own = entry(self.OUTPUT_BY, c)
                added.append(f"{own} = {own} + {self._slope_text(sensor, name)}")
        lines += self.arrays.over_lanes(added) if added else []
        counted = f"{entry('S_INVERSE_COUNTED')}*{by}"
        information = entry(f"INFORMATION_{first}_{first}", upper_triangle_offset(k, "C", "(C + D)"))
        lines += loop(
            {"C": k, "D": f"{k} - C"},
            f"{information} = {information} + {counted}*{entry(self.OUTPUT_BY, 'C + D')}",
        )
        gain = f"{entry('S_INVERSE')}*{entry(self.CROSS_COV, 'I')}"
        if self.follows_outputs:
            gradient, mean = entry(f"GRADIENT_{first}", "C"), entry(self.MEAN, "I")
            lines += loop({"C": k}, f"{gradient} = {gradient} - {counted}*{entry('INNOVATION')}")
            lines += loop({"I": n}, f"{mean} = {mean} + {gain}*{entry('INNOVATION')}")
        sensitivity = entry(self.DX, f"I*{k} + C")
        lines += loop({"I": n, "C": k}, f"{sensitivity} = {sensitivity} - {gain}*{by}")
        upper, lower = entry(self.COV, f"I*{n} + I + D"), entry(self.COV, f"(I + D)*{n} + I")
        lines += loop(
            {"I": n, "D": f"{n} - I"},
            f"VALUE = {upper} - {gain}*{entry(self.CROSS_COV, 'I + D')}",
            f"{upper} = VALUE",
            f"{lower} = VALUE",
        )
        return define(f"condition_{sensor}(W)", "Condition on an output.", lines)

    def finish(self) -> str:
        """Source of ``finish(W)``: the whole filter after the integrator."""
        n, arrays = len(self.states), self.arrays
        lines = ["propagate(W)", "predict(W)"]
        for sensor in range(self.model.n_outputs):
            lines += [f"{step}_{sensor}(W)" for step in ("show", "weigh", "condition")]
        lines += arrays.copy(self.states[0], self.MEAN, n)
        packed = arrays.entry(self.P, upper_triangle_offset(n, "I", "(I + D)"))
        lines += arrays.loop({"I": n, "D": f"{n} - I"}, f"{packed} = {arrays.entry(self.COV, f'I*{n} + I + D')}")
        return define("finish(W)", "Predict, and add likelihood and information.", lines)
