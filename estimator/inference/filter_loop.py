"""The compiled loop of the online estimator over samples, for any model.

A block ``W`` holds one system, or `LANES` noise hypotheses of one. For each sample the loop adds the random walk of the
coefficients, writes the inputs into their rows, updates the beliefs, and weighs the hypotheses by free energy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from estimator.compilation.array_operations import copy
from estimator.compilation.simd import LANES, jit, jit_closure, kernel
from estimator.engine import kernels
from estimator.engine.source_cache import variant_digest
from estimator.engine.storage_layout import belief_rows, first_input_row
from estimator.engine.variational_free_energy import compile_free_energies
from estimator.inference import mean_field
from estimator.inference.member_steps import compile_member_steps
from estimator.inference.noise_mixture import apply_switching, forecast_mixture, mark_diverged, reweight
from estimator.models.difference_equation import difference
from estimator.models.model import Model


@dataclass(frozen=True)
class FilterLoop:
    """A compiled loop over samples, and the layout of its block.

    Attributes:
        run: ``run(W, weights, begun, inputs, outputs, stencil, steps, walk, energies, forecasts)``, which
            returns -1, or the number of the sample at which the numbers overflowed; then nothing has changed.

            - W: (blocks, rows * lanes), the members' systems one after another.
            - weights: (members,) of the hypotheses.
            - begun: (1,) 0 before the first sample ever, then 1.
            - inputs: (samples * inputs,) the past inputs that still act, then the new ones, sample after sample; the
              former are shifted.
            - outputs: (samples, sensors), after the stored one; NaN where missing.
            - stencil: of `estimator.inference.input_interpolation.InputStencil`.
            - steps: its stride, n_stored, lookahead and repeats_first, as int64.
            - walk: (K,) variances of the coefficients' random walk per sample.
            - energies: (samples, iterations) receives the free energies [nats]; empty to skip all checks.
            - forecasts: (samples, sensors, 2) receives the predictive mean and variance of each output.
        layout: row number of each quantity.
        lanes: lanes of a block.
    """

    run: Any
    layout: Mapping[str, int]
    lanes: int


@cache
def compile_structured_loop(
    model: Model, degree: int, iterations: int, expectations: str = "first_order", members: int = 1
) -> FilterLoop:
    """Compile the loop of the structured factorisation; several members take a lane each.

    Members share one linearisation, except with sigma points, which depend on a member's own covariance.
    """
    if members > 1 and expectations == "first_order":
        return _compile_shared_loop(model, degree, iterations)
    lanes = 1 if members == 1 else LANES
    belief_update = kernels.compile_belief_update(
        model,
        degree,
        iterations=iterations,
        lanes=lanes,
        keep_trace=True,
        may_be_missing=True,
        expectations=expectations,
    )
    layout, update = belief_update.layout, belief_update.update
    energies_of = compile_free_energies(model, iterations, lanes, layout)
    variant = f"{model.name}_{variant_digest(model.digest, degree, iterations, lanes, expectations)}"
    unsound = layout.get("INDEFINITE_COUNT", -1) * lanes

    @jit_closure(variant)
    def update_block(W, C, before):
        if unsound >= 0:
            for j in range(lanes):
                W[unsound + j] = 0.0
        update(W)
        energies_of(W, before)

    sensors = model.n_outputs
    means = tuple(layout[f"TRACE_{k}_mean"] * lanes for k in range(sensors))
    variance_parts = tuple(
        tuple(
            layout[f"TRACE_{k}_{what}"] * lanes for what in ("variance", f"q_{iterations - 1}", f"r_{iterations - 1}")
        )
        for k in range(sensors)
    )

    @jit_closure(variant)
    def score_member(W, j, before, values, forecasts):
        for i in range(iterations):
            values[i] = np.nan if unsound >= 0 and W[unsound + j] > 0.0 else before[i * lanes + j]
        for k in range(sensors):
            forecasts[k, 0] = W[means[k] + j]
            forecasts[k, 1] = W[variance_parts[k][0] + j] + W[variance_parts[k][1] + j] + W[variance_parts[k][2] + j]

    return FilterLoop(
        _compile_loop(variant, model, layout, lanes, iterations * lanes, update_block, score_member), layout, lanes
    )


def _compile_shared_loop(model: Model, degree: int, iterations: int) -> FilterLoop:
    """Compile the loop of members about one linearisation."""
    steps = compile_member_steps(model, degree, iterations)
    run = _compile_loop(
        steps.variant, model, steps.layout, LANES, 1, steps.update_block, steps.score_member,
        steps.shared_layout, steps.share_linearisation,
    )  # fmt: skip
    return FilterLoop(run, steps.layout, LANES)


@cache
def compile_mean_field_loop(iterations: int, as_published: bool) -> FilterLoop:
    """Compile the loop of the paper's mean field, which gives no forecasts."""
    model = difference()
    layout = mean_field.mean_field_layout()
    begin, iterate, end, energy = mean_field.compile_mean_field(layout, lanes=1)
    variant = f"mean_field_{variant_digest(model.digest, iterations, as_published)}"

    @jit_closure(variant)
    def update_block(W, C, before):
        begin(W)
        for i in range(iterations):
            iterate(W, as_published)
            before[i] = energy(W, 0)
        end(W)

    @jit_closure(variant)
    def score_member(W, j, before, values, forecasts):
        for i in range(iterations):
            values[i] = before[i]
        forecasts[0, 0] = forecasts[0, 1] = np.nan

    return FilterLoop(_compile_loop(variant, model, layout, 1, iterations, update_block, score_member), layout, 1)


