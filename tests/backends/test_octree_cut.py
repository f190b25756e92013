"""Which cells are simulated: safe boxes, importance, budgets, and what a valid cut is (section 4)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from lattices import LEAVES, PLACE, TREE, lattice, uniform

from faceanim.backends.octree_mass_spring import cut
from faceanim.backends.octree_mass_spring.model import assemble, closed
from faceanim.backends.octree_mass_spring.options import PAPER_BETA, SAFE_BETA
from faceanim.geometry import octree
from faceanim.ground.errors import UserError
from faceanim.kernels import lattice as kernels

CUBE = np.array(list(product((0.0, 1.0), repeat=3)))


def least_corner_volume(corner: np.ndarray) -> float:
    """Return the smallest corner Jacobian of the unit cube moved to `corner` (8, 3)."""
    cells = kernels.LatticeCells(np.arange(8, dtype=np.int32)[None], np.ones(1))
    out = np.zeros(1)
    kernels.corner_volumes(np.ascontiguousarray(corner), cells, out)
    return float(out[0])


@pytest.mark.parametrize("beta", [0.1, 1 / 6, 0.2, 0.25, 0.4999])
def test_the_worst_case_of_a_safe_box(beta: float) -> None:
    """Every corner of a cell moved by beta at most: the least Jacobian (.2: -.20, .25: -.50, .4999: -4.0).

    Extremes lie at corners of the boxes; random ones never go below, and one corner and its neighbours reach it.
    """
    rng = np.random.default_rng(0)
    found = min(least_corner_volume(CUBE + beta * rng.choice([-1.0, 1.0], (8, 3))) for _ in range(3000))
    assert least_corner_volume(CUBE) == pytest.approx(1.0)
    if beta < 1 / 6:
        assert found >= 1 - 6 * beta - 1e-12
    e = np.eye(3)
    # all of the 2^12 extreme positions of a corner and its three neighbours
    signs = np.array(list(product((-1.0, 1.0), repeat=12))).reshape(-1, 4, 3)
    edges = e + beta * (signs[:, 1:] - signs[:, :1])
    worst = float(np.linalg.det(edges).min())
    assert found >= worst - 1e-12
    named = 1 - 6 * beta  # corner + beta, neighbours - beta along every axis
    assert float(np.linalg.det(e - 2 * beta * np.ones((3, 3)))) == pytest.approx(named)
    measured = {0.1: 0.4, 1 / 6: 0.0, 0.2: -0.2, 0.25: -0.5, 0.4999: -4.0}[beta]
    assert worst == pytest.approx(measured, abs=2e-3) and worst <= named + 1e-12


def test_the_default_box_cannot_invert_and_the_papers_can() -> None:
    """beta = 1/6 - 1e-3 leaves .006 of a corner's volume at worst; 0.49 turns corners inside out."""
    signs = np.array(list(product((-1.0, 1.0), repeat=12))).reshape(-1, 4, 3)
    worst = [float(np.linalg.det(np.eye(3) + b * (signs[:, 1:] - signs[:, :1])).min()) for b in (SAFE_BETA, PAPER_BETA)]
    assert worst[0] == pytest.approx(0.006) and worst[1] < -1.0


def test_in_two_dimensions_a_quarter_is_the_limit() -> None:
    """1 - 4 beta: .2499 leaves +.0004, .26 takes -.04."""
    signs = np.array(list(product((-1.0, 1.0), repeat=6))).reshape(-1, 3, 2)
    for beta, worst in ((0.2499, 0.0004), (0.26, -0.04)):
        edges = np.eye(2) + beta * (signs[:, 1:] - signs[:, :1])
        assert float(np.linalg.det(edges).min()) == pytest.approx(worst, abs=1e-9)


def test_a_cell_is_unsafe_if_a_step_leaves_its_box() -> None:
    """d = |f| dt^2 / m against beta h: the cells around the pushed node, just above and not just below."""
    model = uniform(lattice(), 0)
    node = int(np.flatnonzero((np.abs(model.points - [1.0, 0.5, 0.5]) < 1e-9).all(axis=1))[0])
    dt = 0.015
    limit = SAFE_BETA * 0.125 * model.mass[node] / dt**2
    for factor, count in ((0.99, 0), (1.01, 8)):
        force = np.zeros_like(model.points)
        force[node, 0] = factor * limit
        assert cut.unsafe_cells(model, force, dt, SAFE_BETA).sum() == count


