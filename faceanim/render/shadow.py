"""The shadow of the key light, drawn from the light's own place each frame."""

from __future__ import annotations

import numpy as np

from faceanim.ground.arrays import Bools, Floats
from faceanim.kernels import raster, shadow
from faceanim.render.camera import Camera

SIZE = 256
REACH = 3
_FARNESS = 10.0


def no_shadow() -> shadow.Shadow:
    """Return the shadow of a scene in which nothing throws one."""
    return shadow.Shadow(np.zeros((2, 2, 2), np.float32), np.zeros(16, np.float32), 0.0)


class ShadowMap:
    """Depth of some triangles of a mesh seen from the key light; owns its buffers.

    mesh : as the renderer's   casts : (t,) the triangles that throw shadows   points : (n, 3) [mm] at rest; the map
    covers a sphere around them with room for a sixth more
    """

    def __init__(self, mesh: raster.Mesh, casts: Bools, points: Floats, paint: raster.Paint) -> None:
        self._mesh = mesh._replace(
            triangle=np.ascontiguousarray(mesh.triangle[casts]),
            item=np.ascontiguousarray(mesh.item[casts]),
            uv=np.ascontiguousarray(mesh.uv[casts]),
        )
        material = paint.material.copy()
        material[:, raster.M_SIDED] = 0.0  # back sides lie behind fronts
        self._paint = paint._replace(material=material)
        self._frame = raster.buffers(len(points), len(self._mesh.triangle), SIZE, SIZE, -(-SIZE // raster.BAND))
        self._moved = np.ones(len(paint.material), np.bool_)
        self._order = np.arange(len(self._frame.row_start) - 1, dtype=np.int32)[::-1].copy()
        used = points[np.unique(self._mesh.triangle)]
        self._centre = 0.5 * (used.min(axis=0) + used.max(axis=0))
        self._radius = 7.0 / 6.0 * float(np.linalg.norm(used - self._centre, axis=1).max())
        self._moment = np.zeros((SIZE, SIZE, 2), np.float32)
        self._spare = np.zeros((SIZE, SIZE, 2), np.float32)

    def draw(self, points: Floats, camera: Camera, direction: Floats) -> shadow.Shadow:
        """Draw the map for `points` (n, 3) and a light from `direction` (3,), given in the camera's space."""
        axes, distance = camera.axes, _FARNESS * self._radius
        towards = axes.T @ direction
        up = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
        fov = 2.0 * float(np.degrees(np.arctan(1.0 / (_FARNESS - 1.0))))
        eye = Camera(self._centre + distance * towards, self._centre, up, fov, distance - 2.0 * self._radius)
        number = eye.numbers(SIZE, SIZE)
        frame, mesh = self._frame, self._mesh
        shadow.light_view_pass(points, number, frame.eye, frame.screen)
        raster.setup_pass(self._moved, mesh, number, 0.0, frame, self._paint)
        if raster.band_pass(frame) > len(frame.row_list):
            frame = self._frame = raster.longer_list(frame)
            raster.band_pass(frame)
        raster.coverage_pass(self._order, False, mesh, number, frame)
        far = 2.0 * self._radius
        shadow.moment_pass(number, distance, far, REACH, frame.sample, self._moment, self._spare)
        to_light = np.zeros(16, np.float32)
        to_light[:9] = (eye.axes @ axes.T).ravel()
        to_light[9:12] = eye.axes @ (camera.position - eye.position)
        to_light[12], to_light[13], to_light[15] = number[raster.C_FOCAL], number[raster.C_X], distance
        return shadow.Shadow(self._moment, to_light, 0.004 * self._radius)
