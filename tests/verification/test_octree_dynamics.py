"""The lattice in motion: forces, conservation, ties, rest against Newton, and the hit rate of the safe boxes."""

from __future__ import annotations

import numpy as np
import pytest
from lattices import LEAVES, PLACE, TREE, lattice, load, on_face, settled, uniform

from faceanim.backends.octree_mass_spring import harmonic
from faceanim.backends.octree_mass_spring.cut import unsafe_cells
from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, assemble
from faceanim.backends.octree_mass_spring.options import SAFE_BETA
from faceanim.backends.octree_mass_spring.transfer import transfer
from faceanim.geometry import octree
from faceanim.kernels import lattice as kernels


def small(rule: str = "energy") -> Lattice:
    tree = octree.block((8, 4, 4), 0.25)
    count = len(tree.leaves.index)
    stiffness = np.random.default_rng(2).uniform(1.0, 3.0, count)
    return Lattice(tree, stiffness, np.full(count, 0.25**3), rule)


def mixed(rule: str = "energy", hard: bool = False) -> Model:
    at = small(rule)
    return assemble(at, np.where(at.tree.leaves.index[:, 0] < 4, 0, 1), hard=hard)


def inner_energy(model: Model, x: np.ndarray) -> float:
    tables = model.tables
    target = np.zeros((len(tables.ties.stiffness), 3))
    return float(
        kernels.spring_energy(x, tables.springs)
        + kernels.hex_energy(x, tables.hexes)
        + kernels.tie_energy(x, tables.ties, target)
    )


def inner_force(model: Model, x: np.ndarray) -> np.ndarray:
    force = np.zeros_like(x)
    target = np.zeros((len(model.tables.ties.stiffness), 3))
    kernels.all_forces(x, np.zeros_like(x), model.tables, target, force)
    return force


def crumpled(model: Model, amount: float, seed: int = 0) -> np.ndarray:
    """Return the model turned by 70 degrees and crumpled by `amount` sides."""
    c, s = np.cos(1.2), np.sin(1.2)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    x = model.points @ turn.T + [0.3, -0.2, 0.1]
    x += amount * model.side.min() * np.random.default_rng(seed).standard_normal(x.shape)
    kernels.follow(x, model.tables.slaves)
    return np.ascontiguousarray(x)


@pytest.mark.parametrize("rule", ["energy", "harmonic"])
@pytest.mark.parametrize("hard", [False, True])
@pytest.mark.parametrize("amount", [0.05, 0.5])
def test_forces_balance_and_follow_from_the_energy(rule: str, hard: bool, amount: float) -> None:
    """No net force or torque, ties included (section 5: sum F_i = F, sum P_i x F_i = a x F), and central differences."""
    model = mixed(rule, hard)
    x = crumpled(model, amount)
    force = inner_force(model, x)
    scale = np.abs(force).sum()
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13 * scale)
    np.testing.assert_allclose(np.cross(x, force).sum(axis=0), 0.0, atol=1e-12 * scale)
    way = np.random.default_rng(1).standard_normal(x.shape)
    kernels.follow(way, model.tables.slaves)
    eps = 1e-6
    slope = (inner_energy(model, x + eps * way) - inner_energy(model, x - eps * way)) / (2 * eps)
    free = model.free_mask()
    assert -slope == pytest.approx(float((force[free] * way[free]).sum()), rel=2e-6)


@pytest.mark.parametrize("rule", ["energy", "harmonic"])
def test_a_turned_body_is_at_rest(rule: str) -> None:
    """Rigid motion stores no energy and makes no force."""
    model = mixed(rule)
    x = crumpled(model, 0.0)
    assert abs(inner_energy(model, x)) < 1e-24
    assert np.abs(inner_force(model, x)).max() < 1e-11


def test_the_hessian_of_a_spring_lattice() -> None:
    """Where all springs are stretched, the projected stiffness is the exact derivative of the force."""
    model = assemble(small(), np.zeros(len(small().stiffness)))
    x = 1.2 * model.points
    way = np.random.default_rng(0).standard_normal(x.shape)
    eps = 1e-6
    change = (inner_force(model, x + eps * way) - inner_force(model, x - eps * way)) / (2 * eps)
    np.testing.assert_allclose((model.stiffness_at(x) @ way.ravel()).reshape(-1, 3), -change, atol=1e-6)


def test_beyond_its_range_a_spring_is_a_hundred_times_stiffer() -> None:
    """l0 (0.3, 1.7) with a ramp of 100 outside (section 1); a spring of no length makes no NaN."""
    ends = np.zeros(1, dtype=np.int32)
    spring = kernels.LatticeSprings(ends, ends + 1, np.ones(1), np.ones(1), np.full(1, 0.3), np.full(1, 1.7), 100.0)

    def pull(length: float) -> float:
        force = np.zeros((2, 3))
        kernels.spring_force(np.array([[0.0, 0, 0], [length, 0, 0]]), spring, force)
        return float(force[0, 0])

    assert pull(1.5) == pytest.approx(0.5) and pull(0.4) == pytest.approx(-0.6)
    assert pull(1.8) == pytest.approx(0.7 + 100 * 0.1) and pull(0.2) == pytest.approx(-0.7 - 100 * 0.1)
    assert pull(0.0) == 0.0


