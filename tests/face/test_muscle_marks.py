"""Marks and lines of muscle images: found where they are, joined as they are drawn, and faults named at their place."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from faceanim.face.library import asset_folder
from faceanim.face.muscle_marks import Marks, find_marks
from faceanim.ground.errors import UserError

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
SIZE = 512
FEW = settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@dataclass
class Drawing:
    """Attachments, insertions, axis ends (n, 2) [pixel], lines (attachment, insertion) and the bends of these."""

    attachment: np.ndarray
    insertion: np.ndarray
    axis: np.ndarray
    lines: list[tuple[int, int]]
    bends: np.ndarray

    def on(self, ground: np.ndarray, radius: float = 3.0, width: float = 1.7, colours=(GREEN, RED, BLUE)) -> np.ndarray:
        """Return the muscle image, lines first, marks on top."""
        image = ground.astype(float)
        for (a, b), bend in zip(self.lines, self.bends):
            stroke(image, arc(self.attachment[a], self.insertion[b], bend), width)
        for points, colour in zip((self.attachment, self.insertion, self.axis), colours):
            for point in points:
                disc(image, point, radius, colour)
        return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def drawing(attachment=(), insertion=(), axis=(), lines=(), bends=None) -> Drawing:
    points = [np.array(p, float).reshape(-1, 2) for p in (attachment, insertion, axis)]
    return Drawing(*points, list(lines), np.zeros(len(lines)) if bends is None else np.array(bends))


def arc(start, end, bend: float) -> np.ndarray:
    t = np.linspace(0.0, 1.0, 2 if bend == 0 else 24)[:, None]
    way = np.asarray(end, float) - start
    return start + t * way + 4.0 * bend * t * (1.0 - t) * np.array([-way[1], way[0]])


def stroke(image: np.ndarray, course: np.ndarray, width: float, colour=WHITE) -> None:
    """Blend a line of that width over `image` (h, w, 3) float, in place, antialiased."""
    low = np.maximum(np.floor(course.min(0) - width - 2).astype(int), 0)
    high = np.minimum(np.ceil(course.max(0) + width + 2).astype(int), image.shape[1::-1])
    if (high <= low).any():
        return
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    away = np.full(x.shape, np.inf)
    for a, b in pairwise(course):
        d = b - a
        t = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / max(d @ d, 1e-12), 0.0, 1.0)
        away = np.minimum(away, np.hypot(x - a[0] - t * d[0], y - a[1] - t * d[1]))
    cover = np.clip(0.5 * width + 0.5 - away, 0.0, 1.0)[..., None]
    box = image[low[1] : high[1], low[0] : high[0]]
    box[:] = box * (1.0 - cover) + cover * np.array(colour, float)


def disc(image: np.ndarray, centre, radius: float, colour) -> None:
    stroke(image, np.array([centre, centre], float), 2.0 * radius, colour)


@cache
def skin(size: int = SIZE, light: float = 0.75, seed: int = 0) -> np.ndarray:
    """A face of sorts on a grey gradient: skin, eyes with white and iris, reddish lips, highlights, grain."""
    texture = cv2.imread(str(asset_folder() / "albedo.jpg"))[:, :, ::-1]
    h, w = texture.shape[0] // 2, texture.shape[1] // 2
    face = cv2.resize(texture[h // 2 : h // 2 + h, w // 2 : w // 2 + w], (size, size), interpolation=cv2.INTER_AREA)
    image = np.repeat(np.repeat(np.linspace(60.0, 120.0, size)[:, None, None], size, 1), 3, 2)
    _oval(image, (256, 256), (195, 235), face * light)
    white = np.array([225, 220, 215]) if light < 1.0 else np.array([250, 250, 250])
    for x in (196, 316):
        _oval(image, (x, 205), (22, 9), white)
        _oval(image, (x, 204), (8, 8), (70, 120, 190) if x < 256 else (60, 40, 25))
        _oval(image, (x, 204), (4, 4), (10, 8, 8))
        _oval(image, (x - 3, 201), (1.5, 1.5), (255, 255, 255))
    _oval(image, (256, 360), (42, 13), (180, 95, 85))
    _oval(image, (256, 360), (38, 2), (90, 40, 40))
    _oval(image, (256, 290), (3, 8), (235, 225, 215))
    image += np.random.default_rng(seed).normal(0.0, 2.5, image.shape)
    return np.clip(image, 0, 255)


def _oval(image: np.ndarray, centre, axes, colour) -> None:
    k = len(image) / SIZE
    y, x = (np.mgrid[: len(image), : len(image)] + 0.5) / k
    deep = 1.0 - np.hypot((x - centre[0]) / axes[0], (y - centre[1]) / axes[1])
    cover = np.clip(deep * min(axes) * 0.7 + 0.5, 0.0, 1.0)[..., None]
    image[:] = image * (1.0 - cover) + cover * np.asarray(colour, float)


def random_face(seed: int, count: int = 14, bend: float = 0.0) -> Drawing:
    """About 2 * count lines with partly shared ends, left and right alike; every line shows where it leads."""
    rng = np.random.default_rng(seed)
    while True:
        attachment, insertion, lines = _random_half(rng, count)
        axis = _random_axes(rng, attachment + insertion)
        n, m = len(attachment), len(insertion)
        halves = [p + [np.array([SIZE - x, y]) for x, y in p] for p in (attachment, insertion, axis)]
        both = lines + [(a + n, b + m) for a, b in lines]
        out = drawing(*halves, lines=both, bends=rng.uniform(-bend, bend, len(both)))
        if _can_be_read(out):
            return out


def _random_half(rng, count: int):
    attachment: list[np.ndarray] = []
    insertion: list[np.ndarray] = []
    lines: list[tuple[int, int]] = []
    crowded = np.array([[320.0, 355.0], [285.0, 345.0], [275.0, 372.0]])

    def fits(point, alike, unlike):
        return point[0] > 258 and all(np.hypot(*(point - p)) > 2.6 for p in alike) and all(
            np.hypot(*(point - p)) > 6.5 for p in unlike
        )  # fmt: skip

    while len(lines) < count:
        old_b, old_a = insertion and rng.random() < 0.25, attachment and rng.random() < 0.1
        spot = (
            crowded[rng.integers(3)] + rng.normal(0, 6, 2)
            if rng.random() < 0.45
            else rng.uniform((260, 80), (430, 440))
        )
        b = insertion[rng.integers(len(insertion))] if old_b else spot
        a = attachment[rng.integers(len(attachment))] if old_a else rng.uniform((260, 80), (430, 440))
        right = (old_b or fits(b, insertion, attachment)) and (old_a or fits(a, attachment, [*insertion, b]))
        if not right or not 18 < np.hypot(*(a - b)) < 190:
            continue
        insertion += [] if old_b else [b]
        attachment += [] if old_a else [a]
        i = next(k for k, p in enumerate(attachment) if p is a)
        j = next(k for k, p in enumerate(insertion) if p is b)
        if (i, j) not in lines:
            lines.append((i, j))
    return attachment, insertion, lines


def _random_axes(rng, taken) -> list[np.ndarray]:
    axis: list[np.ndarray] = []
    while len(axis) < 3:
        point = rng.uniform((262, 80), (430, 440))
        if all(np.hypot(*(point - p)) > 7 for p in taken + axis):
            axis.append(point)
    return axis


def _can_be_read(it: Drawing) -> bool:
    """Say whether every line shows white of its own, and would not look the same with a mark nearby as its end."""
    hidden = np.zeros((SIZE, SIZE), np.uint8)
    for x, y in np.vstack([it.attachment, it.insertion]):
        cv2.circle(hidden, (round(16 * (x - 0.5)), round(16 * (y - 0.5))), 61, 1, -1, shift=4)

    def seen(a: int, b: int, bend: float) -> np.ndarray:
        image = np.zeros((SIZE, SIZE), np.uint8)
        points = np.round(16 * (arc(it.attachment[a], it.insertion[b], bend) - 0.5)).astype(np.int32)
        cv2.polylines(image, [points.reshape(-1, 1, 2)], False, 1, 2, shift=4)
        return image & (1 - hidden)

    def differ(one: np.ndarray, other: np.ndarray, rest: np.ndarray) -> bool:
        near = [cv2.dilate(image, np.ones((3, 3), np.uint8)) for image in (one, other, rest)]
        return int(((one & (1 - near[1])) | (other & (1 - near[0])))[near[2] == 0].sum()) >= 14

    masks = [seen(a, b, bend) for (a, b), bend in zip(it.lines, it.bends)]
    total = np.sum(masks, axis=0).astype(np.uint8)
    for (a, b), bend, mask in zip(it.lines, it.bends, masks):
        rest = (total > mask).astype(np.uint8)
        if not differ(mask, np.zeros_like(mask), rest):
            return False
        near_a, near_b = (
            np.flatnonzero((np.hypot(*(p - p[k]).T) < 14) & (np.arange(len(p)) != k))
            for p, k in ((it.attachment, a), (it.insertion, b))
        )
        others = [seen(k, b, bend) for k in near_a] + [seen(a, k, bend) for k in near_b]
        if not all(differ(mask, other, rest) for other in others):
            return False
    return True


def jpeg(image: np.ndarray, quality: int = 90) -> np.ndarray:
    done, data = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1])


def resized(image: np.ndarray, size: int, how: int) -> np.ndarray:
    return cv2.resize(image, (size, size), interpolation=how)


def codes(marks: Marks) -> list[str]:
    return [fault.code for fault in marks.fault]


def errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distance of each true mark to the found one; as many must be found as there are."""
    assert len(found) == len(true)
    away, which = cKDTree(found).query(true)
    assert len(set(which)) == len(true)
    return away


