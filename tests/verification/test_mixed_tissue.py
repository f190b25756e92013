"""Nearly incompressible and large: Cook's membrane, and a bone advance that only some laws of tissue survive."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.elements.mass_tensor import MassTensor
from faceanim.elements.mixed import MixedElements
from faceanim.elements.newton import Report, newton
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.tissue.craniofacial import tissue
from faceanim.tissue.material import Material


def membrane(n: int, thickness: float) -> TetMesh:
    """Return Cook's tapered panel, 48 wide and 44 to 16 high, as one layer of n x n cells."""
    box = box_tets((n, n, 1), (1.0, 1.0, thickness))
    s, r, z = box.points.T
    points = np.stack([48.0 * s, 44.0 * s + (44.0 - 28.0 * s) * r, z], axis=1)
    return TetMesh(points, box.tets)


def lifted(
    n: int, material: Material, law: str, force: float = 100.0, *, plane: str = "strain"
) -> tuple[float, float, Report]:
    """Return how far the upper corner and the middle of the free end rise in plane strain or stress under a `force`."""
    thickness = 48.0 / n if plane == "strain" else 0.5
    mesh = membrane(n, thickness)
    elements = MixedElements(mesh, material, order=2, law=law)
    x = elements.points
    fixed = np.zeros(x.shape, dtype=bool)
    fixed[:, 2] = (plane == "strain") | (x[:, 2] < 1e-9)
    fixed[x[:, 0] < 1e-9, :2] = True
    triangles = mesh.boundary_triangles
    end = triangles[(mesh.points[triangles][:, :, 0] > 48.0 - 1e-9).all(axis=1)]
    load = elements.traction(end, (0.0, force / 16.0, 0.0))
    assert load[:, 1].sum() == pytest.approx(force * thickness)
    y, report = newton(elements, fixed=fixed, force=load)
    rise = [
        (y - x)[np.linalg.norm(x[:, :2] - place, axis=1) < 1e-6, 1].mean() for place in ((48.0, 60.0), (48.0, 52.0))
    ]
    return rise[0], rise[1], report


MU, KAPPA = 80.1938, 400942.0
RUBBER = Material.mooney_rivlin("rubber", 1.0, 0.5 * MU, 0.0, KAPPA)


@pytest.mark.parametrize(("poisson", "corner", "middle"), [(0.4999, 7.752, 7.396), (0.49, 7.847, 7.487)])
def test_cooks_membrane_linear(poisson: float, corner: float, middle: float) -> None:
    """Plane strain, E = 250: within .3 % of the plane P2/P1 solution on 32 x 32 cells."""
    found = lifted(16, Material("m", 1.0, 250.0, poisson), "linear")
    assert found[:2] == pytest.approx((corner, middle), rel=3e-3)


def test_cooks_membrane_in_plane_stress() -> None:
    """E = 1, nu = 1/3, a thin panel free to contract: within .3 % of 23.962."""
    found = lifted(8, Material("m", 1.0, 1.0, 1.0 / 3.0), "linear", 1.0, plane="stress")
    assert found[1] == pytest.approx(23.962, rel=3e-3)


def test_cooks_membrane_large_strain_on_a_coarse_mesh() -> None:
    """Neo-Hookean, kappa / mu = 5000: on 8 x 8 cells within .5 % of the 32 x 32 solution, in few iterations."""
    corner, middle, report = lifted(8, RUBBER, "neo_hookean")
    assert (corner, middle) == pytest.approx((6.926, 6.955), rel=5e-3)
    assert report.converged and report.load_steps == 1 and report.iterations < 20


@pytest.mark.slow
def test_cooks_membrane_large_strain() -> None:
    """Neo-Hookean: within .3 % of the plane P2/P1 solution on 32 x 32 cells."""
    corner, middle, report = lifted(16, RUBBER, "neo_hookean")
    assert report.converged
    assert (corner, middle) == pytest.approx((6.926, 6.955), rel=3e-3)


def advanced(elements: Elements, up: float, step: float = 0.125) -> Report:
    """Return how a quarter of a slab 30 x 30 x 12 mm takes a disc of radius 12 moved `up` beneath it.

    The slab is bonded to the disc and, around it, to bone that stays; the outer sides are free.
    """
    x = elements.points
    bottom = x[:, 2] < 1e-9
    disc = bottom & (np.hypot(x[:, 0], x[:, 1]) < 12.0 + 1e-9)
    fixed = x < 1e-9
    fixed[bottom] = True
    values = x.copy()
    values[disc, 2] += up
    _, report = newton(
        elements, fixed=fixed, values=values, tolerance=1e-6, first_step=step, least_step=1.0 / 64.0, most=40
    )
    return report


SLAB = box_tets((8, 8, 4), (30.0, 30.0, 12.0))


def test_the_stable_law_takes_an_advance_of_twelve_millimetres() -> None:
    """The law "tension" converges with no element inverted, whether locking-free or plain."""
    muscle = tissue("muscle", poisson_ratio=0.49)
    for elements in (MixedElements(SLAB, muscle, law="tension"), Elements(SLAB, tissue("muscle"), law="tension")):
        report = advanced(elements, 12.0)
        assert report.converged and report.valid and report.least_ratio > 0.1
        assert report.iterations < 40


@pytest.mark.parametrize(("poisson", "up"), [(0.3, 5.0), (0.45, 8.0)])
def test_green_strain_lets_elements_invert(poisson: float, up: float) -> None:
    """St Venant-Kirchhoff, as the mass tensor has it, turns elements inside out: the report says the result is void."""
    muscle = tissue("muscle", poisson_ratio=poisson)
    report = advanced(MassTensor(SLAB, muscle, law="stvk"), up, 0.25)
    assert report.inverted > 10 and report.least_ratio < -0.5 and not report.valid
    report = advanced(Elements(SLAB, muscle, law="stvk_barrier"), up, 0.25)
    assert report.converged and report.valid, "with a barrier in its volume term it does not"


@pytest.mark.slow
def test_the_printed_constants_fail() -> None:
    """Mooney-Rivlin with the printed constants finds no equilibrium at 12 mm: it stops far before, and says so."""
    for elements in (
        MixedElements(SLAB, tissue("muscle", poisson_ratio=0.49), law="mooney_rivlin"),
        Elements(SLAB, tissue("muscle"), law="mooney_rivlin"),
    ):
        report = advanced(elements, 12.0)
        assert not report.converged and report.fraction < 0.5
