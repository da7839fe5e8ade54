"""Steps of the filter loop for members of a noise grid about one linearisation (`estimator.engine.shared_update`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from estimator.compilation.simd import LANES, jit_closure
from estimator.engine.shared_update import compile_shared_update
from estimator.engine.source_cache import variant_digest
from estimator.models.model import Model


@dataclass(frozen=True)
class MemberSteps:
    """Compiled steps of a sample, and the layouts of their blocks.

    Attributes:
        variant: identifies the compiled code.
        layout: rows of the members' blocks W.
        shared_layout: rows of the block C that the members share, with the input and the outputs.
        share_linearisation: ``share_linearisation(W, weights, C)``: linearises about the mixture's mean.
        update_block: ``update_block(W, C, before)``: updates a block of members.
        score_member: ``score_member(W, j, before, values, forecasts)``: free energies and forecasts of lane j.
    """

    variant: str
    layout: Mapping[str, int]
    shared_layout: Mapping[str, int]
    share_linearisation: Callable[..., None]
    update_block: Callable[..., None]
    score_member: Callable[..., None]


def compile_member_steps(model: Model, degree: int, iterations: int) -> MemberSteps:
    """Compile the steps for a model of one sensor."""
    shared = compile_shared_update(model, degree, iterations, may_be_missing=True, every_iteration=True)
    layout, shared_layout, linearise, update = shared.layout, shared.shared_layout, shared.linearise, shared.update
    variant = f"{model.name}_{variant_digest(model.digest, degree, iterations, 'shared')}"
    n_quantities = len(model.names)
    shapes = ("GAMMA_SHAPE", *(f"XI_SHAPE_{y}" for y in model.outputs))
    shape_rows = tuple((shared_layout[row] * LANES, layout[row] * LANES) for row in shapes)
    energy_rows = tuple(layout[f"FREE_ENERGY_{i}"] * LANES for i in range(iterations))
    forecast_rows = tuple((layout[f"MEAN_{y}"] * LANES, layout[f"VARIANCE_{y}"] * LANES) for y in model.outputs)

    @jit_closure(variant)
    def share_linearisation(W, weights, C):
        """Linearise about the mixture's mean, summed as deviations from the likeliest member."""
        likeliest = 0
        for m in range(len(weights)):
            likeliest = m if weights[m] > weights[likeliest] else likeliest
        B, lane = W[likeliest // LANES], likeliest % LANES
        for i in range(n_quantities):
            reference, deviation = B[i * LANES + lane], 0.0
            for m in range(len(weights)):
                if weights[m] > 0.0:
                    deviation += weights[m] * (W[m // LANES, i * LANES + m % LANES] - reference)
            for j in range(LANES):
                C[i * LANES + j] = reference + deviation
        for to, source in shape_rows:
            for j in range(LANES):
                C[to + j] = B[source + lane]
        linearise(C)

    @jit_closure(variant)
    def update_block(W, C, before):
        update(W, C)

    @jit_closure(variant)
    def score_member(W, j, before, values, forecasts):
        for i in range(iterations):
            values[i] = W[energy_rows[i] + j]
        for k in range(len(forecast_rows)):
            forecasts[k, 0], forecasts[k, 1] = W[forecast_rows[k][0] + j], W[forecast_rows[k][1] + j]

    return MemberSteps(variant, layout, shared_layout, share_linearisation, update_block, score_member)
