"""Powers and reciprocal roots: as accurate as the library's."""

import math

import numpy as np
import pytest

from faceanim.ground.jit import kernel
from faceanim.kernels.power import exp2, log2, power, rsqrt


@kernel
def each_power(x, y, out):
    for i in range(x.size):
        out[i] = power(x[i], y[i])


@kernel
def each_logarithm(x, out):
    for i in range(x.size):
        out[i] = log2(x[i])


@kernel
def each_exponential(x, out):
    for i in range(x.size):
        out[i] = exp2(x[i])


@kernel
def each_rsqrt(x, out):
    for i in range(x.size):
        out[i] = rsqrt(x[i])


def over(function, *arrays):
    out = np.empty(arrays[0].size)
    function(*arrays, out)
    return out


def test_power_agrees_with_the_library() -> None:
    """x^y is exact to 1e-14 relative for x from 1e-4 to 1e4 and |y| up to 5, and to 1e-13 out to 1e150."""
    noise = np.random.default_rng(2)
    x = 10.0 ** noise.uniform(-4, 4, 40001)
    y = noise.uniform(-5, 5, x.size)
    assert np.abs(over(each_power, x, y) / x**y - 1).max() < 1e-14
    x = 10.0 ** noise.uniform(-30, 30, 40001)
    assert np.abs(over(each_power, x, y) / x**y - 1).max() < 1e-13


@pytest.mark.parametrize("exponent", [0.0, 1.0, -1.0, 2.0, 0.5])
def test_power_of_one_and_simple_powers(exponent: float) -> None:
    """1^y = 1 exactly; x^0, x^1, x^-1, x^2, x^(1/2) to the last places."""
    x = np.concatenate([[1.0], np.linspace(0.5, 3.0, 777), np.nextafter(1.0, [0.0, 2.0])])
    result = over(each_power, x, np.full(x.size, exponent))
    assert result[0] == 1.0
    np.testing.assert_allclose(result, x**exponent, rtol=1e-15)


def test_logarithm_and_exponential() -> None:
    """log2 and 2^y agree with the library over the whole range of normal numbers; integers are exact."""
    x = 2.0 ** np.linspace(-1020, 1020, 20011)
    np.testing.assert_allclose(over(each_logarithm, x), np.log2(x), rtol=4e-16, atol=4e-16)
    near = 1.0 + np.linspace(-1e-3, 1e-3, 2001)
    expected = np.array([math.log1p(v - 1.0) for v in near]) / math.log(2.0)
    np.testing.assert_allclose(over(each_logarithm, near), expected, rtol=1e-15, atol=0)
    y = np.linspace(-999.9, 999.9, 20011)
    np.testing.assert_allclose(over(each_exponential, y), np.exp2(y), rtol=4e-16)
    whole = np.arange(-1000.0, 1001.0)
    assert (over(each_exponential, whole) == np.exp2(whole)).all()
    assert (over(each_exponential, np.array([2e3, -2e3])) == [2.0**1000, 2.0**-1000]).all()


def test_reciprocal_root() -> None:
    """1/sqrt(x) is exact to a few units in the last place, and a length of zero gives zero times it, not a NaN."""
    x = 10.0 ** np.random.default_rng(3).uniform(-280, 290, 40001)
    assert np.abs(over(each_rsqrt, x) * np.sqrt(x) - 1).max() < 8e-16
    x = np.linspace(1e-3, 1e3, 40001)
    assert np.abs(over(each_rsqrt, x) * np.sqrt(x) - 1).max() < 8e-16
    zero = over(each_rsqrt, np.zeros(9))
    assert np.isfinite(zero).all() and (0.0 * zero == 0.0).all()
