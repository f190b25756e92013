"""The shadow of the key light, drawn from the light's own place each frame."""

from __future__ import annotations

import numpy as np

from faceanim.ground.arrays import Bools, Floats
from faceanim.kernels import raster
from faceanim.kernels.shadow import STRIP, Shadow, spare_buffer
from faceanim.render.camera import Camera

SIZE = 192
"""Width and height of the map [pixel]."""


def shadow_tables(mesh: raster.Mesh, casts: Bools) -> Shadow:
    """Return the tables of a shadow thrown by the items `casts` (items,) of the mesh; none at all without any."""
    size = SIZE if casts.any() else 2
    return Shadow(
        triangle=np.ascontiguousarray(mesh.triangle[casts[mesh.item]]),
        casts=np.ascontiguousarray(casts),
        to_map=np.zeros((3, 4)),
        spot=np.zeros((len(mesh.origin), 4), np.float32),
        depth=np.zeros((raster.PIECES, size, size), np.float32),
        moment=np.zeros((size, size, 2), np.float32),
        spare=spare_buffer(size),
        to_light=np.zeros(12, np.float32),
        far=0.0,
        bias=0.0,
    )


def strips(shadow: Shadow) -> int:
    """Return the number of strips of rows of the map."""
    return -(-len(shadow.moment) // STRIP)


def aim(shadow: Shadow, points: Floats, camera: Camera, direction: Floats) -> Shadow:
    """Return the shadow of light from `direction` (3,), given in the camera's space.

    points : (n, 3) [mm] of what throws it, at rest; the map covers a sphere around them with room for a sixth more
    """
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = 7.0 / 6.0 * float(np.linalg.norm(points - centre, axis=1).max())
    towards = camera.axes.T @ direction
    up = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    size = len(shadow.moment)
    to_map = Camera(centre + towards, centre, up).axes * np.array(
        [[0.5 * size / radius], [-0.5 * size / radius], [1.0]]
    )
    shift = np.array([0.5 * size, 0.5 * size, 0.0]) - to_map @ centre
    shadow.to_map[:] = np.column_stack([to_map, shift])
    from_eye = np.column_stack([to_map @ camera.axes.T, to_map @ camera.position + shift])
    shadow.to_light[:] = from_eye.ravel()
    return shadow._replace(far=2.0 * radius, bias=0.004 * radius)
