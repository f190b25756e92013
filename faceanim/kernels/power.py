"""Powers and reciprocal square roots that the compiler can vectorise: polynomials and integer arithmetic, no library.

The mathematics library's `pow` works on one number at a time and costs four to six times as much in a vector loop.
"""

from __future__ import annotations

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import bits, from_bits

_SQRT_HALF = np.int64(0x3FE6A09E667F3BCD)  # bits of sqrt(1/2): mantissas are taken from [sqrt(1/2), sqrt(2))
_MANTISSA = np.int64(52)
_BIAS = np.int64(1023)
_SHIFTER = 6755399441055744.0  # 1.5 * 2^52: adding it leaves an integer in the low bits of the sum
_SHIFTER_BITS = np.int64(0x4338000000000000)
_LN2 = 0.693147180559945309
_TWO_OVER_LN2 = 2.885390081777926815
_RSQRT_MAGIC = np.int64(0x5FE6EB50C7B537A9)
_ONE = np.int64(1)


@kernel(inline=True)
def log2(x):
    """Return log2(x), x a positive normal float64; absolute error below 4e-16 * max(1, |log2 x|).

    x = 2^e m with m in [sqrt(1/2), sqrt(2)); log m = 2 artanh(s), s = (m - 1) / (m + 1), |s| < 0.172.
    """
    whole = bits(x)
    exponent = (whole - _SQRT_HALF) >> _MANTISSA
    m = from_bits(whole - (exponent << _MANTISSA))
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 1 / 15 + z * (1 / 17)
    p = 1 / 9 + z * (1 / 11 + z * (1 / 13 + z * p))
    p = 1 / 3 + z * (1 / 5 + z * (1 / 7 + z * p))
    return (from_bits(exponent + _SHIFTER_BITS) - _SHIFTER) + s * (_TWO_OVER_LN2 + (_TWO_OVER_LN2 * z) * p)


@kernel(inline=True)
def exp2(y):
    """Return 2^y for |y| <= 1000; relative error below 4e-16. Larger |y| is clipped to that range."""
    y = y if y < 1000.0 else 1000.0
    y = y if y > -1000.0 else -1000.0
    n = np.floor(y + 0.5)
    f = (y - n) * _LN2
    p = 1 / 39916800 + f * (1 / 479001600)
    p = 1 / 40320 + f * (1 / 362880 + f * (1 / 3628800 + f * p))
    p = 1 / 120 + f * (1 / 720 + f * (1 / 5040 + f * p))
    p = 1.0 + f * (1.0 + f * (1 / 2 + f * (1 / 6 + f * (1 / 24 + f * p))))
    scale = bits(n + _SHIFTER) - _SHIFTER_BITS
    return p * from_bits((scale + _BIAS) << _MANTISSA)


@kernel(inline=True)
def power(x, y):
    """Return x^y, x a positive normal float64, |y log2 x| <= 1000; relative error below 1e-14 for |y log2 x| < 30.

    The error grows with the size of the exponent of the result, as 1.1e-16 * |y log2 x|.
    """
    return exp2(y * log2(x))


@kernel(inline=True)
def rsqrt(x):
    """Return 1/sqrt(x) to 3 units in the last place; finite (1e150) for 0 <= x <= 1e-300.

    Halving the exponent bits gives 1/sqrt(x) to 3.4 %; each correction is the binomial series of (1 - r)^(-1/2) to
    r^3, with r = 1 - x y^2, and takes the error to its fourth power. So length = x * rsqrt(x) is 0 at x = 0, and a
    unit vector of a zero vector is zero, not a NaN.
    """
    x = x if x > 1e-300 else 1e-300
    y = from_bits(_RSQRT_MAGIC - (bits(x) >> _ONE))
    r = 1.0 - x * y * y
    y = y + y * (r * (0.5 + r * (0.375 + r * 0.3125)))
    r = 1.0 - x * y * y
    return y + y * (r * (0.5 + r * (0.375 + r * 0.3125)))
