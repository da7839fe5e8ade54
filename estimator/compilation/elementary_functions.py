"""Elementary and Gamma functions for compiled kernels.

`log` and the others with `scalar_jit` are free of branches and calls, so that they vectorise. The Gamma functions keep
their digits at the very large shapes of the paper's noise priors (1e8), where differences of library values lose all
digits of the divergence between posterior and prior.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import jit

LOG_2PI = math.log(2 * math.pi)

_SQRT_HALF_BITS = np.int64(0x3FE6A09E667F3BCD)
_N_MANTISSA_BITS = np.int64(52)
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10


@scalar_jit
def _exponent_and_mantissa(x):
    """Exponent k and mantissa m of x = 2^k m and m in [sqrt(1/2), sqrt(2)), of a positive, normal number."""
    bits = np.float64(x).view(np.int64)
    k = (bits - _SQRT_HALF_BITS) >> _N_MANTISSA_BITS
    return k, np.int64(bits - (k << _N_MANTISSA_BITS)).view(np.float64)


@scalar_jit
def _log_from_parts(k, f):
    """log(2^k (1 + f)), with log(1 + f) = 2 artanh(s), s = f/(2 + f), by the minimax polynomial of fdlibm's ``log``."""
    s = f / (2.0 + f)
    z = s * s
    p = 0.1531383769920937332 + z * 0.1479819860511658591
    p = 0.2222219843214978396 + z * (0.1818357216161805012 + z * p)
    p = 0.6666666666666735130 + z * (0.3999999999940941908 + z * (0.2857142874366239149 + z * p))
    return k * _LN2_HIGH + (2.0 * s + (s * (z * p) + k * _LN2_LOW))


@scalar_jit
def log(x):
    """Natural logarithm of a positive, normal number, to 3 units in the last place.

    The value for zero, infinities and NaN is meaningless.
    """
    k, m = _exponent_and_mantissa(x)
    return _log_from_parts(k, m - 1.0)


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


@scalar_jit
def log1p(x):
    """Logarithm of 1 + x, x > -1, to 4 units in the last place, also where 1 + x has lost most digits of x."""
    u = 1.0 + x
    k, m = _exponent_and_mantissa(u)
    lost = (x - (u - 1.0)) * (np.int64((1023 - k) << _N_MANTISSA_BITS).view(np.float64))
    return _log_from_parts(k, (m - 1.0) + lost)


@scalar_jit
def gamma_half_ratio(a):
    """Factors r and t of Γ(a + 1/2) / Γ(a) = exp(-t) / sqrt(r), a > 0, to rounding for a up to 1e9 and more.

    Ten steps of the recurrence, then the asymptotic series of Γ(a + 1/2) / Γ(a).
    """
    below = a * (a + 1.0) * (a + 2.0) * (a + 3.0) * (a + 4.0) * (a + 5.0) * (a + 6.0) * (a + 7.0) * (a + 8.0)
    above = (a + 0.5) * (a + 1.5) * (a + 2.5) * (a + 3.5) * (a + 4.5) * (a + 5.5) * (a + 6.5) * (a + 7.5) * (a + 8.5)
    # For a very large shape the products overflow; their ratio is 1.
    stepped = (above * (a + 9.5)) / (below * (a + 9.0)) if a < 1e30 else 1.0
    inverse = 1.0 / (a + 10.0)
    z = inverse * inverse
    series = 1 / 640 - z * (17 / 14336 - z * (31 / 18432 - z * (691 / 180224 - z * (5461 / 425984))))
    return stepped * stepped * inverse, inverse * (1 / 8 - z * (1 / 192 - z * series))


@scalar_jit
def log_gamma_half_ratio(a):
    """Log Gamma(a + 1/2) - log Gamma(a) of a > 0, to rounding even if both are about 1e9."""
    r, t = gamma_half_ratio(a)
    return -0.5 * log(r) - t


@jit
def gamma_update_divergence(shape, rate, rate_increment):
    """Divergence KL[Gamma(shape + 1/2, rate + increment) || Gamma(shape, rate)] in nats.

    It is the divergence of a noise precision's belief by one sample. The formula is in increment/rate, since rate +
    increment loses most digits of the increment.
    """
    ratio = rate_increment / rate
    return (
        0.5 * digamma(shape + 0.5)
        - log_gamma_half_ratio(shape)
        + shape * log1p(ratio)
        - (shape + 0.5) * ratio / (1.0 + ratio)
    )


@jit
def expected_log_gamma(shape, rate):
    """E[log g] of g ~ Gamma(shape, rate)."""
    return digamma(shape) - math.log(rate)


