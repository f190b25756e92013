"""The depth below a bone's surface: exact on planes, second order on curves, right about sides, refusing what it must."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faceanim.geometry.bone_field import (
    DIAGONAL,
    REACH,
    BoneField,
    bone_field,
    prism_boxes,
    pseudo_normals,
    reject_open,
    rigid_pose,
)
from faceanim.geometry.embedding import barycentric
from faceanim.geometry.shapes import box_tets, sphere
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError

RADIUS = 20.0


def wall() -> TriMesh:
    """Return a box whose top is the plane z = 5."""
    return TriMesh(
        box_tets((2, 2, 2), (24.0, 24.0, 12.0)).points - [12.0, 12.0, 7.0],
        box_tets((2, 2, 2), (1, 1, 1)).boundary_triangles,
    )


@pytest.fixture(scope="module")
def ball() -> BoneField:
    """A sphere of radius 20."""
    return bone_field(sphere(RADIUS, 5), spacing=1.0)


def shells(deepest: float, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Return random points at most `deepest` inside the sphere, and their distances to its centre."""
    rng = np.random.default_rng(1)
    ray = rng.normal(size=(count, 3))
    r = rng.uniform(RADIUS - deepest, RADIUS - 1e-3, count)
    return ray / np.linalg.norm(ray, axis=1)[:, None] * r[:, None], r


@pytest.mark.parametrize("reading", ["linear", "mean", "spline", "nearest"])
def test_depth_below_a_plane_is_exact(reading: str) -> None:
    """Any reading of distances that are linear is linear: d = 5 - z to 1e-12, its gradient -z."""
    field = bone_field(wall(), spacing=0.9, step=2.0)
    points = np.random.default_rng(0).uniform([-6.0, -6.0, 3.0], [6.0, 6.0, 5.3], size=(500, 3))
    got = field.sample(points, reading=reading)
    assert np.abs(got.depth - (5.0 - points[:, 2])).max() < 1e-12
    clear = np.abs(points[:, 2] - 5.0) > 1e-2
    assert np.abs(got.inward - [0.0, 0.0, -1.0])[clear].max() < 1e-11


def test_linear_reading_keeps_the_interpolation_bound(ball: BoneField) -> None:
    """The error of eq 7 on a sphere is at most edge^2 / (8 r), beside how far the triangles are off the sphere."""
    points, r = shells(3.0)
    longest = max(
        np.linalg.norm(np.diff(ball.surface.points[ball.surface.triangles[:, [0, k]]], axis=1), axis=2).max()
        for k in (1, 2)
    )
    sagitta = longest**2 / 8.0 / RADIUS
    error = np.abs(ball.sample(points, reading="linear").depth - (RADIUS - r))
    bound = (DIAGONAL * ball.spacing) ** 2 / (8.0 * (r - DIAGONAL))
    assert (error <= bound + sagitta).all()
    assert error.max() > 0.3 * bound.min()


@pytest.mark.slow
def test_error_falls_with_the_spacing() -> None:
    """Halving the lattice divides the error of eq 7 by 4; the spline's is a tenth of it."""
    points, r = shells(2.0)
    error = {}
    for spacing in (4.0, 2.0):
        field = bone_field(sphere(RADIUS, 6), spacing=spacing, step=2.5)
        for reading in ("linear", "spline"):
            error[reading, spacing] = np.abs(field.sample(points, reading=reading).depth - (RADIUS - r)).max()
    assert 1.8 < np.log2(error["linear", 4.0] / error["linear", 2.0]) < 2.3
    assert error["spline", 4.0] < 0.1 * error["linear", 4.0]
    assert error["spline", 2.0] < 0.1 * error["linear", 2.0]


def test_nearest_reading_is_exact() -> None:
    """From the triangles kept with the nodes the nearest of all is found, whichever it is."""
    field = bone_field(sphere(RADIUS, 3), spacing=1.0)
    points, _ = shells(3.0)
    got = field.sample(points, reading="nearest")
    assert np.abs(got.depth - field.exact(points)).max() < 1e-12
    on = points - got.depth[:, None] * got.inward
    assert np.abs(field.exact(on)).max() < 1e-9


def test_gradients_point_to_the_centre(ball: BoneField) -> None:
    """Inward is towards the centre: within h / r for eq 9, far nearer for the nodes' means and the spline."""
    points, r = shells(3.0)
    true = -points / r[:, None]
    for reading, most in (("linear", 0.07), ("mean", 0.006), ("spline", 0.008)):
        got = ball.sample(points, reading=reading).inward
        assert np.abs(got - true).max() < most, reading


