"""Flesh near rigid bones and flesh on flesh, for tests of contact."""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.elements.contact import BonePenalty, near_bones
from faceanim.elements.sheet_contact import NamedSheets, SheetPenalty, coupled, opposed
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.bone_field import BoneField, bone_field
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.shapes import box_tets, sphere
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.tissue.material import Material

YOUNG = 15.0


def ball_below(mesh: TetMesh, radius: float = 20.0, gap: float = 0.05) -> BoneField:
    """Return a sphere that ends `gap` below the middle of the slab `mesh`."""
    middle = 0.5 * (mesh.points.min(axis=0) + mesh.points.max(axis=0))
    surface = sphere(radius, 4)
    at = np.array([middle[0], middle[1], mesh.points[:, 2].min() - radius - gap])
    return bone_field(TriMesh(surface.points + at, surface.triangles), spacing=1.0)


def block_bone(low: Any, high: Any, spacing: float = 1.0) -> BoneField:
    """Return a box from `low` (3,) to `high` (3,)."""
    size = np.subtract(high, low)
    box = box_tets((2, 2, 2), tuple(size))
    return bone_field(TriMesh(box.points + np.asarray(low), box.boundary_triangles), spacing=spacing)


def slab(cells: tuple[int, int, int] = (10, 10, 3), size: Any = (40.0, 40.0, 12.0), **changes: Any) -> Elements:
    """Return a slab of soft flesh."""
    poisson = changes.pop("poisson", 0.45)
    return Elements(box_tets(cells, size), Material("flesh", 1e-6, YOUNG, poisson), **changes)


def sides(elements: Elements) -> np.ndarray:
    """Return which nodes are on the sides that do not face up or down."""
    at = elements.points[:, :2]
    return np.asarray(((at < at.min(axis=0) + 1e-9) | (at > at.max(axis=0) - 1e-9)).any(axis=1))


def penalty(
    elements: Elements, held: np.ndarray, bones: list[BoneField], factor: float = 50.0, **options: Any
) -> BonePenalty:
    """Return the contact of the lower face of `elements` with `bones`."""
    floor = np.flatnonzero(elements.points[:, 2] < elements.points[:, 2].min() + 1e-9)
    faces = elements.face_nodes(elements.mesh.boundary_triangles)
    touch = near_bones(
        elements.mesh, held, bones, reach=30.0, young=YOUNG, factor=factor, among=floor, faces=faces,
        points=elements.points,
    )  # fmt: skip
    return BonePenalty(elements, touch, bones, **options)


def up(way: float) -> np.ndarray:
    """Return the poses of one bone moved up by `way` [mm]."""
    pose = np.eye(4)
    pose[2, 3] = way
    return pose[None]


def two_slabs(
    one: int, other: int, poisson: float = 0.3, gap: float = 0.3
) -> tuple[TetMesh, TriMesh, Embedding, NamedSheets]:
    """Return slabs of 10 x 10 x 5 mm above each other, their surface, how it is carried, and the sheets that face."""
    below, above = box_tets((one, one, 2), (10.0, 10.0, 5.0)), box_tets((other, other, 2), (10.0, 10.0, 5.0))
    lifted = above.points + np.array([0.0, 0.0, 5.0 + gap])
    points = np.concatenate([below.points, lifted])
    mesh = TetMesh(points, np.concatenate([below.tets, above.tets + len(below.points)]))
    z = mesh.points[mesh.boundary_nodes, 2]
    lower, upper = (np.flatnonzero(np.abs(z - level) < 1e-9).astype(np.int32) for level in (5.0, 5.0 + gap))
    skin = Embedding.of_nodes(mesh.boundary_nodes)
    return mesh, mesh.boundary, skin, opposed(mesh.boundary, lower, upper, gap=0.1)


def pressed_slabs(one: int, other: int, poisson: float = 0.3, room: bool = True) -> tuple[Elements, SheetPenalty]:
    """Return the two slabs as elements and the contact between them; `room` for its couplings in the tangent."""
    mesh, surface, skin, pair = two_slabs(one, other, poisson)
    pairs = coupled(surface, [pair], skin) if room else None
    elements = Elements(mesh, Material("flesh", 1e-6, YOUNG, poisson), coupled=pairs)
    return elements, SheetPenalty(elements, surface, skin, [pair], 50.0 * YOUNG / 2.5)
