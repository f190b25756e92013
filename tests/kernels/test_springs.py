"""The elastic force: the gradient of its energy, and exactly what the paper's equations say."""

from itertools import pairwise

import numpy as np
import pytest
from spring_meshes import deformed, evaluate, hessian, sheet, springs_of

from faceanim.kernels.spring_triangle import BLOCK
from faceanim.kernels.springs import elastic_energy
from faceanim.kernels.tables import Law, Springs

LAWS = [
    Law(0.0, 1.0, 2.0, 1),
    Law(1.0, 1.0, 2.0, 1),
    Law(2.0, 0.7, 3.0, 1),
    Law(3.0, 2.0, 1.0, 1),
    Law(0.7, 1.3, 2.0, 1),
    Law(1.0, 1.3, 2.5, 1),
    Law(0.35, 0.9, 1.3, 1),
    Law(5.0, 3.0, 4.0, 1),
]


def plain_force(x: np.ndarray, springs: Springs, law: Law) -> np.ndarray:
    """Return the forces spring by spring, from Eqs. 1-4 and 14 as written, without a word about efficiency."""
    out = np.zeros_like(x)
    corners = np.stack([springs.a, springs.b, springs.c])
    for q in range(springs.a.size):
        for k in range(3):
            i, j, m = corners[k, q], corners[(k + 1) % 3, q], corners[(k + 2) % 3, q]
            axis = x[m] - x[j]
            s = np.linalg.norm(axis) - springs.edge_length[k, q]
            f = springs.edge_stiffness[k, q] * (1 + (s / law.s0) ** 2) ** law.alpha * s * axis / np.linalg.norm(axis)
            out[j] += f
            out[m] -= f
            t = (x[i] - x[j]) @ axis / (axis @ axis)
            foot = (1 - t) * x[j] + t * x[m]
            h, d = np.linalg.norm(x[i] - foot), springs.height[k, q]
            g = -springs.height_stiffness[k, q] * (1 + ((h - d) / law.s0) ** 2) ** law.alpha * (h - d)
            g += springs.repulsion[k, q] * ((d / h) ** law.beta - 1)
            f = g * (x[i] - foot) / h
            out[i] += f
            if law.reaction:
                out[j] -= (1 - t) * f
                out[m] -= t * f
    return out


@pytest.mark.parametrize("reaction", [0, 1])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
def test_force_is_that_of_the_equations(law: Law, reaction: int) -> None:
    """The block kernel gives the sum of the single springs' forces, whole and broken exponents alike."""
    points, triangles = sheet(9, 8)
    springs = springs_of(points, triangles)
    law = law._replace(reaction=reaction)
    x = deformed(points)
    expected = plain_force(x, springs, law)
    force = evaluate(x, springs, law)[:, :3]
    np.testing.assert_allclose(force, expected, rtol=0, atol=3e-13 * np.abs(expected).max())


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
def test_force_is_minus_the_gradient_of_the_energy(law: Law) -> None:
    """With reaction, F = -dU/dx by central differences of fourth order."""
    points, triangles = sheet(5, 5)
    springs = springs_of(points, triangles)
    x = deformed(points, 0.2)
    force = evaluate(x, springs, law)[:, :3]
    step = 1e-3
    for i in range(0, len(x), 3):
        for d in range(3):
            values = []
            for k in (-2, -1, 1, 2):
                moved = x.copy()
                moved[i, d] += k * step
                values.append(elastic_energy(moved, springs, law))
            slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
            assert slope == pytest.approx(-force[i, d], abs=2e-7 * np.abs(force).max())


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
def test_no_net_force_and_no_net_torque(law: Law) -> None:
    """With reaction, forces and torques add up to zero to round-off; without it (the paper's form) they do not."""
    points, triangles = sheet(20, 15)
    springs = springs_of(points, triangles)
    x = deformed(points)
    force = evaluate(x, springs, law)[:, :3]
    scale = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-14 * scale
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-14 * scale * np.abs(x).max()
    force = evaluate(x, springs, law._replace(reaction=0))[:, :3]
    assert np.abs(force.sum(axis=0)).max() > 1e-3 * np.abs(force).max()


