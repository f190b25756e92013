"""Laws of tetrahedral meshes, of boxes made of them, and of points carried by them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from faceanim.geometry.embedding import Embedding, barycentric, embed
from faceanim.geometry.shapes import SPLITS, box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.ground.errors import UserError

REGULAR = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
CELLS = st.tuples(*(st.integers(1, 4),) * 3)
SIZES = st.tuples(*(st.floats(0.1, 50.0),) * 3)
SEEDS = st.integers(0, 2**31)


def shaken(cells: tuple[int, int, int], seed: int, amount: float = 0.1) -> TetMesh:
    """Return a box of unit cubes whose nodes are moved at random, too little to invert an element."""
    box = box_tets(cells, tuple(float(c) for c in cells))
    return TetMesh(box.points + amount * np.random.default_rng(seed).uniform(-1, 1, box.points.shape), box.tets)


@settings(max_examples=25, deadline=None)
@given(CELLS, SIZES, st.sampled_from(SPLITS))
def test_a_box_is_filled_once(cells: tuple[int, int, int], size: tuple[float, float, float], split: str) -> None:
    """Positive volumes that sum to the box, six elements a cube, and a closed boundary of the box's area."""
    box = box_tets(cells, size, split=split)
    a, b, c = size
    assert len(box.tets) == 6 * np.prod(cells) and box.volumes.min() > 0
    assert box.volumes.sum() == pytest.approx(a * b * c)
    assert box.boundary.areas.sum() == pytest.approx(2.0 * (a * b + b * c + c * a))
    np.testing.assert_allclose(box.boundary.normals_by_area.sum(axis=0), 0.0, atol=1e-9 * (a * b + b * c + c * a))


def test_the_boundary_looks_outwards() -> None:
    """The divergence theorem: the sum of x . n over the boundary is three times the volume."""
    mesh = shaken((3, 2, 2), 5)
    surface = mesh.boundary
    centre = surface.points[surface.triangles].mean(axis=1)
    assert np.einsum("ti,ti->", centre, surface.normals_by_area) / 3.0 == pytest.approx(mesh.volumes.sum())
    np.testing.assert_array_equal(surface.points, mesh.points[mesh.boundary_nodes])


def test_a_mirrored_box_is_its_own_mirror_image() -> None:
    """Split "mirrored" with an even number of cubes is symmetric in each axis; "kuhn" leans and is not."""

    def elements(box: TetMesh, axis: int) -> set[tuple[tuple[float, ...], ...]]:
        sign, shift = np.ones(3), np.zeros(3)
        if axis >= 0:
            sign[axis], shift[axis] = -1.0, box.points[:, axis].max()
        x = np.round(box.points * sign + shift, 9) + 0.0
        return {tuple(sorted(map(tuple, tet.tolist()))) for tet in x[box.tets]}

    even = box_tets((4, 2, 2), (4.0, 2.0, 2.0))
    lean = box_tets((4, 2, 2), (4.0, 2.0, 2.0), split="kuhn")
    for axis in range(3):
        assert elements(even, axis) == elements(even, -1)
        assert elements(lean, axis) != elements(lean, -1)


@settings(max_examples=20, deadline=None)
@given(CELLS, SEEDS)
def test_gradients_reproduce_linear_fields(cells: tuple[int, int, int], seed: int) -> None:
    """Shape functions sum to 1, and u = A x + b has the gradient A in every element."""
    mesh = shaken(cells, seed)
    a = np.random.default_rng(seed).normal(size=(3, 3))
    u = mesh.points @ a.T + 0.5
    np.testing.assert_allclose(mesh.gradients.sum(axis=1), 0.0, atol=1e-12)
    gradient = np.einsum("eai,eaj->eij", u[mesh.tets], mesh.gradients)
    np.testing.assert_allclose(gradient, np.broadcast_to(a, gradient.shape), atol=1e-9)


def test_quality_is_one_for_a_regular_element_and_negative_for_an_inverted_one() -> None:
    """It does not change with size, falls towards 0 as the element flattens."""
    quality = TetMesh(7.0 * REGULAR, [[0, 2, 1, 3]]).quality[0]
    assert abs(quality) == pytest.approx(1.0)
    other = TetMesh(7.0 * REGULAR, [[0, 1, 2, 3]]).quality[0]
    assert other == pytest.approx(-quality)
    upright = [0, 1, 2, 3] if other > 0 else [0, 2, 1, 3]
    flat = [TetMesh(REGULAR * [1.0, 1.0, s], [upright]).quality[0] for s in (1.0, 0.3, 0.03, 0.003)]
    assert np.all(np.diff(flat) < 0) and 0 < flat[-1] < 0.1


