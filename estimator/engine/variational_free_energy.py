"""Variational free energy of a sample, from the trace of the compiled belief update."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from estimator.compilation.elementary_functions import LOG_2PI, gamma_half_ratio, log, log1p
from estimator.compilation.scalar_jit import scalar_jit
from estimator.engine.source_cache import load_generated
from estimator.models.model import Model


@scalar_jit
def half_noise_powers(scaled_innovation, inverse_innovation_variance, q, r):
    """Half of E[w²] and of E[v²] under the Kalman step with noise variances q and r.

    Args:
        scaled_innovation: the innovation divided by its variance.
        inverse_innovation_variance: inverse of the innovation's variance with q and r.
        q: variance of the output by process noise, hᵀ Q h / E[γ].
        r: variance of the sensor noise, 1/E[ξ].
    """
    w = q * scaled_innovation
    v = r * scaled_innovation
    return 0.5 * (w * w + q * (1.0 - q * inverse_innovation_variance)), 0.5 * (
        v * v + r * (1.0 - r * inverse_innovation_variance)
    )


@scalar_jit
def precision_divergence(half_power, variance, shape, rate):
    """Contribution of a precision's belief to the free energy: its divergence from the prior, and the expected terms.

    The terms in ψ(shape + 1/2) and in half_power/(rate + half_power) cancel in the sum.

    Args:
        half_power: half of the noise's second moment.
        variance: the noise variance assumed by the iteration.
        shape: shape of the precision before the sample.
        rate: rate of the precision before the sample.

    Returns:
        f and t of the contribution ½ log f + t. One logarithm of the product of all f of a sample saves time.
    """
    precision = 1.0 / variance
    r, t = gamma_half_ratio(shape)
    return (rate + half_power) * precision * r, shape * log1p(half_power / rate) - half_power * precision + t


def compile_free_energies(
    model: Model, iterations: int, lanes: int, layout: Mapping[str, int], every_iteration: bool = True
) -> Any:
    """Compile ``f(W, out)``: the free energies [nats] of the last update in every lane, after each iteration.

    F = KL[q(states, coefficients) || prior, transition, likelihood] + KL[q(γ) || prior] + KL[q(ξ) || prior] to first
    order, summed over the sensors. The first sensor with process noise counts for γ and its ξ, each further one for its
    ξ; a missing output counts 0. ``out`` is (iterations * lanes,), or (lanes,) for the last iteration; NaN where a
    variance is not positive.

    Args:
        model: the equation.
        iterations: number of iterations of the update.
        lanes: lanes of a block.
        layout: layout of `estimator.engine.kernels.compile_belief_update` with ``keep_trace=True``.
        every_iteration: after every iteration, or only after the last.
    """
    reported = range(iterations) if every_iteration else [iterations - 1]

    def make() -> str:
        at = lambda row: f"W[{layout[row] * lanes} + LANE]"  # noqa: E731
        lines = []
        for place, i in enumerate(reported):
            for k, sensor in enumerate(model.outputs):
                found = f"F_{place}_{k}"
                lines += [
                    f"y, e, s = {at(f'Y_{sensor}')}, {at(f'TRACE_{k}_innovation')}, {at(f'TRACE_{k}_variance')}",
                    "# Shapes and rates before the sample; the rate of the process noise in units of the output.",
                    f"g, n = {at('GAMMA_SHAPE')} - 0.5, {at(f'XI_SHAPE_{sensor}')} - 0.5",
                    f"g_rate, n_rate = g * {at(f'TRACE_{k}_q_0')}, n * {at(f'TRACE_{k}_r_0')}",
                    f"q, r = {at(f'TRACE_{k}_q_{i}')}, {at(f'TRACE_{k}_r_{i}')}",
                    "weight = 1.0 / (s + q + r)",
                    "step = e * weight",
                    "half_w, half_v = half_noise_powers(step, weight, q, r)",
                    "# The Gaussian's evidence is ½ log 2πS + e²/2S at the noise variances of the iteration.",
                    "f, t = precision_divergence(half_v, r, n, n_rate)",
                    "f_w, t_w = precision_divergence(half_w, q, g, g_rate)",
                    "f, t = (f * f_w if q > 0.0 else f), (t + t_w if q > 0.0 else t)",
                    "value = 0.5 * (LOG_2PI + log((s + q + r) * f) + e * step) + t",
                    "sound = s + q + r > 0.0 and r > 0.0 and n_rate > 0.0 and half_v >= 0.0 and q >= 0.0",
                    f"{found} = (value if sound else NAN) if y == y else 0.0",
                ]
            total = " + ".join(f"F_{place}_{k}" for k in range(model.n_outputs))
            lines.append(f"B[{place * lanes} + LANE] = {total}")
        loop = ["@scalar_jit", "def free_energies(W, B):", f"    for LANE in range({lanes}):"]
        return "\n".join(loop + [f"        {line}" for line in lines]) + "\n"

    names = {"NAN": float("nan"), "LOG_2PI": LOG_2PI, "log": log}
    names |= {f.__name__: f for f in (precision_divergence, half_noise_powers)}
    key = repr((model.digest, iterations, lanes, sorted(layout.items()), every_iteration))
    return load_generated(model.name, "free-energy", key, make, names).free_energies