def test_constant_strain_is_exact_in_a_hexahedron() -> None:
    """A homogeneous lattice gives its own elasticity back, but for its softer surface; 6 rigid modes, 18 stiff ones.

    In shear the body diagonals pull the surface's nodes in and out, where no neighbour balances them: up to 5 % softer.
    """
    tree = octree.block((4, 4, 4), 0.5)
    cube = harmonic.cubes(tree, np.full(64, 2.0))[1][0]
    value = np.linalg.eigvalsh(cube)
    assert (np.abs(value[:6]) < 1e-9 * value[-1]).all() and value[6] > 1e-3 * value[-1]
    c44 = (1 / 3 + 1 / 3) * 2.0 / 0.5
    for strain, energy in (((1, 0, 0, 0, 0, 0), 1.5 * c44), ((0, 0, 0, 1, 0, 0), 0.5 * c44)):
        e = np.array([[strain[0], strain[5] / 2, strain[4] / 2], [strain[5] / 2, strain[1], strain[3] / 2],
                      [strain[4] / 2, strain[3] / 2, strain[2]]])  # fmt: skip
        u = (octree.CORNERS @ e.T).ravel()
        assert 0.95 * energy < 0.5 * u @ cube @ u < energy * (1 + 1e-6)


def moved(model: Model, x: np.ndarray, v: np.ndarray, force: np.ndarray, fixed: np.ndarray, **how: float) -> None:
    """Step `x` and `v` in place with the nodes `fixed` held."""
    free = ~fixed
    free[model.tables.slaves.node] = False
    inverse = np.zeros(len(x))
    inverse[free] = 1.0 / model.mass[free]
    ties = len(model.tables.ties.stiffness)
    none = np.zeros((0, 3))
    kernels.advance(
        x, v, force, model.tables, inverse, np.zeros(0, np.int32), none, np.zeros((ties, 3)), np.zeros((ties, 3)),
        how["dt"], how["drag"], np.inf, int(how["count"]), np.zeros_like(x),
    )  # fmt: skip


def test_momentum_is_kept() -> None:
    """A free block thrown crumpled keeps its linear momentum to rounding and its angular momentum as well as Euler does."""
    for hard in (False, True):
        model = mixed(hard=hard)
        x, free = crumpled(model, 0.1), model.free_mask()
        v = np.random.default_rng(5).standard_normal(x.shape)
        kernels.follow(v, model.tables.slaves)
        before = model.mass @ np.where(free[:, None], v, 0.0)
        moved(model, x, v, np.zeros_like(x), np.zeros(len(x), bool), dt=1e-3, drag=0.0, count=300)
        np.testing.assert_allclose(model.mass @ np.where(free[:, None], v, 0.0), before, atol=1e-12)


def test_energy_does_not_drift() -> None:
    """Symplectic Euler far below the stable step: the energy of a swinging block stays within a percent over 5,000 steps."""
    model = uniform(lattice(), 1)
    x, v = model.points.copy(), np.zeros_like(model.points)
    x[:, 2] += 0.02 * x[:, 0] ** 2
    fixed = on_face(model.points, 0, 0.0)
    start = inner_energy(model, x)
    for _ in range(10):
        moved(model, x, v, np.zeros_like(x), fixed, dt=0.002, drag=0.0, count=500)
        now = inner_energy(model, x) + 0.5 * float(model.mass @ (v**2).sum(axis=1))
        assert now == pytest.approx(start, rel=0.02)