@pytest.mark.parametrize("law", [LAWS[1], LAWS[6]])
def test_rest_and_rigid_motion_give_no_force(law: Law) -> None:
    """g(d) = 0: no force and no energy at rest, nor after a rotation and a translation."""
    points, triangles = sheet(12, 11)
    springs = springs_of(points, triangles)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for x in (points, points @ turn.T + [3.0, -70.0, 11.0]):
        assert np.abs(evaluate(x, springs, law)[:, :3]).max() < 1e-10
        assert abs(elastic_energy(x, springs, law)) < 1e-20
    assert (evaluate(points, springs, law)[:, 3] > 0).all()


def one_triangle(height: float, foot: float = 0.4) -> np.ndarray:
    """Return corners B, C of a base of 2 mm on the x axis and A at `height` above the place `foot` of it."""
    return np.array([[2.0 * foot, height, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])


def test_repulsion_alone_in_one_triangle() -> None:
    """Only the height of corner A has a spring: A feels g = zeta ((d/h)^beta - 1) along the height, exactly."""
    rest = one_triangle(1.5)
    springs = springs_of(rest, np.array([[0, 1, 2]], np.int32))
    single = np.zeros((3, 1))
    single[0] = 7.0
    springs = springs._replace(edge_stiffness=0.0 * single, height_stiffness=0.0 * single, repulsion=single)
    for beta in (1.0, 2.0, 1.7):
        for h in (1.5, 0.9, 2.5, 1e-3):
            force = evaluate(one_triangle(h), springs, Law(1.0, 1.0, beta, 1))[:, :3]
            g = 7.0 * ((1.5 / h) ** beta - 1)
            np.testing.assert_allclose(force, [[0, g, 0], [0, -0.6 * g, 0], [0, -0.4 * g, 0]], atol=1e-12 + 1e-13 * g)


def test_repulsion_grows_without_bound() -> None:
    """g -> infinity as h -> 0, so that a triangle under repulsion does not invert; the energy does so too."""
    rest = one_triangle(1.5)
    springs = springs_of(rest, np.array([[0, 1, 2]], np.int32))
    law = Law(1.0, 1.0, 2.0, 1)
    pushes = [evaluate(one_triangle(10.0**-k), springs, law)[0, 1] for k in range(1, 9)]
    energies = [elastic_energy(one_triangle(10.0**-k), springs, law) for k in range(1, 9)]
    assert all(later > 50 * earlier for earlier, later in pairwise(pushes))
    assert all(later > 5 * earlier for earlier, later in pairwise(energies))


@pytest.mark.parametrize("foot", [-0.8, 1.9])
def test_obtuse_triangle(foot: float) -> None:
    """A foot outside the edge (t < 0 or t > 1) pulls one end and pushes the other: F_b = -(1-t) g, F_c = -t g."""
    springs = springs_of(one_triangle(1.5, foot), np.array([[0, 1, 2]], np.int32))
    x = one_triangle(1.2, foot)
    force = evaluate(x, springs, LAWS[1])[:, :3]
    np.testing.assert_allclose(force, plain_force(x, springs, LAWS[1]), rtol=1e-12, atol=1e-12)
    assert np.abs(force.sum(axis=0)).max() < 1e-12
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-12


@pytest.mark.parametrize("law", [LAWS[0], LAWS[1], LAWS[2], LAWS[6]], ids=lambda law: f"{law.alpha}-{law.beta}")
@pytest.mark.parametrize("size", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("stretch", [0.6, 1.0, 1.6])
def test_stiffness_bounds_the_hessian(law: Law, size: float, stretch: float) -> None:
    """2 diag(k) - H is positive semidefinite at any state, which makes the semi-implicit step stable for every dt."""
    points, triangles = sheet(5, 4)
    springs = springs_of(points, triangles)
    x = points * [stretch, 1.0, 1.0] + np.random.default_rng(2).normal(0.0, size, points.shape)
    h = hessian(x, springs, law)
    assert np.abs(h - h.T).max() < 1e-5 * np.abs(h).max()
    root = np.sqrt(np.repeat(evaluate(x, springs, law)[:, 3], 3))
    largest = np.linalg.eigvalsh(0.5 * (h + h.T) / np.outer(root, root))[-1]
    assert 0.2 < largest < 2.0 + 1e-6


@pytest.mark.parametrize("rows", [2, BLOCK // 2 + 1, BLOCK // 2 + 2, 150])
def test_any_number_of_triangles(rows: int) -> None:
    """Whole blocks and broken ones, one triangle and many: the forces of the plain equations on the last vertices."""
    points, triangles = sheet(rows, 2)
    springs = springs_of(points, triangles)
    x = deformed(points)
    expected = plain_force(x, springs, LAWS[1])
    np.testing.assert_allclose(evaluate(x, springs, LAWS[1])[:, :3], expected, atol=1e-12 * np.abs(expected).max())


def test_large_mesh_and_repetition() -> None:
    """Asking for tables ahead on large meshes changes nothing; repeated runs are the same to the byte."""
    points, triangles = sheet(150, 120)
    springs = springs_of(points, triangles)
    x = deformed(points)
    first = evaluate(x, springs, LAWS[1])
    assert first.tobytes() == evaluate(x, springs, LAWS[1]).tobytes()
    rows = triangles[:200]
    part = springs_of(points, rows)
    picked = [array[:, :200] for array in springs[3:8]]
    part = part._replace(**dict(zip(Springs._fields[3:8], map(np.ascontiguousarray, picked), strict=True)))
    inner = [i for i in range(40, 60) if np.isin(np.flatnonzero((triangles == i).any(axis=1)), np.arange(200)).all()]
    small = evaluate(x, part, LAWS[1])
    np.testing.assert_allclose(first[inner], small[inner], rtol=1e-12)


def test_isolated_vertices_and_no_triangles() -> None:
    """A vertex without triangles has neither force nor stiffness."""
    points, triangles = sheet(4, 4)
    springs = springs_of(np.vstack([points, [[0.0, 0.0, 9.0]]]), triangles)
    out = evaluate(np.vstack([deformed(points), [[1.0, 2.0, 3.0]]]), springs, LAWS[1])
    assert (out[-1] == 0).all() and (out[:-1, 3] > 0).all()
    none = springs_of(points, triangles[:0])
    assert (evaluate(points, none, LAWS[1]) == 0).all()
    assert elastic_energy(points, none, LAWS[1]) == 0.0


def test_coincident_corners_give_no_nan_from_structural_springs() -> None:
    """An edge of length zero has no direction and so no force, rather than a NaN that spreads."""
    points, triangles = sheet(4, 4)
    springs = springs_of(points, triangles)
    springs = springs._replace(height_stiffness=0.0 * springs.height, repulsion=0.0 * springs.height)
    x = points.copy()
    x[5] = x[6]
    assert np.isfinite(evaluate(x, springs, LAWS[0])[:, :3]).all()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of plain Python, where kernels are not compiled
@pytest.mark.parametrize("law", [LAWS[1], LAWS[6]])
def test_a_lost_vertex_shows(law: Law) -> None:
    """A position that is no number gives forces that are none, there and on the neighbours, so that it is noticed."""
    points, triangles = sheet(6, 6)
    springs = springs_of(points, triangles)
    x = deformed(points)
    x[14, 1] = np.nan
    near = np.unique(triangles[(triangles == 14).any(axis=1)])
    lost = np.isnan(evaluate(x, springs, law)[:, :3]).any(axis=1)
    assert (np.flatnonzero(lost) == near).all()
