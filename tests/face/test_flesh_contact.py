"""A whole head: its flesh against its bones and lip on lip."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.elements.contact import BonePenalty, follow, near_bones, settle
from faceanim.elements.sheet_contact import SheetPenalty, coupled
from faceanim.elements.tetrahedra import Elements
from faceanim.face.face import Face
from faceanim.geometry.bone_field import BoneField, bone_field


@pytest.fixture(scope="module")
def head() -> Face:
    """The default head, coarse."""
    return Face.from_assets("default", "coarse")


@pytest.fixture(scope="module")
def bones(head: Face) -> list[BoneField]:
    """Cranium and jaw."""
    return [bone_field(bone, spacing=1.5) for bone in (head.skull.cranium, head.skull.jaw)]


def test_the_skull_can_be_measured(head: Face, bones: list[BoneField]) -> None:
    """Both bones are closed; folds of their surfaces are mended; landmarks on the bone have a depth of nearly zero."""
    for k, bone in enumerate(bones):
        names = [name for name, which in head.skull.landmark_bone.items() if which == k]
        points = np.array([head.skull.landmarks[name] for name in names])
        assert np.abs(np.median(bone.exact(points))) < 1.0
        nodes = bone.mesh.points[::501]
        assert np.abs(bone.exact(nodes) - bone.table.depth[::501]).max() < 1e-9
        assert 0 < bone.mended < 0.05 * len(bone.table.depth)


@pytest.mark.slow
def test_bones_push_flesh_that_does_not_grow_on_them(head: Face, bones: list[BoneField]) -> None:
    """Flesh let go from the front of the jaw is pushed by it, 2 mm forward, and no node is 0.05 mm in it."""
    body = head.body()
    solid = body.solid
    assert solid is not None
    mesh = solid.mesh
    near = np.abs(bones[1].exact(mesh.points)) < 6.0
    loose = (solid.bone_weight[:, 1] > 0.5) & near & (mesh.points[:, 2] > 60.0)
    loose &= np.isin(np.arange(len(loose)), mesh.boundary_nodes)
    held = solid.held & ~loose
    young = np.array([m.young_modulus for m in solid.materials])[solid.region]
    elements = Elements(mesh, solid.materials, solid.region)
    contact = BonePenalty(elements, near_bones(mesh, held, bones, reach=8.0, young=young), bones)
    assert contact.energy(elements.points) == 0.0
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 2, 3] = 2.0

    def carried(pose: np.ndarray) -> np.ndarray:
        way = np.einsum("nb,bij,nj->ni", solid.bone_weight, pose[:, :3, :3], elements.points)
        return way + solid.bone_weight @ pose[:, :3, 3]

    done = follow(elements, contact, poses, fixed=held, carried=carried, tolerance=1e-6)
    assert done.reports[-1].valid
    assert 3 < done.touches[-1].active and done.touches[-1].deepest < 0.05


@pytest.mark.slow
def test_lips_and_lids_keep_their_gap(head: Face) -> None:
    """With the jaw 2 mm forward lips touch but do not pass through each other, and rest is at rest."""
    body = head.body()
    solid = body.solid
    assert solid is not None
    pairs = coupled(body.surface, body.pairs, solid.skin, 6.0)
    elements = Elements(solid.mesh, solid.materials, solid.region, coupled=pairs)
    lips = SheetPenalty(elements, body.surface, solid.skin, body.pairs, 300.0)
    assert lips.energy(elements.points) == 0.0
    values = elements.points + solid.bone_weight[:, 1:] * np.array([0.0, 0.0, 2.0])
    x, report = settle(elements, (lips,), fixed=solid.held, values=values, tolerance=1e-6)
    assert report.converged and report.valid
    assert lips.report(x).through < 1e-9
    assert lips.report(x).deepest < 0.1