def assert_found(marks: Marks, it: Drawing, usual: float, worst: float, scale: float = 1.0) -> None:
    """All marks within bounds [pixel of the drawing], all lines and no other, no fault."""
    pairs = ((marks.attachment, it.attachment), (marks.insertion, it.insertion), (marks.axis, it.axis))
    away = np.concatenate([errors(found / scale, true) for found, true in pairs])
    assert np.percentile(away, 90) < usual
    assert away.max() < worst
    a = cKDTree(it.attachment * scale).query(marks.attachment)[1]
    b = cKDTree(it.insertion * scale).query(marks.insertion)[1]
    assert {(int(a[i]), int(b[j])) for i, j in marks.line} == set(it.lines)
    assert len(marks.line) == len(it.lines)
    assert codes(marks) == []


CLEAR = drawing([(150, 150), (350, 300), (200, 400)], [(250, 250), (380, 130)], [(100, 300), (400, 300)],
                [(0, 0), (1, 0), (1, 1), (2, 0)])  # fmt: skip


@pytest.mark.parametrize("light", [0.75, 1.15])
def test_a_face_without_marks_has_neither_marks_nor_faults(light):
    marks = find_marks(skin(light=light).astype(np.uint8))
    assert len(marks.insertion) == len(marks.attachment) == len(marks.axis) == len(marks.line) == 0
    assert marks.fault == ()
    assert find_marks(jpeg(skin(light=light).astype(np.uint8))).fault == ()


