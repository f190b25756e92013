"""Triangular shells: derivatives, rigid motion, patches, carried points, threads and refusals."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from shell_meshes import grid_points, grid_triangles

from faceanim.elements.newton import newton
from faceanim.elements.shells import LAWS, Sheet, Shells, ShellSystem
from faceanim.ground.errors import UserError
from faceanim.kernels.shells import tilt_factor

EVERY = pytest.mark.parametrize("law", LAWS)
C10, C01 = 186.164, -151.093


def sheet(law: str, thickness: float = 0.8) -> Sheet:
    """Return a sheet of this law, as stiff as skin."""
    if law in ("linear", "neo_hookean"):
        return Sheet.elastic(thickness, 200.0, 0.45, law, drilling=1e-3)
    return Sheet.rubber(thickness, C10, C01, law, drilling=1e-3)


def dome(law: str, *, offset: bool = True) -> Shells:
    """Return a crooked, curved patch of 16 triangles with an offset that differs from node to node."""
    rng = np.random.default_rng(2)
    points = grid_points((4, 2), (0.0, 0.0), (4.0, 2.2), lambda u, v: (u, v, 0.15 * u * (4.0 - u) + 0.2 * v * v))
    points[:, :2] += 0.1 * rng.uniform(-1.0, 1.0, (len(points), 2))
    arm = 0.3 * rng.standard_normal(points.shape) + np.array([0.0, 0.0, 0.4]) if offset else None
    return Shells(points, grid_triangles((4, 2), "crossed"), sheet(law), offset=arm)


def shaken(shells: Shells, amount: float = 0.05) -> np.ndarray:
    """Return a deformed state far from rest: all turned by the same large rotation, then shaken."""
    rng = np.random.default_rng(4)
    turn = Rotation.from_rotvec([0.7, -1.1, 0.6])
    m = len(shells.carrier)
    x = np.concatenate([shells.carrier @ turn.as_matrix().T, np.tile(turn.as_rotvec(), (m, 1))])
    return x + amount * rng.standard_normal(x.shape)


@EVERY
def test_forces_are_the_slope_of_the_energy(law: str) -> None:
    """Force = -grad energy by central differences, for every freedom."""
    system = ShellSystem(dome(law))
    x = shaken(system.shells)
    forces, h = system.forces(x), 1e-5
    for node, axis in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[node, axis] = h
        slope = (system.energy(x + step) - system.energy(x - step)) / (2.0 * h)
        assert -forces[node, axis] == pytest.approx(slope, abs=1e-7 * np.abs(forces).max())


@EVERY
def test_stiffness_is_the_slope_of_the_forces(law: str) -> None:
    """The tangent, the elements' blocks and -grad force by central differences agree; it is symmetric."""
    shells = dome(law)
    x = shaken(shells)
    block = shells.stiffnesses(x)
    scale, h = np.abs(block).max(), 1e-5
    for axis in range(18):
        step = np.zeros_like(x)
        step[shells.node[5].repeat(3)[axis], axis % 3] = h
        slope = -(shells.forces(x + step)[5] - shells.forces(x - step)[5]).ravel() / (2.0 * h)
        np.testing.assert_allclose(block[5, :, axis], slope, atol=2e-7 * scale)
    np.testing.assert_array_equal(block, block.transpose(0, 2, 1))
    d = np.random.default_rng(0).standard_normal(x.shape)
    system = ShellSystem(shells)
    bend = (system.forces(x - h * d) - system.forces(x + h * d)).ravel() / (2.0 * h)
    np.testing.assert_allclose(system.tangent(x) @ d.ravel(), bend, atol=3e-7 * np.abs(bend).max())


@EVERY
def test_the_definite_tangent_has_no_negative_eigenvalue(law: str) -> None:
    """`definite` raises negative eigenvalues to zero, element by element, and leaves definite elements alone."""
    shells = dome(law)
    x = shaken(shells)
    plain, definite = shells.stiffnesses(x), shells.stiffnesses(x, definite=True)
    value, vector = np.linalg.eigh(plain)
    assert value.min() < -1e-3 * value.max(), "this state must be a test"
    raised = np.einsum("eik,ek,ejk->eij", vector, np.maximum(value, 0.0), vector)
    np.testing.assert_allclose(definite, raised, atol=1e-10 * np.abs(plain).max())
    np.testing.assert_array_equal(shells.stiffnesses(shells.points, definite=True), shells.stiffnesses(shells.points))