def test_bad_meshes_are_named() -> None:
    """The first bad element or loose node is in the message."""
    upright = [0, 1, 2, 3] if TetMesh(REGULAR, [[0, 1, 2, 3]]).volumes[0] > 0 else [0, 2, 1, 3]
    TetMesh(REGULAR, [upright]).reject_bad()
    with pytest.raises(UserError, match=r"element 0 .* is inverted"):
        TetMesh(REGULAR, [[upright[0], upright[2], upright[1], upright[3]]]).reject_bad()
    with pytest.raises(UserError, match=r"element 0 .* is flat"):
        TetMesh(REGULAR * [1.0, 1.0, 0.0], [upright]).reject_bad()
    with pytest.raises(UserError, match=r"1 nodes without element .node 4"):
        TetMesh(np.concatenate([REGULAR, [[5.0, 5.0, 5.0]]]), [upright]).reject_bad()
    with pytest.raises(UserError, match="no elements"):
        TetMesh(REGULAR, np.zeros((0, 4), dtype=np.int32)).reject_bad()
    with pytest.raises(UserError, match=r"outside 0..3"):
        TetMesh(REGULAR, [[0, 1, 2, 4]])
    with pytest.raises(UserError, match="not finite"):
        TetMesh(REGULAR * np.nan, [upright])
    for cells, size, split in (
        ((0, 1, 1), (1, 1, 1), "kuhn"),
        ((1, 1, 1), (1, 0, 1), "kuhn"),
        ((1, 1, 1), (1, 1, 1), "x"),
    ):
        with pytest.raises(UserError, match="box:"):
            box_tets(cells, size, split=split)


def test_parts_are_joined_by_shared_nodes() -> None:
    """Two boxes apart are two parts; each node lists its elements."""
    box = box_tets((1, 1, 2), (1.0, 1.0, 2.0))
    two = TetMesh(
        np.concatenate([box.points, box.points + 5.0]), np.concatenate([box.tets, box.tets + len(box.points)])
    )
    np.testing.assert_array_equal(two.parts, np.repeat([0, 1], len(box.tets)))
    for v in (0, 5, len(box.points) + 3):
        np.testing.assert_array_equal(two.node_tets.of(v), np.flatnonzero((two.tets == v).any(axis=1)))


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_carried_points_follow_linear_motion(seed: int) -> None:
    """Points inside or outside are reproduced at rest, and move with any affine map of the nodes."""
    rng = np.random.default_rng(seed)
    mesh = shaken((3, 2, 2), seed)
    points = rng.uniform(-0.3, 1.3, (40, 3)) * [3.0, 2.0, 2.0]
    carried = embed(mesh, points)
    np.testing.assert_allclose(carried.weight.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(carried.apply(mesh.points), points, atol=1e-9)
    a, b = rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose(carried.apply(mesh.points @ a.T + b), points @ a.T + b, atol=1e-8)
    np.testing.assert_allclose(carried.matrix(len(mesh.points)) @ mesh.points, points, atol=1e-9)


@settings(max_examples=20, deadline=None)
@example(716)  # a large element among many small ones
@given(SEEDS)
def test_inner_points_ride_on_the_element_that_holds_them(seed: int) -> None:
    """No weight is negative for a point in an element, and its weights are its barycentric coordinates."""
    rng = np.random.default_rng(seed)
    mesh = shaken((3, 2, 2), seed)
    tet = rng.integers(0, len(mesh.tets), 30)
    weight = rng.dirichlet(np.ones(4), 30)
    points = np.einsum("ka,kai->ki", weight, mesh.points[mesh.tets[tet]])
    np.testing.assert_allclose(barycentric(mesh, tet, points), weight, atol=1e-9)
    assert embed(mesh, points).weight.min() > -1e-9


def test_forces_on_points_do_the_same_work_on_nodes() -> None:
    """f . (B u) = (B^T f) . u."""
    rng = np.random.default_rng(1)
    mesh = shaken((2, 2, 2), 1)
    carried = embed(mesh, rng.uniform(0.0, 2.0, (9, 3)))
    f, u = rng.normal(size=(9, 3)), rng.normal(size=mesh.points.shape)
    b = carried.matrix(len(mesh.points))
    assert np.sum(f * carried.apply(u)) == pytest.approx(np.sum((b.T @ f) * u))


def test_only_allowed_elements_carry() -> None:
    """`among` confines the carriers; none at all, or weights that do not sum to 1, are refused."""
    mesh = box_tets((4, 1, 1), (4.0, 1.0, 1.0))
    right = np.flatnonzero(mesh.points[mesh.tets, 0].min(axis=1) >= 2.0)
    carried = embed(mesh, np.array([[0.2, 0.4, 0.4]]), among=right)
    assert mesh.points[carried.node, 0].min() >= 2.0
    np.testing.assert_allclose(carried.apply(mesh.points), [[0.2, 0.4, 0.4]], atol=1e-9)
    with pytest.raises(UserError, match="no element to carry"):
        embed(mesh, np.zeros((1, 3)), among=np.zeros(0, dtype=int))
    with pytest.raises(UserError, match="sum to 1"):
        Embedding(np.zeros((1, 2), np.int32), np.array([[0.5, 0.4]]))
    with pytest.raises(UserError, match="equal"):
        Embedding(np.zeros((1, 2), np.int32), np.ones((1, 3)))
