"""Variational iterations over the Gamma beliefs of the process and measurement noise precisions, as assignments."""

from __future__ import annotations

from typing import NamedTuple

import sympy as sp

from estimator.compilation.elementary_functions import LOG_2PI
from estimator.engine.branch_functions import select
from estimator.engine.symbolic import HALF, ONE, ZERO, Program, log1p, symbol, where_valid


class NoiseIteration(NamedTuple):
    """Assumptions and results of an iteration, in symbols.

    Attributes:
        process_variance: assumed variance of the process noise, 1/E[γ].
        q: assumed variance of the output by process noise.
        r: assumed variance of the sensor noise.
        inverse_innovation_cov: 1/S.
        scaled_innovation: ν/S.
        gamma_shape: resulting shape of q(γ).
        gamma_rate: resulting rate of q(γ).
        xi_shape: resulting shape of q(ξ).
        xi_rate: resulting rate of q(ξ).
    """

    process_variance: sp.Expr
    q: sp.Expr
    r: sp.Expr
    inverse_innovation_cov: sp.Expr
    scaled_innovation: sp.Expr
    gamma_shape: sp.Expr
    gamma_rate: sp.Expr
    xi_shape: sp.Expr
    xi_rate: sp.Expr


def iterate_noise_beliefs(
    program: Program, tag: str, sensor: str, scalars: tuple[sp.Expr, sp.Expr, sp.Expr, sp.Expr], iterations: int
) -> list[NoiseIteration]:
    """Iterate q(γ) and q(ξ) of a sensor (`estimator.engine.gaussian_update` has the formulas).

    Both second moments are sums of positive terms, E[v²] = r (r ν²/S² + 1 - r/S). The moment of the process noise is
    for unit strength, so that no division by hᵀ Q h occurs, which may be 0 where the noise depends on the state.

    Args:
        program: receives the assignments.
        tag: the sensor's number, in their names.
        sensor: the sensor's name.
        scalars: hᵀ P⁻ h, ν, hᵀ Q h, and whether the output is observed.
        iterations: number of iterations.
    """
    s, e, output_noise, is_observed = scalars
    gamma_rate, xi_rate = symbol("GAMMA_RATE"), symbol(f"XI_RATE_{sensor}")
    gamma_shape, xi_shape = symbol("GAMMA_SHAPE"), symbol(f"XI_SHAPE_{sensor}")
    half_count = program.assign(f"HALF_COUNT{tag}", HALF * is_observed)
    new_gamma_shape = (
        program.assign(f"NEW_GAMMA_SHAPE{tag}", gamma_shape + half_count) if output_noise != 0 else gamma_shape
    )
    new_xi_shape = program.assign(f"NEW_XI_SHAPE{tag}", xi_shape + half_count)
    # Every iteration has the same shapes, and divisions take long.
    inverse_gamma_shape = (
        program.assign(f"GAMMA_SHAPE_INVERSE{tag}", 1 / new_gamma_shape) if output_noise != 0 else ZERO
    )
    inverse_xi_shape = program.assign(f"XI_SHAPE_INVERSE{tag}", 1 / new_xi_shape)
    process_variance = (
        program.assign(f"PROCESS_VARIANCE{tag}_0", gamma_rate / gamma_shape) if output_noise != 0 else ZERO
    )
    r = program.assign(f"R{tag}_0", xi_rate / xi_shape)
    noise_iterations = []
    for i in range(iterations):
        q = program.assign(f"Q_OUTPUT{tag}_{i}", output_noise * process_variance)
        inverse_innovation_cov = program.assign(f"S_INVERSE{tag}_{i}", 1 / (s + q + r))
        scaled_innovation = program.assign(f"INNOVATION_OVER_S{tag}_{i}", e * inverse_innovation_cov)
        square = program.assign(f"INNOVATION_OVER_S_SQUARED{tag}_{i}", scaled_innovation**2)
        new_gamma_rate, new_xi_rate = (
            program.assign(
                f"{letter}{tag}_{i}", rate + half_count * variance * (v * square + (1 - v * inverse_innovation_cov))
            )
            if v != 0
            else rate
            for letter, rate, variance, v in (
                ("NEW_GAMMA_RATE", gamma_rate, process_variance, q),
                ("NEW_XI_RATE", xi_rate, r, r),
            )
        )
        noise_iterations.append(
            NoiseIteration(
                process_variance,
                q,
                r,
                inverse_innovation_cov,
                scaled_innovation,
                new_gamma_shape,
                new_gamma_rate,
                new_xi_shape,
                new_xi_rate,
            )
        )
        process_variance = (
            program.assign(f"PROCESS_VARIANCE{tag}_{i + 1}", new_gamma_rate * inverse_gamma_shape)
            if output_noise != 0
            else ZERO
        )
        r = program.assign(f"R{tag}_{i + 1}", new_xi_rate * inverse_xi_shape)
    return noise_iterations


def sensor_free_energy(
    program: Program, tag: str, sensor: str, scalars: tuple[sp.Expr, ...], iteration: NoiseIteration
) -> sp.Expr:
    """The free energy [nats] of a sensor's output after an iteration (`estimator.engine.variational_free_energy`).

    The terms of a Gamma belief that depend on its shape alone are read from the symbols ``RATIO_<precision>`` and
    ``TERM_<precision>``, r and t of `estimator.compilation.elementary_functions.gamma_half_ratio`.
    """
    s, e, output_noise, is_observed = scalars
    weight, step = iteration.inverse_innovation_cov, iteration.scaled_innovation
    variance = program.assign(f"S_TOTAL{tag}", s + iteration.q + iteration.r)
    xi_rate = symbol(f"XI_RATE_{sensor}")
    noises = [("XI", f"XI_{sensor}", iteration.r, symbol(f"XI_SHAPE_{sensor}"), xi_rate)]
    if output_noise != 0:
        rate = program.assign(f"GAMMA_RATE_OUTPUT{tag}", output_noise * symbol("GAMMA_RATE"))
        noises.append(("GAMMA", "GAMMA", iteration.q, symbol("GAMMA_SHAPE"), rate))
    factor, term, powers = variance, ZERO, {}
    for name, precision, noise, shape, rate in noises:
        half_power = program.assign(f"{name}_POWER{tag}", HALF * noise * (noise * step**2 + (1 - noise * weight)))
        inverse = program.assign(f"{name}_PRECISION{tag}", 1 / noise)
        ratio = program.assign(f"{name}_FACTOR{tag}", (rate + half_power) * inverse * symbol(f"RATIO_{precision}"))
        divergence = program.assign(
            f"{name}_DIVERGENCE{tag}",
            shape * log1p(half_power / rate) - half_power * inverse + symbol(f"TERM_{precision}"),
        )
        if name == "GAMMA":  # where the noise depends on the state, its variance may be 0
            ratio, divergence = select(noise, ratio, ONE), select(noise, divergence, ZERO)
        factor, term, powers[name] = factor * ratio, term + divergence, half_power
    value = program.assign(f"ENERGY{tag}", HALF * (sp.Float(LOG_2PI) + sp.log(factor) + e * step) + term)
    value = program.assign(
        f"ENERGY_VALID{tag}", where_valid(value, variance, iteration.r, xi_rate, powers["XI"], iteration.q)
    )
    return select(is_observed, value, ZERO) if is_observed != ONE else value