@EVERY
@pytest.mark.parametrize("degrees", [30.0, 100.0, 179.0])
def test_rigid_motion_gives_no_force(law: str, degrees: float) -> None:
    """Turned by 30 degrees and more, with an offset: no energy and no force, also on top of an earlier rotation."""
    shells = dome(law)
    axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    turn = Rotation.from_rotvec(np.radians(degrees) * axis)
    m = len(shells.carrier)
    stiff = np.abs(shells.stiffnesses(shells.points)).max()
    x = np.concatenate([shells.carrier @ turn.as_matrix().T + 3.0, np.tile(turn.as_rotvec(), (m, 1))])
    for _ in range(2):
        assert np.abs(shells.forces(x)).max() < 3e-14 * stiff
        assert shells.energies(x).max() < 1e-13
        np.testing.assert_allclose(shells.stretches(x), 1.0, rtol=1e-13)
        x = shells.rebase(x)
        x[:m] = x[:m] @ turn.as_matrix().T
        x[m:] = turn.as_rotvec()


@EVERY
def test_six_motions_of_a_triangle_are_free(law: str) -> None:
    """At rest a triangle's stiffness has 3 + 3 zero eigenvalues, the rigid motions, and 12 positive ones."""
    shells = dome(law)
    value = np.linalg.eigvalsh(shells.stiffnesses(shells.points))
    assert np.abs(value[:, :6]).max() < 1e-13 * value.max()
    assert value[:, 6].min() > 1e-6 * value.max()


@EVERY
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_energy_does_not_depend_on_the_point_of_view(law: str, seed: int) -> None:
    """A rotation of a deformed shell leaves its energy, and turns its forces."""
    shells = dome(law)
    m = len(shells.carrier)
    x = shaken(shells, 0.03)
    turn = Rotation.random(random_state=seed)
    seen = np.concatenate([x[:m] @ turn.as_matrix().T, (turn * Rotation.from_rotvec(x[m:])).as_rotvec()])
    np.testing.assert_allclose(shells.energies(seen), shells.energies(x), rtol=1e-9)
    force = ShellSystem(shells).forces(x)[:m]
    np.testing.assert_allclose(
        ShellSystem(shells).forces(seen)[:m], force @ turn.as_matrix().T, atol=1e-9 * np.abs(force).max()
    )


@EVERY
def test_membrane_patch(law: str) -> None:
    """The edge of a flat, crooked patch moved affinely: the inside follows exactly, and stays flat."""
    points = grid_points((3, 3), (0.0, 0.0), (3.0, 3.0))
    inner = ((points[:, :2] > 0.1) & (points[:, :2] < 2.9)).all(axis=1)
    points[inner, :2] += np.random.default_rng(1).uniform(-0.25, 0.25, (int(inner.sum()), 2))
    shells = Shells(points, grid_triangles((3, 3)), sheet(law))
    m = len(points)
    F = np.array([[1.06, 0.05, 0.0], [-0.02, 0.97, 0.0], [0.3, -0.1, 1.0]])
    goal = shells.points.copy()
    goal[:m] = points @ F.T
    fixed = np.zeros((2 * m, 3), dtype=bool)
    fixed[:m][~inner] = True
    x, report = newton(ShellSystem(shells), fixed=fixed, values=goal, tolerance=1e-12)
    assert report.converged and report.definite is None
    np.testing.assert_allclose(x[:m], goal[:m], atol=1e-10)
    largest = np.linalg.svd(F[:, :2], compute_uv=False)[0]
    np.testing.assert_allclose(shells.stretches(x), largest, rtol=1e-10)