def _compile_loop(
    variant: str,
    model: Model,
    layout: Mapping[str, int],
    lanes: int,
    scratch: int,
    update_block: Any,
    score_member: Any,
    shared_layout: Mapping[str, int] | None = None,
    share_linearisation: Any = None,
) -> Any:
    """Compile `FilterLoop.run` around an update.

    Args:
        variant: identifies the compiled code; see `estimator.compilation.simd.jit_closure`.
        model: the equation.
        layout: row number of each quantity.
        lanes: lanes of a block.
        scratch: size of ``before``.
        update_block: ``update_block(W, C, before)``: updates a block, and writes its free energies into ``before``.
        score_member: ``score_member(W, j, before, values, forecasts)``: free energies and forecasts of lane j.
        shared_layout: rows of the block C that the members share, with the input and the outputs; None without one.
        share_linearisation: ``share_linearisation(W, weights, C)``: fills the rest of C.
    """
    sensors, is_single, is_shared = model.n_outputs, lanes == 1, shared_layout is not None
    sample_layout = layout if shared_layout is None else shared_layout
    shared_size = 1 if shared_layout is None else len(shared_layout) * lanes
    load_sample = _compile_sample_loader(variant, model, sample_layout, lanes)
    add_walk = _compile_walk(variant, model, layout, lanes)
    record_length = len(belief_rows(model)) * lanes

    @kernel(variant=variant)
    def run(W, weights, begun, inputs, outputs, stencil, steps, walk, energies, forecasts):
        stride, n_stored, lookahead, repeats_first = steps[0], steps[1], steps[2], steps[3]
        members, samples, iterations = len(weights), len(outputs) - lookahead, energies.shape[1]
        judged = energies.shape[0] > 0
        before, C = np.empty(scratch), np.zeros(shared_size)
        member_energies, shares = np.empty((members, iterations)), np.empty((members, iterations))
        predictions = np.empty((members, sensors, 2))
        old_weights, backup = np.empty(members), np.empty((len(W), record_length))
        copy(old_weights, 0, weights, members)
        _copy_beliefs(backup, W, record_length)
        first = 1 if lookahead and begun[0] == 0.0 else 0
        if repeats_first and begun[0] == 0.0:
            for i in range(n_stored):
                inputs[i] = inputs[n_stored + i % stride]
        overflowed_at = -1
        for t in range(first, samples):
            if is_shared:
                load_sample(C, inputs, t * stride, stencil, outputs[t])
                share_linearisation(W, weights, C)
            for b in range(len(W)):
                add_walk(W[b], walk)
                if not is_shared:
                    load_sample(W[b], inputs, t * stride, stencil, outputs[t])
                update_block(W[b], C, before)
                for j in range(min(lanes, members - b * lanes)):
                    m = b * lanes + j
                    score_member(W[b], j, before, member_energies[m], predictions[m])
            here = t - first
            if is_single or not judged:
                for k in range(sensors):
                    forecasts[here, k, 0], forecasts[here, k, 1] = predictions[0, k, 0], predictions[0, k, 1]
            else:
                _weigh_members(weights, member_energies, shares, predictions, energies[here], forecasts[here])
            if judged:
                if is_single:
                    copy(energies[here], 0, member_energies[0], iterations)
                if not _all_finite(energies[here]):
                    overflowed_at = t
                    break
        if judged and overflowed_at < 0 and samples > first and not _any_finite(W, weights, lanes, record_length):
            overflowed_at = samples - 1
        if overflowed_at >= 0:
            _copy_beliefs(W, backup, record_length)
            copy(weights, 0, old_weights, members)
            if repeats_first and begun[0] == 0.0:
                for i in range(n_stored):
                    inputs[i] = 0.0
            return overflowed_at
        for i in range(n_stored):
            inputs[i] = inputs[i + samples * stride]
        for i in range(lookahead):
            for k in range(sensors):
                outputs[i, k] = outputs[i + samples, k]
        begun[0] = 1.0
        return overflowed_at

    return run


