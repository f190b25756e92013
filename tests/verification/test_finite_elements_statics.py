"""Finite elements at rest: derivatives, patch test, beams, rubber, plates and torsion against exact solutions."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faceanim.elements.newton import newton
from faceanim.elements.tetrahedra import BARRIER, LAWS, Elements
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material

SOFT = Material("soft", 1000.0, 10.0, 0.3, 0.3)
TENSE = Material("tense", 1000.0, 10.0, 0.3, -4.0)
"""For the law "tension", which needs c01 <= 0."""
BOTH = pytest.mark.parametrize("order", [1, 2])
EVERY = pytest.mark.parametrize("law", LAWS)


def crooked(cells: tuple[int, int, int] = (2, 2, 2), size: tuple[float, float, float] = (1.0, 1.2, 0.9)) -> TetMesh:
    """Return a box whose inner nodes are moved at random."""
    box = box_tets(cells, size)
    inner = np.ones(len(box.points), dtype=bool)
    inner[box.boundary_nodes] = False
    points = box.points.copy()
    points[inner] += 0.12 * np.random.default_rng(1).uniform(-1.0, 1.0, (int(inner.sum()), 3)) / np.array(cells)
    return TetMesh(points, box.tets)


def soft(law: str) -> Material:
    """Return the material that suits a law."""
    return TENSE if law == "tension" else SOFT


def outside(elements: Elements) -> np.ndarray:
    """Return which nodes are on the faces of the bounding box, (n,)."""
    x = elements.points
    return ((np.abs(x - x.min(axis=0)) < 1e-9) | (np.abs(x - x.max(axis=0)) < 1e-9)).any(axis=1)


def faces_at(elements: Elements, axis: int, place: float) -> np.ndarray:
    """Return the boundary triangles in the plane `axis` = `place`."""
    corner = elements.mesh.points[elements.mesh.boundary_triangles]
    return elements.mesh.boundary_triangles[(np.abs(corner[:, :, axis] - place) < 1e-9).all(axis=1)]


@BOTH
@EVERY
def test_forces_and_tangent_are_derivatives(law: str, order: int) -> None:
    """Force = -grad energy and tangent = -grad force by central differences; the tangent is symmetric."""
    elements = Elements(crooked(), soft(law), order=order, law=law)
    rng = np.random.default_rng(0)
    turn = Rotation.random(random_state=3).as_matrix() if law != "linear" else np.eye(3)
    x = (elements.points + 0.04 / order**2 * rng.standard_normal(elements.points.shape)) @ turn.T
    assert elements.volume_ratio(x).min() > 0.05
    d = rng.standard_normal(x.shape)
    h = 1e-6
    slope = (elements.energy(x + h * d) - elements.energy(x - h * d)) / (2.0 * h)
    assert -float((elements.forces(x) * d).sum()) == pytest.approx(slope, rel=1e-6)
    bend = (elements.forces(x - h * d) - elements.forces(x + h * d)).ravel() / (2.0 * h)
    tangent = elements.tangent(x)
    np.testing.assert_allclose(tangent @ d.ravel(), bend, atol=3e-7 * np.abs(bend).max())
    assert abs(tangent - tangent.T).max() < 1e-13 * abs(tangent).max()
    definite = elements.tangent(x, definite=True).toarray()
    assert np.linalg.eigvalsh(definite).min() > -1e-12 * np.abs(definite).max()


@BOTH
@EVERY
def test_rigid_motion_gives_no_force(law: str, order: int) -> None:
    """A translation (and for nonlinear laws a rotation) costs nothing, to round-off."""
    elements = Elements(crooked(), soft(law), order=order, law=law)
    turn = np.eye(3) if law == "linear" else Rotation.from_euler("xyz", [50.0, -140.0, 20.0], degrees=True).as_matrix()
    x = elements.points @ turn.T + np.array([3.0, -2.0, 5.0])
    assert np.abs(elements.forces(x)).max() < 1e-13 * abs(elements.tangent(elements.points)).max()
    assert elements.energy(x) == pytest.approx(0.0, abs=1e-12)


@BOTH
@EVERY
def test_patch_test(law: str, order: int) -> None:
    """Affine movement of the boundary: the inside follows to round-off, with the exact F in every element."""
    elements = Elements(crooked(), soft(law), order=order, law=law)
    F = np.array([[1.2, 0.15, -0.1], [0.05, 0.9, 0.2], [-0.08, 0.1, 1.1]])
    exact = elements.points @ F.T + 0.3
    x, report = newton(elements, fixed=outside(elements), values=exact, tolerance=1e-13)
    assert report.converged
    np.testing.assert_allclose(x, exact, atol=2e-14 * 100)
    np.testing.assert_allclose(elements.volume_ratio(x), np.linalg.det(F), rtol=1e-12)


@BOTH
def test_traction_patch(order: int) -> None:
    """A uniform traction on rollers stretches a bar uniformly: sigma / E along, -nu sigma / E across."""
    elements = Elements(crooked((3, 2, 2), (1.5, 1.0, 1.0)), SOFT, order=order, law="linear")
    load = elements.traction(faces_at(elements, 0, 1.5), (2.0, 0.0, 0.0))
    assert load.sum(axis=0) == pytest.approx([2.0, 0.0, 0.0])
    x, _ = newton(elements, fixed=np.abs(elements.points) < 1e-9, force=load)
    strain = 2.0 / SOFT.young_modulus * np.array([1.0, -0.3, -0.3])
    np.testing.assert_allclose(x, elements.points * (1.0 + strain), atol=1e-12)


def test_the_result_does_not_depend_on_threads() -> None:
    """Forces and tangent have the same bytes on one thread and on two."""
    elements = Elements(crooked((3, 3, 3)), SOFT, order=2)
    x = elements.points + 0.02 * np.random.default_rng(5).standard_normal(elements.points.shape)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = elements.forces(x).tobytes(), elements.tangent(x).data.tobytes()
        numba.set_num_threads(before)
        assert one == (elements.forces(x).tobytes(), elements.tangent(x).data.tobytes())
    finally:
        numba.set_num_threads(before)


@BOTH
def test_mass_and_loads_add_up(order: int) -> None:
    """Consistent and lumped mass hold the body's mass; M integrates products exactly; body forces their integral."""
    elements = Elements(crooked(), SOFT, order=order)
    whole = 1000.0 * 1.0 * 1.2 * 0.9
    ones = np.zeros_like(elements.points)
    ones[:, 0] = 1.0
    assert ones.ravel() @ (elements.mass @ ones.ravel()) == pytest.approx(whole)
    assert elements.lumped_mass.sum() == pytest.approx(whole) and elements.lumped_mass.min() > 0.0
    np.testing.assert_allclose((elements.mass @ ones.ravel())[::3], elements.gravity_mass, atol=1e-12 * whole)
    linear = np.zeros_like(elements.points)
    linear[:, 0] = elements.points[:, 0]
    assert linear.ravel() @ (elements.mass @ linear.ravel()) == pytest.approx(whole / 3.0)
    load = elements.body_force(lambda p: np.stack([p[:, 0], np.ones(len(p)), 0.0 * p[:, 0]], axis=1))
    np.testing.assert_allclose(load.sum(axis=0), [1.2 * 0.9 * 0.5, 1.2 * 0.9, 0.0], atol=1e-13)


