"""Finite elements against scikit-fem, an independent library, and against known numbers of a hanging bar."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from faceanim.elements.newton import newton
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.tissue.material import Material

SOFT = Material("soft", 1.0, 10.0, 0.35)


def pair(order: int, law: str) -> tuple[Elements, Any, Any, np.ndarray]:
    """Return our elements, scikit-fem and its basis on the same crooked box, and its freedom for each of ours."""
    skfem = pytest.importorskip("skfem")
    box = box_tets((4, 2, 2), (2.0, 1.0, 1.0))
    p = box.points
    mesh = TetMesh(np.stack([p[:, 0] + 0.1 * p[:, 1] ** 2, p[:, 1] + 0.07 * p[:, 0], p[:, 2]], axis=1), box.tets)
    elements = Elements(mesh, SOFT, order=order, law=law)
    shape = skfem.ElementTetP1() if order == 1 else skfem.ElementTetP2()
    # four points, as ours, or one
    basis = skfem.Basis(
        skfem.MeshTet(mesh.points.T, mesh.tets.T.astype(np.int64)), skfem.ElementVector(shape), intorder=order
    )
    return elements, skfem, basis, matched(elements.points, basis)


def matched(points: np.ndarray, basis: Any) -> np.ndarray:
    """Return the freedom of `basis` at each of `points` for each axis, flat."""
    place = basis.doflocs.T
    out = np.empty((len(points), 3), dtype=np.int64)
    key = {(*np.round(x, 7), axis): None for x in points for axis in range(3)}
    count: dict[tuple[float, ...], int] = {}
    for dof, x in enumerate(place):  # the freedoms of one place come in the order of the axes
        at = tuple(np.round(x, 7))
        axis = count.get(at, 0)
        count[at] = axis + 1
        key[(*at, axis)] = dof
    for i, x in enumerate(points):
        for axis in range(3):
            dof = key[(*np.round(x, 7), axis)]
            assert dof is not None
            out[i, axis] = dof
    return out.ravel()


@pytest.mark.parametrize("order", [1, 2])
def test_linear_elasticity_as_scikit_fem(order: int) -> None:
    """The stiffness matrix agrees entry by entry to 1e-9, and so does the solution under a body force."""
    elements, skfem, basis, dof = pair(order, "linear")
    from skfem.models.elasticity import linear_elasticity

    theirs = linear_elasticity(SOFT.lame_first, SOFT.shear_modulus).assemble(basis)
    ours = elements.tangent(elements.points)
    assert abs(ours - theirs[dof][:, dof]).max() < 1e-9 * abs(ours).max()

    @skfem.LinearForm
    def weight(v: Any, w: Any) -> Any:
        return 0.1 * v[0] - 0.3 * v[1] + 0.0 * w.x[0]

    load = weight.assemble(basis)
    fixed = elements.points[:, 0] - 0.1 * elements.points[:, 1] ** 2 < 0.05
    x, _ = newton(elements, fixed=fixed, force=elements.gravity_mass[:, None] * np.array([0.1, -0.3, 0.0]))
    answer = skfem.solve(*skfem.condense(theirs, load, D=dof[np.repeat(fixed, 3)]))[dof].reshape(-1, 3)
    np.testing.assert_allclose(x - elements.points, answer, atol=1e-9 * np.abs(answer).max())


def neo_hookean_forms(skfem: Any, material: Material, dimension: int) -> tuple[Any, Any]:
    """Return residual and tangent of the classical law as scikit-fem forms; in two dimensions under plane strain."""
    from skfem.helpers import ddot, det, grad, inv, transpose

    mu, lame = material.shear_modulus, material.lame_first
    one = np.eye(dimension)[:, :, None, None]

    @skfem.LinearForm
    def residual(v: Any, w: Any) -> Any:
        F = grad(w["u"]) + one
        G = transpose(inv(F))
        return ddot(mu * (F - G) + lame * np.log(det(F)) * G, grad(v))

    @skfem.BilinearForm
    def tangent(u: Any, v: Any, w: Any) -> Any:
        F = grad(w["u"]) + one
        G = transpose(inv(F))
        turned = np.einsum("il...,kl...,kj...->ij...", G, grad(u), G)
        change = mu * grad(u) + (mu - lame * np.log(det(F))) * turned + lame * ddot(G, grad(u)) * G
        return ddot(change, grad(v))

    return residual, tangent


def solved(
    skfem: Any, basis: Any, forms: tuple[Any, Any], load: np.ndarray, fixed: np.ndarray, parts: int
) -> np.ndarray:
    """Return the displacement by plain Newton steps of scikit-fem's own matrices, the load in equal parts."""
    residual, tangent = forms
    u = np.asarray(basis.zeros())
    for part in range(1, parts + 1):
        for _ in range(25):
            state = basis.interpolate(u)
            right = load * part / parts - residual.assemble(basis, u=state)
            step = skfem.solve(*skfem.condense(tangent.assemble(basis, u=state), right, D=fixed))
            u = u + step
            if np.abs(step).max() < 1e-11:
                break
        else:
            raise AssertionError("scikit-fem's Newton steps did not converge")
    return u


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_neo_hookean_as_scikit_fem(order: int) -> None:
    """A bar bent far by its weight: the same positions to 1e-6 as with forms written and solved in scikit-fem."""
    elements, skfem, basis, dof = pair(order, "neo_hookean")
    fixed = elements.points[:, 0] - 0.1 * elements.points[:, 1] ** 2 < 0.05
    force = elements.gravity_mass[:, None] * np.array([0.1, -0.5, 0.05])
    x, report = newton(elements, fixed=fixed, force=force)
    assert report.converged and np.abs(x - elements.points).max() > 0.4
    load = np.empty(len(dof))
    load[dof] = force.ravel()
    forms = neo_hookean_forms(skfem, SOFT, 3)
    answer = solved(skfem, basis, forms, load, dof[np.repeat(fixed, 3)], 6)[dof].reshape(-1, 3)
    np.testing.assert_allclose(x - elements.points, answer, atol=1e-6 * np.abs(answer).max())