def _compile_walk(variant: str, model: Model, layout: Mapping[str, int], lanes: int) -> Any:
    """Compile ``add_walk(W, walk)``: the random walk of the coefficients over a sample."""
    variance_rows = tuple(layout[f"P_{c}_{c}"] * lanes for c in model.coefficients)

    @jit_closure(variant)
    def add_walk(W, walk):
        walks = False
        for c in range(len(variance_rows)):
            walks = walks or walk[c] > 0.0
        if walks:
            for c in range(len(variance_rows)):
                for j in range(lanes):
                    W[variance_rows[c] + j] += walk[c]

    return add_walk


def _compile_sample_loader(variant: str, model: Model, layout: Mapping[str, int], lanes: int) -> Any:
    """Compile ``load_sample(W, inputs, start, stencil, output)``: inputs and outputs of a sample."""
    u_row = first_input_row(layout, model) * lanes
    y_row = layout[f"Y_{next(iter(model.outputs))}"] * lanes
    sensors = model.n_outputs

    @jit_closure(variant)
    def load_sample(W, inputs, start, stencil, output):
        for i in range(len(stencil)):
            value = 0.0
            for w in range(stencil.shape[1]):
                value += inputs[start + w] * stencil[i, w]
            for j in range(lanes):
                W[u_row + i * lanes + j] = value
        for k in range(sensors):
            for j in range(lanes):
                W[y_row + k * lanes + j] = output[k]

    return load_sample


@jit
def _weigh_members(weights, member_energies, shares, predictions, energies, forecasts):
    """Weigh the members by a sample, and give the mixture's free energies and forecasts.

    Args:
        weights: (members,), updated.
        member_energies: (members, iterations) free energies of the members.
        shares: (members, iterations), overwritten with the weights after each iteration.
        predictions: (members, sensors, 2) means and variances.
        energies: (iterations,) receives the free energies of the mixture.
        forecasts: (sensors, 2) receives its means and variances.
    """
    members, iterations = member_energies.shape
    for m in range(members):
        mark_diverged(member_energies[m], predictions[m])
        for i in range(iterations):
            shares[m, i] = weights[m]
    apply_switching(shares, member_energies)
    forecast_mixture(shares, predictions, forecasts)
    reweight(shares, member_energies, energies)
    for m in range(members):
        weights[m] = shares[m, iterations - 1]


@jit
def _all_finite(values):
    """Whether all numbers are finite."""
    finite = True
    for i in range(len(values)):
        finite = finite and np.isfinite(values[i])
    return finite


@jit
def _any_finite(blocks, weights, lanes, record_length):
    """Whether a member with weight has a finite belief: no free energy judges what the last sample left."""
    found = False
    for m in range(len(weights)):
        finite = weights[m] > 0.0
        for i in range(m % lanes, record_length, lanes):
            finite = finite and np.isfinite(blocks[m // lanes, i])
        found = found or finite
    return found


@jit
def _copy_beliefs(target, source, record_length):
    """Copy the beliefs of some blocks to others."""
    for b in range(len(source)):
        for i in range(record_length):
            target[b, i] = source[b, i]