def test_wrong_requests_are_refused() -> None:
    """Unknown laws, orders, rules, folded elements, foreign faces and wrong arrays raise `UserError`."""
    mesh = box_tets((1, 1, 1), (1.0, 1.0, 1.0))
    for wrong in ({"law": "hooke"}, {"order": 3}, {"quadrature": 5}, {"region": [9] * 6}, {"middle": mesh.points}):
        with pytest.raises(UserError):
            Elements(mesh, SOFT, **wrong)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="inverted"):
        Elements(TetMesh(mesh.points, mesh.tets[:, [0, 2, 1, 3]]), SOFT)
    elements = Elements(mesh, SOFT, order=2)
    bent = elements.points[8:].copy()
    bent[0] += 5.0
    with pytest.raises(UserError, match="folded"):
        Elements(mesh, SOFT, order=2, middle=bent)
    with pytest.raises(UserError, match="edge"):
        elements.traction(np.array([[1, 2, 4]]), (1.0, 0.0, 0.0))
    with pytest.raises(UserError, match="shape"):
        elements.forces(mesh.points)
    with pytest.raises(UserError, match="fixed"):
        newton(elements, fixed=np.zeros(3, dtype=bool))
    with pytest.raises(UserError, match="force"):
        newton(elements, fixed=outside(elements), force=np.full_like(elements.points, np.nan))


