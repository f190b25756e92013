"""Laws of the shipped muscles: they spring from bone, bend inside the soft tissue and end in the skin."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from faceanim.face.attach import LID, LIP, NECK, SKIN
from faceanim.face.face import Face
from faceanim.face.library import load_face
from faceanim.face.muscles import LinearMuscle, SheetMuscle
from faceanim.geometry.distance_field import point_distance
from faceanim.geometry.surface import TriMesh

FASCIA = ("frontalis_inner", "frontalis_outer", "risorius")
"""Muscles that spring from no bone: from the galea, and from the fascia over parotid gland and masseter."""
ORBIT = ("levator_palpebrae",)
"""Behind the eyeball, not beneath the skin."""


@cache
def face() -> Face:
    return load_face()


@cache
def outer_skin() -> TriMesh:
    """The skin without the lining of the mouth and the lids."""
    f = face()
    keep = np.isin(f.region, (SKIN, LIP, LID, NECK))[f.mesh.triangles].all(axis=1)
    return TriMesh(f.mesh.points, f.mesh.triangles[keep])


def muscles() -> list:
    """Name and row of every muscle with an origin and an insertion."""
    table = face().muscle_table.items()
    return [pytest.param(n, m, id=n) for n, m in table if isinstance(m, LinearMuscle | SheetMuscle)]


def height_above_skin(point: np.ndarray) -> float:
    """Distance to the outer skin [mm], negative beneath it."""
    skin = outer_skin()
    used = np.unique(skin.triangles)
    nearest = used[np.argmin(np.linalg.norm(skin.points[used] - point, axis=1))]
    side = np.sign((point - skin.points[nearest]) @ skin.vertex_normals[nearest])
    return float(side * point_distance(point[None], skin)[0][0])


def depth_outside(bone: str, point: np.ndarray) -> float:
    """Signed distance to a bone [mm], positive outside."""
    skull = face().skull
    grid = skull.cranium_grid if bone == "cranium" else skull.jaw_grid
    return float(grid.sample(point[None])[0])


@pytest.mark.parametrize(("name", "muscle"), muscles())
def test_origins_lie_on_their_bone(name, muscle):
    """Every origin lies within 1 mm of the bone that carries it, unless it springs from fascia."""
    if name not in FASCIA:
        assert abs(depth_outside(muscle.bone, np.array(muscle.origin))) < 1.0


@pytest.mark.parametrize(("name", "muscle"), muscles())
def test_fibres_bend_inside_the_soft_tissue(name, muscle):
    """Every via lies outside both bones and, to 1 mm, not outside the skin."""
    if muscle.via is None:
        return
    via = np.array(muscle.via)
    assert depth_outside("cranium", via) > 0.0
    assert depth_outside("jaw", via) > 0.0
    if name not in ORBIT:
        assert height_above_skin(via) < 1.0


@pytest.mark.parametrize(("name", "muscle"), muscles())
def test_insertions_lie_in_the_skin(name, muscle):
    """Every insertion lies within 3 mm of the outer skin."""
    assert abs(height_above_skin(np.array(muscle.insertion))) < 3.0
