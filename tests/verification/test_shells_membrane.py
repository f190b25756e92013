"""Skin, muscle and fat as thin incompressible sheets, stretched uniformly: the nominal stresses of the closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from shell_meshes import grid_points, grid_triangles

from faceanim.elements.newton import newton
from faceanim.elements.shells import Sheet, Shells, ShellSystem

TISSUES = {"skin": (18.9834587, -15.4071649), "muscle": (9.84540206, -7.74326281), "fat": (16.6131140, -16.0126823)}
"""c10 and c01 [gf/mm^2] of An improved finite element model for craniofacial surgery simulation, Table 1."""
GF = 9.80665
"""1 gf/mm^2 in kPa."""
STRESS = {
    ("skin", "mooney_rivlin"): ((12.086, 10.437, 13.058), (26.703, 3.202, 24.458), (99.073, -142.609, 59.259), -12.234),
    ("skin", "tension"): ((12.086, 25.953, 16.112), (26.703, 57.365, 35.257), (99.073, 184.898, 123.448), -33.252),
    ("muscle", "mooney_rivlin"): ((6.929, 6.839, 7.675), (15.055, 4.473, 14.376), (54.026, -65.511, 34.832), -8.149),
    ("muscle", "tension"): ((6.929, 14.636, 9.210), (15.055, 31.694, 19.804), (54.026, 99.086, 67.092), -18.712),
    ("fat", "mooney_rivlin"): ((3.822, -5.440, 2.192), (11.032, -25.955, 4.106), (59.674, -211.211, 9.949), 7.735),
    ("fat", "tension"): ((3.822, 10.685, 5.367), (11.032, 30.337, 15.330), (59.674, 129.167, 76.661), -14.109),
}
"""Nominal stress [kPa] in uniaxial, equibiaxial and planar tension at 1.05, 1.10 and 1.30, and uniaxially at 0.90."""
THICKNESS = 1.5


def patch(sheet: Sheet) -> Shells:
    """Return a crooked square of side 2 with one inner node."""
    points = grid_points((2, 2), (0.0, 0.0), (2.0, 2.0))
    points[4, :2] = (1.15, 0.9)
    return Shells(points, grid_triangles((2, 2), "falling"), sheet)


def nominal_stress(sheet: Sheet, along: float, across: float) -> tuple[float, float]:
    """Return the nominal stresses [kPa] in both directions of a sheet stretched by `along` and `across`."""
    shells = patch(sheet)
    x = shells.points.copy()
    x[:9] *= np.array([along, across, 1.0])
    forces = ShellSystem(shells).forces(x)
    assert np.abs(forces[4]).max() < 1e-10, "the inner node is in balance"
    assert np.abs(forces[9:]).max() < 1e-10, "no moments"
    section = 2.0 * THICKNESS
    far = [-forces[:9][shells.carrier[:, i] > 1.9, i].sum() / section for i in (0, 1)]
    return far[0], far[1]


def constants(tissue: str) -> tuple[float, float]:
    """Return c10 and c01 [kPa]."""
    c10, c01 = TISSUES[tissue]
    return c10 * GF, c01 * GF


def modes(stretch: float) -> list[tuple[float, float]]:
    """Return both stretches in uniaxial, equibiaxial and planar tension."""
    return [(stretch, stretch**-0.5), (stretch, stretch), (stretch, 1.0)]


@pytest.mark.parametrize(("tissue", "law"), STRESS)
def test_homogeneous_stretch(tissue: str, law: str) -> None:
    """Plane stress of an incompressible sheet: the table to its last digit; nothing across in uniaxial tension."""
    sheet = Sheet.rubber(THICKNESS, *constants(tissue), law)
    *tension, compressed = STRESS[tissue, law]
    for stretch, row in zip((1.05, 1.10, 1.30), tension, strict=True):
        for (along, across), value in zip(modes(stretch), row, strict=True):
            assert nominal_stress(sheet, along, across)[0] == pytest.approx(value, abs=6e-4)
    assert nominal_stress(sheet, 0.9, 0.9**-0.5)[0] == pytest.approx(compressed, abs=6e-4)
    for stretch in (0.9, 1.05, 1.3):
        assert nominal_stress(sheet, stretch, stretch**-0.5)[1] == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("stretch", [0.8, 0.95, 1.2, 1.6])
def test_closed_forms_of_mooney_rivlin(stretch: float) -> None:
    """2 (l - l^-2)(c10 + c01 / l), 2 (l - l^-5)(c10 + c01 l^2) and 2 (l - l^-3)(c10 + c01), to round-off."""
    c10, c01 = constants("skin")
    sheet = Sheet.rubber(THICKNESS, c10, c01, "mooney_rivlin")
    l = stretch
    exact = (
        2.0 * (l - l**-2) * (c10 + c01 / l),
        2.0 * (l - l**-5) * (c10 + c01 * l * l),
        2.0 * (l - l**-3) * (c10 + c01),
    )
    for (along, across), value in zip(modes(l), exact, strict=True):
        assert nominal_stress(sheet, along, across)[0] == pytest.approx(value, abs=1e-11 * c10)


def test_closed_form_of_neo_hooke_and_of_linear_elasticity() -> None:
    """mu (l - l^-2) in uniaxial tension; under the law "linear" E l (l^2 - 1)/2 with nu = 0."""
    rubber = Sheet.elastic(THICKNESS, 300.0, 0.5, "neo_hookean")
    assert nominal_stress(rubber, 1.4, 1.4**-0.5)[0] == pytest.approx(100.0 * (1.4 - 1.4**-2), rel=1e-12)
    linear = Sheet.elastic(THICKNESS, 300.0, 0.0)
    assert nominal_stress(linear, 1.4, 1.0)[0] == pytest.approx(300.0 * 1.4 * 0.48, rel=1e-12)


def test_the_laws_agree_at_small_strain() -> None:
    """All laws have the same tangent at rest as linear elasticity with nu = 1/2 and the same shear modulus."""
    c10, c01 = constants("muscle")
    young = 6.0 * (c10 + c01)
    blocks = [
        patch(sheet).stiffnesses(patch(sheet).points)
        for sheet in (
            Sheet.elastic(THICKNESS, young, 0.5),
            Sheet.elastic(THICKNESS, young, 0.5, "neo_hookean"),
            Sheet.rubber(THICKNESS, c10, c01, "mooney_rivlin"),
            Sheet.rubber(THICKNESS, c10, c01, "tension"),
        )
    ]
    for block in blocks[1:]:
        np.testing.assert_allclose(block, blocks[0], atol=1e-10 * np.abs(blocks[0]).max())


@pytest.mark.parametrize("law", ["mooney_rivlin", "tension", "neo_hookean", "linear"])
def test_a_pulled_strip_narrows_by_itself(law: str) -> None:
    """Equilibrium with free sides: the tension of the closed form, l^-1/2 across, and the sheet thins as much."""
    c10, c01 = constants("skin")
    if law in ("mooney_rivlin", "tension"):
        sheet = Sheet.rubber(THICKNESS, c10, c01, law)
    else:
        sheet = Sheet.elastic(THICKNESS, 210.0, 0.5, law)
    system = ShellSystem(patch(sheet))
    rest = system.points
    fixed: Any = np.zeros_like(rest, dtype=bool)
    fixed[:9, 0] = (rest[:9, 0] < 0.1) | (rest[:9, 0] > 1.9)
    fixed[:9, 1] = rest[:9, 1] < 0.1
    fixed[:9, 2] = True
    goal = rest.copy()
    goal[:9, 0] *= 1.08
    x, report = newton(system, fixed=fixed, values=goal)
    assert report.converged
    if law != "linear":
        np.testing.assert_allclose(x[:9, 1], rest[:9, 1] * 1.08**-0.5, atol=1e-9)
        np.testing.assert_allclose(system.shells.thickness_stretches(x), 1.08**-0.5, rtol=1e-9)
    np.testing.assert_allclose(system.shells.stretches(x), 1.08, rtol=1e-9)
