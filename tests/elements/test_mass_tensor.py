"""The mass-tensor model is the finite element model of the same law, summed differently."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faceanim.elements.mass_tensor import MassTensor
from faceanim.elements.newton import newton
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material

MUSCLE, FAT = Material("muscle", 1.0, 100.0, 0.45), Material("fat", 1.0, 30.0, 0.3)


def both(law: str) -> tuple[MassTensor, Elements]:
    """Return the two models of a block of two tissues."""
    mesh = box_tets((4, 3, 2), (8.0, 6.0, 5.0))
    region = (mesh.points[mesh.tets].mean(axis=1)[:, 0] > 4.0).astype(int)
    return MassTensor(mesh, (MUSCLE, FAT), region, law=law), Elements(mesh, (MUSCLE, FAT), region, law=law)


@pytest.mark.parametrize("law", ["linear", "stvk"])
def test_forces_are_those_of_the_elements(law: str) -> None:
    """Energy and forces agree to 1e-12 at large random displacements, also through inversion."""
    tensor, elements = both(law)
    rng = np.random.default_rng(4)
    for size in (1e-3, 0.3, 3.0):
        x = elements.points + size * rng.standard_normal(elements.points.shape)
        f = elements.forces(x)
        np.testing.assert_allclose(tensor.forces(x), f, atol=1e-12 * np.abs(f).max())
        assert tensor.energy(x) == pytest.approx(elements.energy(x), rel=1e-12)


@pytest.mark.parametrize("law", ["linear", "stvk"])
def test_at_rest_it_is_the_finite_element_solution(law: str) -> None:
    """Brought to equilibrium under imposed motion both models give the same positions and reactions to 1e-8."""
    tensor, elements = both(law)
    x = elements.points
    ends = (x[:, 0] < 1e-9) | (x[:, 0] > 8.0 - 1e-9)
    values = x + np.where((x[:, 0] > 4.0)[:, None], [0.6, 0.4, 0.0], 0.0)
    found = [newton(model, fixed=ends, values=values) for model in (tensor, elements)]
    assert all(report.converged and report.valid for _, report in found)
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-8)
    force = elements.forces(found[1][0])
    np.testing.assert_allclose(tensor.forces(found[0][0]), force, atol=1e-8 * np.abs(force).max())


def test_a_turn_gives_no_force_with_greens_strain() -> None:
    """The linear model answers a rotation with forces, the other one does not."""
    turn = Rotation.from_euler("xyz", [30.0, 40.0, 50.0], degrees=True).as_matrix()
    tensor, elements = both("stvk")
    x = elements.points @ turn.T + 2.0
    scale = np.abs(both("linear")[0].forces(x)).max()
    assert scale > 1.0
    assert np.abs(tensor.forces(x)).max() < 1e-12 * scale


def test_what_it_cannot_do_is_refused() -> None:
    """Laws that are no polynomial of the displacements raise `UserError`."""
    mesh = box_tets((1, 1, 1), (1.0, 1.0, 1.0))
    with pytest.raises(UserError, match="neo_hookean"):
        MassTensor(mesh, MUSCLE, law="neo_hookean")
    with pytest.raises(UserError, match="positions"):
        MassTensor(mesh, MUSCLE).forces(np.zeros((2, 3)))
