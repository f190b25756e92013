"""Places on skin and bone, and names by place, on the built-in head and on others made from it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from heads import other_head
from hypothesis import given, settings
from hypothesis import strategies as st

from faceanim.face.library import load_face
from faceanim.face.muscle_places import PAPER_MUSCLES, RINGS, Places, ring_of
from faceanim.face.muscles import LinearMuscle, SheetMuscle, SphincterMuscle
from faceanim.geometry.distance_field import point_distance

FACE = load_face(density="coarse")
HEADS = {"built-in": 1.0, "small": 0.7, "stretched": (1.08, 0.94, 1.03), "mirrored": (-1.0, 1.0, 1.0)}


@cache
def places_of(head: str) -> Places:
    """Return the places of one of the heads."""
    return Places(FACE if head == "built-in" else other_head(FACE, HEADS[head]))


@pytest.mark.parametrize("head", HEADS)
def test_known_muscles_are_named_by_their_place(head: str) -> None:
    """Every one of them, on every head, all at once and one by one, also a few millimetres off."""
    places = places_of(head)
    rows = {n: m for n, m in places.known.items() if isinstance(m, (LinearMuscle, SheetMuscle))}
    insertion, origin = (np.array([getattr(m, end) for m in rows.values()]) for end in ("insertion", "origin"))
    names, far = places.names_of(insertion, origin)
    assert names == list(rows) and far < 1e-9
    rng = np.random.default_rng(5)
    names, far = places.names_of(
        insertion + rng.normal(0, 0.8, insertion.shape), origin + rng.normal(0, 0.8, origin.shape)
    )
    assert names == list(rows) and far < 3.0
    assert [places.name_of(i, o) for i, o in zip(insertion, origin, strict=True)] == list(rows)


def test_the_paper_s_muscles_are_known() -> None:
    """All 23."""
    known = places_of("built-in").known
    assert all(f"{name}_{side}" in known for name in PAPER_MUSCLES for side in ("left", "right"))
    assert 2 * len(PAPER_MUSCLES) + len(RINGS) == 23
    assert {ring_of(name) for name in known} == {None, *RINGS}


def test_a_muscle_far_from_all_known_ones_gets_a_name_of_its_own() -> None:
    """With its side, and another number for each."""
    places = places_of("built-in")
    end, start = np.array([70.0, 60.0, 10.0]), np.array([60.0, 100.0, -20.0])
    assert places.name_of(end, start) == "muscle_1_left"
    assert places.name_of(end, start, {"muscle_1_left"}) == "muscle_2_left"
    flip = np.array([-1.0, 1.0, 1.0])
    assert places.name_of(flip * end, flip * start) == "muscle_1_right"
    row = places.muscle("muscle_1_left", end, start, "cranium")
    assert isinstance(row, LinearMuscle) and row.insertion == tuple(end) and not row.paired


@pytest.mark.parametrize("head", HEADS)
def test_insertions_lie_on_the_skin_and_origins_on_bone_or_fascia(head: str) -> None:
    """Along the rays that a muscle image stands for."""
    places = places_of(head)
    rows = {n: m for n, m in places.known.items() if isinstance(m, (LinearMuscle, SheetMuscle))}
    insertion, origin = (np.array([getattr(m, end) for m in rows.values()]) for end in ("insertion", "origin"))
    skin = places.skin(*places.across(insertion))
    assert skin.found.all()
    # A stretched head carries its muscles along by an affine map, which is exact here, so that all stay in place.
    assert np.linalg.norm(skin.point - insertion, axis=1).max() < 1.0
    start, way = places.across(origin)
    bone, over = places.bone(start, way, places.cylinder.reach), places.skin(start, way)
    share = np.array([places.fascia(name) for name in rows])[:, None]
    assert np.linalg.norm(bone.point + share * (over.point - bone.point) - origin, axis=1).max() < 1.0
    springs = {name.rpartition("_")[0] for name in rows if places.fascia(name)}
    assert springs == {"frontalis_inner", "frontalis_outer", "risorius"}


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("ring", RINGS)
def test_rings_are_found_from_their_axis_ends(head: str, ring: str) -> None:
    """Centre and axes come back; so does the name, also with the ends in the other order."""
    places = places_of(head)
    ends = places.axis_ends(places.known, ring)
    assert ends is not None and np.isfinite(ends).all()
    assert places.ring_name(*ends) == places.ring_name(*ends[::-1]) == ring
    for pair in (ends, ends[::-1]):
        rows = places.rings(ring, *pair)
        assert set(rows) == {n for n in places.known if ring_of(n) == ring and "palpebral" not in n}
        for name, row in rows.items():
            known = places.known[name]
            assert isinstance(row, SphincterMuscle) and isinstance(known, SphincterMuscle)
            np.testing.assert_allclose(row.centre, known.centre, atol=0.02)
            np.testing.assert_allclose(row.axes, known.axes, atol=0.02)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 2**31))
def test_axis_ends_are_paired_in_any_order(order: list[int], seed: int) -> None:
    """Jittered by a few millimetres, and with one more that belongs nowhere."""
    places = places_of("built-in")
    ends = np.concatenate([e for r in RINGS if (e := places.axis_ends(places.known, r)) is not None])
    ends = ends + np.random.default_rng(seed).normal(0.0, 1.0, ends.shape)
    stray = np.array([[0.0, 95.0, 60.0]])
    for points in (ends[list(order)], np.concatenate([ends[list(order)], stray])):
        found = places.rings_of(points)
        assert {ring: {order[i] // 2 for i in pair} for ring, pair in found.items()} == {
            ring: {k} for k, ring in enumerate(RINGS)
        }


@settings(max_examples=20, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-80.0, 80.0))
def test_rays_end_on_skin_and_bone(turn: float, height: float) -> None:
    """Skin is met first; the layer of the rings lies under it, by half the depth of the bone."""
    places = places_of("built-in")
    way = np.array([-np.sin(turn), 0.0, -np.cos(turn)])
    start = np.array([0.0, height, places.cylinder.axis[1]]) - 300.0 * way
    skin = places.skin_along(start, way)
    if skin is None:  # an eyeball is in front
        assert 0.0 < height < 30.0 and 0.1 < abs(turn) < 0.7
        return
    assert point_distance(skin[None], FACE.mesh)[0][0] < 1e-6
    layer = places.ring_layer(start, way)
    assert layer is not None and np.linalg.norm(layer - skin) < 16.0
    hit = places.bone_along(start, way)
    if hit is not None:
        bone, name = hit
        mesh = FACE.cranium if name == "cranium" else FACE.jaw_mesh
        assert point_distance(bone[None], mesh)[0][0] < 1e-6
        assert (bone - skin) @ way > -1.0


def test_rays_that_miss_say_so() -> None:
    """Above the head, and into an eye."""
    places = places_of("built-in")
    assert places.skin_along([0.0, 500.0, 300.0], [0.0, 0.0, -1.0]) is None
    assert places.bone_along([0.0, 500.0, 300.0], [0.0, 0.0, -1.0]) is None
    assert places.ring_layer([0.0, 500.0, 300.0], [0.0, 0.0, -1.0]) is None
    eye = FACE.eyes["left"]
    assert places.skin_along(eye.centre + np.array([0.0, 1.5, 100.0]), [0.0, 0.0, -1.0]) is None
