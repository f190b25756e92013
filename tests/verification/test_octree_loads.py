"""Coarse blocks under load against the fine one: the tables of sections 3, 5, 7 and 8 of the specification.

Errors are of the mean displacement of the loaded side [%]; forces are transferred by virtual work.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from lattices import (
    KINDS,
    LEAVES,
    PLACE,
    coarse_error,
    displacement_error,
    fine_nodes,
    lattice,
    load,
    loaded_side,
    settled,
    uniform,
)  # fmt: skip

from faceanim.backends.octree_mass_spring.model import Model, assemble
from faceanim.backends.octree_mass_spring.transfer import Landmarks, landmark_error

FINE = {"tension": 0.0294, "shear": 0.0296, "bend": 0.0545, "gravity": 0.0534}
LAYERS = {
    "across": np.where(PLACE[:, 0] % 2 == 0, 1.0, 10.0),
    "along": np.where(PLACE[:, 2] % 2 == 0, 1.0, 10.0),
}


@cache
def fine_model(material: str = "homogeneous") -> Model:
    return uniform(lattice(stiffness=LAYERS.get(material, 1.0)), 0)


@cache
def reference(kind: str, size: float = 1.0, material: str = "homogeneous") -> np.ndarray:
    model = fine_model(material)
    return settled(model, load(kind, model, size), kind)


@pytest.mark.parametrize("kind", sorted(FINE))
def test_the_fine_block(kind: str) -> None:
    """Tension .0294, shear .0296, bend .0545, gravity .0534 within 1 % (section 3).

    Gravity: the figure belongs to g rho = .025; with g = .05 and rho = 1 as written the tip sinks by .1067, twice that.
    """
    side = np.isclose(fine_model().points[:, 2 if kind == "shear" else 0], 1.0 if kind == "shear" else 2.0)
    mean = np.linalg.norm(reference(kind)[side].mean(axis=0))
    assert mean == pytest.approx(FINE[kind], rel=0.01)


ENERGY = {
    "tension": (-0.3, -0.9, -2.4),
    "shear": (-3.2, -10.7, -22.6),
    "bend": (-6.1, -22.8, -50.7),
    "twist": (-6.8, -22.7, -42.4),
}


@pytest.mark.parametrize("kind", sorted(ENERGY))
def test_the_energy_rule(kind: str) -> None:
    """-0.3 | -0.9 | -2.4 in tension and so on, within 1.5 points (section 3, "cb")."""
    force = load(kind, fine_model())
    errors = [coarse_error(lattice(), level, kind, reference(kind), force) for level in (1, 2, 3)]
    np.testing.assert_allclose(errors, ENERGY[kind], atol=1.5)


PAPER = {
    ("literal", "tension"): (36.5, 42.0, 48.0),
    ("literal", "shear"): (217.0, 320.0, 415.0),
    ("literal", "bend"): (64.0, 68.0, 52.0),
    ("literal", "twist"): (258.0, 281.0, 165.0),
    ("series", "tension"): (15.0, 25.0, 31.0),
    ("series", "shear"): (55.0, 106.0, 150.0),
    ("series", "bend"): (18.0, 13.0, -9.0),
    ("series", "twist"): (61.0, 83.0, 34.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "kind"), sorted(PAPER))
def test_the_papers_rules_are_too_soft(rule: str, kind: str) -> None:
    """+217 % in shear and so on, within 10 % of the figure or 1.5 points (section 3, "lit" and "ser").

    One figure differs: "literal" in tension at half resolution is +36.5, not +24; the homogeneous lattice with face
    and body diagonals of .333 and .152 has E / 1.348, which alone makes +34.8.
    """
    force = load(kind, fine_model())
    errors = [coarse_error(lattice(rule), level, kind, reference(kind), force) for level in (1, 2, 3)]
    np.testing.assert_allclose(errors, PAPER[rule, kind], rtol=0.1, atol=1.5)


def test_the_modulus_of_a_literal_fragment() -> None:
    """E of a coarse homogeneous lattice with the literal diagonals for s = 2: 1.348 times too soft, +34.8 %, not +24."""
    ke, kf, kb = 1.0, 0.3333 / 3.0, 0.1515 / 4.0
    c11, c12 = ke + 2 * kf + 4 / 3 * kb, kf + 4 / 3 * kb
    assert (5 / 3) / (c11 - 2 * c12**2 / (c11 + c12)) == pytest.approx(1.348, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "size", "expected"),
    [("tension", 15.0, (-0.2, -0.8, -2.1)), ("bend", 20.0, (-5.1, -19.6, -46.6))],
)
def test_the_energy_rule_at_large_load(kind: str, size: float, expected: tuple[float, ...]) -> None:
    """Stretched by F = 3 and bent by .74: much the same errors, within 1.5 points (section 3, last column)."""
    force = load(kind, fine_model(), size)
    errors = [coarse_error(lattice(), level, kind, reference(kind, size), force) for level in (1, 2, 3)]
    np.testing.assert_allclose(errors, expected, atol=1.5)


def test_forces_go_by_virtual_work() -> None:
    """B^T f keeps the force and the torque; sampling "f = w r" at the coarse nodes raises it by 1.09, 1.45 and 2.91."""
    force = load("twist", fine_model())
    x = fine_model().points
    torque = np.cross(x - [2.0, 0.5, 0.5], force).sum(axis=0)[0]
    for level, n, figure in ((1, 4, 1.09), (2, 2, 1.45), (3, 1, 2.91)):
        model = uniform(lattice(), level)
        coarse = fine_nodes(model).T @ force
        assert np.cross(model.points - [2.0, 0.5, 0.5], coarse).sum(axis=0)[0] == pytest.approx(torque, rel=1e-12)
        assert (1 + 2 / n**2) / (1 + 2 / 64) == pytest.approx(figure, abs=5e-3)


@pytest.mark.parametrize("kind", ["tension", "bend"])
def test_the_landmark_error(kind: str) -> None:
    """Err over sum |u| is within 1 to 4 points of the displacement error (sections 3 and 6), and 0 against itself."""
    fine, u = fine_model(), reference(kind)
    tree = fine.lattice.tree
    side = np.flatnonzero(np.isclose(fine.points[:, 0], 2.0))
    marks = Landmarks(tree.locate(fine.points[side]), fine.points[side])
    assert landmark_error(marks, fine, fine.points + u, fine, fine.points + u) == (0.0, 0.0)
    for level in (1, 2, 3):
        model = uniform(lattice(), level)
        moved = settled(model, fine_nodes(model).T @ load(kind, fine), kind)
        total, share = landmark_error(marks, fine, fine.points + u, model, model.points + moved)
        assert total == pytest.approx(share * np.linalg.norm(u[side], axis=1).sum())
        error = displacement_error(u, fine_nodes(model) @ moved, kind)
        assert abs(100.0 * share - abs(error)) < 4.0


SIZES = {
    (1, 0.1): (13.7, 8.4, 6.3), (1, 1.0): (5.0, 2.3, 2.0), (1, 10.0): (0.7, -0.5, -0.1), (1, 100.0): (0.07, -0.9, -0.4),
    (1, None): (0.0, -1.0, -0.4), (2, 1.0): (8.0, 1.2, 1.9), (2, 10.0): (0.9, -3.4, -1.5), (2, None): (0.0, -4.0, -1.9),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("coarse", "ks"), sorted(SIZES, key=str))
def test_half_fine_half_coarse(coarse: int, ks: float | None) -> None:
    """Ties of .1 to 100 fine edges, and hard slaves: tension, bend, gravity within .5 points (section 5)."""
    level = np.where(PLACE[:, 0] < 8, 0, coarse)
    cut = {"hard": True} if ks is None else {"ks": ks}
    kinds = ("tension", "bend", "gravity")
    errors = [coarse_error(lattice(), level, k, reference(k), load(k, fine_model()), **cut) for k in kinds]
    np.testing.assert_allclose(errors, SIZES[coarse, ks], atol=0.5)


def test_a_mixed_cut_at_the_default_ties() -> None:
    """1|1/2 with ks = 10: +.7, -.5, -.1 within .5 points (section 5)."""
    level = np.where(PLACE[:, 0] < 8, 0, 1)
    errors = [coarse_error(lattice(), level, k, reference(k), load(k, fine_model())) for k in ("tension", "bend")]
    np.testing.assert_allclose(errors, (0.7, -0.5), atol=0.5)


def test_the_largest_steps() -> None:
    """dt_crit .0302, .0603, .119, .208 within 2 % (section 7); ties of 100 edges cost steps, slaves do not."""
    steps = [uniform(lattice(), level).largest_step() for level in range(4)]
    np.testing.assert_allclose(steps, (0.0302, 0.0603, 0.119, 0.208), rtol=0.02)
    half = np.where(PLACE[:, 0] < 8, 0, 1)
    assert assemble(lattice(), half, hard=True).largest_step() == pytest.approx(steps[0], rel=0.01)
    assert assemble(lattice(), half, ks=100.0).largest_step() < 0.2 * steps[0]


def test_sizes_of_the_levels() -> None:
    """1,377, 225, 45, 12 nodes and 14,624, 2,000, 296, 50 springs (section 7)."""
    models = [uniform(lattice(), level) for level in range(4)]
    assert [len(m.points) for m in models] == [1377, 225, 45, 12]
    assert [len(m.tables.springs.i) for m in models] == [14624, 2000, 296, 50]


MATERIALS = {
    ("homogeneous", "tension", "equal_energy"): (-0.3, -0.9, -2.5),
    ("homogeneous", "tension", "harmonic"): (-0.1, -0.5, -1.8),
    ("homogeneous", "bend", "energy"): (-6.0, -23.0, -51.0),
    ("homogeneous", "bend", "harmonic"): (-2.1, -11.7, -31.0),
    ("across", "tension", "equal_energy"): (-63.0, -63.0, -64.0),
    ("across", "tension", "energy"): (-39.0, -40.0, -41.0),
    ("across", "tension", "harmonic"): (0.7, 0.5, -0.6),
    ("across", "bend", "equal_energy"): (-68.0, -74.0, -83.0),
    ("across", "bend", "energy"): (-50.0, -57.0, -70.0),
    ("across", "bend", "harmonic"): (-5.0, -13.0, -30.0),
    ("along", "shear", "equal_energy"): (-68.0, -70.0, -74.0),
    ("along", "shear", "energy"): (-62.0, -65.0, -71.0),
    ("along", "shear", "harmonic"): (-3.0, -8.0, -16.0),
    ("along", "bend", "equal_energy"): (-30.0, -42.0, -63.0),
    ("along", "bend", "energy"): (-28.0, -41.0, -63.0),
    ("along", "bend", "harmonic"): (14.0, 12.0, 18.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(("material", "kind", "method"), sorted(MATERIALS))
def test_layered_material(material: str, kind: str, method: str) -> None:
    """One cell of 1, one of 10, across x or along it, at a tenth of the loads: within 1.5 points (section 8)."""
    stiffness = LAYERS.get(material, np.ones(LEAVES))
    rule, chain = {
        "energy": ("energy", "small_strain"),
        "equal_energy": ("energy", "equal_energy"),
        "harmonic": ("harmonic", "small_strain"),
    }[method]
    force = load(kind, fine_model(material), 0.1)
    whole = reference(kind, 0.1, material)
    at = lattice(rule, chain, stiffness)
    errors = [coarse_error(at, level, kind, whole, force) for level in (1, 2, 3)]
    np.testing.assert_allclose(errors, MATERIALS[material, kind, method], atol=1.5)


ALONG = {
    ("energy", "equal_energy"): (-8.0, -9.0, -11.0),
    ("energy", "small_strain"): (-4.0, -5.0, -8.0),
    ("harmonic", "small_strain"): (5.0, 19.0, 69.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "chain"), sorted(ALONG))
def test_tension_along_the_layers(rule: str, chain: str) -> None:
    """Layers along x stretch by -8 | -9 | -11 and so on: all nine within 3 % of one plus the figure (section 8).

    Soft layers bulge out of the loaded side, so that the mean axial displacement is compared; every figure of the
    specification is lower by the same 2.6 % than here, which is a difference of its fine reference.
    """
    kind, at = "tension", lattice(rule, chain, LAYERS["along"])
    force, whole = load(kind, fine_model("along"), 0.1), reference(kind, 0.1, "along")
    side = loaded_side(kind)
    for level, figure in zip((1, 2, 3), ALONG[rule, chain], strict=True):
        model = uniform(at, level)
        weight = fine_nodes(model)
        moved = weight @ settled(model, weight.T @ force, kind)
        ratio = moved[side, 0].mean() / whole[side, 0].mean()
        assert ratio / (1.0 + figure / 100.0) == pytest.approx(1.0, abs=0.035)


def test_loads_are_named() -> None:
    """The four loads and gravity all act: their forces are not zero and tension's sum is .2."""
    for kind in KINDS:
        assert np.abs(load(kind, fine_model())).max() > 0
    assert load("tension", fine_model())[:, 0].sum() == pytest.approx(0.2)
