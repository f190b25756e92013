"""Laws of the built-in skull, the teeth and the jaw's motion."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.face.fit import outer_surface
from faceanim.face.library import asset_arrays, asset_text
from faceanim.face.skull import JawLaw, JawMotion, Skull, incisor_gap
from faceanim.geometry.distance_field import point_distance, signed_distance_grid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import AssetError, UserError

PARTS = ("teeth_upper", "teeth_lower", "gums_upper", "gums_lower", "tongue")


@pytest.fixture(scope="module")
def skull():
    """The built-in skull."""
    return Skull.from_arrays(asset_arrays("skull.npz"))


@pytest.fixture(scope="module")
def jaw():
    """The built-in jaw motion."""
    return JawMotion.from_assets(asset_arrays("skull.npz"), asset_text("jaw.toml"))


@pytest.fixture(scope="module")
def mouth():
    """The arrays of the mouth parts."""
    return asset_arrays("mouth.npz")


def mesh(mouth, name):
    """One part as a mesh."""
    return TriMesh(mouth[f"{name}_points"], mouth[f"{name}_triangles"])


def test_bones_are_mirror_symmetric(skull):
    """Every vertex has its mirror image, to the last bit; so do the distance grids."""
    for bone, grid in ((skull.cranium, skull.cranium_grid), (skull.jaw, skull.jaw_grid)):
        own = {tuple(p) for p in (bone.points + 0.0).tolist()}
        assert all((-x + 0.0, y, z) in own for x, y, z in own)
        assert np.array_equal(grid.values, grid.values[::-1])
        assert grid.origin[0] == -0.5 * (grid.values.shape[0] - 1) * grid.spacing


def test_bones_are_closed(skull):
    """Every directed edge of a bone has its opposite, so an inside exists."""
    for bone in (skull.cranium, skull.jaw):
        edge, count = np.unique(bone.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=0, return_counts=True)
        table = dict(zip(map(tuple, edge.tolist()), count.tolist(), strict=True))
        assert all(table.get((b, a)) == n for (a, b), n in table.items())
        assert np.einsum("ti,ti->", bone.points[bone.triangles[:, 0]], bone.normals_by_area) > 0.0


@pytest.mark.parametrize("density", ["coarse", "default"])
def test_everything_hard_lies_inside_the_skin(skull, mouth, density):
    """No vertex of bone or tooth is outside the closed outer skin; at least 2 mm of tissue lie over each."""
    face = asset_arrays(f"face_{density}.npz")
    skin = outer_surface(TriMesh(face["points"], face["triangles"]), face["region"])
    grid = signed_distance_grid([skin], spacing=3.0, margin=6.0, band=9.0)
    hard = np.vstack([skull.cranium.points, skull.jaw.points, mouth["teeth_upper_points"], mouth["teeth_lower_points"]])
    assert (grid.sample(hard) < 0.0).all()
    assert point_distance(hard, skin)[0].min() > 2.0


@pytest.mark.parametrize("density", ["coarse", "default", "fine"])
def test_rest_skin_is_clear_of_bone_and_teeth(skull, density):
    """At rest skin and lips, and the labial mucosa beside them, keep at least 0.5 mm from bone and teeth."""
    face = asset_arrays(f"face_{density}.npz")
    points, region = face["points"], face["region"]
    gap = np.minimum(skull.cranium_grid.sample(points), skull.jaw_grid.sample(points))
    assert gap[region <= 1].min() > 0.8
    lips = points[face["lip_upper"]]
    near = (region == 2) & (np.abs(points[:, 1] - lips[:, 1].min()) < 9.0) & (points[:, 2] > lips[:, 2].max() - 25.0)
    assert near.any()
    assert gap[near].min() > 0.5


@pytest.mark.parametrize("density", ["coarse", "default", "fine"])
def test_depths_in_the_face_files_are_distances_to_bone(skull, density):
    """The stored depths are the distances of the skin to this skull, mirror symmetric."""
    face = asset_arrays(f"face_{density}.npz")
    pick = np.arange(0, len(face["points"]), 41)
    cranium, jaw = skull.depth(np.ascontiguousarray(face["points"][pick]))
    assert np.abs(face["depth_cranium"][pick] - cranium).max() < 1e-3
    assert np.abs(face["depth_jaw"][pick] - jaw).max() < 1e-3
    assert np.array_equal(face["depth"], face["depth"][face["mirror"]])
    assert np.array_equal(face["depth"], np.minimum(face["depth_cranium"], face["depth_jaw"]))


def test_full_opening_is_natural(skull, jaw):
    """Full opening: 40-47 mm between the incisors, by 25-39 degrees and 12-20 mm of condylar slide."""
    assert 40.0 <= incisor_gap(skull, jaw.pose(1.0)) <= 47.0
    assert 25.0 <= jaw.law.max_opening_deg <= 39.0
    assert 12.0 <= np.linalg.norm(jaw.slide(1.0)) <= 20.0
    gaps = [incisor_gap(skull, jaw.pose(o)) for o in np.linspace(0.1, 1.0, 10)]
    assert (np.diff(gaps) > 0).all()


def test_the_jaw_turns_before_it_slides(jaw):
    """The first tenth of the opening is almost pure rotation, and the slide never runs back."""
    way = np.array([np.linalg.norm(jaw.slide(o)) for o in np.linspace(0.0, 1.0, 41)])
    assert way[0] == 0.0
    assert way[4] < 0.04 * way[-1]
    assert (np.diff(way) >= 0).all()


def test_poses_are_rigid_and_begin_at_rest(jaw):
    """Rest is the identity; every pose is a rotation with a translation."""
    assert np.array_equal(jaw.pose(0.0), np.eye(4))
    for controls in ((1.0, 0.0, 0.0), (0.4, -1.0, 0.3), (0.0, 1.0, 1.0)):
        turn = jaw.pose(*controls)[:3, :3]
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-14)
        assert np.isclose(np.linalg.det(turn), 1.0)


def test_lateral_is_mirrored_and_goes_to_the_subjects_left(skull, jaw):
    """Positive lateral carries the incisors to +x; the negative is its mirror image."""
    tip = np.append(skull.incisor_lower, 1.0)
    left, right = (jaw.pose(0.3, s, 0.2) @ tip for s in (1.0, -1.0))
    assert left[0] > 4.0
    assert np.allclose(left[:3] * [-1.0, 1.0, 1.0], right[:3], atol=1e-12)
    assert (jaw.pose(0.0, 0.0, 1.0) @ tip)[2] - tip[2] == pytest.approx(jaw.law.max_protrusion_mm)


def test_controls_outside_their_range_are_refused(jaw):
    """Opening and protrusion live in [0, 1], lateral in [-1, 1]."""
    for controls, name in (((1.1, 0, 0), "opening"), ((0, -2, 0), "lateral"), ((0, 0, float("nan")), "protrusion")):
        with pytest.raises(UserError, match=name):
            jaw.pose(*controls)


def test_broken_jaw_files_are_refused():
    """Unknown keys, missing keys and senseless values are named."""
    with pytest.raises(AssetError):
        JawMotion.from_assets(asset_arrays("skull.npz"), "max_opening_deg = 30.0\n")
    with pytest.raises(UserError, match="slide_onset"):
        JawLaw(30.0, 10.0, 8.0, 1.0, 6.0, 7.0, 1.0)
    with pytest.raises(AssetError, match="condyle"):
        JawMotion.from_assets({}, asset_text("jaw.toml"))


def test_skull_survives_writing_and_reading(skull):
    """Arrays written and read again give the same skull; grids to half precision."""
    again = Skull.from_arrays(skull.to_arrays())
    assert np.array_equal(again.cranium.points, skull.cranium.points)
    assert np.array_equal(again.jaw_grid.values, skull.jaw_grid.values)
    assert again.landmarks.keys() == skull.landmarks.keys()
    short = skull.to_arrays()
    del short["jaw_grid"]
    with pytest.raises(AssetError, match="jaw_grid"):
        Skull.from_arrays(short)


def test_grids_are_distances_to_bone_and_teeth(skull, mouth):
    """Near the surface the grid gives the distance to the nearer of bone and teeth, within half a cell."""
    rng = np.random.default_rng(0)
    for bone, grid, row in (
        (skull.cranium, skull.cranium_grid, "teeth_upper"),
        (skull.jaw, skull.jaw_grid, "teeth_lower"),
    ):
        pick = rng.integers(0, len(bone.points), 400)
        points = bone.points[pick] + 3.0 * bone.vertex_normals[pick]
        exact = np.minimum(point_distance(points, bone)[0], point_distance(points, mesh(mouth, row))[0])
        outside = grid.sample(points) > 0.9
        assert outside.sum() > 200
        assert np.abs(grid.sample(points)[outside] - exact[outside]).max() < 0.5 * grid.spacing


def test_mouth_parts_are_well_formed(mouth):
    """Colours for every vertex, the right bone, symmetric, and closed outward surfaces for teeth and tongue."""
    for name in PARTS:
        part = mesh(mouth, name)
        assert mouth[f"{name}_colour"].shape == (len(part.points), 3)
        assert int(mouth[f"{name}_bone"]) == (0 if name.endswith("upper") else 1)
        assert abs(part.points[:, 0].min() + part.points[:, 0].max()) < 1e-9
        part.reject_degenerate(1e-4)
    for name in ("teeth_upper", "teeth_lower", "tongue"):
        part = mesh(mouth, name)
        assert np.einsum("ti,ti->", part.points[part.triangles[:, 0]], part.normals_by_area) > 0.0
        edge = np.sort(part.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert (np.unique(edge, axis=0, return_counts=True)[1] == 2).all()


def test_the_bite_is_natural(skull, mouth):
    """Upper incisors overlap the lower ones by 1-4 mm in height and depth; the rows do not bite into each other."""
    overlap = skull.incisor_lower - skull.incisor_upper
    assert 1.0 < overlap[1] < 4.5
    assert 1.0 < -overlap[2] < 5.0
    grid = signed_distance_grid([mesh(mouth, "teeth_upper")], spacing=0.5, margin=2.0, band=2.0)
    depth = -grid.sample(mouth["teeth_lower_points"]).min()
    assert depth < 0.8
