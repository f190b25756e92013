"""Laws of the kernels that shade eight numbers at a time."""

from __future__ import annotations

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.lanes import LANES, mix8


@kernel
def _mixed(source, out):
    mix8(out, 1, 3, source, 0, 16, 8, np.float32(0.5), np.float32(0.25), np.float32(2.0))


def test_three_rows_are_mixed_and_dealt_out() -> None:
    """Element i + k stride of the target is the weighted sum of element k of three rows; the others stay."""
    source = np.random.default_rng(1).normal(size=(3, LANES)).astype(np.float32)
    out = np.full(3 * LANES, -7.0, np.float32)
    _mixed(source, out)
    np.testing.assert_allclose(out[1::3], 0.5 * source[0] + 0.25 * source[2] + 2.0 * source[1], rtol=1e-6)
    assert (out[0::3] == -7.0).all() and (out[2::3] == -7.0).all()
