"""Muscle images: drawn, read again, on this head and on others; everything that can be wrong with one."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from time import perf_counter

import msgspec
import numpy as np
import pytest
from heads import other_head
from hypothesis import given, settings
from hypothesis import strategies as st

from faceanim.bench.muscle_images import TREATMENTS, mark_errors
from faceanim.face.attach import EAR, SCALP
from faceanim.face.face import Face
from faceanim.face.library import load_face
from faceanim.face.muscle_check import check_picture, check_table
from faceanim.face.muscle_image import (
    BLUE,
    GREEN,
    RED,
    WHITE,
    drawn_marks,
    map_picture,
    paint_marks,
    read_picture_marks,
)
from faceanim.face.muscle_places import RINGS, Places
from faceanim.face.muscles import AnyMuscle, LinearMuscle, SheetMuscle, one_sided
from faceanim.ground.errors import UserError
from faceanim.render.muscle_picture import face_picture, muscle_image

FACE = load_face()
PLACES = Places(FACE)
ROWS = one_sided(FACE.muscle_table)
LINES = {n: m for n, m in ROWS.items() if isinstance(m, (LinearMuscle, SheetMuscle))}


@cache
def picture_of(kind: str, size: int = 512) -> np.ndarray:
    """Return the built-in muscle image."""
    return muscle_image(FACE, FACE.muscle_table, kind, size, places=PLACES)[0]


AT_512 = ("as drawn", "JPEG 90")


@pytest.mark.parametrize(
    "treatment", [pytest.param(name, marks=[] if name in AT_512 else pytest.mark.slow) for name in TREATMENTS]
)
@pytest.mark.parametrize("kind", ["front", "cylinder"])
def test_drawn_and_read_again(kind: str, treatment: str) -> None:
    """All muscles are paired and named right, whatever happened to the file; at 512 x 512 within a pixel's size."""
    found = map_picture(TREATMENTS[treatment](picture_of(kind)), FACE, places=PLACES)
    assert found.kind == kind
    assert {p.name for p in found.placed} == {*LINES, *RINGS}
    assert set(found.table) == set(ROWS)
    assert found.faults == ()
    errors = mark_errors(found, ROWS, PLACES)
    if treatment in AT_512:
        assert np.median(errors) < 0.5
        assert errors.max() < 1.5
    for name, row in found.table.items():
        known = ROWS[name]
        assert type(row) is type(known)
        assert getattr(row, "bone", None) == getattr(known, "bone", None)
        assert row.force == known.force


def test_a_clean_picture_raises_no_fault() -> None:
    """Nor does the list of muscles that it was drawn from."""
    assert check_picture(picture_of("front"), FACE, places=PLACES) == []
    assert check_table(FACE.muscle_table, FACE, places=PLACES) == []


def test_reading_and_checking_are_quick() -> None:
    """The best of three stays below two seconds and one."""
    picture = picture_of("cylinder")
    for work, limit in ((map_picture, 2.0), (check_picture, 1.0)):
        seconds = []
        for _ in range(3):
            start = perf_counter()
            work(picture, FACE)
            seconds.append(perf_counter() - start)
        assert min(seconds) < limit


# Random muscles


def _from_line(point: np.ndarray, line: np.ndarray) -> float:
    """Return the distance of a point (2,) from a segment (2, 2)."""
    way = line[1] - line[0]
    share = np.clip((point - line[0]) @ way / (way @ way), 0.0, 1.0)
    return float(np.linalg.norm(point - line[0] - share * way))


