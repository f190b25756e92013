"""Cameras: where the eye stands, where it looks, and what fits in the picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from faceanim.ground.arrays import Floats, floats
from faceanim.ground.errors import UserError, unknown_name
from faceanim.kernels.raster import C_FOCAL, C_NEAR, C_POSITION, C_X, C_Y, N_CAMERA

VIEWS: dict[str, tuple[float, float]] = {
    "front": (0.0, 0.0),
    "three_quarter": (38.0, 4.0),
    "three_quarter_left": (38.0, 4.0),
    "three_quarter_right": (-38.0, 4.0),
    "side": (90.0, 0.0),
    "side_left": (90.0, 0.0),
    "side_right": (-90.0, 0.0),
    "back": (180.0, 0.0),
    "below": (0.0, -35.0),
    "above": (0.0, 35.0),
}
"""View name -> (turn towards the subject's left, lift) of the eye about the subject [degree]."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera in the head frame.

    position, target : (3,) [mm]   up : (3,)   fov : full angle of view over the picture's shorter side [degree]
    near : distance below which nothing is drawn [mm]
    """

    position: Floats
    target: Floats
    up: Floats
    fov: float = 18.0
    near: float = 5.0

    def __post_init__(self) -> None:
        for name in ("position", "target", "up"):
            object.__setattr__(self, name, floats(name, getattr(self, name), 3))
        if not 0.0 < self.fov < 170.0:
            raise UserError(f"fov is {self.fov} degrees; it must lie between 0 and 170")
        if not self.near > 0.0:
            raise UserError(f"near is {self.near} mm; it must be positive")
        if not np.linalg.norm(np.cross(self.up, self.target - self.position)) > 0.0:
            raise UserError("the camera looks along its own up direction, or its position is its target")

    @property
    def axes(self) -> Floats:
        """Rows: right, up, forward, (3, 3)."""
        forward = self.target - self.position
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.array([right, np.cross(right, forward), forward])

    def numbers(self, width: int, height: int) -> Floats:
        """Return the camera as the rasteriser wants it for a picture of that size [pixel]."""
        out = np.zeros(N_CAMERA)
        out[:9] = self.axes.ravel()
        out[C_POSITION : C_POSITION + 3] = self.position
        out[C_FOCAL] = 0.5 * min(width, height) / np.tan(np.radians(0.5 * self.fov))
        out[C_X], out[C_Y], out[C_NEAR] = 0.5 * width, 0.5 * height, self.near
        return out

    def project(self, points: Any, width: int, height: int) -> Floats:
        """Return the pixel position (from the top left corner) and depth [mm] of `points` (n, 3), as (n, 3)."""
        number = self.numbers(width, height)
        eye = (floats("points", points, None, 3) - self.position) @ self.axes.T
        scale = number[C_FOCAL] / eye[:, 2]
        return np.stack([number[C_X] + eye[:, 0] * scale, number[C_Y] - eye[:, 1] * scale, eye[:, 2]], axis=1)

    @classmethod
    def named(cls, view: str, bounds: Any, *, aspect: float = 1.0, margin: float = 0.04, fov: float = 18.0) -> Camera:
        """Return a camera of a named view (see `VIEWS`) that shows all of `bounds` as large as it can.

        bounds : (n, 3) points [mm] to keep in the picture; two points mean the box between them
        aspect : width over height of the picture   margin : empty border, as a part of the picture
        Raises `UserError` for an unknown view or fewer than two points.
        """
        if view not in VIEWS:
            raise unknown_name("view", view, VIEWS)
        points = floats("bounds", bounds, None, 3)
        if len(points) < 2:
            raise UserError("bounds holds fewer than two points; a camera needs something to frame")
        if len(points) == 2:
            corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
            points = np.where(corner == 0, points[0], points[1])
        turn, lift = np.radians(VIEWS[view])
        back = np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
        return cls._fitted(points, back, aspect, margin, fov)

    @classmethod
    def _fitted(cls, points: Floats, back: Floats, aspect: float, margin: float, fov: float) -> Camera:
        up = np.array([0.0, 1.0, 0.0])
        target = 0.5 * (points.min(axis=0) + points.max(axis=0))
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        half = (
            np.tan(np.radians(0.5 * fov)) * (1.0 - 2.0 * margin) * np.array([max(aspect, 1.0), max(1.0 / aspect, 1.0)])
        )
        distance = size / float(half.min())
        near = 1.0
        for _ in range(12):
            camera = cls(target + distance * back, target, up, fov, near)
            eye = (points - camera.position) @ camera.axes.T
            slope = eye[:, :2] / np.maximum(eye[:, 2:], 0.05 * distance)
            low, high = slope.min(axis=0), slope.max(axis=0)
            target = target + 0.5 * distance * (low + high) @ camera.axes[:2]
            # The nearest points move most: approach so that the widest ray fits.
            grow = float(np.max(0.5 * (high - low) / half))
            distance = max(distance * (0.5 + 0.5 * grow), 0.1 * size)
        return cls(target + distance * back, target, up, fov, max(0.02 * distance, 1e-3))

    @classmethod
    def front(cls, bounds: Any, **options: Any) -> Camera:
        """Return `named("front", bounds, ...)`."""
        return cls.named("front", bounds, **options)

    @classmethod
    def three_quarter(cls, bounds: Any, **options: Any) -> Camera:
        """Return `named("three_quarter", bounds, ...)`: the subject's left half turned to the eye."""
        return cls.named("three_quarter", bounds, **options)

    @classmethod
    def side(cls, bounds: Any, **options: Any) -> Camera:
        """Return `named("side", bounds, ...)`: seen from the subject's left."""
        return cls.named("side", bounds, **options)