def test_spline_gradient_is_the_derivative_of_its_depth(ball: BoneField) -> None:
    """Central differences of the spline's depth agree everywhere, also where lattice cells meet."""
    points, _ = shells(3.0, 300)
    points[:100] = np.round(points[:100] * 2.0) / 2.0
    points = points[np.linalg.norm(points, axis=1) < RADIUS - 0.05]
    got = ball.sample(points)
    for d in range(3):
        step = np.zeros(3)
        step[d] = 1e-6
        slope = (ball.sample(points + step).depth - ball.sample(points - step).depth) / 2e-6
        assert np.abs(slope - got.inward[:, d]).max() < 1e-6


def test_equation_nine_in_every_tetrahedron(ball: BoneField) -> None:
    """The fast reading is eq 9, [d1 - d4, ..] G^-1 (m - n4) + d4, in the tetrahedra that the field shows as its mesh."""
    mesh = ball.mesh
    mesh.reject_bad()
    chosen = np.arange(0, len(mesh.tets), 97)
    corner = mesh.points[mesh.tets[chosen]]
    weight = np.random.default_rng(2).dirichlet(np.ones(4), len(chosen))
    m = np.einsum("ea,eai->ei", weight, corner)
    depth = ball.table.depth[mesh.tets[chosen]]
    g = (corner[:, :3] - corner[:, 3:]).transpose(0, 2, 1)
    slope = np.linalg.solve(g.transpose(0, 2, 1), (depth[:, :3] - depth[:, 3:])[:, :, None])[:, :, 0]
    want = np.einsum("ei,ei->e", slope, m - corner[:, 3]) + depth[:, 3]
    got = ball.sample(m, reading="linear")
    assert np.abs(got.depth - want).max() < 1e-12
    assert np.abs(got.inward - slope).max() < 1e-11
    assert np.abs(barycentric(mesh, chosen.astype(np.int32), m) - weight).max() < 1e-9


def test_depth_is_the_minimum_over_all_triangles(ball: BoneField) -> None:
    """Every node of the envelope has the exact distance to the surface, not that to some triangle near it."""
    nodes = ball.mesh.points[::53]
    assert np.abs(ball.table.depth[::53] - ball.exact(nodes)).max() < 1e-12