def _random_muscles(seed: int, count: int) -> dict[str, AnyMuscle]:
    """Return muscles of random place on both sides of the face; lines cross, but run under no other muscle's mark."""
    rng = np.random.default_rng(seed)
    rows: dict[str, AnyMuscle] = {}
    lines: list[np.ndarray] = []
    while len(rows) < count:
        turn, height = rng.uniform(-0.9, 0.9, 2), rng.uniform(-75.0, 70.0, 2)
        way = -np.stack([np.sin(turn), np.zeros(2), np.cos(turn)], axis=1)
        start = np.stack([np.zeros(2), height, np.full(2, PLACES.cylinder.axis[1])], axis=1) - 300.0 * way
        skin, bone = PLACES.skin(start, way), PLACES.bone(start, way, 300.0)
        if not (skin.found.all() and bone.found[1] and np.linalg.norm(bone.point[1] - skin.point[1]) < 40.0):
            continue
        nearest = np.argmin(np.linalg.norm(FACE.mesh.points - skin.point[0], axis=1))
        if FACE.region[nearest] in (SCALP, EAR):
            continue
        pixels = PLACES.cylinder.pixels(skin.point, (512, 512))
        long = np.linalg.norm(pixels[0] - pixels[1])
        close = any(
            _from_line(p, b) < 6.0 for a, b in [(pixels, q) for q in lines] + [(q, pixels) for q in lines] for p in a
        )
        if not 14.0 < long < 120.0 or close:
            continue
        lines.append(pixels)
        name = f"some_{len(rows)}"
        rows[name] = LinearMuscle(tuple(bone.point[1]), tuple(skin.point[0]), 900.0, 14.0, paired=False,
                                  bone=("cranium", "jaw")[bone.bone[1]])  # fmt: skip
    return rows


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 16), st.sampled_from(["as drawn", "JPEG 90"]))
def test_random_muscles_drawn_and_read_again(seed: int, count: int, treatment: str) -> None:
    """Each is found once, between the right ends, whatever crosses it."""
    rows = _random_muscles(seed, count)
    drawn = drawn_marks(rows, FACE, "cylinder", (512, 512), places=PLACES)
    picture = TREATMENTS[treatment](paint_marks(face_picture(FACE, "cylinder", 512), drawn))
    found = read_picture_marks(picture, FACE, "cylinder", places=PLACES)
    wanted = {(tuple(m.insertion), tuple(m.origin)) for m in rows.values() if isinstance(m, LinearMuscle)}
    assert [f for f in found.faults if f.code != "wrong-layer"] == []
    assert len(found.placed) == len(wanted)
    for insertion, origin in wanted:
        off = [np.linalg.norm(p.insertion - insertion) for p in found.placed]
        nearest = found.placed[int(np.argmin(off))]
        assert min(off) < 1.5
        across = np.cross(nearest.origin - origin, PLACES.across(np.array([origin]))[1][0])
        assert np.linalg.norm(across) < 1.5  # named muscles may spring from fascia or another bone on the same ray


# Other heads


@pytest.mark.slow
@pytest.mark.parametrize("density", ["coarse", "fine"])
def test_the_same_image_fits_the_other_densities(density: str) -> None:
    """At the same places within 1.5 mm."""
    found = map_picture(picture_of("front"), load_face(density=density))
    errors = mark_errors(found, ROWS, PLACES)
    assert {p.name for p in found.placed} == {*LINES, *RINGS}
    assert np.median(errors) < 0.5 and errors.max() < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["front", "cylinder"])
@pytest.mark.parametrize("scale", [0.6, 1.3])
def test_the_same_image_fits_a_scaled_head(kind: str, scale: float) -> None:
    """All lengths grow with the head, names stay."""
    head = other_head(FACE, scale)
    places = Places(head)
    found = map_picture(picture_of(kind), head, places=places)
    assert found.kind == kind
    assert {p.name for p in found.placed} == {*LINES, *RINGS}
    assert mark_errors(found, places.known, places).max() < 1.5 * scale
    row = found.table["zygomaticus_major_left"]
    assert isinstance(row, LinearMuscle)
    assert row.radius == pytest.approx(scale * LINES["zygomaticus_major_left"].radius)  # type: ignore[union-attr]


