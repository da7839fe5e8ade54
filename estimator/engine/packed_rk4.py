"""Runge-Kutta integration of a large model, as loops over packed arrays: `estimator.engine.variational_rk4` in loops.

The model's own expressions stay straight lines, once for all stages. Matrices are looped over by rows, and the products
with the sparse Jacobian of the rates have straight lines for its entries alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sp

from estimator.compilation.scalar_jit.llvm_translation import INDEPENDENT_INDEX
from estimator.engine import printer_numba
from estimator.engine.packed_arrays import PackedArrays, define, sum_of
from estimator.engine.printer_numba import print_expression
from estimator.engine.storage_layout import held_noise_rows, noise_ratio_rows, slope_entries, stage_inputs
from estimator.engine.symbolic import (
    Assignments,
    differentiate,
    eliminate_common_subexpressions,
    input_at_stages,
    substitute,
    symbol,
)
from estimator.models.model import Model

#: Reach of a stage in the step, and weight of its rates at the end, as expressions in its number 0 to 3.
_REACH, _WEIGHT = "0.5*((S + 1)//2)", "(1 + (S + 1)//2 % 2)/6"


def print_packed_integrator(
    model: Model, degree: int, layout: Mapping[str, int], lanes: int, variable_step: bool, noise_ratios: bool
) -> str:
    """Source of ``begin(W)`` and ``move(W, TAU, STEP)``, as `variational_rk4.print_integrator` has them.

    Q is in the rows ``NOISE_i_k`` of `estimator.engine.storage_layout.packed_rows`, unless the noise is held.

    Args:
        model: the equation; the source is empty for a difference equation.
        degree: degree of the input's polynomial.
        layout: row number of each quantity, with `packed_rows`.
        lanes: lanes of the block.
        variable_step: whether ``SAMPLE_LENGTH`` is the length of the sample, in sampling steps; else it is 1.
        noise_ratios: as for `estimator.engine.symbolic.propagate_sample`.
    """
    if not model.is_continuous:
        return ""
    writer = _IntegratorWriter(model, degree, layout, lanes, variable_step, noise_ratios)
    return writer.begin() + writer.stage() + writer.noise() + writer.sensitivities() + writer.move()


class _IntegratorWriter:
    """The parts of `print_packed_integrator`, with its arguments."""

    def __init__(
        self,
        model: Model,
        degree: int,
        layout: Mapping[str, int],
        lanes: int,
        variable_step: bool,
        noise_ratios: bool,
    ) -> None:
        self.model, self.degree, self.noise_ratios = model, degree, noise_ratios
        self.layout, self.lanes = layout, lanes
        self.states, self.movers = list(model.states), list(model.dynamic_names)
        self.first = self.states[0]
        self.held = held_noise_rows(model)
        self.arrays = PackedArrays(layout, lanes)
        self.slopes = self._slopes()
        entry = self.arrays.entry
        length = f"{entry('SAMPLE_LENGTH')}*" if variable_step else ""
        #: Length of a Runge-Kutta step [sampling steps].
        self.step_text = f"{length}STEP"
        self.step_symbol = (symbol("SAMPLE_LENGTH") if variable_step else sp.S.One) * symbol("STEP")

    def _slopes(self) -> dict[tuple[str, str], sp.Expr]:
        """The entries of the Jacobian that are not 0."""
        jacobian = differentiate(self.model).jacobian
        found = {(i, j): slope for i, row in zip(self.states, jacobian, strict=True)
                 for j, slope in zip(self.movers, row, strict=True) if slope != 0}  # fmt: skip
        return {pair: found[pair] for pair in slope_entries(self.model) if pair in found}

    def row(self, letter: str) -> str:
        """The first row of a matrix or vector by states."""
        name = f"{letter}_{self.first}_{self.first}"
        return name if name in self.layout else f"{letter}_{self.first}"

    def slope(self, i: str, k: str, stage: int | str = "S") -> str:
        """The entry of the Jacobian at a stage."""
        if self.slopes[i, k].is_Number:
            return print_expression(self.slopes[i, k])
        return self.arrays.entry(f"SLOPE_0_{i}_{k}", f"{stage}*{len(slope_entries(self.model))}")

    def begin(self) -> str:
        """Source of ``begin(W)``."""
        n, m, entry, loop = len(self.states), len(self.movers), self.arrays.entry, self.arrays.loop
        lines = self.arrays.copy(self.row("M"), self.first, n)
        lines += loop({"I": n}, f"{entry(self.row('RATE'), 'I')} = 0.0")
        lines += loop({"I": n * m}, f"{entry(self.row('F'), 'I')} = 0.0")
        lines += loop({"I": n}, f"{entry(self.row('F'), f'I*{m + 1}')} = 1.0")
        for rows in self.held:
            lines += loop({"I": n}, f"{entry(rows[0], 'I')} = 0.0")
        lines += loop({"I": n * n}, f"{entry(self.row('IDENTITY'), 'I')} = 0.0")
        lines += loop({"I": n}, f"{entry(self.row('IDENTITY'), f'I*{n + 1}')} = 1.0")
        if not self.held:
            lines += loop({"I": n * n}, f"{entry(self.row('NOISE'), 'I')} = 0.0")
        return define("begin(W)", "The integrator at the start of a sample.", lines)

    def stage(self) -> str:
        """Source of ``stage(W, TAU, STEP, REACH, WEIGHT, S)``: the model's own expressions at stage S."""
        model, c, h = self.model, differentiate(self.model), self.step_symbol
        at: dict[str, sp.Expr | str] = {i: f"STAGE_{i}" for i in self.states}
        at |= stage_inputs(model, "A")
        lines: Assignments = [
            line for line in input_at_stages(model, self.degree, symbol("STEP")) if line[0][-2:] == "_A"
        ]
        lines += [(f"STAGE_{i}", symbol(f"M_{i}") + symbol("REACH") * h * symbol(f"RATE_{i}")) for i in self.states]
        named = {f"RATE_{i}_e": move for i, move in zip(self.states, c.moves, strict=True)}
        named |= {f"SLOPE_{i}_{j}": slope for (i, j), slope in self.slopes.items() if not slope.is_Number}
        named |= {f"EFFECT_{i}": effect for i, effect in zip(self.states, c.noise, strict=True)}
        lines += substitute(eliminate_common_subexpressions(named, "CSE"), at)
        layout: dict[str, int | str] = dict(self.layout)
        n, n_slopes = len(self.states), len(slope_entries(model))
        results = {f"RATE_{i}": f"RATE_{i}_e" for i in self.states}
        for name in named:
            kind, _, which = name.partition("_")
            if kind == "SLOPE":
                layout[f"{name}_S"] = f"{self.layout[f'SLOPE_0_{which}']} + S*{n_slopes}"
                results[f"{name}_S"] = name
        for number, i in enumerate(self.states):
            layout[f"EFFECT_{i}_S"] = f"{self.layout[self.row('EFFECT_0')]} + S*{n} + {number}"
            results[f"EFFECT_{i}_S"] = f"EFFECT_{i}"
            end = symbol(f"STATE_END_{i}") + symbol("WEIGHT") * h * symbol(f"RATE_{i}_e")
            lines.append((f"STATE_END_{i}_e", end))
            results[f"STATE_END_{i}"] = f"STATE_END_{i}_e"
        uniform, doc = ("TAU", "STEP", "REACH", "WEIGHT", "S"), "The model's expressions at stage S of a step."
        return printer_numba.print_lane_loop(
            "stage", lines, results, layout, self.lanes, uniform, doc, lane_index=INDEPENDENT_INDEX
        )

    def noise(self) -> str:
        """Source of ``noise(W, STEP, NEXT_REACH, WEIGHT, S)``: the rates of Q at stage S, J Q + Q Jᵀ + g gᵀ.

        ``COV`` is Q at the stage, square, and then Q at the next stage.
        """
        if self.held:
            return ""
        n, entry, loop, row = len(self.states), self.arrays.entry, self.arrays.loop, self.row
        cov, product = row("COV"), row("PRODUCT")
        body = []
        for a, i in enumerate(self.states):
            terms = [f"{self.slope(i, k)}*{entry(cov, f'{b * n} + K')}"
                     for b, k in enumerate(self.states) if (i, k) in self.slopes]  # fmt: skip
            body.append(f"{entry(product, f'{a * n} + K')} = {sum_of(terms)}")
        lines = loop({"K": n}, *body)
        at_stage = [self.effect(index) for index in ("I", "(I + D)")]
        if self.model.independent_noise:
            ratios = noise_ratio_rows(self.model) if self.noise_ratios else [""] * len(self.model.noise_sources)
            for source, ratio in zip(self.model.noise_sources, ratios, strict=True):
                a = self.states.index(source)
                target, g = entry(product, a * (n + 1)), self.effect(a)
                # On the diagonal the product counts twice.
                lines += self.arrays.over_lanes(
                    [f"{target} = {target} + 0.5*{entry(ratio) + '*' if ratio else ''}{g}*{g}"]
                )
        outer = "" if self.model.independent_noise else f" + {at_stage[0]}*{at_stage[1]}"
        both = f"{entry(product, f'I*{n} + I + D')} + {entry(product, f'(I + D)*{n} + I')}"
        place, end = f"I*{n} + I + D", entry(row("NOISE_END"), f"I*{n} + I + D")
        lines += loop(
            {"I": n, "D": f"{n} - I"},
            f"RATE = {self.step_text}*({both}{outer})",
            f"Q = {entry(row('NOISE'), place)} + NEXT_REACH*RATE",
            f"{end} = {end} + WEIGHT*RATE",
            f"{entry(cov, place)} = Q",
            f"{entry(cov, f'(I + D)*{n} + I')} = Q",
        )
        signature = "noise(W, STEP, NEXT_REACH, WEIGHT, S)"
        return define(signature, "The rates of the process noise covariance at stage S.", lines)

    def effect(self, state: str | int, stage: int | str = "S") -> str:
        """The entry of the process noise's effect on a state, by number, at a stage."""
        return self.arrays.entry(self.row("EFFECT_0"), f"{stage}*{len(self.states)} + {state}")

    def sensitivities(self) -> str:
        """Source of ``sensitivities(W, STEP)``: F and the held noise's columns at the end of the step."""
        n, m, entry, loop, row = len(self.states), len(self.movers), self.arrays.entry, self.arrays.loop, self.row
        by, identity = row("END_BY"), row("IDENTITY")
        held_ends = [f"HELD_END{s}_{self.first}" for s in range(len(self.held))]
        # A row in each turn, through the stages from the last to the first.
        used = sorted({i for i, _ in self.slopes} | (set(self.states) if self.held else set()), key=self.states.index)
        body = [f"DIAGONAL_{i} = {self.step_text}*{entry(identity, f'I*{n} + {self.states.index(i)}')}" for i in used]
        ends: dict[str, list[str]] = {name: [] for name in [*self.movers, *held_ends]}
        for stage in (3, 2, 1, 0):
            weight, reach = (1, 2, 2, 1)[stage] / 6, (0.5, 0.5, 1.0, 0.0)[stage]
            for i in used:
                later = f"END_BY_{i}_{stage + 1}"
                through = f" + {reach}*{self.step_text}*{later}" if later in ends[i] else ""
                body.append(f"BY_RATE_{i}_{stage} = {weight!r}*DIAGONAL_{i}{through}")
            for j in self.movers:
                terms = [f"BY_RATE_{i}_{stage}*{self.slope(i, j, stage)}" for i in self.states if (i, j) in self.slopes]
                if terms:
                    ends[j].append(f"END_BY_{j}_{stage}")
                    body.append(f"END_BY_{j}_{stage} = {sum_of(terms)}")
            for s, held in enumerate(held_ends):
                sources = [self.model.noise_sources[s]] if self.model.independent_noise else self.states
                terms = [f"BY_RATE_{i}_{stage}*{self.effect(self.states.index(i), stage)}" for i in sources]
                ends[held].append(f"HELD_{s}_{stage}")
                body.append(f"HELD_{s}_{stage} = {sum_of(terms)}")
        for b, j in enumerate(self.movers):
            one = [entry(identity, f"I*{n} + {b}")] if j in self.states else []
            body.append(f"{entry(by, f'I*{m} + {b}')} = {sum_of([*one, *ends[j]])}")
        body += [f"{entry(held, 'I')} = {sum_of(ends[held])}" for held in held_ends]
        lines = loop({"I": n}, *body)
        # A column of F in each turn, in place.
        f = row("F")
        lines += loop({"K": n}, *self._through_step(f, m, "K"))
        if m > n:
            lines += loop(
                {"K": m - n}, *self._through_step(f, m, f"{n} + K", [entry(by, f"{a * m + n} + K") for a in range(n)])
            )
        for rows, held in zip(self.held, held_ends, strict=True):
            lines += self.arrays.over_lanes(self._through_step(rows[0], 1, "0", [entry(held, a) for a in range(n)]))
        return define("sensitivities(W, STEP)", "The derivatives at the end of a step.", lines)

    def _through_step(self, first_row: str, stride: int, column: str, added: Sequence[str] = ()) -> list[str]:
        """Statements that take a column of derivatives through the step, in place."""
        n, m, entry = len(self.states), len(self.movers), self.arrays.entry
        places = [entry(first_row, f"{a * stride} + {column}") for a in range(n)]
        statements = [f"BEFORE_{a} = {place}" for a, place in enumerate(places)]
        for a in range(n):
            terms = [f"{entry(self.row('END_BY'), a * m + b)}*BEFORE_{b}" for b in range(n)]
            statements.append(f"AFTER_{a} = {sum_of([*added[a : a + 1], *terms])}")
        return statements + [f"{place} = AFTER_{a}" for a, place in enumerate(places)]

    def move(self) -> str:
        """Source of ``move(W, TAU, STEP)``: one Runge-Kutta step."""
        n, copy, row = len(self.states), self.arrays.copy, self.row
        lines = copy(row("STATE_END"), row("M"), n)
        if not self.held:
            lines += copy(row("NOISE_END"), row("NOISE"), n * n)
            entry = self.arrays.entry
            lines += self.arrays.loop(
                {"I": n, "D": f"{n} - I"},
                f"Q = {entry(row('NOISE'), f'I*{n} + I + D')}",
                f"{entry(row('COV'), f'I*{n} + I + D')} = Q",
                f"{entry(row('COV'), f'(I + D)*{n} + I')} = Q",
            )
        lines += [
            "for S in range(4):",
            f"    REACH = {_REACH}",
            f"    WEIGHT = {_WEIGHT}",
            "    stage(W, TAU + REACH*STEP, STEP, REACH, WEIGHT, S)",
        ]
        if not self.held:
            lines += [
                f"    NEXT_REACH = {_REACH.replace('S + 1', 'S + 2')}",
                "    noise(W, STEP, NEXT_REACH, WEIGHT, S)",
            ]
        lines += ["sensitivities(W, STEP)", *copy(row("M"), row("STATE_END"), n)]
        if not self.held:
            lines += copy(row("NOISE"), row("NOISE_END"), n * n)
        return define("move(W, TAU, STEP)", "One Runge-Kutta step, from TAU in [0, 1) of the sample on.", lines)