@pytest.mark.slow
def test_cook_at_finite_strain_as_scikit_fem() -> None:
    """Cook's membrane, mu = 422.5 kPa, nu = 0.3, traction 62.5 kPa: a slab of tets rises as scikit-fem's plane does.

    The rise of the loaded edge's middle and upper corner, by quadratic quadrilaterals under plane strain, within 0.2 %.
    """
    skfem = pytest.importorskip("skfem")
    material = Material("m", 1.0, 2.6 * 422.5, 0.3)
    s = np.linspace(0.0, 1.0, 17)
    square = skfem.MeshQuad.init_tensor(s, s)
    x, y = square.p
    plane = skfem.MeshQuad(np.stack([48.0 * x, 44.0 * x + y * (44.0 - 28.0 * x)]), square.t)
    basis = skfem.Basis(plane, skfem.ElementVector(skfem.ElementQuad2()))
    edge = basis.boundary(plane.facets_satisfying(lambda p: np.abs(p[0] - 48.0) < 1e-6))

    @skfem.LinearForm
    def traction(v: Any, w: Any) -> Any:
        return 62.5 * v[1]

    forms = neo_hookean_forms(skfem, material, 2)
    clamped = basis.get_dofs(lambda p: p[0] < 1e-9).flatten()
    u = solved(skfem, basis, forms, traction.assemble(edge), clamped, 5)
    expected = []
    for height in (52.0, 60.0):
        at = np.flatnonzero(np.hypot(basis.doflocs[0] - 48.0, basis.doflocs[1] - height) < 1e-6)
        expected.append(u[at[1]])
    from test_finite_elements_statics import cook, cook_moves

    found = cook_moves(cook(16, material, "neo_hookean"), 62.5, strain=True)
    assert found == pytest.approx(expected, rel=2e-3)


