"""The shadow of the key light, drawn from the light's own place each frame."""

from __future__ import annotations

import numpy as np

from faceanim.ground.arrays import Bools, Floats
from faceanim.kernels.raster import PIECES, Mesh
from faceanim.kernels.shadow import STRIP, Caster, Depths, Shadow, spare_buffer
from faceanim.render.camera import Camera

SIZE = 192
"""Width and height of the map [pixel]."""


class ShadowMap:
    """The tables of a shadow thrown by the items `casts` (items,) of a mesh; draws nothing if there are none.

    points : (k, 3) [mm] of what throws it, at rest; the map covers a sphere around them with room for a sixth more
    count : number of vertices of the mesh
    """

    def __init__(self, mesh: Mesh, casts: Bools, points: Floats, count: int) -> None:
        size = SIZE if casts.any() else 2
        self._points = points
        depth, moment = np.zeros((PIECES, size, size), np.float32), np.zeros((size, size, 2), np.float32)
        triangle = np.ascontiguousarray(mesh.triangle[casts[mesh.item]])
        self.caster = Caster(triangle, casts, np.zeros((3, 4)), np.zeros((count, 4), np.float32), depth, 0.0)
        self.depths = Depths(depth, moment, spare_buffer(size), 0.0)
        self.shadow = Shadow(moment, np.zeros(12, np.float32), 0.0)
        self.strips = -(-size // STRIP)
        """Strips of rows of the map."""

    def moved(self, items: Bools) -> bool:
        """Whether any of these items (items,) throws a shadow."""
        return bool((items & self.caster.casts).any())

    def aim(self, camera: Camera, direction: Floats) -> None:
        """Let the light come from `direction` (3,), given in the camera's space."""
        if not self.caster.casts.any():
            return
        points, size = self._points, len(self.shadow.moment)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = 7.0 / 6.0 * float(np.linalg.norm(points - centre, axis=1).max())
        towards = camera.axes.T @ direction
        up = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
        scale = 0.5 * size / radius
        to_map = Camera(centre + towards, centre, up).axes * np.array([[scale], [-scale], [1.0]])
        shift = np.array([0.5 * size, 0.5 * size, 0.0]) - to_map @ centre
        self.caster.to_map[:] = np.column_stack([to_map, shift])
        self.shadow.to_light[:] = np.column_stack([to_map @ camera.axes.T, to_map @ camera.position + shift]).ravel()
        self.caster = self.caster._replace(far=2.0 * radius)
        self.depths = self.depths._replace(far=2.0 * radius)
        self.shadow = self.shadow._replace(bias=0.004 * radius)