@pytest.mark.parametrize("value", [0, 128, 255])
@pytest.mark.parametrize("shape", [(1, 1), (40, 60), (384, 512)])
def test_a_blank_picture_is_empty(value, shape):
    marks = find_marks(np.full((*shape, 3), value, np.uint8))
    assert marks.insertion.shape == marks.attachment.shape == marks.axis.shape == (0, 2)
    assert marks.line.shape == (0, 2)
    assert marks.line.dtype == np.int32
    assert marks.fault == ()


@pytest.mark.parametrize("picture", [np.zeros((9, 9)), np.zeros((9, 9, 4), np.uint8), np.zeros((9, 9, 3))])
def test_what_is_no_picture_is_refused(picture):
    with pytest.raises(UserError, match="uint8"):
        find_marks(picture)


@pytest.mark.parametrize("seed", range(4))
def test_random_faces_are_read(seed):
    it = random_face(seed)
    assert_found(find_marks(it.on(skin(light=0.75 if seed % 2 else 1.1))), it, 0.1, 0.4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_random_faces_are_read_after_jpeg_and_resizing(seed):
    it = random_face(seed)
    image = it.on(skin())
    assert_found(find_marks(jpeg(image)), it, 0.25, 0.6)
    for size, how in ((384, cv2.INTER_AREA), (384, cv2.INTER_LINEAR), (1024, cv2.INTER_AREA), (1024, cv2.INTER_LINEAR)):
        assert_found(find_marks(resized(image, size, how)), it, 0.2, 0.6, size / SIZE)


@pytest.mark.parametrize("seed", range(3))
def test_bent_lines_are_read(seed):
    it = random_face(seed, count=10, bend=0.1)
    assert_found(find_marks(it.on(skin())), it, 0.1, 0.4)
    assert_found(find_marks(jpeg(it.on(skin()))), it, 0.25, 0.7)


@FEW
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(2.8, 6.0))
def test_a_lonely_disc_is_found_to_a_fraction_of_a_pixel(dx, dy, radius):
    axis = [(150 + dx, 250 + dy), (330 - dx, 250 + dy)]
    it = drawing([(200 + dx, 100)], [(300, 100 + dy)], axis, [(0, 0)])
    image = it.on(skin(), radius)
    assert_found(find_marks(image), it, 0.15, 0.15)
    assert_found(find_marks(jpeg(image)), it, 0.35, 0.35)


