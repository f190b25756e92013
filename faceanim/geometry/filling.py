"""A volume for any closed surface: the cubes that it fills, split into tetrahedra, and the surface as they carry it."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from faceanim.geometry import octree
from faceanim.geometry.embedding import Embedding, embed
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh


def filled(surface: TriMesh, side: float) -> tuple[TetMesh, Embedding]:
    """Return cubes of `side` [mm] that a closed surface fills, six tetrahedra each, and its vertices carried by them.

    The volume reaches up to a cube's width beyond the surface, or falls short of it where little of a cube is inside.
    Raises `UserError` for a surface that is open, inside out or crosses itself, for several parts, and for a side that
    is too large or too small.
    """
    cells = octree.from_surface(surface, side, 1).leaves
    tets = []
    for path in permutations((4, 2, 1)):  # corner 4 x + 2 y + z; each path along three axes is a tetrahedron
        corner = np.cumsum([0, *path])
        turn = np.linalg.det(octree.CORNERS[corner[1:]].astype(np.float64))
        tets.append(cells.corner[:, corner if turn > 0 else corner[[0, 2, 1, 3]]])
    mesh = TetMesh(cells.points, np.stack(tets, axis=1).reshape(-1, 4).astype(np.int32))
    return mesh, embed(mesh, surface.points)