def test_a_free_body_under_load_is_reported() -> None:
    """Nothing holds it: the search ends, says so, and keeps the last state instead of numbers that mean nothing."""
    elements = Elements(crooked(), SOFT)
    force = np.zeros_like(elements.points)
    force[:, 0] = 1.0
    x, report = newton(elements, fixed=np.zeros(len(force), dtype=bool), force=force, most=10)
    assert not report.converged and report.fraction < 1.0 and np.isfinite(x).all()


def test_small_cantilever() -> None:
    """P L^3 / 3EI + 6 P L / 5 G A within 0.2 %: L = 10, b = h = 1, E = 1e5, nu = 0.3, P = 1; the root may contract."""
    elements = Elements(box_tets((12, 2, 2), (10.0, 1.0, 1.0)), Material("m", 1.0, 1e5, 0.3), order=2)
    load = elements.traction(faces_at(elements, 0, 10.0), (0.0, -1.0, 0.0))
    root = elements.points[:, 0] < 1e-9
    across = np.abs(elements.points - 0.5) < 1e-9
    fixed = root[:, None] & np.stack([root, across[:, 1], across[:, 2]], axis=1)
    x, _ = newton(elements, fixed=fixed, force=load)
    tip = np.abs(elements.points[:, 0] - 10.0) < 1e-9
    assert (elements.points - x)[tip, 1].mean() == pytest.approx(0.040312, rel=2e-3)


def slender(cells: int, side: float) -> tuple[Elements, float]:
    """Return a clamped bar of length 1, nu = 0, and its bending stiffness EI."""
    elements = Elements(box_tets((cells, 1, 1), (1.0, side, side)), Material("m", 1.0, 1e5, 0.0), order=2)
    return elements, 1e5 * side**4 / 12.0


def tip_of(elements: Elements, force: np.ndarray) -> np.ndarray:
    """Return the mean movement of the end of a bar clamped at x = 0."""
    x, report = newton(elements, fixed=elements.points[:, 0] < 1e-9, force=force, check_definite=True)
    assert report.converged and report.definite
    end = np.abs(elements.points[:, 0] - 1.0) < 1e-9
    return (x - elements.points)[end].mean(axis=0)


@pytest.mark.parametrize(
    ("alpha", "down", "back"), [(1, 0.301721, 0.056433), (4, 0.669964, 0.328941), (10, 0.810609, 0.554996)]
)
def test_elastica_end_load(alpha: float, down: float, back: float) -> None:
    """Tip of the elastica under P = alpha EI / L^2 within 0.1 %, on a bar of slenderness 50."""
    elements, bending = slender(40, 0.02)
    load = elements.traction(faces_at(elements, 0, 1.0), (0.0, -alpha * bending / 0.02**2, 0.0))
    tip = tip_of(elements, load)
    assert -tip[1] == pytest.approx(down, rel=1e-3) and -tip[0] == pytest.approx(back, rel=1e-3)


@pytest.mark.parametrize(("beta", "down"), [(1, 0.123471), (4, 0.425159), (16, 0.797020)])
def test_elastica_own_weight(beta: float, down: float) -> None:
    """Tip of the elastica under its weight q = beta EI / L^3 within 0.1 %."""
    elements, bending = slender(40, 0.02)
    weight = elements.gravity_mass[:, None] * np.array([0.0, -beta * bending / 0.02**2, 0.0])
    assert -tip_of(elements, weight)[1] == pytest.approx(down, rel=1e-3)