@FEW
@given(st.floats(2.6, 6.5), st.floats(0.0, 3.14), st.sampled_from([RED, GREEN, BLUE]))
def test_overlapping_discs_of_one_colour_are_told_apart(apart, angle, colour):
    shift = 0.5 * apart * np.array([np.cos(angle), np.sin(angle)])
    pairs = np.array([(170.3, 270.4), (330.7, 300.2), (256.0, 140.0)])
    ends = np.vstack([pairs + shift, pairs - shift])
    image = drawing(axis=ends).on(skin(), colours=(GREEN, RED, colour))
    image = drawing(axis=[(120, 420), (380, 420)]).on(image, colours=(GREEN, RED, colour))
    marks = find_marks(image)
    found = {RED: marks.insertion, GREEN: marks.attachment, BLUE: marks.axis}[colour]
    assert errors(found, np.vstack([ends, [(120, 420), (380, 420)]])).max() < 0.4


def test_three_discs_in_a_row_and_in_a_heap_are_told_apart():
    row = [(200.2, 250.1), (202.9, 251.0), (205.6, 251.8)]
    heap = [(300.0, 300.0), (303.0, 300.2), (301.5, 302.8)]
    alone = [(150, 350), (350, 150), (256, 420)]
    marks = find_marks(drawing(axis=row + heap + alone).on(skin()))
    assert errors(marks.axis, np.array(row + heap + alone)).max() < 0.4


def test_a_disc_half_under_another_colour_is_found():
    it = drawing([(200.3, 200.6), (300, 300)], [(203.5, 202.0), (250, 380)], lines=[(0, 1), (1, 0)])
    assert_found(find_marks(it.on(skin())), it, 0.3, 0.3)


def test_marks_cut_by_the_border_are_found():
    axis = np.array([(1.0, 200.0), (511.0, 300.0), (200.0, 0.5), (256.0, 511.5)])
    assert errors(find_marks(drawing(axis=axis).on(skin())).axis, axis).max() < 0.5