def test_motion_dies_down_to_the_equilibrium() -> None:
    """Symplectic Euler with damping comes to rest where Newton does, to 1e-12 of the displacement (section 3: 3e-14)."""
    for level in (1, 2):
        model = uniform(lattice(), level)
        from lattices import fine_nodes

        force = fine_nodes(model).T @ load("bend", uniform(lattice(), 0))
        u = settled(model, force, "bend")
        x, v = model.points.copy(), np.zeros_like(model.points)
        fixed = on_face(model.points, 0, 0.0)
        moved(model, x, v, force, fixed, dt=0.5 * model.largest_step(), drag=0.35, count=14_000 // level)
        np.testing.assert_allclose(x - model.points, u, atol=1e-12 * np.abs(u).max())


def test_beyond_the_stable_step_it_explodes() -> None:
    """1.02 dt_crit grows, 0.98 dt_crit does not: the bound is sharp."""
    model = uniform(lattice(), 1)
    fixed = np.zeros(len(model.points), dtype=bool)
    sizes = []
    for factor in (0.98, 1.02):
        x = model.points + 1e-9 * np.random.default_rng(0).standard_normal(model.points.shape)
        v = np.zeros_like(x)
        moved(model, x, v, np.zeros_like(x), fixed, dt=factor * model.largest_step(), drag=0.0, count=400)
        sizes.append(np.abs(x - model.points).max())
    assert sizes[0] < 1e-6 and not sizes[1] < 1e-6


@pytest.mark.parametrize("hard", [False, True])
def test_changing_cells_keeps_momentum(hard: bool) -> None:
    """From any cut to any other: total momentum to 1e-13; refining also keeps every position it had (section 5)."""
    at = lattice()
    rng = np.random.default_rng(0)
    old = assemble(at, np.where(PLACE[:, 0] < 8, 0, 1), hard=hard)
    x, v = crumpled(old, 0.05), rng.standard_normal(old.points.shape)
    kernels.follow(v, old.tables.slaves)
    before = np.einsum("ca,cad->d", old.own_mass, v[old.corner])
    for _ in range(4):
        new = assemble(at, rng.integers(0, 4, LEAVES) * (rng.random(LEAVES) < 0.01), hard=hard)
        _, velocity = transfer(old, new, x, v)
        after = np.einsum("ca,cad->d", new.own_mass, velocity[new.corner])
        np.testing.assert_allclose(after, before, atol=1e-13 * np.abs(old.own_mass[:, :, None] * v[old.corner]).sum())
    coarse, fine = uniform(at, 2), uniform(at, 0)
    x = crumpled(coarse, 0.05)
    up, _ = transfer(coarse, fine, x, np.zeros_like(x))
    back, _ = transfer(fine, coarse, up, np.zeros_like(up))
    np.testing.assert_allclose(back, x, atol=1e-13)


def hits(model: Model, beta: float, trials: int, steps: int, scale: float) -> tuple[int, int, int]:
    """Return flagged and inverted, flagged, and inverted cells over random nodal forces of about `scale` times critical."""
    rng = np.random.default_rng(7)
    dt = 0.5 * model.largest_step()
    both = flagged = inverted = 0
    unit = model.mass[:, None] * model.side.min() / dt**2
    free = np.zeros(len(model.points), dtype=bool)
    for _ in range(trials):
        force = scale * rng.random() * unit * rng.standard_normal(model.points.shape)
        flag = unsafe_cells(model, force, dt, beta)
        x, v = model.points.copy(), np.zeros_like(model.points)
        moved(model, x, v, force, free, dt=dt, drag=0.0, count=steps)
        turned = model.least_volume(x) <= 0.0
        both, flagged, inverted = both + (flag & turned).sum(), flagged + flag.sum(), inverted + turned.sum()
    return int(both), int(flagged), int(inverted)


@pytest.mark.slow
def test_the_hit_rate_of_the_safe_boxes() -> None:
    """8 x 4 x 4 cells, dt = dt_crit / 2, 1,500 random loads: one step misses nothing at 1/6, some at .49 (section 4).

    Precision depends on how forces are spread, which the specification leaves open; the order of the three does not.
    """
    model = uniform(lattice(), 1)
    one = {beta: hits(model, beta, 1500, 1, 0.5) for beta in (SAFE_BETA, 0.25, 0.49)}
    assert one[SAFE_BETA][2] > 1000
    assert one[SAFE_BETA][0] == one[SAFE_BETA][2]
    assert one[0.25][0] == one[0.25][2]
    assert 0.99 < one[0.49][0] / one[0.49][2] <= 1.0
    precision = [one[beta][0] / one[beta][1] for beta in (SAFE_BETA, 0.25, 0.49)]
    assert precision[0] < precision[1] < precision[2]


def test_one_step_cannot_invert_a_safe_cell() -> None:
    """With beta below 1/6 every cell that one step inverts was flagged, whatever the force."""
    model = uniform(lattice(), 2)
    both, flagged, inverted = hits(model, SAFE_BETA, 200, 1, 1.0)
    assert both == inverted > 50 and flagged >= inverted


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_force_that_inverts_in_one_step(level: int) -> None:
    """A node of the end face pushed inward by a whole side turns its cells: F = h m / dt^2, 3.5 to 4.2 times more a level.

    The specification's .62 at dt = .0151 is the first of a coarse scan that inverts; the exact figure is .535.
    """
    model = uniform(lattice(), level)
    node = int(np.argmin(np.linalg.norm(model.points - [2.0, 0.5, 0.5], axis=1)))
    dt = 0.5 * model.largest_step()
    exact = model.side[0] * model.mass[node] / dt**2
    assert exact == pytest.approx((0.535, 2.15, 8.9)[level], rel=0.03)
    for factor, turned in ((0.99, False), (1.01, True)):
        force = np.zeros_like(model.points)
        force[node, 0] = -factor * exact
        x, v = model.points.copy(), np.zeros_like(model.points)
        moved(model, x, v, force, np.zeros(len(x), bool), dt=dt, drag=0.0, count=1)
        assert (model.least_volume(x).min() <= 0.0) == turned


def test_volumes_of_cells() -> None:
    """The least corner Jacobian is 1 at rest, stays under turns, and is the stretch under a homogeneous stretch."""
    model = uniform(lattice(), 1)
    np.testing.assert_allclose(model.least_volume(crumpled(model, 0.0)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(model.least_volume(model.points * [1.5, 0.5, 1.0]), 0.75, rtol=1e-12)
    assert len(TREE.levels) == 5