@pytest.mark.parametrize(("beta", "first"), [(1 / 6, 0.10), (0.25, 0.15), (0.49999, 0.30)])
def test_the_force_at_which_a_surface_node_is_flagged(beta: float, first: float) -> None:
    """16 x 8 x 8, dt = .0151, an inward force on a node of a side: flags at .10, .15, .30 (section 4)."""
    model = uniform(lattice(), 0)
    node = int(np.flatnonzero((np.abs(model.points - [2.0, 0.5, 0.5]) < 1e-9).all(axis=1))[0])

    def flagged(size: float) -> bool:
        force = np.zeros_like(model.points)
        force[node, 0] = -size
        return bool(cut.unsafe_cells(model, force, 0.0151, beta).any())

    exact = beta * 0.125 * model.mass[node] / 0.0151**2
    assert exact <= first <= 1.2 * exact  # the specification's figures are the first flagged ones of a coarse scan
    assert flagged(1.001 * exact) and not flagged(0.999 * exact)


def test_at_a_fixed_step_the_safe_force_grows_sixteenfold_a_level() -> None:
    """m x 8 and h x 2 per level (section 4)."""
    limits = []
    for level in range(3):
        model = uniform(lattice(), level)
        node = int(np.flatnonzero((np.abs(model.points - [1.0, 0.5, 0.5]) < 1e-9).all(axis=1))[0]) if level < 3 else 0
        limits.append(model.mass[node] * model.side[0])
    np.testing.assert_allclose(np.array(limits[1:]) / limits[:-1], 16.0, rtol=1e-9)


def test_force_makes_cells_larger_until_they_are_safe() -> None:
    """The cut survives its own force, is coarse where it acts and fine far away, and a stronger one makes it coarser."""
    at, dt = lattice(), 0.015
    sizes = []
    for strength in (0.05, 0.5, 5.0):

        def push(model, strength=strength):  # type: ignore[no-untyped-def]
            force = np.zeros_like(model.points)
            near = np.argmin(np.linalg.norm(model.points - [2.0, 0.5, 0.5], axis=1))
            force[near, 0] = -strength
            return force

        level = cut.safe_cut(at, push, dt, SAFE_BETA)
        model = assemble(at, level)
        bad = cut.unsafe_cells(model, push(model), dt, SAFE_BETA)
        assert not (bad & (model.cell_level < at.top)).any()
        sizes.append(len(model.cell))
    assert sizes[0] == LEAVES and sizes[0] > sizes[1] > sizes[2]
    assert level[TREE.leaves.centres[:, 0] < 0.3].min() < level.max()


def test_a_cut_is_closed() -> None:
    """One leaf asked to be coarse takes its whole cell; nothing else changes."""
    want = np.zeros(LEAVES, dtype=np.int32)
    want[0] = 2
    level = closed(TREE, want)
    assert (level == 2).sum() == 64 and (level > 0).sum() == 64
    assert (PLACE[level == 2] < 4).all()
    assert closed(TREE, np.full(LEAVES, 99)).max() == 4


@pytest.mark.parametrize("hard", [False, True])
def test_nodes_of_unlike_cells(hard: bool) -> None:
    """Half fine, half coarse: coincident nodes are one, every other node on the border hangs on its coarse face."""
    at = lattice()
    model = assemble(at, np.where(PLACE[:, 0] < 8, 0, 1), hard=hard)
    assert model.mass.sum() == pytest.approx(2.0, rel=1e-13)
    border = np.isclose(model.points[:, 0], 1.0)
    assert border.sum() == 81
    ties = model.tables.ties
    hanging = model.tables.slaves.node if hard else ties.node[:, 8]
    assert len(hanging) == 81 - 25 and border[hanging].all()
    if not hard:
        np.testing.assert_allclose(ties.weight.sum(axis=1), 0.0, atol=1e-14)
        np.testing.assert_allclose(model.tie_matrix() @ model.points, 0.0, atol=1e-14)
        count = (ties.weight[:, :8] > 0).sum(axis=1)
        assert sorted(np.unique(count)) == [2, 4]  # on edges and on faces
    else:
        np.testing.assert_allclose(model.reduce @ model.points, model.points, atol=1e-14)