def test_a_prisms_own_box_misses_nodes() -> None:
    """Boxes of prisms along leaning vertex normals, as printed, give some nodes too large a distance; grown boxes none."""
    sharp = TriMesh(
        np.array([[0, 0, 0], [20, 0, 0], [0, 20, 0], [2, 2, 9.0]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    )
    exact = bone_field(sharp, spacing=0.5, step=1.0)
    printed = bone_field(sharp, spacing=0.5, step=1.0, grown=False)
    low, high = prism_boxes(sharp, 1.0)
    tight = prism_boxes(sharp, 1.0, grown=False)
    assert (low <= tight[0]).all() and (high >= tight[1]).all()
    points = exact.mesh.points[exact.table.depth >= 0.0]
    held = printed.sample(points, reading="linear").depth
    assert (np.abs(held - exact.table.depth[exact.table.depth >= 0.0]) > 0.05).mean() > 0.05
    assert np.abs(exact.table.depth - exact.exact(exact.mesh.points)).max() < 1e-12


def test_sides_at_a_sharp_corner() -> None:
    """Beside the tip of a needle, points are outside although the nearest triangle's own normal says otherwise."""
    needle = TriMesh(
        np.array([[0, 0, 0], [6, 0, 0], [0, 6, 0], [5.9, 0.05, 10.0]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    )
    field = bone_field(needle, spacing=0.5, step=1.0)
    around = np.array([5.9, 0.05, 10.0]) + 0.7 * np.array([[0, 0, 1], [1, 0, 0.5], [-0.4, -0.4, 0.9], [0, 1, 0.3]])
    assert (field.exact(around) < 0.0).all()
    assert field.mended == 0
    normals = pseudo_normals(needle)
    assert normals.face.shape == (4, 3) and normals.vertex.shape == (4, 3, 3)


def test_folded_surfaces_are_mended() -> None:
    """A fin of no thickness has no side by its normals; the winding number says that nothing is inside it."""
    box = box_tets((1, 1, 1), (10.0, 10.0, 10.0))
    points = np.concatenate([box.points, [[20.0, 5.0, 5.0]]])
    # the edge from (10, 0, 0) to (10, 10, 10), or the other diagonal, gets a fin: a doubled triangle
    t = box.boundary_triangles.tolist()
    face = [k for k in t if all(box.points[i][0] == 10.0 for i in k)]
    shared = sorted(set(face[0]) & set(face[1]))
    a, b = next((k[i], k[(i + 1) % 3]) for k in face for i in range(3) if {k[i], k[(i + 1) % 3]} == set(shared))
    tip = len(points) - 1
    field = bone_field(TriMesh(points, np.array([*t, [a, b, tip], [b, a, tip]])), spacing=0.7, step=1.0)
    beyond = np.random.default_rng(3).uniform([11.0, 4.0, 4.0], [20.5, 6.0, 6.0], size=(300, 3))
    assert field.mended > 0
    assert (field.exact(beyond) <= 0.0).all()
    assert (field.sample(beyond, reading="linear").depth <= 0.0).all()


def test_a_pose_carries_the_field(ball: BoneField) -> None:
    """Points moved with the bone are as deep as before, in the same direction turned."""
    points, _ = shells(2.0, 200)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    pose[:3, 3] = [4.0, -7.0, 1.0]
    before, after = ball.sample(points), ball.sample(points @ pose[:3, :3].T + pose[:3, 3], pose)
    assert np.abs(after.depth - before.depth).max() < 1e-12
    assert np.abs(after.inward - before.inward @ pose[:3, :3].T).max() < 1e-12


def test_beyond_and_behind_the_envelope(ball: BoneField) -> None:
    """Far outside there is no depth; behind the envelope a point is buried and keeps the direction that it had."""
    points = np.array([[0.0, 0.0, 40.0], [0.0, 0.0, 2.0], [300.0, 0.0, 0.0]])
    last = np.tile([0.0, 1.0, 0.0], (3, 1))
    for reading in ("linear", "spline"):
        got = ball.sample(points, reading=reading, last=last)
        assert got.depth.tolist() == [-np.inf, np.inf, -np.inf]
        assert got.buried.tolist() == [False, True, False]
        assert got.inward.tolist() == [[0, 0, 0], [0, 1, 0], [0, 0, 0]]


def test_a_step_into_the_surface_is_never_buried(ball: BoneField) -> None:
    """A point as deep as the step that the field was made for is still read, by every reading."""
    assert ball.step == pytest.approx(3.0)
    points, _ = shells(ball.step)
    for reading in ("linear", "mean", "spline", "nearest"):
        assert np.isfinite(ball.sample(points, reading=reading).depth).all()


def test_a_symmetric_bone_has_a_symmetric_field() -> None:
    """The lattice is its own mirror image about x = 0, so depths there are mirrored too, to rounding."""
    field = bone_field(sphere(8.0, 3), spacing=0.8, step=1.0)
    points = np.random.default_rng(4).normal(size=(400, 3))
    points *= (np.random.default_rng(5).uniform(7.1, 7.9, 400) / np.linalg.norm(points, axis=1))[:, None]
    for reading in ("linear", "spline"):
        one, other = field.sample(points, reading=reading), field.sample(points * [-1.0, 1.0, 1.0], reading=reading)
        assert np.abs(one.depth - other.depth).max() < 1e-12


def test_open_and_inside_out_surfaces_are_refused() -> None:
    """A hole is named with its edge; a surface that looks inwards is told to be turned."""
    closed = sphere(5.0, 2)
    with pytest.raises(UserError, match=r"not watertight: 3 edges.*joins vertices \d+ and \d+"):
        reject_open(TriMesh(closed.points, closed.triangles[1:]))
    turned = closed.triangles.copy()
    turned[4] = turned[4, ::-1]
    with pytest.raises(UserError, match="not watertight"):
        bone_field(TriMesh(closed.points, turned))
    with pytest.raises(UserError, match="looks inwards"):
        bone_field(TriMesh(closed.points, closed.triangles[:, ::-1]))
    with pytest.raises(UserError, match="no triangles"):
        reject_open(TriMesh(closed.points, np.zeros((0, 3), np.int32)))


def test_envelopes_too_thin_are_refused() -> None:
    """A thickness below a step and the reach of a reading is refused, naming both; so are other impossible sizes."""
    surface = sphere(5.0, 1)
    with pytest.raises(UserError, match=r"thickness 3 mm is too thin for steps of 3 mm.*at least"):
        bone_field(surface, thickness=3.0, step=3.0)
    enough = 1.0 + REACH * DIAGONAL
    assert bone_field(surface, thickness=enough, step=1.0).step == pytest.approx(1.0)
    with pytest.raises(UserError, match=r"margin = 0\.1"):
        bone_field(surface, margin=0.1)
    for name, value in (("spacing", 0.0), ("step", np.nan), ("spacing", -1.0), ("step", np.inf)):
        with pytest.raises(UserError, match=f"{name} = "):
            bone_field(surface, **{name: value})
    with pytest.raises(UserError, match="too large"):
        bone_field(surface, spacing=0.01, step=1.0)
    with pytest.raises(UserError, match="unknown reading"):
        bone_field(surface).sample(np.zeros((1, 3)), reading="cubic")


def test_poses_that_are_not_rigid_are_refused() -> None:
    """Stretched, mirrored and broken poses are named."""
    for pose in (np.diag([1.0, 1.0, 1.01, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 1.0, 1.0, 2.0])):
        with pytest.raises(UserError, match="pose of the jaw is not rigid"):
            rigid_pose("pose of the jaw", pose)
    with pytest.raises(UserError, match="shape"):
        rigid_pose("pose", np.eye(3))
    with pytest.raises(UserError, match="not finite"):
        rigid_pose("pose", np.full((4, 4), np.nan))