@pytest.mark.slow
def test_the_mirrored_image_on_the_mirrored_head() -> None:
    """Gives the mirrored muscles, left and right exchanged."""
    name = "corrugator_left"
    one = LINES[name]
    off = msgspec.structs.replace(one, insertion=(34.0, 44.0, 97.6), via=None)
    picture, _ = muscle_image(FACE, {**ROWS, name: off}, "front", places=PLACES)
    plain = map_picture(picture, FACE, places=PLACES)
    turned = map_picture(np.ascontiguousarray(picture[:, ::-1]), other_head(FACE, (-1.0, 1.0, 1.0)))
    swap = {"left": "right", "right": "left"}
    ends = {p.name: p for p in turned.placed}
    for placed in plain.placed:
        base, _, side = placed.name.rpartition("_")
        twin = ends[f"{base}_{swap[side]}" if side in swap else placed.name]
        if placed.bone is None:
            continue
        np.testing.assert_allclose(twin.insertion, placed.insertion * [-1, 1, 1], atol=0.02)
        np.testing.assert_allclose(twin.origin, placed.origin * [-1, 1, 1], atol=0.05)


# What can be wrong


def _paint(
    marks: Iterable[tuple[tuple[int, int, int], tuple[float, float]]],
    lines: Iterable[tuple[tuple[float, float], tuple[float, float]]] = (),
    base: np.ndarray | None = None,
) -> np.ndarray:
    """Return the face from the front (or `base`) with discs and lines painted on it."""
    from faceanim.face.muscle_image import LINE_WIDTH, MARK_RADIUS, _paint

    out = (face_picture(FACE, "front", 512) if base is None else base).astype(np.float32)
    for a, b in lines:
        _paint(out, np.array(a), np.array(b), 0.5 * LINE_WIDTH, WHITE)
    for colour, place in marks:
        _paint(out, np.array(place), np.array(place), MARK_RADIUS, colour)
    return np.round(out).astype(np.uint8)


BROW, CHEEK, JAW, SKY, HAIR, EYE = (190, 185), (160, 290), (200, 395), (20, 30), (256, 40), (195, 221)
NECK = (180, 470)
FAULTS = {
    "line-without-end": (_paint([(GREEN, CHEEK)], [(CHEEK, (200, 330))]), (200, 330)),
    "two-insertions": (_paint([(RED, CHEEK), (RED, BROW)], [(CHEEK, BROW)]), None),
    "two-attachments": (_paint([(GREEN, CHEEK), (GREEN, BROW)], [(CHEEK, BROW)]), None),
    "insertion-without-line": (_paint([(RED, CHEEK)]), CHEEK),
    "attachment-without-line": (_paint([(GREEN, CHEEK)]), CHEEK),
    "odd-axis-marks": (_paint([(BLUE, CHEEK)], base=picture_of("front")), CHEEK),
    "wrong-colour": (_paint([((255, 220, 0), CHEEK)], base=picture_of("front")), CHEEK),
    "off-face": (_paint([(RED, SKY), (GREEN, BROW)], [(SKY, BROW)]), SKY),
    "wrong-layer": (_paint([(RED, HAIR), (GREEN, BROW)], [(HAIR, BROW)]), HAIR),
    "floating-origin": (_paint([(RED, CHEEK), (GREEN, NECK)], [(CHEEK, NECK)]), NECK),
    "missing": (_paint([(RED, CHEEK), (GREEN, BROW)], [(CHEEK, BROW)]), None),
    "nothing-found": (face_picture(FACE, "front", 512), None),
}


@pytest.mark.parametrize("code", FAULTS)
def test_every_fault_is_named_where_it_is(code: str) -> None:
    """With its pixel, within a mark's size, and a sentence."""
    picture, place = FAULTS[code]
    faults = [f for f in check_picture(picture, FACE, "front", places=PLACES) if f.code == code]
    assert faults, [f.code for f in check_picture(picture, FACE, "front", places=PLACES)]
    assert len(faults[0].message) > 20
    if place is not None:
        assert faults[0].pixel is not None
        assert np.linalg.norm(np.array(faults[0].pixel) - place) < 4.0