def test_constant_curvature_patch() -> None:
    """Values of w = (a x^2 + b x y + c y^2) / 2 on the edge of a crooked patch: the inside and the energy are exact."""
    points = grid_points((3, 3), (0.0, 0.0), (3.0, 3.0))
    inner = ((points[:, :2] > 0.1) & (points[:, :2] < 2.9)).all(axis=1)
    points[inner, :2] += np.random.default_rng(1).uniform(-0.25, 0.25, (int(inner.sum()), 2))
    plate = Sheet.elastic(0.3, 1e4, 0.3)
    system = ShellSystem(Shells(points, grid_triangles((3, 3)), plate))
    m = len(points)
    a, b, c = 0.7, -0.4, 0.3
    x, y = points[:, 0], points[:, 1]
    exact = np.zeros((2 * m, 3))
    exact[:m, 2] = 0.5 * (a * x * x + b * x * y + c * y * y)
    exact[m:, 0] = 0.5 * b * x + c * y
    exact[m:, 1] = -(a * x + 0.5 * b * y)
    stiffness = system.tangent(system.points)
    free = np.zeros((2 * m, 3), dtype=bool)
    free[:m][inner] = True
    free[m:][inner] = True
    factor = system.factorisation(free)
    assert factor.factor(stiffness.data)
    inside = factor.solve(np.zeros_like(exact), np.where(free, 0.0, exact))
    np.testing.assert_allclose(inside[free], exact[free], atol=1e-12)
    density = a * a + c * c + 2.0 * 0.3 * a * c + 0.5 * (1.0 - 0.3) * b * b
    energy = 0.5 * float(exact.ravel() @ (stiffness @ exact.ravel()))
    assert energy == pytest.approx(0.5 * plate.bending_stiffness * density * 9.0, rel=1e-12)


def test_drilling_holds_only_the_relative_turn() -> None:
    """Nodes that turn about the normal with their triangles are free; against them they meet alpha G h A."""
    shells = dome("linear")
    flat = Shells(grid_points((1, 1), (0.0, 0.0), (2.0, 1.0)), grid_triangles((1, 1)), sheet("linear"))
    angle = 0.02
    turned = flat.points.copy()
    turned[4:, 2] = angle
    stiff = 1e-3 * flat.sheets[0].shear_modulus * 0.8 * 2.0
    assert flat.energies(turned).sum() == pytest.approx(0.5 * stiff * np.sin(angle) ** 2, rel=1e-9)
    turned[:4] = Rotation.from_rotvec([0.0, 0.0, angle]).apply(turned[:4])
    assert flat.energies(turned).sum() < 1e-15
    assert shells.energies(shells.points).max() == pytest.approx(0.0, abs=1e-20)


@EVERY
def test_an_offset_is_nothing_but_another_place_of_the_nodes(law: str) -> None:
    """A shell carried at an arm has the energy and forces of one whose nodes are in its mid-surface."""
    arm = dome(law)
    plain = Shells(arm.carrier + arm.offset, arm.triangles, arm.sheets)
    x = shaken(arm)
    m = len(arm.carrier)
    there = np.concatenate([arm.middle(x), x[m:]])
    np.testing.assert_allclose(arm.energies(x), plain.energies(there), rtol=1e-12)
    force, expected = arm.forces(x), plain.forces(there)
    np.testing.assert_allclose(force[:, :3], expected[:, :3], atol=1e-12 * np.abs(expected).max())
    at_nodes = ShellSystem(plain).forces(there)
    expected = arm.attached_forces(x, arm.offset, at_nodes[:m])
    expected[m:] += at_nodes[m:]
    np.testing.assert_allclose(ShellSystem(arm).forces(x), expected, atol=1e-11 * np.abs(expected).max())


def test_rebase_keeps_every_place_and_force() -> None:
    """What is folded into the reference is not lost: mid-surface, energy and forces on positions stay the same."""
    shells = dome("tension")
    x = shaken(shells)
    m = len(shells.carrier)
    before = shells.middle(x), shells.energies(x), shells.forces(x)[:, :3], shells.rotations(x)
    y = shells.rebase(x)
    assert not y[m:].any() and (y[:m] == x[:m]).all()
    after = shells.middle(y), shells.energies(y), shells.forces(y)[:, :3], shells.rotations(y)
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(new, old, atol=1e-12 * np.abs(old).max())
    d = np.random.default_rng(0).standard_normal(y.shape)
    system, h = ShellSystem(shells), 1e-6
    slope = (system.energy(y + h * d) - system.energy(y - h * d)) / (2.0 * h)
    assert -float((system.forces(y) * d).sum()) == pytest.approx(slope, rel=1e-6)


