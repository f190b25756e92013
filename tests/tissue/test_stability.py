"""Stability of incompressible laws: the printed craniofacial constants, the theory, and laws that never fail."""

from __future__ import annotations

import math

import pytest

from faceanim.ground.errors import UserError
from faceanim.tissue.craniofacial import TABLE_1, tissue
from faceanim.tissue.material import Material
from faceanim.tissue.stability import nominal_stress, stability

LIMITS = {
    "skin": {
        ("tension", "uniaxial"): {"drucker": 1.1100},
        ("compression", "uniaxial"): {"slope": 0.8957, "drucker": 0.9006, "sign": 0.8116},
        ("tension", "equibiaxial"): {"slope": 1.0523, "drucker": 1.0538, "sign": 1.1100},
        ("compression", "equibiaxial"): {"drucker": 0.9492},
        ("tension", "planar"): {"drucker": 1.0948},
        ("compression", "planar"): {"drucker": 0.9134},
    },
    "muscle": {
        ("tension", "uniaxial"): {"drucker": 1.1276},
        ("compression", "uniaxial"): {"slope": 0.8799, "drucker": 0.8863, "sign": 0.7865},
        ("tension", "equibiaxial"): {"slope": 1.0603, "drucker": 1.0622, "sign": 1.1276},
        ("compression", "equibiaxial"): {"drucker": 0.9417},
        ("tension", "planar"): {"drucker": 1.1099},
        ("compression", "planar"): {"drucker": 0.9010},
    },
    "fat": {
        ("tension", "uniaxial"): {"drucker": 1.0186},
        ("compression", "uniaxial"): {"slope": 0.9816, "drucker": 0.9818, "sign": 0.9639},
        ("tension", "equibiaxial"): {"slope": 1.0092, "drucker": 1.0092, "sign": 1.0186},
        ("compression", "equibiaxial"): {"drucker": 0.9908},
        ("tension", "planar"): {"drucker": 1.0161},
        ("compression", "planar"): {"drucker": 0.9842},
    },
}
STRETCHES = (1.05, 1.10, 1.30)
STRESSES = {
    ("skin", "mooney_rivlin"): (12.086, 10.437, 13.058, 26.703, 3.202, 24.458, 99.073, -142.609, 59.259, -12.234),
    ("skin", "tension"): (12.086, 25.953, 16.112, 26.703, 57.365, 35.257, 99.073, 184.898, 123.448, -33.252),
    ("muscle", "mooney_rivlin"): (6.929, 6.839, 7.675, 15.055, 4.473, 14.376, 54.026, -65.511, 34.832, -8.149),
    ("muscle", "tension"): (6.929, 14.636, 9.210, 15.055, 31.694, 19.804, 54.026, 99.086, 67.092, -18.712),
    ("fat", "mooney_rivlin"): (3.822, -5.440, 2.192, 11.032, -25.955, 4.106, 59.674, -211.211, 9.949, 7.735),
    ("fat", "tension"): (3.822, 10.685, 5.367, 11.032, 30.337, 15.330, 59.674, 129.167, 76.661, -14.109),
}
"""Nominal stress [kPa]: uniaxial, equibiaxial, planar at each of STRETCHES, then uniaxial at .9."""


def test_printed_constants_in_kilopascals() -> None:
    """Table 1 in kPa: C10, C01, G0 = 2 (C10 + C01), E and kappa with the third column as Poisson's ratio."""
    for name, c10, c01, shear, young, bulk in (
        ("skin", 186.164, -151.093, 70.143, 209.03, 3484.0),
        ("muscle", 96.550, -75.935, 41.230, 107.20, 89.33),
        ("fat", 162.919, -157.031, 11.776, 35.09, 584.9),
    ):
        m = tissue(name)
        assert (m.c10, m.c01, m.shear_modulus) == pytest.approx((c10, c01, shear), abs=6e-4)
        assert (m.young_modulus, m.bulk_modulus) == pytest.approx((young, bulk), rel=2e-4)
    assert tissue("muscle", poisson_ratio=0.49).shear_modulus == pytest.approx(tissue("muscle").shear_modulus)
    with pytest.raises(UserError, match="fat, muscle, skin"):
        tissue("bone")
    with pytest.raises(UserError, match=r"below 0\.5"):
        tissue("skin", poisson_ratio=0.5)