HANGING = {
    1.96: (-0.260, -0.253, 0.074, 0.001),
    4.90: (-0.649, -0.544, 0.457, 0.004),
    9.80: (-1.299, -0.794, 1.822, 0.011),
}


def hung(law: str, g: float, young: float = 1.5e5) -> tuple[Elements, np.ndarray, Any]:
    """Return the bar 1 x 0.2 x 0.2 of 240 linear tetrahedra, clamped at x = 0, hanging under `g`."""
    mesh = box_tets((10, 2, 2), (1.0, 0.2, 0.2), split="kuhn")
    elements = Elements(mesh, Material("bar", 1000.0, young, 0.3), law=law)
    force = elements.gravity_mass[:, None] * np.array([0.0, -g, 0.0])
    x, report = newton(elements, fixed=mesh.points[:, 0] < 1e-9, force=force)
    assert report.converged
    return elements, x, report


def growth(elements: Elements, x: np.ndarray) -> float:
    """Return the relative change of the volume."""
    return float(TetMesh(x, elements.mesh.tets).volumes.sum() / elements.mesh.volumes.sum() - 1.0)


@pytest.mark.parametrize("g", HANGING)
def test_hanging_bar(g: float) -> None:
    """Tip and volume change of the bar with 11 x 3 x 3 nodes, linear and neo-Hookean."""
    tip_linear, tip, swollen, grown = HANGING[g]
    for law, down, volume in (("linear", tip_linear, swollen), ("neo_hookean", tip, grown)):
        elements, x, _ = hung(law, g)
        end = elements.points[:, 0] > 0.999
        assert (x - elements.points)[end, 1].mean() == pytest.approx(down, abs=1e-3)
        assert growth(elements, x) == pytest.approx(volume, abs=1e-3)


def test_corotational_differs_from_neo_hookean_by_the_law() -> None:
    """At g = 9.8 the two differ by 0.039 in the mass norm: the size of the constitutive ambiguity."""
    elements, x, _ = hung("neo_hookean", 9.8)
    _, other, _ = hung("corotational", 9.8)

    def norm(u: np.ndarray) -> float:
        return float(np.sqrt(u.ravel() @ (elements.mass @ u.ravel())))

    assert norm(other - x) / norm(x - elements.points) == pytest.approx(0.039, abs=1e-3)


def test_st_venant_kirchhoff_inverts() -> None:
    """At E = 1e5 between g = 5.8 and 6.0 the tip jumps from -0.73 to -0.86 as an element inverts: marked as not valid."""
    elements, x, before = hung("stvk", 5.8, 1e5)
    end = elements.points[:, 0] > 0.999
    assert before.valid and before.least_ratio == pytest.approx(0.49, abs=0.01)
    assert (x - elements.points)[end, 1].mean() == pytest.approx(-0.73, abs=0.01)
    elements, x, after = hung("stvk", 6.0, 1e5)
    assert not after.valid and after.inverted >= 1 and after.least_ratio == pytest.approx(-0.98, abs=0.01)
    assert (x - elements.points)[end, 1].mean() == pytest.approx(-0.86, abs=0.01)


@pytest.mark.slow
def test_twenty_thousand_elements() -> None:
    """A bar of 20,400 neo-Hookean elements that sags by most of its length is solved in one load step."""
    mesh = box_tets((34, 10, 10), (1.0, 0.3, 0.3))
    elements = Elements(mesh, Material("bar", 1000.0, 1.5e5, 0.3))
    force = elements.gravity_mass[:, None] * np.array([0.0, -9.8, 0.0])
    x, report = newton(elements, fixed=mesh.points[:, 0] < 1e-9, force=force)
    assert len(mesh.tets) == 20_400
    assert report.converged and report.iterations <= 15 and report.load_steps == 1
    assert (elements.points - x)[:, 1].max() == pytest.approx(0.811, abs=0.005)
