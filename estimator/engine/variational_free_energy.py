"""The free energy of a sample, from what the generated update leaves in its trace."""

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
        scaled_innovation: the innovation, what was seen less what was predicted, times the weight.
        inverse_innovation_variance: inverse of the prediction's variance with this sample's noises.
        q: variance of the process noise as the sensor shows it, 1/E[γ].
        r: variance of the sensor's noise, 1/E[ξ].
    """
    w = q * scaled_innovation
    v = r * scaled_innovation
    return 0.5 * (w * w + q * (1.0 - q * inverse_innovation_variance)), 0.5 * (
        v * v + r * (1.0 - r * inverse_innovation_variance)
    )


@scalar_jit
def precision_divergence(half_power, variance, shape, rate):
    """What the belief in a precision adds: the moment and logarithm it moved to, and its divergence from the prior.

    The three have terms in ψ(shape + 1/2), and in half_power/(rate + half_power), that cancel.

    Args:
        half_power: half of the noise's second moment.
        variance: of the noise, as the iteration assumed it.
        shape: of the precision before the sample.
        rate: of the precision before the sample.

    Returns:
        f and t: it adds ½ log f + t. The logarithms of a sample are taken of one product: they are most of the work.
    """
    precision = 1.0 / variance
    r, t = gamma_half_ratio(shape)
    return (rate + half_power) * precision * r, shape * log1p(half_power / rate) - half_power * precision + t


def compile_free_energies(
    model: Model, iterations: int, lanes: int, layout: Mapping[str, int], every_iteration: bool = True
) -> Any:
    """Compile ``f(W, out)``: the free energies [nats] that the last update left every lane with, after each iteration.

    F = KL[q(states, coefficients) || prior, transition, likelihood] + KL[q(γ) || prior] + KL[q(ξ) || prior] to first
    order, summed over the sensors: the first that shows the process noise counts for γ and its own ξ, each further one
    for its ξ. A missing output counts for nothing. ``out`` is (iterations * lanes,), or (lanes,), one iteration after
    another; NaN where an update has left what is no variance.

    Args:
        model: whose belief.
        iterations: of the update.
        lanes: systems in a block.
        layout: of the update, `estimator.engine.kernels.compile_belief_update` with ``trace=True``.
        every_iteration: whether after every iteration, or only after the last.
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
                    "# Shapes and rates before the sample; that of the process noise as the sensor shows it.",
                    f"g, n = {at('GAMMA_SHAPE')} - 0.5, {at(f'XI_SHAPE_{sensor}')} - 0.5",
                    f"g_rate, n_rate = g * {at(f'TRACE_{k}_q_0')}, n * {at(f'TRACE_{k}_r_0')}",
                    f"q, r = {at(f'TRACE_{k}_q_{i}')}, {at(f'TRACE_{k}_r_{i}')}",
                    "weight = 1.0 / (s + q + r)",
                    "step = e * weight",
                    "half_w, half_v = half_noise_powers(step, weight, q, r)",
                    "# The Gaussian's own evidence is ½ log 2πS + e²/2S at the noise variances of the iteration.",
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
