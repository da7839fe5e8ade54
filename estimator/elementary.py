"""Elementary functions in the form the kernels need.

`log` is free of branches and calls, so that it vectorises. The Gamma functions are evaluated at the very large shapes
of the paper's noise priors (1e8), where differences of library values would keep no digit of the divergence between
a posterior and its prior.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.lanes import inlined, jit

LOG_2PI = math.log(2 * math.pi)

_SQRT_HALF_BITS = np.int64(0x3FE6A09E667F3BCD)
_MANTISSA_BITS = np.int64(52)
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10


@inlined
def log(x):
    """Natural logarithm of a positive, normal number, to 3 units in the last place.

    x = 2^k m with m in [sqrt(1/2), sqrt(2)) and log m = 2 artanh(s), s = (m - 1)/(m + 1), by the minimax polynomial
    in s^2 of fdlibm's ``log``. Zero, infinities and NaN give a finite or NaN value without meaning.
    """
    bits = np.float64(x).view(np.int64)
    k = (bits - _SQRT_HALF_BITS) >> _MANTISSA_BITS
    m = np.int64(bits - (k << _MANTISSA_BITS)).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 0.1531383769920937332 + z * 0.1479819860511658591
    p = 0.2222219843214978396 + z * (0.1818357216161805012 + z * p)
    p = 0.6666666666666735130 + z * (0.3999999999940941908 + z * (0.2857142874366239149 + z * p))
    return k * _LN2_HIGH + (2.0 * s + (s * (z * p) + k * _LN2_LOW))


@jit
def digamma(a):
    """Digamma function of a > 0: recurrence up to 10, then the asymptotic series (Abramowitz and Stegun 6.3.18)."""
    shift = 0.0
    while a < 10.0:
        shift -= 1.0 / a
        a += 1.0
    z = 1.0 / (a * a)
    series = z * (1 / 12 - z * (1 / 120 - z * (1 / 252 - z * (1 / 240 - z * (1 / 132)))))
    return shift + math.log(a) - 0.5 / a - series


@jit
def log_gamma_half_step(a):
    """Log Gamma(a + 1/2) - log Gamma(a) of a > 0, to rounding also where both are of the order of 1e9."""
    shift = 0.0
    while a < 20.0:
        shift -= math.log1p(0.5 / a)
        a += 1.0
    z = 1.0 / (a * a)
    return shift + 0.5 * math.log(a) - (1 / 8 - z * (1 / 192 - z * (1 / 640 - z * 17 / 14336))) / a


@jit
def gamma_step_divergence(shape, rate, increment):
    """Divergence KL[Gamma(shape + 1/2, rate + increment) || Gamma(shape, rate)] in nats.

    This is what one sample adds to the belief in a noise precision. Written in increment/rate, because rate +
    increment has already rounded away most digits of the increment.
    """
    ratio = increment / rate
    return (
        0.5 * digamma(shape + 0.5)
        - log_gamma_half_step(shape)
        + shape * math.log1p(ratio)
        - (shape + 0.5) * ratio / (1.0 + ratio)
    )


@jit
def expected_log_gamma(shape, rate):
    """E[log g] of g ~ Gamma(shape, rate)."""
    return digamma(shape) - math.log(rate)