@pytest.mark.parametrize(
    "colours", [((0, 200, 0), (230, 20, 30), (40, 60, 255)), ((60, 255, 60), (255, 30, 30), (0, 0, 220))]
)
@pytest.mark.parametrize(("radius", "width"), [(3.0, 1.5), (6.0, 3.0), (8.0, 2.0)])
def test_artists_colours_and_sizes(colours, radius, width):
    assert_found(find_marks(CLEAR.on(skin(light=1.1), radius, width, colours)), CLEAR, 0.15, 0.15)


@pytest.mark.parametrize("angle", [5.0, 7.0, 10.0, 30.0, 90.0])
def test_crossing_lines_are_told_apart(angle):
    half = 90.0 * np.array([np.cos(np.radians(angle / 2)), np.sin(np.radians(angle / 2))])
    middle, mirror = np.array([256.0, 300.0]), np.array([1.0, -1.0])
    it = drawing(
        [middle - half, middle - half * mirror], [middle + half, middle + half * mirror], lines=[(0, 0), (1, 1)]
    )
    for image in (it.on(skin()), jpeg(it.on(skin()))):
        assert_found(find_marks(image), it, 0.35, 0.35)


def test_a_line_runs_on_under_a_foreign_mark():
    """The far insertion has no other line, so the one that is seen behind the near one leads there."""
    it = drawing([(150, 250), (250, 350)], [(250, 250), (350, 250)], lines=[(0, 1), (1, 0)])
    assert_found(find_marks(it.on(skin())), it, 0.15, 0.15)
    both = drawing([(150, 250)], [(250, 250), (350, 250)], lines=[(0, 0), (0, 1)])
    assert_found(find_marks(both.on(skin())), both, 0.15, 0.15)


@pytest.mark.parametrize("bend", [-0.1, -0.05, 0.05, 0.1])
def test_an_arc_is_one_line(bend):
    it = drawing([(150, 200), (330, 140)], [(330, 330), (180, 330)], lines=[(0, 0), (1, 1)], bends=[bend, -bend])
    assert_found(find_marks(it.on(skin())), it, 0.15, 0.15)


def only_fault(image: np.ndarray, code: str, place, within: float) -> None:
    for picture in (image, jpeg(image)):
        faults = find_marks(picture).fault
        assert [f.code for f in faults] == [code], faults
        assert np.hypot(*(np.array(faults[0].pixel) - place)) < within
        assert len(faults[0].message) > 30


@pytest.mark.parametrize(
    ("start", "end"), [((250, 250), (300, 200)), ((350, 300), (350, 350)), ((150, 150), (110, 240))]
)
def test_a_line_that_ends_without_a_mark(start, end):
    image = skin().copy()
    stroke(image, np.array([start, end], float), 1.7)
    only_fault(CLEAR.on(image), "line-without-end", end, 4.0)


def test_a_line_without_any_mark():
    image = skin().copy()
    stroke(image, np.array([(110.0, 340.0), (150.0, 380.0)]), 1.7)
    faults = find_marks(CLEAR.on(image)).fault
    assert [f.code for f in faults] == ["line-without-end"]
    assert min(np.hypot(*(np.array(faults[0].pixel) - p)) for p in ((110, 340), (150, 380))) < 4.0


def test_a_line_between_marks_of_one_kind():
    image = skin().copy()
    stroke(image, np.array([(250.0, 250.0), (380.0, 130.0)]), 1.7)
    only_fault(CLEAR.on(image), "two-insertions", (315, 190), 5.0)
    image = skin().copy()
    stroke(image, np.array([(150.0, 150.0), (200.0, 400.0)]), 1.7)
    only_fault(CLEAR.on(image), "two-attachments", (175, 275), 5.0)


