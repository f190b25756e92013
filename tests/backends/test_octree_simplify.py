"""Many cells into one: mass, chains, parallel edges and diagonals (section 2 of the specification)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lattices import TREE, lattice

from faceanim.backends.octree_mass_spring import simplify
from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.geometry import octree
from faceanim.ground.errors import UserError

K, D = np.array([1.0, 2.0, 4.0]), np.array([0.5, 0.8, 0.3])
CORNERS = np.array(list(product((0, 1), repeat=3)))


def test_a_leaf_is_isotropic() -> None:
    """k_edge = k_face + 8/3 k_body; E = 5/2 C44 with C44 = C12 and nu = 1/4 (section 1)."""
    assert simplify.KE == pytest.approx(simplify.KF + 8 / 3 * simplify.KB)
    elastic = np.zeros((3, 3, 3, 3))
    leaf = simplify.simplify_springs(np.ones((1, 1, 1, 1)), "energy", "small_strain")[0]
    for (a, b), k in zip(simplify.PAIRS, leaf, strict=True):
        way = (CORNERS[b] - CORNERS[a]).astype(float)
        elastic += k * np.einsum("i,j,k,l->ijkl", way, way, way, way) / (way @ way)
    c11, c12, c44 = elastic[0, 0, 0, 0], elastic[0, 0, 1, 1], elastic[0, 1, 0, 1]
    assert c12 == pytest.approx(c44) and c11 == pytest.approx(3 * c44)
    assert c12 / (c11 + c12) == pytest.approx(0.25)
    assert simplify.YOUNG == pytest.approx(2.5 * c44)


@pytest.mark.parametrize("s", [2, 4, 8])
def test_mass_and_centroid_stay(s: int) -> None:
    """Total mass and centroid of any fragment are kept to 1e-13 (section 2, mass)."""
    mass = np.random.default_rng(s).uniform(0.1, 2.0, (3, s, s, s))
    coarse = simplify.simplify_mass(mass)
    np.testing.assert_allclose(coarse.sum(axis=1), mass.sum(axis=(1, 2, 3)), rtol=1e-13)
    middle = np.stack(np.meshgrid(*[np.arange(s) + 0.5] * 3, indexing="ij"), -1) / s
    exact = np.einsum("cijk,ijkd->cd", mass, middle)
    np.testing.assert_allclose(coarse @ CORNERS, exact, rtol=1e-13)


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_the_block_keeps_its_mass_and_edges(level: int) -> None:
    """16 x 8 x 8 over 2, 4 and 8: mass 2.000 and no surplus stiffness (section 1: half shares gave 2.9375, +6.2 %)."""
    springs, mass = lattice().cell_tables(level)
    assert mass.sum() == pytest.approx(2.0, rel=1e-13)
    np.testing.assert_allclose(springs[:, :12], 0.25 * 2**level, rtol=1e-13)


def test_the_curve_of_a_chain() -> None:
    """k = (1, 2, 4), D = (.5, .8, .3): K, F, d, area and K- of section 2."""
    curve = simplify.chain_curve(K, D)
    np.testing.assert_allclose(curve.stiffness, [0.571429, 1.333333, 2.0], atol=5e-7)
    np.testing.assert_allclose(curve.force, [0.5, 1.2, 1.6], rtol=1e-14)
    np.testing.assert_allclose(curve.travel, [0.875, 1.4, 1.6], rtol=1e-14)
    assert simplify.curve_area(curve) == pytest.approx(0.945, rel=1e-14)
    assert float(simplify.chain_stiffness(K, D, "equal_energy")) == pytest.approx(0.738281, abs=5e-7)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(0.1, 10.0), st.floats(0.1, 2.0)), min_size=1, max_size=8))
def test_equal_energy_is_the_closed_form_and_never_softer(rows: list[tuple[float, float]]) -> None:
    """K- = sum k D^2 / (sum D)^2 = 2 area / (sum D)^2 to 1e-13, and K- >= K_0 (Cauchy-Schwarz)."""
    k, d = np.array(rows).T
    curve = simplify.chain_curve(k, d)
    closed = float(simplify.chain_stiffness(k, d, "equal_energy"))
    assert closed == pytest.approx(2.0 * simplify.curve_area(curve) / d.sum() ** 2, rel=1e-12)
    assert closed >= float(simplify.chain_stiffness(k, d)) * (1 - 1e-12)
    assert curve.stiffness[0] == pytest.approx(float(simplify.chain_stiffness(k, d)))
    assert curve.travel[-1] == pytest.approx(d.sum())


def test_the_pitfall_of_equal_energy() -> None:
    """k = (1, 10) with equal travel: 2.75 against the series value .909, three times too stiff at small strain."""
    k, d = np.array([1.0, 10.0]), np.ones(2)
    assert float(simplify.chain_stiffness(k, d, "equal_energy")) == pytest.approx(2.75)
    assert float(simplify.chain_stiffness(k, d)) == pytest.approx(10 / 11)


def test_lengths_of_a_chain_and_fracture() -> None:
    """Lengths add; with fracture K+ = K_0 and the row ends where its weakest spring does."""
    rest = np.ones(3)
    low, high = rest - D, rest + 0.5 * D
    whole = simplify.chain(K, rest, low, high)
    assert whole.stiffness == pytest.approx(4 / 7)
    assert (whole.rest, whole.low, whole.high) == pytest.approx((3.0, low.sum(), high.sum()))
    paper = simplify.chain(K, rest, low, high, mode="equal_energy")
    assert paper.stiffness == pytest.approx(0.73828125)
    breaks = simplify.chain(K, rest, low, high, mode="equal_energy", fracture=True)
    assert breaks.stiffness == pytest.approx(0.5 * (0.73828125 + 4 / 7))
    assert breaks.high == pytest.approx(3.0 + 1.0 * 0.25 / (4 / 7))
    with pytest.raises(UserError, match="chain"):
        simplify.chain(K, rest, rest, high)


def test_parallel_chains_add_and_their_lengths_do_not() -> None:
    """Stiffness adds up by bilinear weights; lengths are the mean with the same weights, normalised."""
    stiffness, length = np.full((3, 5), 2.0), np.full((3, 5), 7.0)
    total, mean = simplify.merge(stiffness, length)
    assert total.sum() == pytest.approx(30.0)
    np.testing.assert_allclose(mean, 7.0, rtol=1e-14)


@pytest.mark.parametrize(
    ("rule", "face", "body"),
    [
        ("literal", (0.333, 0.258, 0.215), (0.152, 0.075, 0.038)),
        ("series", (0.667, 0.517, 0.430), (0.455, 0.225, 0.114)),
        ("energy", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    ],
)
def test_shear_of_a_homogeneous_fragment(rule: str, face: tuple[float, ...], body: tuple[float, ...]) -> None:
    """Face and body diagonals over s times a leaf's, for s = 2, 4, 8 (section 2, table of shear ratios)."""
    one = simplify.simplify_springs(np.ones((1, 1, 1, 1)), rule, "small_strain")[0]
    for s, f, b in zip((2, 4, 8), face, body, strict=True):
        ratio = simplify.simplify_springs(np.ones((1, s, s, s)), rule, "small_strain")[0] / one / s
        np.testing.assert_allclose(ratio[:12], 1.0, rtol=1e-13)
        np.testing.assert_allclose(ratio[12:24], f, atol=6e-4)
        np.testing.assert_allclose(ratio[24:], b, atol=6e-4)