def test_carried_points_and_their_loads_are_derivatives() -> None:
    """`attached_slopes` is the slope of `attached`, `attached_forces` its transpose, `attached_curvatures` the bend."""
    shells = dome("linear")
    x = shells.rebase(shaken(shells))
    m = len(shells.carrier)
    rng = np.random.default_rng(9)
    x[m:] = 0.8 * rng.standard_normal((m, 3))
    arm, force, d = rng.standard_normal((3, m, 3))
    h, step = 1e-5, np.concatenate([np.zeros((m, 3)), d])
    moved = (shells.attached(x + h * step, arm) - shells.attached(x - h * step, arm)) / (2.0 * h)
    slope = shells.attached_slopes(x, arm)
    np.testing.assert_allclose(np.einsum("mij,mj->mi", slope, d), moved, atol=1e-8)
    load = shells.attached_forces(x, arm, force)
    np.testing.assert_array_equal(load[:m], force)
    assert float((load * step).sum()) == pytest.approx(float((force * moved).sum()), rel=1e-8)
    bend = (shells.attached_forces(x + h * step, arm, force) - shells.attached_forces(x - h * step, arm, force))[m:]
    curvature = shells.attached_curvatures(x, arm, force)
    np.testing.assert_allclose(np.einsum("mij,mj->mi", curvature, d), bend / (2.0 * h), atol=1e-8)
    np.testing.assert_allclose(shells.attached(x, shells.offset), shells.middle(x), atol=1e-14)


def test_area_and_stretch() -> None:
    """A sheet stretched by 1.3 and 0.9 has 1.17 times its area, the largest stretch 1.3, and thins by 1 / 1.17."""
    shells = Shells(grid_points((2, 2), (0.0, 0.0), (2.0, 2.0)), grid_triangles((2, 2)), sheet("mooney_rivlin"))
    x = shells.points.copy()
    turn = Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix()
    x[:9] = (x[:9] * np.array([0.9, 1.3, 1.0])) @ turn.T
    np.testing.assert_allclose(shells.area_ratios(x), 1.17, rtol=1e-13)
    np.testing.assert_allclose(shells.stretches(x), 1.3, rtol=1e-13)
    np.testing.assert_allclose(shells.thickness_stretches(x), 1.0 / 1.17, rtol=1e-13)
    assert (shells.stretches(x) > shells.stretch_limits).all()
    assert shells.sheets[0].stretch_limit == pytest.approx(1.1100, abs=5e-5)
    assert sheet("tension").stretch_limit == np.inf


def test_a_triangle_without_area_has_no_finite_energy() -> None:
    """Corners brought onto a line: infinite energy, so that no search goes there, and no numbers for forces."""
    shells = Shells(np.eye(3), [[0, 1, 2]], sheet("tension"))
    x = shells.points.copy()
    x[2] = 0.5 * (x[0] + x[1])
    assert shells.energies(x)[0] == np.inf
    assert np.isnan(shells.forces(x)).all()
    assert np.isnan(shells.stiffnesses(x, definite=True)).all()


def test_the_tilt_factor_is_smooth() -> None:
    """g = alpha / sin alpha and its slopes, from one expression to the other and at rest."""
    cosine = np.concatenate([1.0 - np.geomspace(1e-12, 1e-3, 6), [0.6, 0.699999, 0.700001, 0.2, -0.5, -0.95]])
    for c in cosine:
        g, g1, g2 = tilt_factor(c)
        angle = 2.0 * np.arcsin(np.sqrt(0.5 * (1.0 - c)))
        assert g == pytest.approx(angle / np.sin(angle) if angle > 1e-5 else 1.0, rel=1e-9)
        h = 1e-6 if c < 0.999 else 0.0
        if h:
            above, below = tilt_factor(c + h), tilt_factor(c - h)
            assert g1 == pytest.approx((above[0] - below[0]) / (2.0 * h), rel=1e-7)
            assert g2 == pytest.approx((above[1] - below[1]) / (2.0 * h), rel=1e-6)
    np.testing.assert_allclose(tilt_factor(1.0), (1.0, -1.0 / 3.0, 4.0 / 15.0), rtol=1e-15)


def test_the_result_does_not_depend_on_threads() -> None:
    """Forces and tangent have the same bytes on one thread and on more."""
    system = ShellSystem(dome("tension"))
    x = shaken(system.shells)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = system.forces(x).tobytes(), system.tangent(x).data.tobytes()
        numba.set_num_threads(before)
        assert one == (system.forces(x).tobytes(), system.tangent(x).data.tobytes())
    finally:
        numba.set_num_threads(before)