@pytest.mark.parametrize("name", TABLE_1)
def test_printed_constants_become_unstable(name: str) -> None:
    """The scan finds the tabulated limits, and the theory's: ellipticity ends at sqrt(-c10 / c01) in any mode."""
    material = tissue(name)
    found = stability(material)
    assert not found.stable
    assert found.ellipticity == pytest.approx(material.stretch_limit, abs=1e-9)
    for (way, mode), limits in LIMITS[name].items():
        for measure, value in limits.items():
            assert getattr(getattr(found, way)[mode], measure) == pytest.approx(value, abs=6e-5), (way, mode, measure)
    uniaxial = found.tension["uniaxial"]
    assert uniaxial.slope == uniaxial.sign == math.inf, "the curve itself looks sound"
    assert found.tension["uniaxial"].ellipticity == pytest.approx(material.stretch_limit, abs=1e-9)
    assert found.compression["uniaxial"].ellipticity == pytest.approx(material.stretch_limit**-2, abs=1e-9)
    assert found.compression["equibiaxial"].slope == found.compression["planar"].sign == 0.0


def test_laws_that_are_stable_everywhere() -> None:
    """The law "tension" with the same constants, and neo-Hooke, fail nowhere from a third to three times the length."""
    for name in TABLE_1:
        found = stability(tissue(name), "tension")
        assert found.stable and found.ellipticity == math.inf
    assert stability(Material("m", 1.0, 1.0, 0.3), "neo_hookean").stable
    assert stability(Material("m", 1.0, 1.0, 0.3, 0.3)).ellipticity == math.inf


@pytest.mark.parametrize(("name", "law"), STRESSES)
def test_nominal_stresses(name: str, law: str) -> None:
    """Stress of the printed constants under their own law and under "tension", to the last digit."""
    material = tissue(name)
    found = [nominal_stress(material, law, m, l) for l in STRETCHES for m in ("uniaxial", "equibiaxial", "planar")]
    found.append(nominal_stress(material, law, "uniaxial", 0.9))
    assert found == pytest.approx(STRESSES[name, law], abs=1e-3)


def test_constants_unstable_at_rest_are_refused() -> None:
    """No shear stiffness, c10 < 0, no numbers: `UserError` names the constant and the rule; c01 < 0 alone is allowed."""
    for c10, c01, what in ((1.0, -1.0, "c10 \\+ c01 = 0.0"), (1.0, -1.5, "unstable"), (-1.0, 2.0, "c10 = -1.0"),
                           (float("nan"), 1.0, "finite")):  # fmt: skip
        with pytest.raises(UserError, match=what):
            Material.mooney_rivlin("m", 1.0, c10, c01, 100.0)
    with pytest.raises(UserError, match="bulk_modulus"):
        Material.mooney_rivlin("m", 1.0, 1.0, 0.0, 0.0)
    for share in (1.1, float("inf"), float("nan"), -float("inf")):
        with pytest.raises(UserError, match="mooney"):
            Material("m", 1.0, 1.0, 0.3, share)
    m = Material.mooney_rivlin("m", 1.0, 2.0, -1.5, 100.0)
    assert (m.c10, m.c01, m.bulk_modulus) == pytest.approx((2.0, -1.5, 100.0))
    assert m.stretch_limit == pytest.approx(math.sqrt(2.0 / 1.5))
    assert Material("m", 1.0, 1.0, 0.3, 0.5).stretch_limit == math.inf


def test_wrong_questions_are_refused() -> None:
    """Unknown laws and modes, impossible stretches, and the law "tension" with c01 > 0 raise `UserError`."""
    material = tissue("skin")
    with pytest.raises(UserError, match="ogden"):
        stability(material, "ogden")
    with pytest.raises(UserError, match="torsion"):
        nominal_stress(material, "tension", "torsion", 1.1)
    with pytest.raises(UserError, match="stretch"):
        nominal_stress(material, "tension", "planar", 0.0)
    with pytest.raises(UserError, match="mooney <= 0"):
        stability(Material("m", 1.0, 1.0, 0.3, 0.3), "tension")
