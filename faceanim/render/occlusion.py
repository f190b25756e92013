"""Ambient occlusion of a surface at rest: which part of the sky above each vertex is not hidden by the surface itself.

Measured with the rasteriser: from many directions the surface is drawn as seen from afar, and a vertex is lit from
there if nothing lies before it. The result is smoothed over the surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.ground.arrays import Floats, Ints, floats, ints
from faceanim.render.camera import Camera
from faceanim.render.renderer import DrawItem, Renderer
from faceanim.render.shading import Material


def _directions(count: int) -> Floats:
    """Evenly spread unit vectors, mirror symmetric in x, (count, 3), count even."""
    half = count // 2
    i = np.arange(half) + 0.5
    z = 1.0 - i / half * 2.0
    turn = np.pi * (1.0 + 5.0**0.5) * i
    r = np.sqrt(1.0 - z * z)
    one = np.stack([np.abs(r * np.cos(turn)), z, r * np.sin(turn)], axis=1)
    return np.concatenate([one, one * (-1.0, 1.0, 1.0)])


def _smoothed(values: Floats, triangles: Ints, rounds: int) -> Floats:
    n = len(values)
    a, b = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    degree = np.maximum(np.bincount(a, minlength=n) + np.bincount(b, minlength=n), 1)
    for _ in range(rounds):
        mean = (np.bincount(a, values[b], n) + np.bincount(b, values[a], n)) / degree
        values = 0.5 * (values + mean)
    return values


def vertex_openness(points: Any, triangles: Any, *, directions: int = 96, size: int = 256, bias: float = 1.0) -> Floats:
    """Return how open to the sky each vertex is, (n,) in [0, 1]: 1 where nothing but its own half space hides the sky.

    points : (n, 3) [mm]   triangles : (t, 3)   bias : a vertex counts as seen if nothing lies farther before it [mm]
    The light is weighted by the cosine to the vertex normal.
    """
    p = floats("points", points, None, 3)
    t = ints("triangles", triangles, None, 3, below=len(p))
    a, b, c = (p[t[:, k]] for k in range(3))
    normal = np.zeros_like(p)
    np.add.at(normal, t.ravel(), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    centre, reach = 0.5 * (p.min(axis=0) + p.max(axis=0)), float(np.linalg.norm(np.ptp(p, axis=0)))
    item = DrawItem(p, t, Material(two_sided=True))
    lit, total = np.zeros(len(p)), np.zeros(len(p))
    renderer: Renderer | None = None
    for d in _directions(directions):
        up = np.array([0.0, 1.0, 0.0]) if abs(d[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
        camera = Camera(centre + 8.0 * reach * d, centre, up, fov=7.4, near=4.0 * reach)
        if renderer is None:
            renderer = Renderer(size, camera, [item])
        renderer.camera = camera
        depth = renderer.depth()
        spot = camera.project(p, size, size)
        x = np.clip(spot[:, 0].astype(np.int64), 0, size - 1)
        y = np.clip(spot[:, 1].astype(np.int64), 0, size - 1)
        weight = np.maximum(normal @ d, 0.0)
        rise = spot[:, 2][:, None] - depth[y, x]
        lit += weight * np.mean(np.clip(1.0 - (rise - bias) / bias, 0.0, 1.0), axis=1)
        total += weight
    return _smoothed(np.clip(lit / np.maximum(total, 1e-9), 0.0, 1.0), t, 2)
