"""Poses of bones as twists: rotation vector w and velocity v whose screw motion, run for a unit of time, is the pose.

Rotation exp([w]x), translation Rt(w) v, with the same mean rotation Rt that warps the modes.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError

FARTHEST = 1.9 * np.pi
"""Rotation at which Rt is so nearly singular that nothing is solved with it any more [rad]."""


def skew(w: Floats) -> Floats:
    """Return [w]x, (..., 3, 3), with [w]x v = w x v."""
    out = np.zeros((*np.shape(w), 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    return np.asarray(out - out.swapaxes(-1, -2))


def rotation(w: Floats) -> Floats:
    """Return exp([w]x), (..., 3, 3)."""
    a, _, sine = coefficients(w)
    s = skew(w)
    return np.asarray(np.eye(3) + sine * s + a * (s @ s))


def mean_rotation(w: Floats) -> Floats:
    """Return Rt(w), the mean of exp(t [w]x) over t in 0..1, (..., 3, 3) (App. II)."""
    a, b, _ = coefficients(w)
    s = skew(w)
    return np.asarray(np.eye(3) + a * s + b * (s @ s))


def coefficients(w: Floats) -> tuple[Floats, Floats, Floats]:
    """Return A, B and S = sin(th) / th of rotation vectors (..., 3), each (..., 1, 1); see `kernels.warp`."""
    square = (np.asarray(w) ** 2).sum(axis=-1)[..., None, None]
    near = square < 1e-4
    safe = np.where(near, 1.0, square)
    th = np.sqrt(safe)
    a = np.where(near, 0.5 - square / 24.0 + square**2 / 720.0, 2.0 * np.sin(0.5 * th) ** 2 / safe)
    b = np.where(near, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0, (1.0 - np.sin(th) / th) / safe)
    return a, b, 1.0 - square * b


def mean_rotation_slope(w: Floats, u: Floats) -> Floats:
    """Return the derivative of Rt(w) u by w for `w`, `u` (k, 3), (k, 3, 3)."""
    square = (w**2).sum(axis=-1)[:, None, None]
    a, b, sine = coefficients(w)
    near = square < 1e-2
    safe = np.where(near, 1.0, square)
    cosine = np.cos(np.sqrt(safe))
    da = np.where(near, -1.0 / 24.0 + square / 360.0 - square**2 / 13440.0, 0.5 * (sine - 2.0 * a) / safe)
    db = np.where(
        near, -1.0 / 120.0 + square / 2520.0 - square**2 / 120960.0, 0.5 * ((sine - cosine) / safe - 2.0 * b) / safe
    )
    once, twice = np.cross(w, u), np.cross(w, np.cross(w, u))
    along = 2.0 * (da[:, 0] * once + db[:, 0] * twice)
    inner = np.einsum("ki,ki->k", w, u)[:, None, None] * np.eye(3)
    turning = np.einsum("ki,kj->kij", w, u) - 2.0 * np.einsum("ki,kj->kij", u, w) + inner
    return np.asarray(np.einsum("ki,kj->kij", along, w) - a * skew(u) + b * turning)


def twist_of(pose: Floats, bone: int, near: Floats) -> Floats:
    """Return the twist (6,), rotation vector [rad] and velocity [mm], of `pose` (4, 4), on the branch nearest `near`.

    Raises `UserError` if the pose is no rotation and translation.
    """
    r = pose[:3, :3]
    if (
        np.abs(r @ r.T - np.eye(3)).max() > 1e-6
        or np.linalg.det(r) < 0.0
        or np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-9
    ):
        raise UserError(f"control: bone_pose {bone} is not rigid; a rotation and a translation are needed")
    w = Rotation.from_matrix(r).as_rotvec()
    angle = float(np.linalg.norm(w))
    if angle > 1e-9:
        axis = w / angle
        turns = round((float(axis @ near[:3]) - angle) / (2.0 * np.pi))
        unwrapped = angle + 2.0 * np.pi * turns
        w = w if abs(unwrapped) > FARTHEST else unwrapped * axis
    return np.concatenate([w, np.linalg.solve(mean_rotation(w), pose[:3, 3])])