RUBBER = Material.mooney_rivlin("rubber", 1.0, 1.0, 0.25, 2.0e4)
BALL = Material.mooney_rivlin("ball", 1.0, 1.0, 0.25, 2.0e3)


def rubber_cube(stretch: dict[int, float]) -> float:
    """Return the mean nominal stress on x = 1 of a unit cube on rollers, stretched along some axes, free else."""
    elements = Elements(crooked(size=(1.0, 1.0, 1.0)), RUBBER, law="mooney_rivlin")
    fixed = np.abs(elements.points) < 1e-9
    values = elements.points.copy()
    for axis, value in stretch.items():
        end = np.abs(elements.points[:, axis] - 1.0) < 1e-9
        fixed[end, axis] = True
        values[:, axis] *= value
    x, report = newton(elements, fixed=fixed, values=values)
    assert report.converged and report.least_ratio > 0.99
    return float(-elements.forces(x)[np.abs(elements.points[:, 0] - 1.0) < 1e-9, 0].sum())


@pytest.mark.parametrize(
    ("stretch", "nominal"),
    [({0: 0.6}, -6.170370), ({0: 1.5}, 2.462963), ({0: 2.0}, 3.9375), ({0: 3.0}, 6.259259),
     ({0: 2.0, 1: 2.0}, 7.875), ({0: 2.0, 1: 1.0}, 4.6875)],
    ids=["press", "pull-1.5", "pull-2", "pull-3", "equibiaxial", "pure-shear"],
)  # fmt: skip
def test_mooney_rivlin_cube(stretch: dict[int, float], nominal: float) -> None:
    """Nominal stress of nearly incompressible rubber, c10 = 1, c01 = 0.25, within 0.1 %."""
    assert rubber_cube(stretch) == pytest.approx(nominal, rel=1e-3)


def test_mooney_rivlin_simple_shear() -> None:
    """Shear stress 2 (c10 + c01) g, exactly linear in g."""
    elements = Elements(crooked(size=(1.0, 1.0, 1.0)), RUBBER, law="mooney_rivlin")
    x = elements.points + elements.points[:, 1:2] * np.array([1.0, 0.0, 0.0])
    x, _ = newton(elements, fixed=outside(elements), values=x)
    slid = -elements.forces(x)
    # every face carries its share of the traction, so the work of all of them over the shear is stress times volume
    work = float((slid * (elements.points[:, 1:2] * np.array([1.0, 0.0, 0.0]))).sum())
    assert work == pytest.approx(2.5, rel=1e-6)


def octant_shell(cells: tuple[int, int], inner: float = 1.0, outer: float = 1.5) -> Elements:
    """Return an octant of a thick rubber sphere in curved quadratic tetrahedra, cells (across, around)."""
    radial, around = cells
    parts, tets, count = [], [], 0
    for axis in range(3):
        box = box_tets((radial, around, around), (1.0, 1.0, 1.0))
        parts.append(np.roll(sphere_patch(box.points, inner, outer), axis, axis=1))
        tets.append(box.tets + count)
        count += len(box.points)
    points, index = welded(np.concatenate(parts))
    mesh = TetMesh(points, index[np.concatenate(tets)])
    straight = Elements(mesh, BALL, order=2)
    a, b = (mesh.points[straight.edges[:, k]] for k in (0, 1))
    length = 0.5 * (np.linalg.norm(a, axis=1) + np.linalg.norm(b, axis=1))
    middle = 0.5 * (a + b)
    middle *= (length / np.linalg.norm(middle, axis=1))[:, None]
    return Elements(mesh, BALL, order=2, law="mooney_rivlin", middle=middle)


def sphere_patch(box: np.ndarray, inner: float, outer: float) -> np.ndarray:
    """Map the unit box to the third of an octant around the x axis: a cube's face x = 1, blown up to a sphere."""
    direction = np.stack([np.ones(len(box)), box[:, 1], box[:, 2]], axis=1)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return direction * (inner + (outer - inner) * box[:, :1])