@pytest.mark.parametrize("rule", ["literal", "series", "energy"])
def test_mirrored_material_gives_mirrored_springs(rule: str) -> None:
    """Turning a fragment over turns its springs over: no direction is preferred."""
    leaf = np.random.default_rng(0).uniform(0.5, 2.0, (1, 4, 4, 4))
    springs = simplify.simplify_springs(leaf, rule, "small_strain")[0]
    number = {tuple(sorted(pair)): k for k, pair in enumerate(simplify.PAIRS.tolist())}
    for axis in range(3):
        turned = simplify.simplify_springs(np.flip(leaf, 1 + axis), rule, "small_strain")[0]
        image = np.arange(8) ^ (4, 2, 1)[axis]
        order = [number[tuple(sorted((int(image[a]), int(image[b]))))] for a, b in simplify.PAIRS]
        np.testing.assert_allclose(turned[order], springs, rtol=1e-12)


def test_half_a_fragment_has_half_the_energy() -> None:
    """Where half of the leaves are missing, edges and diagonals keep the energy of a homogeneous stretch that is there."""
    leaf = np.ones((1, 4, 4, 4))
    leaf[0, 2:] = 0.0
    whole, half = (simplify.simplify_springs(f, "energy", "small_strain")[0] for f in (np.ones_like(leaf), leaf))
    stretch = lambda k: sum(  # noqa: E731
        s * (CORNERS[b] - CORNERS[a])[0] ** 4 / ((CORNERS[b] - CORNERS[a]) ** 2).sum()
        for (a, b), s in zip(simplify.PAIRS, k, strict=True)
    )
    assert stretch(half) == pytest.approx(0.5 * stretch(whole), rel=1e-12)
    assert (half > 0).all()


def test_levels_come_from_the_leaves() -> None:
    """With heterogeneous leaves, level 2 is not level 1 simplified again, but has the mass of the leaves."""
    rng = np.random.default_rng(3)
    one = Lattice(TREE, rng.uniform(1, 10, len(TREE.leaves.index)), rng.uniform(1, 2, len(TREE.leaves.index)))
    for level in range(4):
        assert one.cell_tables(level)[1].sum() == pytest.approx(one.mass.sum(), rel=1e-13)
        mass = one.cell_tables(level)[1]
        cells = TREE.levels[level]
        np.testing.assert_allclose(
            np.einsum("ca,cad->d", mass, cells.points[cells.corner]), one.mass @ TREE.leaves.centres, rtol=1e-13
        )


def test_unsound_lattices_are_refused() -> None:
    """Wrong sizes, numbers that are not positive, unknown rules."""
    tree, good = octree.block((2, 1, 1), 1.0), np.ones(2)
    with pytest.raises(UserError, match="stiffness"):
        Lattice(tree, np.ones(3), good)
    with pytest.raises(UserError, match="mass"):
        Lattice(tree, good, np.array([1.0, -1.0]))
    with pytest.raises(UserError, match="unknown rule"):
        Lattice(tree, good, good, "paper")
    with pytest.raises(UserError, match="unknown chain"):
        Lattice(tree, good, good, "energy", "x")