_TWO_OVER_PI = 2 / math.pi
# π/2 in the three parts of fdlibm. The first two have 33 bits, so that their products with an integer of up to 20 bits
# are exact, with and without fused multiply-add.
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_ROUNDING_CONSTANT = 1.5 * 2.0**52


@scalar_jit
def _reduce_to_quarter_turn(x):
    """The nearest integer number of quarter turns in x, and the remainder of x, within ±π/4."""
    quarter = (x * _TWO_OVER_PI + _ROUNDING_CONSTANT) - _ROUNDING_CONSTANT
    return quarter, ((x - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]


@scalar_jit
def _sine_on_quarter(r):
    z = r * r
    p = -7.6471637318198164759e-13 + z * 2.8114572543455207632e-15
    p = 2.7557319223985890653e-6 + z * (-2.5052108385441718775e-8 + z * (1.6059043836821614599e-10 + z * p))
    p = -1 / 6 + z * (1 / 120 + z * (-1.9841269841269841270e-4 + z * p))
    return r + r * (z * p)


@scalar_jit
def _cosine_on_quarter(r):
    z = r * r
    p = 4.7794773323873852974e-14 - z * 1.5619206968586226462e-16
    p = 2.4801587301587301587e-5 + z * (
        -2.7557319223985890653e-7 + z * (2.0876756987868098979e-9 + z * (-1.1470745597729724714e-11 + z * p))
    )
    return 1.0 - 0.5 * z + z * z * (1 / 24 + z * (-1 / 720 + z * p))


@scalar_jit
def sin(x):
    """Sine, to 2 units in the last place of its largest value for |x| up to 1e5, without branches."""
    quarter, r = _reduce_to_quarter_turn(x)
    n = np.int64(quarter)
    value = _cosine_on_quarter(r) if (n & 1) == 1 else _sine_on_quarter(r)
    return -value if (n & 2) == 2 else value


@scalar_jit
def cos(x):
    """Cosine, as `sin`."""
    quarter, r = _reduce_to_quarter_turn(x)
    n = np.int64(quarter)
    value = _sine_on_quarter(r) if (n & 1) == 1 else _cosine_on_quarter(r)
    return -value if ((n + 1) & 2) == 2 else value


@scalar_jit
def exp(x):
    """Exponential to 2 units in the last place, without branches; below -700 its value there, and above 700 too."""
    bounded = min(max(x, -700.0), 700.0)
    k = (bounded * 1.4426950408889634 + _ROUNDING_CONSTANT) - _ROUNDING_CONSTANT
    r = (bounded - k * _LN2_HIGH) - k * _LN2_LOW
    p = 1 / 5040 + r * (1 / 40320 + r * (1 / 362880 + r * (1 / 3628800 + r * (1 / 39916800 + r * (1 / 479001600)))))
    p = 1.0 + r * (1.0 + r * (1 / 2 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * p))))))
    scale = (np.int64(k) + np.int64(1023)) << _N_MANTISSA_BITS
    value = p * np.int64(scale).view(np.float64)
    return value if x == x else x


@scalar_jit
def tanh(x):
    """Hyperbolic tangent to 4 units in the last place of 1, without branches."""
    e = exp(-2.0 * abs(x))
    value = (1.0 - e) / (1.0 + e)
    return value if x >= 0.0 else -value


_TAN_3_PI_8 = math.tan(3 * math.pi / 8)
_ATAN_P0 = -8.750608600031904122785e-1


@scalar_jit
def atan(x):
    """Arc tangent to 2 units in the last place, without branches, by the rational minimax approximation of Cephes."""
    a = abs(x)
    is_large, is_medium = a > _TAN_3_PI_8, a > 0.66
    numerator = -1.0 if is_large else (a - 1.0 if is_medium else a)
    denominator = a if is_large else (a + 1.0 if is_medium else 1.0)
    turn = math.pi / 2 if is_large else (math.pi / 4 if is_medium else 0.0)
    rest = 6.123233995736765886130e-17 if is_large else (3.061616997868382943065e-17 if is_medium else 0.0)
    r = numerator / denominator
    z = r * r
    p = -1.228866684490136173410e2 + z * (-7.500855792314704667340e1 + z * (-1.615753718733365076637e1 + z * _ATAN_P0))
    p = -6.485021904942025371773e1 + z * p
    q = 4.328810604912902668951e2 + z * (1.650270098316988542046e2 + z * (2.485846490142306297962e1 + z))
    q = 1.945506571482613964425e2 + z * (4.853903996359136964868e2 + z * q)
    value = turn + (r + (r * (z * p / q) + rest))
    return value if x >= 0.0 else -value


@scalar_jit
def sign(x):
    """-1, 0 or 1; NaN of NaN, without branches."""
    value = (1.0 if x > 0.0 else 0.0) - (1.0 if x < 0.0 else 0.0)
    return value if x == x else x