def welded(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct points and the index of each."""
    _, first, index = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[first], index.ravel().astype(np.int32)


@pytest.mark.slow
@pytest.mark.parametrize(("stretch", "pressure"), [(1.1, 0.565394), (2.0, 1.569686)])
def test_thick_sphere_inflation(stretch: float, pressure: float) -> None:
    """Pressure inside a rubber sphere, A = 1, B = 1.5, at an inner stretch, within 1 %: reactions over deformed area."""
    elements = octant_shell((2, 3))
    radius = np.linalg.norm(elements.points, axis=1)
    inside = np.abs(radius - 1.0) < 1e-9
    fixed = np.abs(elements.points) < 1e-9
    fixed[inside] = True
    values = np.where(inside[:, None], stretch * elements.points, elements.points)
    x, report = newton(elements, fixed=fixed, values=values)
    assert report.converged
    outward = elements.points[inside] / radius[inside, None]
    total = float((-elements.forces(x)[inside] * outward).sum())
    assert total / (0.5 * np.pi * stretch**2) == pytest.approx(pressure, rel=0.01)


def cook(cells: int, material: Material, law: str, *, thickness: float = 1.0) -> Elements:
    """Return Cook's membrane as a slab one element thick, in quadratic elements."""
    box = box_tets((cells, cells, 1), (1.0, 1.0, thickness))
    s, t, z = box.points.T
    points = np.stack([48.0 * s, 44.0 * s + t * (44.0 - 28.0 * s), z], axis=1)
    return Elements(TetMesh(points, box.tets), material, order=2, law=law)


def cook_moves(elements: Elements, traction: float, *, strain: bool) -> tuple[float, float]:
    """Return how far the middle of the loaded edge and its upper corner rise; plane strain or plane stress."""
    p = elements.points
    fixed = np.zeros(p.shape, dtype=bool)
    fixed[p[:, 0] < 1e-9, :2] = True
    fixed[:, 2] = True if strain else p[:, 2] < 1e-9
    load = elements.traction(faces_at(elements, 0, 48.0), (0.0, traction, 0.0))
    x, report = newton(elements, fixed=fixed, force=load)
    assert report.converged
    rise = x[:, 1] - p[:, 1]
    return tuple(float(rise[np.hypot(p[:, 0] - 48.0, p[:, 1] - y) < 1e-6].mean()) for y in (52.0, 60.0))  # type: ignore[return-value]


@pytest.mark.slow
def test_cook_linear_plane_stress() -> None:
    """E = 1, nu = 1/3, F = 1: the middle of the edge rises by 23.965."""
    elements = cook(16, Material("m", 1.0, 1.0, 1.0 / 3.0), "linear", thickness=0.5)
    middle, _ = cook_moves(elements, 1.0 / 16.0, strain=False)
    assert middle == pytest.approx(23.965, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("nu", "middle", "corner"), [(1.0 / 3.0, 30.745, 32.27), (0.499995, 26.43, 27.72)])
def test_cook_linear_plane_strain(nu: float, middle: float, corner: float) -> None:
    """E = 70, traction 6.25, compressible and nearly incompressible."""
    elements = cook(32, Material("m", 1.0, 70.0, nu), "linear")
    found = cook_moves(elements, 6.25, strain=True)
    assert found == pytest.approx((middle, corner), rel=5e-3)


@pytest.mark.slow
def test_torsion_of_a_square_bar() -> None:
    """Torque per twist G J / L with J = 0.140577 a^4, ends free to warp, within 0.1 %."""
    side, length, twist = 2.0, 3.0, 1e-3
    material = Material("m", 1.0, 260.0, 0.3)
    elements = Elements(box_tets((3, 10, 10), (length, side, side)), material, order=2, law="linear")
    p = elements.points - np.array([0.0, 0.5 * side, 0.5 * side])
    first, last = np.abs(p[:, 0]) < 1e-9, np.abs(p[:, 0] - length) < 1e-9
    fixed = np.zeros(p.shape, dtype=bool)
    fixed[first | last, 1:] = True
    fixed[np.argmin(np.linalg.norm(p, axis=1)), 0] = True
    angle = twist * np.where(last, 1.0, 0.0)
    values = elements.points + np.stack([0.0 * angle, -angle * p[:, 2], angle * p[:, 1]], axis=1)
    x, _ = newton(elements, fixed=fixed, values=values)
    reaction = -elements.forces(x)[last]
    torque = float((p[last, 1] * reaction[:, 2] - p[last, 2] * reaction[:, 1]).sum())
    constant = torque * length / (twist * material.shear_modulus * side**4)
    assert constant == pytest.approx(0.140577, rel=1e-3)


def manufactured(order: int, cells: int, law: str) -> float:
    """Return the L2 error of the displacement on a cube whose boundary and body force follow a known field."""
    mesh = box_tets((cells, cells, cells), (1.0, 1.0, 1.0))
    elements = Elements(mesh, Material("m", 1.0, 10.0, 0.3), order=order, law=law)
    known, load = sheared(elements) if law == "neo_hookean" else waving(elements)
    values = elements.points + known(elements.points)
    x, report = newton(elements, fixed=outside(elements), values=values, force=elements.body_force(load))
    assert report.converged
    value, _, weight = elements.rule(14)
    place = np.einsum("qa,eai->eqi", value, elements.points[elements.node])
    found = np.einsum("qa,eai->eqi", value, (x - elements.points)[elements.node])
    away = found - known(place.reshape(-1, 3)).reshape(place.shape)
    return float(np.sqrt((weight[:, :, None] * away**2).sum()))


def sheared(elements: Elements) -> tuple[Any, Any]:
    """u = f(y, z) e_x with F^-T = 2 I - F^T: P = mu (F - F^-T), so that the body force is -mu lap f, at any size."""
    mu, w = elements.materials[0].shear_modulus, 0.3

    def wave(p: np.ndarray) -> np.ndarray:
        return w * np.sin(2.0 * p[:, 1]) * np.cos(2.5 * p[:, 2])

    def along(value: np.ndarray) -> np.ndarray:
        return np.stack([value, 0.0 * value, 0.0 * value], axis=1)

    return (lambda p: along(wave(p))), (lambda p: along(mu * (4.0 + 6.25) * wave(p)))


def waving(elements: Elements) -> tuple[Any, Any]:
    """u = a sin(k . x) for linear elasticity: the body force is (mu |k|^2 a + (lambda + mu) (k . a) k) sin(k . x)."""
    m = elements.materials[0]
    a, k = np.array([0.1, -0.07, 0.05]), np.array([2.0, 1.5, -2.5])
    b = m.shear_modulus * (k @ k) * a + (m.lame_first + m.shear_modulus) * (k @ a) * k
    return (lambda p: np.sin(p @ k)[:, None] * a), (lambda p: np.sin(p @ k)[:, None] * b)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["linear", "neo_hookean"])