def test_marks_without_line():
    more = drawing(np.vstack([CLEAR.attachment, [(400, 200)]]), CLEAR.insertion, CLEAR.axis, CLEAR.lines)
    only_fault(more.on(skin()), "attachment-without-line", (400, 200), 0.5)
    more = drawing(CLEAR.attachment, np.vstack([CLEAR.insertion, [(400, 200)]]), CLEAR.axis, CLEAR.lines)
    only_fault(more.on(skin()), "insertion-without-line", (400, 200), 0.5)


@pytest.mark.parametrize(
    "colour", [(255, 255, 0), (255, 0, 255), (0, 255, 255), (255, 140, 0), (140, 0, 255), (255, 0, 120), (0, 130, 255)]
)
def test_a_mark_in_a_wrong_colour(colour):
    image = CLEAR.on(skin()).astype(float)
    disc(image, (400, 200), 3.0, colour)
    only_fault(image.astype(np.uint8), "wrong-colour", (400, 200), 1.0)


def test_specks_are_ignored():
    rng = np.random.default_rng(3)
    image = CLEAR.on(skin())
    for colour in (RED, GREEN, BLUE, (255, 255, 0)):
        for x, y in rng.integers(40, 470, (10, 2)):
            if np.hypot(*(np.vstack([CLEAR.attachment, CLEAR.insertion, CLEAR.axis]) - (x, y)).T).min() > 10:
                image[y, x] = colour
    marks = find_marks(image)
    assert (len(marks.attachment), len(marks.insertion), len(marks.axis), len(marks.line)) == (3, 2, 2, 4)
    assert marks.fault == ()


def _sorted(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points.T, 3))]


def _ends(marks: Marks) -> np.ndarray:
    return np.hstack([marks.attachment[marks.line[:, 0]], marks.insertion[marks.line[:, 1]]])


def test_a_shifted_picture_has_shifted_marks():
    image = random_face(1).on(skin())
    shift = np.array([7, 4])
    one, other = find_marks(image[:-4, :-7]), find_marks(np.roll(image, (4, 7), axis=(0, 1))[4:, 7:])
    assert np.array_equal(one.line, other.line)
    moved = find_marks(cv2.copyMakeBorder(image, 4, 0, 7, 0, cv2.BORDER_REFLECT))
    plain = find_marks(image)
    for name in ("insertion", "attachment", "axis"):
        np.testing.assert_allclose(getattr(moved, name), getattr(plain, name) + shift, atol=0.02)
    assert np.array_equal(moved.line, plain.line)


def test_a_mirrored_picture_has_mirrored_marks():
    image = random_face(2).on(skin())
    one, other = find_marks(image), find_marks(np.ascontiguousarray(image[:, ::-1]))
    for name in ("insertion", "attachment", "axis"):
        mirrored = getattr(other, name) * (-1, 1) + (SIZE, 0)
        assert errors(getattr(one, name), mirrored).max() < 0.05
    mirrored = _ends(other) * (-1, 1, -1, 1) + (SIZE, 0, SIZE, 0)
    np.testing.assert_allclose(_sorted(_ends(one)), _sorted(mirrored), atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_most_of_many_random_faces_are_read_without_any_mistake(bend):
    right = {"clean": 0, "jpeg": 0, "384": 0, "1024": 0}
    for seed in range(100, 130):
        it = random_face(seed, count=15 if bend == 0.0 else 12, bend=bend)
        image = it.on(skin(light=0.75 if seed % 2 else 1.1))
        small, large = resized(image, 384, cv2.INTER_AREA), resized(image, 1024, cv2.INTER_LINEAR)
        for name, picture, k in (
            ("clean", image, 1.0),
            ("jpeg", jpeg(image), 1.0),
            ("384", small, 0.75),
            ("1024", large, 2.0),
        ):
            try:
                assert_found(find_marks(picture), it, 0.35, 0.9, k)
                right[name] += 1
            except AssertionError:
                pass
    assert min(right.values()) >= 26, right
