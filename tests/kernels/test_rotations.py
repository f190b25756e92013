"""Rotation vectors: the rotation, the spin of a change, and the second derivative, below and above one radian."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faceanim.kernels.rotations import add_spin_curvature, turn

AXIS = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
ANGLES = pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.5, 0.99999, 1.00001, 2.5, 5.5])


def turned(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R and T."""
    R, T = np.empty((2, 3, 3))
    turn(theta, R, T)
    return R, T


@ANGLES
def test_rotation(angle: float) -> None:
    """R is what SciPy makes of the rotation vector."""
    np.testing.assert_allclose(turned(angle * AXIS)[0], Rotation.from_rotvec(angle * AXIS).as_matrix(), atol=1e-15)


@ANGLES
def test_spin(angle: float) -> None:
    """A small change of theta turns by T dtheta on top."""
    theta, d, h = angle * AXIS, np.array([0.3, 0.8, -0.5]), 1e-5
    before, after = turned(theta - h * d)[0], turned(theta + h * d)[0]
    spin = Rotation.from_matrix(after @ before.T).as_rotvec() / (2.0 * h)
    np.testing.assert_allclose(turned(theta)[1] @ d, spin, atol=1e-9)


@ANGLES
def test_spin_curvature(angle: float) -> None:
    """The symmetric part of d(T^T m)/dtheta by central differences, added to what is there."""
    theta, m, h = angle * AXIS, np.array([0.7, -0.2, 1.1]), 1e-5
    slope = np.stack(
        [(turned(theta + h * d)[1].T @ m - turned(theta - h * d)[1].T @ m) / (2.0 * h) for d in np.eye(3)], axis=1
    )
    out = np.ones((3, 3))
    add_spin_curvature(theta, *m, out)
    np.testing.assert_allclose(out - 1.0, 0.5 * (slope + slope.T), atol=1e-9)