def test_several_sheets() -> None:
    """Each triangle takes the sheet of its region."""
    points, triangles = grid_points((1, 1), (0.0, 0.0), (1.0, 1.0)), grid_triangles((1, 1))
    pair = (sheet("linear"), sheet("tension", 1.6))
    both = Shells(points, triangles, pair, [1, 0])
    x = both.points.copy()
    x[:4] *= np.array([1.1, 1.0, 1.0])
    alone = [Shells(points, triangles, s).energies(x) for s in pair]
    np.testing.assert_array_equal(both.energies(x), [alone[1][0], alone[0][1]])


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"thickness": 0.0}, "thickness"),
        ({"thickness": np.nan}, "thickness"),
        ({"young_modulus": -1.0}, "young_modulus"),
        ({"poisson_ratio": 0.6}, "poisson_ratio"),
        ({"drilling": 0.0}, "drilling"),
        ({"law": "tensoin"}, "tension"),
        ({"law": "mooney_rivlin"}, "c10"),
        ({"law": "mooney_rivlin", "c10": 1.0, "c01": -1.5}, "c01"),
        ({"law": "tension", "c10": 1.0, "c01": 0.5}, "mooney_rivlin"),
    ],
)
def test_an_impossible_sheet_is_refused(change: dict[str, Any], word: str) -> None:
    """Field, value and rule are named."""
    with pytest.raises(UserError, match=word):
        Sheet(**({"law": "linear", "thickness": 1.0, "young_modulus": 100.0, "poisson_ratio": 0.3} | change))


def test_bad_meshes_and_states_are_refused() -> None:
    """Triangles without area, wrong shapes and indices, and states of the wrong shape."""
    skin = sheet("linear")
    square = grid_points((1, 1), (0.0, 0.0), (1.0, 1.0))
    with pytest.raises(UserError, match="triangle 1 has an area"):
        Shells(square, [[0, 1, 2], [0, 1, 1]], skin)
    with pytest.raises(UserError, match="triangle 0 has an area"):
        Shells([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], skin)
    with pytest.raises(UserError, match="index 4, outside"):
        Shells(square, [[0, 1, 4]], skin)
    with pytest.raises(UserError, match="triangles is empty"):
        Shells(square, np.zeros((0, 3), dtype=int), skin)
    with pytest.raises(UserError, match="offset has shape"):
        Shells(square, [[0, 1, 2]], skin, offset=np.zeros((3, 3)))
    with pytest.raises(UserError, match="carrier has shape"):
        Shells(square[:, :2], [[0, 1, 2]], skin)
    with pytest.raises(UserError, match="region"):
        Shells(square, [[0, 1, 2]], skin, [1])
    shells = Shells(square, [[0, 1, 2]], skin)
    for call in (shells.energies, shells.forces, shells.stiffnesses, shells.rebase, shells.stretches, shells.middle):
        with pytest.raises(UserError, match="positions, then rotation vectors"):
            call(square)
    with pytest.raises(UserError, match="arm has shape"):
        shells.attached(shells.points, np.zeros(3))
    system = ShellSystem(shells)
    with pytest.raises(UserError, match="fixed has shape"):
        system.linear_answer(np.zeros((4, 3), dtype=bool), shells.points)
    with pytest.raises(UserError, match="loose"):
        system.linear_answer(np.zeros((8, 3), dtype=bool), np.zeros((8, 3)))


@pytest.mark.slow
def test_the_skin_of_a_face_takes_little_time() -> None:
    """2,178 triangles of skin: all stiffnesses in well below 0.1 s on one thread."""
    points = grid_points(
        (33, 33), (0.0, 0.0), (100.0, 100.0), lambda u, v: (u, v, 10.0 * np.sin(u / 20) * np.cos(v / 30))
    )
    shells = Shells(
        points, grid_triangles((33, 33)), sheet("tension", 1.5), offset=np.tile([0.0, 0.0, 0.75], (34**2, 1))
    )
    x = shells.points + 0.05 * np.random.default_rng(0).standard_normal(shells.points.shape)
    out = shells.stiffnesses(x)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        seconds = []
        for _ in range(7):
            start = perf_counter()
            shells.stiffnesses(x, out=out)
            seconds.append(perf_counter() - start)
    finally:
        numba.set_num_threads(before)
    assert min(seconds) < 0.08