def test_slaves_of_slaves_end_at_free_nodes() -> None:
    """Leaves beside cells four and eight times as large: masters are never slaves."""
    at = lattice()
    model = assemble(at, np.where(PLACE[:, 0] < 4, 0, np.where(PLACE[:, 0] < 8, 1, 3)), hard=True)
    slaves = model.tables.slaves
    assert not np.isin(slaves.master, slaves.node).any()
    np.testing.assert_allclose(model.reduce @ model.points, model.points, atol=1e-13)
    assert model.mass[model.free_mask()].sum() == pytest.approx(2.0, rel=1e-12)


def test_painted_importance() -> None:
    """Leaves where 1 is painted stay leaves, where 0 is painted cells are as coarse as allowed."""
    points = TREE.leaves.points
    outer = np.flatnonzero((points == 0).any(axis=1) | np.isclose(points, [2, 1, 1]).any(axis=1))
    leaf = TREE.locate(points[outer])
    weight = (points[outer, 0] < 0.5).astype(float)
    level = cut.important_cut(TREE, leaf, weight, 2)
    assert (level[TREE.leaves.centres[:, 0] < 0.5] == 0).all()
    assert (level[TREE.leaves.centres[:, 0] > 1.0] == 2).all()
    np.testing.assert_array_equal(level, closed(TREE, level))


def test_a_box_stays_fine() -> None:
    """Leaves that meet the box stay leaves; beyond, cells are as large as the octree allows."""
    box = np.array([[0.0, 0.0, 0.0], [0.2, 0.2, 0.2]])
    level = cut.box_cut(TREE, box, 3)
    assert (level[(PLACE < 2).all(axis=1)] == 0).all()
    assert level.max() == 3 and 0 < (level == 0).sum() < 64


def test_a_budget_is_kept_and_used() -> None:
    """The number of springs is at most the budget, and one cell more would exceed it; important leaves stay."""
    at = lattice()
    dear = np.where(PLACE[:, 0] < 4, 1.0, 0.0)
    counts = []
    for budget in (20_000, 8000, 3000, 500):
        level = cut.budget_cut(at, budget, dear)
        counts.append(len(assemble(at, level).tables.springs.i))
        assert counts[-1] <= budget
    assert counts[0] == 14_624 and counts[1] > 7000 and counts[2] > 2000
    level = cut.budget_cut(at, 8000, dear)
    assert level[dear == 1].max() <= level[dear == 0].min()
    with pytest.raises(UserError, match="budget"):
        cut.budget_cut(lattice(), 1)


def test_lips_stay_apart_on_every_level() -> None:
    """In any mixture of cells a node never joins the two sides of a slit: pulled apart, they open freely."""
    from slabs import lips

    from faceanim.backends.octree_mass_spring.lattice import Lattice

    mesh = lips()
    tree = octree.from_tets(mesh, 1.0, 3)
    assert tree.overlap is not None
    count = len(tree.leaves.index)
    at = Lattice(tree, np.ones(count), np.ones(count))
    centres = tree.leaves.centres
    upper = centres[:, 1] > 3.0
    for level in (0, 1, np.where(upper, 0, 1), np.where(centres[:, 0] > 8, 2, 0)):
        model = assemble(at, np.broadcast_to(level, count))
        inside = model.side[model.of_leaf] * 0 + centres[:, 0] > 8.5
        up = set(model.corner[model.of_leaf[inside & upper]].ravel())
        down = set(model.corner[model.of_leaf[inside & ~upper]].ravel())
        far = {n for n in up & down if model.points[n, 0] > 8.0 + 1e-6}
        assert not far
        ties = model.tables.ties
        for row, weight in zip(ties.node, ties.weight, strict=True):
            used = set(row[weight != 0].tolist())
            assert not (used & (up - down) and used & (down - up))
