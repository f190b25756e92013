"""Cutting bodies into cubes: what each cube holds, what is joined, and which bodies are refused."""

from __future__ import annotations

import numpy as np
import pytest
from slabs import lips

from faceanim.geometry import octree
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.octree import Octree
from faceanim.geometry.shapes import box_tets, sphere
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.ground.errors import UserError


def box_surface(low: tuple[float, ...] = (0, 0, 0), high: tuple[float, ...] = (1, 1, 1)) -> TriMesh:
    mesh = box_tets((1, 1, 1), (1.0, 1.0, 1.0)).boundary
    return TriMesh(np.array(low) + mesh.points * (np.array(high) - np.array(low)), mesh.triangles)


def joined(*meshes: TriMesh) -> TriMesh:
    start = np.cumsum([0] + [len(m.points) for m in meshes])
    triangles = np.concatenate([m.triangles + s for m, s in zip(meshes, start)])
    return TriMesh(np.concatenate([m.points for m in meshes]), triangles)


def test_a_block_and_its_levels() -> None:
    """16 x 8 x 8 cubes halve down to one: 1,377, 225, 45 and 12 nodes (section 7), every node once."""
    tree = octree.block((16, 8, 8), 0.125)
    assert [len(c.points) for c in tree.levels] == [1377, 225, 45, 12, 8]
    assert [len(c.index) for c in tree.levels] == [1024, 128, 16, 2, 1]
    for level, cells in enumerate(tree.levels):
        assert cells.side == 0.125 * 2**level
        assert len(np.unique(np.round(cells.points / 0.125), axis=0)) == len(cells.points)
        corner = cells.points[cells.corner]
        np.testing.assert_allclose(
            corner, cells.origin + cells.side * (cells.index[:, None] + octree.CORNERS), atol=1e-14
        )
        np.testing.assert_array_equal(cells.index[tree.ancestor[level]], tree.leaves.index >> level)
    for k, up in enumerate(tree.up[:3]):  # the last cube sticks out of the block
        same = up >= 0
        assert same.sum() == len(tree.levels[k + 1].points)
        np.testing.assert_allclose(tree.levels[k].points[same], tree.levels[k + 1].points[up[same]], atol=1e-14)


def test_a_block_of_odd_size_keeps_all_its_leaves() -> None:
    """5 x 3 x 1 cubes: parents stick out, and every leaf lies in its ancestors."""
    tree = octree.block((5, 3, 1), 1.0)
    for level, cells in enumerate(tree.levels):
        low = cells.origin + cells.side * cells.index[tree.ancestor[level]]
        assert (np.abs(tree.leaves.centres - low - 0.5 * cells.side) < 0.5 * cells.side).all()
    assert len(tree.levels[-1].index) == 1


@pytest.mark.parametrize("side", [0.5, 0.37])
def test_every_part_of_a_volume_is_in_one_cell(side: float) -> None:
    """The volumes that cubes cut from the elements add up to the whole; a plain body has one cell a cube."""
    mesh = box_tets((4, 3, 2), (2.0, 1.5, 1.0))
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    mesh = TetMesh(mesh.points @ turn.T, mesh.tets)
    tree = octree.from_tets(mesh, side)
    assert tree.overlap is not None
    assert tree.overlap.volume.sum() == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    np.testing.assert_allclose(np.bincount(tree.overlap.tet, tree.overlap.volume), mesh.volumes, rtol=1e-10)
    assert len(np.unique(tree.leaves.index, axis=0)) == len(tree.leaves.index)
    assert (tree.fill <= 1.0 + 1e-9).all() and tree.parts.max() == 0


def test_aligned_cells_are_full() -> None:
    """A block whose sides are multiples of the cell's gives the same octree as the block itself."""
    tree, block = octree.from_tets(box_tets((4, 2, 2), (2.0, 1.0, 1.0)), 0.25), octree.block((8, 4, 4), 0.25)
    np.testing.assert_allclose(tree.fill, 1.0, rtol=1e-12)
    assert [len(c.points) for c in tree.levels] == [len(c.points) for c in block.levels]


def cells_at(tree: Octree, level: int, y_low: float, y_high: float) -> np.ndarray:
    cells = tree.levels[level]
    low = cells.origin[1] + cells.side * cells.index[:, 1]
    return np.flatnonzero((low < y_high) & (low + cells.side > y_low))


@pytest.mark.parametrize("side", [1.0, 2.0, 0.75])
@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_lips_that_touch_are_not_glued(side: float, gap: float) -> None:
    """Upper and lower lip share no corner beyond the mouth's corner, on any level as long as its cubes are short of it."""
    mesh = lips(gap)
    tree = octree.from_tets(mesh, side)
    assert tree.overlap is not None
    above = mesh.points[mesh.tets].mean(axis=1)
    for level, cells in enumerate(tree.levels):
        cell = tree.ancestor[level][tree.overlap.cell]
        inner = cells.origin[0] + cells.side * cells.index[:, 0] > 4.0 + 1e-6
        upper = np.unique(cell[above[tree.overlap.tet, 1] > 3.0])
        lower = np.unique(cell[above[tree.overlap.tet, 1] < 3.0])
        upper, lower = upper[inner[upper]], lower[inner[lower]]
        if not len(upper):
            continue
        assert not set(upper) & set(lower)
        far = cells.points[:, 0] > 4.0 + cells.side + 1e-6
        shared = set(cells.corner[upper].ravel()) & set(cells.corner[lower].ravel())
        assert not far[sorted(shared)].any()
    assert tree.parts.max() == 0