@pytest.mark.parametrize(("order", "slope"), [(1, 2.0), (2, 3.0)])
def test_order_of_accuracy(order: int, slope: float, law: str) -> None:
    """Manufactured solutions on four meshes: the displacement error falls as h^2 (linear) and h^3 (quadratic elements)."""
    cells = np.array([4, 6, 8, 12] if order == 1 else [2, 3, 4, 6])
    error = np.array([manufactured(order, int(n), law) for n in cells])
    found = -np.diff(np.log(error)) / np.diff(np.log(cells))
    assert found[-1] == pytest.approx(slope, abs=0.15)


def test_a_barrier_is_never_crossed() -> None:
    """Pressed to a tenth of its height, or hit by a huge force, a cube whose law has a barrier keeps det F > 0."""
    for law in BARRIER:
        elements = Elements(crooked(), soft(law), law=law)
        bottom = elements.points[:, 2] < 1e-9
        top = np.abs(elements.points[:, 2] - 0.9) < 1e-9
        values = elements.points * np.where(top[:, None], [1.0, 1.0, 0.1], 1.0)
        x, report = newton(elements, fixed=bottom | top, values=values)
        assert report.converged and report.least_ratio > 0.0 and report.valid
        force = np.where(top[:, None], [0.0, 0.0, -200.0], 0.0)
        x, report = newton(elements, fixed=bottom, force=force)
        assert elements.volume_ratio(x).min() > 0.0
        assert report.converged or report.fraction < 1.0
