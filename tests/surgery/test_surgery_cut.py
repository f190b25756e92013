"""Cutting closed surfaces: both sides closed, volumes that add up, no walls left inside."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError
from faceanim.surgery import cut


def _mesh(made: trimesh.Trimesh) -> TriMesh:
    return TriMesh(made.vertices, made.faces.astype(np.int32))


BOX = _mesh(trimesh.creation.box(extents=(4.0, 6.0, 8.0)))
BALL = _mesh(trimesh.creation.icosphere(subdivisions=2, radius=5.0))
RING = _mesh(trimesh.creation.torus(major_radius=6.0, minor_radius=2.0, major_sections=24, minor_sections=12))
UP = np.array([0.0, 0.0, 1.0])


def _area(mesh: TriMesh) -> float:
    return float(mesh.areas.sum())


def test_measures_of_a_box() -> None:
    """Volume, centre and closedness are those of the box; without a triangle it is open."""
    assert cut.volume(BOX) == pytest.approx(192.0)
    np.testing.assert_allclose(
        cut.centroid(TriMesh(BOX.points + np.array([1.0, 2.0, 3.0]), BOX.triangles)), [1, 2, 3], atol=1e-12
    )
    assert cut.is_closed(BOX) and not cut.is_closed(TriMesh(BOX.points, BOX.triangles[1:]))


@settings(max_examples=60, deadline=None)
@given(
    shape=st.sampled_from(["box", "ball", "ring"]),
    normal=st.tuples(*[st.floats(-1.0, 1.0) for _ in range(3)]).filter(lambda n: np.linalg.norm(n) > 0.1),
    place=st.floats(-0.95, 0.95),
)
def test_halves_are_closed_and_add_up(shape: str, normal: tuple[float, float, float], place: float) -> None:
    """Whatever the plane: both sides closed, together the whole, each on its own side."""
    mesh = {"box": BOX, "ball": BALL, "ring": RING}[shape]
    unit = np.array(normal) / np.linalg.norm(normal)
    reach = float(np.abs(mesh.points @ unit).max())
    point = place * reach * unit
    parts = cut.halves(mesh, point, unit)
    assert all(cut.is_closed(part) for part in parts)
    assert sum(cut.volume(part) for part in parts) == pytest.approx(cut.volume(mesh), rel=1e-6)
    for part, sign in zip(parts, (1.0, -1.0), strict=True):
        assert cut.volume(part) >= 0.0
        assert (sign * ((part.points - point) @ unit) > -1e-7).all()


def test_a_cut_through_corners_and_edges() -> None:
    """Planes through the vertices of the mesh give sound halves."""
    for normal in np.eye(3):
        above, below = cut.halves(BALL, np.zeros(3), normal)
        assert cut.is_closed(above) and cut.is_closed(below)
        assert cut.volume(above) == pytest.approx(0.5 * cut.volume(BALL))
    above, below = cut.halves(BOX, np.array([0.0, 0.0, 4.0]), UP)
    assert cut.volume(above) == pytest.approx(0.0, abs=1e-9) and cut.volume(below) == pytest.approx(192.0)


def test_a_lid_with_a_hole() -> None:
    """A ring cut flat has a ring as its lid: area of the section, closed on both sides."""
    above, _ = cut.halves(RING, np.zeros(3), UP)
    flat = np.abs(above.points[above.triangles][:, :, 2]).max(axis=1) < 1e-9
    corner = [np.linalg.norm(RING.points[:, :2], axis=1).min(), np.linalg.norm(RING.points[:, :2], axis=1).max()]
    polygon = 0.5 * 24 * np.sin(2 * np.pi / 24)
    assert above.areas[flat].sum() == pytest.approx(polygon * (corner[1] ** 2 - corner[0] ** 2), rel=1e-9)
    assert (above.normals_by_area[flat][:, 2] < 0.0).all()


def test_the_rest_of_two_cuts_has_no_wall_inside() -> None:
    """An edge taken out of a box leaves an L: surface and volume are those of the L."""
    planes = [("plane 1", np.array([0.0, 1.0, 0.0]), np.eye(3)[1]), ("plane 2", np.array([0.0, 0.0, 1.0]), UP)]
    piece, rest = cut.cut_out(BOX, planes, "corner")
    assert cut.is_closed(piece) and cut.is_closed(rest)
    assert cut.volume(piece) == pytest.approx(4 * 2 * 3) and cut.volume(rest) == pytest.approx(192 - 24)
    assert _area(piece) == pytest.approx(2 * (4 * 2 + 4 * 3 + 2 * 3))
    assert _area(rest) == pytest.approx(_area(BOX) - 2 * 2 * 3)  # the box without what its two ends lose


def test_a_box_out_of_the_middle() -> None:
    """Six planes leave a cavity: the surface of the rest is both surfaces."""
    planes = [
        (f"side {k}", s * 1.0 * np.eye(3)[k], -s * np.eye(3)[k]) for k in range(3) for s in (1.0, -1.0)
    ]  # fmt: skip
    piece, rest = cut.cut_out(BOX, planes, "middle")
    assert cut.volume(piece) == pytest.approx(8.0) and cut.volume(rest) == pytest.approx(184.0)
    assert cut.is_closed(rest) and _area(rest) == pytest.approx(_area(BOX) + 24.0)


def test_only_the_largest_part() -> None:
    """What hangs apart goes back to the rest."""
    two = cut.joined([BOX, TriMesh(0.25 * BALL.points + [20.0, 0.0, 0.0], BALL.triangles)])
    planes = [("plane 1", np.zeros(3), UP)]
    every, _ = cut.cut_out(two, planes, "halves")
    piece, rest = cut.cut_out(two, planes, "half", largest=True)
    assert len(cut.parts(every)) == 2 and len(cut.parts(piece)) == 1
    assert cut.volume(piece) == pytest.approx(96.0)
    assert cut.volume(piece) + cut.volume(rest) == pytest.approx(cut.volume(two))


def test_cuts_that_miss_are_named() -> None:
    """An empty piece and a whole bone say which plane misses."""
    far = np.array([0.0, 0.0, 30.0])
    with pytest.raises(UserError, match=r"chin: plane 2 leaves nothing: .*26\.0 mm short"):
        cut.cut_out(BOX, [("plane 1", np.zeros(3), UP), ("plane 2", far, UP)], "chin")
    with pytest.raises(UserError, match="whole bone, since plane 1 cut nothing off"):
        cut.cut_out(BOX, [("plane 1", far, -UP)], "chin")