def test_a_cube_across_the_slit_holds_two_cells() -> None:
    """With cubes of 2 mm the slit at y = 3 runs through their middle: two half-filled cells each, one where lips join."""
    tree = octree.from_tets(lips(), 2.0)
    _, count = np.unique(tree.leaves.index, axis=0, return_counts=True)
    assert sorted(np.unique(count)) == [1, 2]
    places, which = np.unique(tree.leaves.index, axis=0, return_inverse=True)
    twice = places[count == 2]
    assert (twice[:, 1] == 1).all() and (twice[:, 0] >= 3).all() and len(twice) == 3 * 3
    np.testing.assert_allclose(tree.fill[count[which.ravel()] == 2], 0.5, rtol=1e-9)


def test_points_find_their_own_lip() -> None:
    """A vertex on the upper lip lies in a cell of the upper lip, although the lower lip is at the same place."""
    mesh = lips()
    tree = octree.from_tets(mesh, 2.0)
    assert tree.overlap is not None
    node = mesh.boundary_nodes
    leaf = tree.locate_in(mesh, Embedding.of_nodes(node), mesh.points[node])
    for k, n in enumerate(node):
        mine = set(tree.overlap.tet[tree.overlap.cell == leaf[k]])
        assert mine & set(mesh.node_tets.of(int(n)))


def test_trilinear_weights_reproduce_points() -> None:
    """Weights sum to 1 and give back every point, inside and outside."""
    tree = octree.block((4, 2, 2), 0.5)
    points = np.random.default_rng(0).uniform(-0.2, 2.2, (50, 3))
    leaf = tree.locate(points)
    weight = tree.leaves.weights(leaf, points)
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-13)
    back = np.einsum("ka,kad->kd", weight, tree.leaves.points[tree.leaves.corner[leaf]])
    np.testing.assert_allclose(back, points, atol=1e-13)


def test_a_sphere_is_filled() -> None:
    """The filled volume of a sphere is that of its mesh within what sampling leaves."""
    surface = sphere(1.0, 2)
    tree = octree.from_surface(surface, 0.25)
    exact = np.linalg.det(surface.points[surface.triangles]).sum() / 6.0
    assert tree.fill.sum() * 0.25**3 == pytest.approx(exact, rel=0.01)
    assert tree.parts.max() == 0 and len(tree.levels) > 2


def test_open_surfaces_are_named() -> None:
    """A missing triangle is an open edge, by number."""
    whole = sphere(1.0, 1)
    with pytest.raises(UserError, match=r"open: edge \d+-\d+"):
        octree.from_surface(TriMesh(whole.points, whole.triangles[1:]), 0.3)


def test_surfaces_inside_out_are_named() -> None:
    """Triangles turned inward enclose a negative volume."""
    whole = sphere(1.0, 1)
    with pytest.raises(UserError, match="inside out"):
        octree.from_surface(TriMesh(whole.points, whole.triangles[:, ::-1]), 0.3)


def test_surfaces_that_cross_themselves_are_named() -> None:
    """Two closed boxes that overlap make one surface that cuts itself; side by side they are two parts."""
    with pytest.raises(UserError, match=r"triangles \d+ and \d+ cut"):
        octree.from_surface(joined(box_surface(), box_surface((0.5, 0.4, 0.3), (1.5, 1.3, 1.4))), 0.2)
    with pytest.raises(UserError, match="2 parts"):
        octree.from_surface(joined(box_surface(), box_surface((3, 0, 0), (4, 1, 1))), 0.25)


def test_a_surface_with_a_hole_in_it_is_hollow() -> None:
    """A void, a closed surface turned inward inside another, holds no flesh."""
    void = box_surface((1, 1, 1), (2, 2, 2))
    void = TriMesh(void.points, void.triangles[:, ::-1])
    tree = octree.from_surface(joined(box_surface((0, 0, 0), (3, 3, 3)), void), 1.0)
    assert len(tree.leaves.index) == 26


@pytest.mark.parametrize("side", [0.0, -1.0, np.nan, 1e-3, 10.0])
def test_sides_that_make_no_sense_are_refused(side: float) -> None:
    """Not positive, too many cells for memory, larger than the body: a `UserError` that names the side."""
    with pytest.raises(UserError, match="side"):
        octree.from_tets(box_tets((2, 2, 2), (1.0, 1.0, 1.0)), side)
    with pytest.raises(UserError, match="side"):
        octree.from_surface(sphere(1.0, 1), side)


def test_empty_input_is_refused() -> None:
    """No cells, no levels, no triangles."""
    with pytest.raises(UserError, match="cells"):
        octree.block((0, 1, 1), 1.0)
    with pytest.raises(UserError, match="levels"):
        octree.block((1, 1, 1), 1.0, 0)
    with pytest.raises(UserError, match="no triangles"):
        octree.from_surface(TriMesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32)), 1.0)
