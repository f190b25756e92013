"""Small solid bodies for tests: a held block on two bones with muscles, and two lips that touch but are not joined."""

from __future__ import annotations

from typing import Any

import numpy as np
from bodies import two_muscles

from faceanim.body.body import Body
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.tissue.material import Material

SKIN = Material("skin", 1e-6, 20.0, 0.25)


def held_slab(
    cells: tuple[int, int, int] = (8, 8, 3), *, force: float = 60.0, size: tuple[float, float, float] = (40.0, 40.0, 6.0),
    material: Any = SKIN, **changes: Any,
) -> Body:  # fmt: skip
    """Return a slab of flesh held at its sides by the cranium, above, and the jaw, below, with three muscles in its top."""
    mesh = box_tets(cells, size)
    mesh = TetMesh(mesh.points - np.array([0.5 * size[0], 0.5 * size[1], size[2]]), mesh.tets)
    x = mesh.points
    held = (np.abs(x[:, 0]) > 0.4999 * size[0]) | (np.abs(x[:, 1]) > 0.4999 * size[1])
    bone = np.where(x[:, 1] < -4.0, 1, 0)
    body = solid_body(mesh, material, held, bone=bone, bones=("cranium", "jaw"), **({"damping": 2000.0} | changes))
    surface = body.surface.points
    free = (surface[:, 2] > -1e-9) & ~body.pinned
    return Body(**{**body.__dict__, "muscles": two_muscles(surface, free, force)})


def lips(gap: float = 0.0, cells: int = 6) -> TetMesh:
    """Return a block 12 x 6 x 6 mm with a slit of height `gap` in the plane y = 3 for x > 4: two lips joined at a corner."""
    mesh = box_tets((2 * cells, cells, cells), (12.0, 6.0, 6.0))
    points, tets = mesh.points.copy(), mesh.tets.copy()
    on_slit = np.isclose(points[:, 1], 3.0) & (points[:, 0] > 4.0 + 1e-9)
    copy = np.full(len(points), -1)
    copy[on_slit] = len(points) + np.arange(on_slit.sum())
    points = np.concatenate([points, points[on_slit]])
    above = points[tets].mean(axis=1)[:, 1] > 3.0
    swap = above[:, None] & (copy[tets] >= 0)
    tets = np.where(swap, copy[tets], tets)
    upper = copy[copy >= 0]
    points[upper, 1] += 0.5 * gap
    points[np.flatnonzero(on_slit), 1] -= 0.5 * gap
    return TetMesh(points, tets)