def test_a_mark_on_an_eyeball_is_off_the_skin() -> None:
    """Nothing can pull there."""
    picture = _paint([(RED, EYE), (GREEN, BROW)], [(EYE, BROW)])
    assert "off-face" in {f.code for f in check_picture(picture, FACE, "front", places=PLACES)}


def test_each_missing_muscle_is_named() -> None:
    """All but two of the 23 are there; the lid muscle, which needs no marks, does not stand for the ring."""
    rows = {n: m for n, m in ROWS.items() if n not in ("risorius_left", "orbicularis_oculi_orbital_right")}
    picture, _ = muscle_image(FACE, rows, "cylinder", places=PLACES)
    for faults in (check_picture(picture, FACE, places=PLACES), check_table(rows, FACE, places=PLACES)):
        assert [f.muscle for f in faults] == ["risorius_left", "orbicularis_oculi_right"]
        assert {(f.code, f.severity) for f in faults} == {("missing", "warning")}


def test_a_picture_without_muscles_is_refused() -> None:
    """With the colours that are needed."""
    with pytest.raises(UserError, match=r"red \(255, 0, 0\)"):
        map_picture(face_picture(FACE, "front", 512), FACE, places=PLACES)
    with pytest.raises(UserError, match="kind"):
        map_picture(picture_of("front"), FACE, "side", places=PLACES)


@pytest.mark.parametrize(
    ("code", "change"),
    [
        ("insertion-off-skin", {"insertion": (20.0, -60.0, 120.0)}),
        ("floating-origin", {"origin": (57.6, -13.0, 80.0)}),
        ("wrong-layer", {"bone": "jaw"}),
        ("no-skin", {"insertion": (0.0, 0.0, 300.0), "radius": 1.0}),
    ],
)
def test_lists_are_checked_in_space(code: str, change: dict[str, object]) -> None:
    """A muscle is named that floats, lies on the wrong bone, or reaches no skin."""
    row = msgspec.structs.replace(ROWS["zygomaticus_major_left"], **change)
    faults = check_table({**ROWS, "zygomaticus_major_left": row}, FACE, places=PLACES)
    assert (code, "zygomaticus_major_left") in {(f.code, f.muscle) for f in faults}
    assert {f.muscle for f in faults} == {"zygomaticus_major_left"}


def test_marks_nearer_than_their_width_become_one() -> None:
    """Which several lines share; marks apart stay apart."""
    base = LINES["zygomaticus_major_left"]
    near = msgspec.structs.replace(base, insertion=(33.2, -53.2, 90.2), origin=(46.0, -18.0, 73.3), via=None)
    drawn = drawn_marks({"a": base, "b": near}, FACE, "front", (512, 512), places=PLACES)
    assert len(drawn.insertion) == 1 and len(drawn.attachment) == 2 and len(drawn.line) == 2


def face_with(face: Face, table: dict[str, AnyMuscle]) -> Face:
    """Return a face with other muscles."""
    return face.with_muscles(table, "test")


def test_muscles_that_were_read_move_the_face_alike() -> None:
    """Fibres of the drawn and read muscles pull where those of the built-in ones do."""
    found = map_picture(picture_of("front"), FACE, places=PLACES)
    own = face_with(FACE, found.table).muscles
    known = FACE.muscles
    assert set(own.names) == set(known.names)
    n = len(FACE.mesh.points)
    for name in known.names:
        a, b = (m.names.index(name) for m in (own, known))
        pull = [np.bincount(m.node[m.muscle == k], m.weight[m.muscle == k], n) for m, k in ((own, a), (known, b))]
        assert np.abs(pull[0] - pull[1]).sum() < 0.35, name
