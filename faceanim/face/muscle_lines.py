"""White lines between marks: which marks they join, and which of them end nowhere.

Every pair of marks is a candidate, straight or bent; one stays that has white all along, up to the marks themselves.
Of these the cheapest set is chosen that explains the white seen and leaves no mark alone, as an integer program: lines
cross, run on under foreign marks and converge, so that no line can be told apart by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_matrix, csr_matrix, hstack, identity, vstack

from faceanim.ground.arrays import Bools, Floats, Ints

WORKING_SIDE = 1024
"""Larger pictures are reduced to this before lines are looked for [pixel]."""
MOST_BEND = 0.13
"""Greatest sagitta of a line, in its length."""
MOST_PATHS, MOST_PIECES = 1500, 50
"""Candidates and loose pieces that are looked at; more are seen in noise only."""
UNEXPLAINED = 0.18
ALONE = 2.0
"""Costs of leaving white unexplained [per pixel's length] and a mark without line; a line costs 1."""
GLARE, MOST_GLARE = 212, 0.5
"""Ground on which no white line shows, 0..255, and the share of it that a line may cross."""
LEAST_LENGTH, LEAST_STRAY = 9.0, 28.0
"""Shortest loose line that is believed, with one mark and with none [pixel at a side of 512]."""


@dataclass(frozen=True, eq=False)
class Lines:
    """pair : (l, 2) indices into the marks, two of one kind where a line is wrong   loose : (n, 2) loose ends [pixel]
    touched : (m,) marks that a loose line reaches
    """

    pair: Ints
    loose: Floats
    touched: Bools


@dataclass(frozen=True, eq=False)
class _Sight:
    """What is seen of lines.

    white : (h, w) 0..1   hidden : (h, w) 1 under marks and on glare   glare : (h, w) 1 where the ground is too bright
    for a line to show   light : (h, w) 1 where it nearly is   peak, width : usual white and width [pixel] of a line
    unit : pixels to one pixel of a picture 512 wide
    """

    white: np.ndarray
    hidden: np.ndarray
    glare: np.ndarray
    light: np.ndarray
    peak: float
    width: float
    unit: float


@dataclass(frozen=True, eq=False)
class _Paths:
    """Candidates: pair (c, 2), cost (c,), and their courses, c arrays (n, 2) [pixel]."""

    pair: Ints
    cost: Floats
    course: list[Floats]


def find_lines(picture: np.ndarray, marks: Floats, kind: Ints, radius: float, blind: Floats) -> Lines:
    """Return the lines of `picture` (h, w, 3) uint8 between `marks` (n, 2) [pixel] of `kind` (n,): 0 attachment, 1
    insertion; radius : of the marks [pixel]; blind : (m, 2) other discs, which hide lines as well [pixel].
    """
    side = max(picture.shape[:2])
    ratio = min(1.0, WORKING_SIDE / side)
    bright = cv2.min(cv2.min(picture[:, :, 0], picture[:, :, 1]), picture[:, :, 2])
    if ratio < 1.0:
        bright = cv2.resize(bright, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)
    sight = _sight(bright, marks * ratio, np.vstack([marks, blind]) * ratio, radius * ratio)
    place = marks * ratio
    paths = _straight(sight, place, kind, radius * ratio)
    chosen, left = _choose(sight, paths, len(marks))
    for k in chosen:
        if kind[paths.pair[k, 0]] == kind[paths.pair[k, 1]]:
            _stroke(left, paths.course[k], sight.width, 1.0)
    if left.sum() > 6.0 * sight.unit * sight.width and len(marks) > 1:
        paths = _joined(paths, _bent(sight, place, kind, radius * ratio, left))
        chosen, left = _choose(sight, paths, len(marks))
    loose, touched = _loose_ends(sight, left, place, radius * ratio)
    return Lines(paths.pair[chosen], loose / ratio, touched)


def _sight(bright: np.ndarray, marks: Floats, discs: Floats, radius: float) -> _Sight:
    """Return where `bright` (h, w) uint8 is thin and white, as coverage."""
    hidden = _under(discs, radius + 1.2, bright.shape)
    unit = max(bright.shape) / 512.0
    radius = radius if radius else 3.0 * unit
    wide = 2 * round(1.3 * radius + 1.0) + 1
    filled = np.where(hidden, cv2.medianBlur(bright, min(4 * wide + 1, 101)), bright)
    ground = cv2.morphologyEx(filled, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide)))
    glare = cv2.dilate((ground > GLARE).view(np.uint8), np.ones((wide, wide), np.uint8)) > 0
    light = (ground > 0.87 * GLARE).astype(np.float32)
    ground = ground.astype(np.float32)
    white = np.clip((filled - ground) / np.maximum(255.0 - ground, 45.0), 0.0, 1.0).astype(np.float32)
    white[hidden | glare] = 0.0
    ring = _ring(marks, radius + 2.2)
    seen = _read(white, ring) if len(marks) else np.zeros((1, 1))
    top = np.sort(seen.max(axis=1))
    strong = top[top > 0.35]
    peak = float(np.clip(np.median(strong), 0.4, 1.0)) if len(strong) else 0.8
    share = np.minimum(seen[seen.max(axis=1) > 0.35] / peak, 1.0)
    arc = 2.0 * np.pi * (radius + 2.2) / max(ring.shape[1], 1)
    # Many marks have several lines; those with one tell its width.
    width = float(np.percentile((share * (share > 0.15)).sum(axis=1), 20)) * arc if len(share) else 0.6 * radius
    hidden = (hidden | glare).astype(np.float32)
    return _Sight(white, hidden, glare.astype(np.float32), light, peak, float(np.clip(width, 1.0, 1.2 * radius)), unit)


def _under(discs: Floats, radius: float, shape: tuple[int, ...]) -> np.ndarray:
    hidden = np.zeros(shape, np.uint8)
    for x, y in discs:
        cv2.circle(hidden, (round(16 * (x - 0.5)), round(16 * (y - 0.5))), round(16 * radius), 1, -1, shift=4)
    return hidden > 0


def _ring(middle: Floats, radius: float) -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, 2 * int(np.pi * radius) + 1)[:-1]
    return middle[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _read(image: np.ndarray, at: Floats) -> Floats:
    """Return `image` (h, w) float32 at points (..., 2) [pixel], linearly between pixel centres; 0 outside."""
    place = (at - 0.5).astype(np.float32)
    rows = place.reshape(-1, place.shape[-2], 2)
    out = np.empty(rows.shape[:2])
    for first in range(0, len(rows), 16384):
        part = rows[first : first + 16384]
        out[first : first + 16384] = cv2.remap(
            image, part[:, :, 0], part[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
    return out.reshape(place.shape[:-1])


def _pairs(place: Floats, kind: Ints) -> tuple[Ints, Ints]:
    """Return all pairs of marks, attachment first, and whether they are mixed up (1) or proper (0)."""
    i, j = np.triu_indices(len(place), 1)
    swap = kind[i] > kind[j]
    first, second = np.where(swap, j, i), np.where(swap, i, j)
    return np.stack([first, second], 1).astype(np.int32), (kind[i] == kind[j]).astype(np.int32)


def _course(start: Floats, end: Floats, bend: Floats | float, count: int) -> Floats:
    """Return points (..., count, 2) on a parabola of sagitta `bend` (in lengths) from start to end."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    way = end - start
    across = np.stack([-way[..., 1], way[..., 0]], axis=-1)
    arch = 4.0 * np.asarray(bend)[..., None, None] * t * (1.0 - t)
    return start[..., None, :] + t * way[..., None, :] + arch * across[..., None, :]


def _support(sight: _Sight, course: Floats) -> tuple[Floats, Floats, Floats]:
    """Return mean and worst white (..., 0..1) along courses (..., n, 2), and the share of them that is seen."""
    level = np.minimum(_read(sight.white, course) / sight.peak, 1.0)
    seen = _read(sight.hidden, course) < 0.02
    count = seen.sum(axis=-1)
    mean = np.where(seen, level, 0.0).sum(axis=-1) / np.maximum(count, 1)
    window = 5
    run = np.cumsum(np.where(seen, level, 1.0), axis=-1)
    if course.shape[-2] <= window:
        return mean, mean, count / course.shape[-2]
    worst = ((run[..., window:] - run[..., :-window]) / window).min(axis=-1)
    return mean, worst, count / course.shape[-2]


def _hopeful(sight: _Sight) -> np.ndarray:
    """Return (h, w) what may be white at best: the greatest within a pixel, and all that is hidden."""
    near = cv2.dilate(np.minimum(sight.white / sight.peak, 1.0), np.ones((3, 3), np.uint8))
    return np.maximum(near, sight.hidden)


def _straight(sight: _Sight, place: Floats, kind: Ints, radius: float) -> _Paths:
    """Return the straight candidates with white all along."""
    pair, mixed = _pairs(place, kind)
    if not len(pair):
        return _paths([])
    # Most pairs are ruled out by a few places between them.
    likely = _read(_hopeful(sight), _course(place[pair[:, 0]], place[pair[:, 1]], 0.0, 16)).min(axis=1) > 0.3
    pair, mixed = pair[likely], mixed[likely]
    length = np.hypot(*(place[pair[:, 1]] - place[pair[:, 0]]).T)
    keep: list[tuple[Ints, float, Floats]] = []
    limit = 10 * sight.unit
    order = np.argsort(length, kind="stable")
    while len(order):
        # Candidates of similar length are read together, as many points each.
        group = order[length[order] <= limit]
        order, limit = order[len(group) :], limit * 1.25
        if not len(group):
            continue
        count = int(np.ceil(length[group[-1]])) + 1
        courses = _course(place[pair[group, 0]], place[pair[group, 1]], 0.0, count)
        mean, worst, share = _support(sight, courses)
        visible = share * length[group]
        glare = _read(sight.glare, courses).mean(axis=1)
        for g, k in enumerate(group):
            if glare[g] > MOST_GLARE:
                continue
            if visible[g] < 2.5 * sight.unit:
                if not mixed[k] and length[k] < 2.0 * radius + 6.0 * sight.unit:
                    keep.append((pair[k], 2.8, courses[g]))
            elif worst[g] > (0.55 if mixed[k] else 0.5) and mean[g] > (0.85 if mixed[k] else 0.8):
                # Deduct from a line what its whiteness leaves to be desired; a line of one kind is the last resort.
                keep.append((pair[k], _cost(mean[g], worst[g], 0.0, mixed[k]), courses[g]))
    return _paths(keep)


def _cost(mean: float, worst: float, bend: float, mixed: int) -> float:
    return 1.0 + 9.0 * (1.0 - mean) + 2.5 * (1.0 - worst) + 2.0 * abs(bend) + 1.2 * mixed


def _paths(keep: list[tuple[Ints, float, Floats]]) -> _Paths:
    """Return candidates, the cheapest if there are more than any picture needs."""
    keep = sorted(keep, key=lambda k: k[1])[:MOST_PATHS]
    pair = np.array([k[0] for k in keep], np.int32).reshape(-1, 2)
    return _Paths(pair, np.array([k[1] for k in keep], float), [k[2] for k in keep])


def _joined(a: _Paths, b: _Paths) -> _Paths:
    return _Paths(np.vstack([a.pair, b.pair]), np.concatenate([a.cost, b.cost]), a.course + b.course)


def _bent(sight: _Sight, place: Floats, kind: Ints, radius: float, left: np.ndarray) -> _Paths:
    """Return the bent candidates with white all along, some of it not explained yet (`left`, (h, w))."""
    pair, mixed = _pairs(place, kind)
    wanted = _read(cv2.blur(left, (5, 5)), _ring(place, radius + 3.5)).max(axis=1) > 0.02
    sure = wanted[pair].any(axis=1)
    pair, mixed = pair[sure], mixed[sure]
    length = np.hypot(*(place[pair[:, 1]] - place[pair[:, 0]]).T)
    hopeful = _hopeful(sight)
    keep: list[tuple[Ints, float, Floats]] = []
    for k in np.flatnonzero((length > 2.0 * radius + 4.0) & (length < 330.0 * sight.unit)):
        start, end = place[pair[k, 0]], place[pair[k, 1]]
        steps = max(int(np.ceil(MOST_BEND * length[k] / (0.6 * sight.width))), 1)
        bends = np.linspace(-MOST_BEND, MOST_BEND, 2 * steps + 1)
        level = _read(hopeful, _course(start, end, bends, max(int(length[k] / (2.0 * sight.unit)), 8)))
        hope = np.where((level.mean(axis=1) > 0.65) & ((level < 0.3).mean(axis=1) < 0.12), level.mean(axis=1), 0.0)
        if not hope.any():
            continue
        likely = bends[hope > hope.max() - 0.06]
        bend, mean, worst, course = _settled(sight, start, end, likely.min(), likely.max(), bends[1] - bends[0])
        good = mean > 0.85 and worst > 0.55 if mixed[k] else mean > 0.75 and worst > 0.45
        if good and _read(sight.glare, course).mean() < MOST_GLARE:
            keep.append((pair[k], _cost(mean, worst, bend, mixed[k]), course))
    return _paths(keep)


def _settled(
    sight: _Sight, start: Floats, end: Floats, least: float, most: float, step: float
) -> tuple[float, float, float, Floats]:
    """Return the bend that fits best between two, its mean and worst white, and its course."""
    bends = np.arange(least - step, most + 1.01 * step, 0.25 * step)
    courses = _course(start, end, bends, int(np.ceil(np.hypot(*(end - start)))) + 1)
    mean, worst, _ = _support(sight, courses)
    best = int(np.argmax(mean + 0.5 * worst))
    return float(bends[best]), float(mean[best]), float(worst[best]), courses[best]


def _choose(sight: _Sight, paths: _Paths, marks: int) -> tuple[Ints, np.ndarray]:
    """Return the numbers of the paths that explain the white at least cost, and the white (h, w) that stays."""
    core = (sight.white > 0.5 * sight.peak).astype(np.float32)
    if not len(paths.cost):
        return np.zeros(0, np.int32), core
    inside, groups = _explained(sight, paths, core)
    size = np.asarray(groups) * UNEXPLAINED / (sight.unit * sight.width)
    ends = coo_matrix(
        (np.ones(paths.pair.size), (paths.pair.ravel(), np.repeat(np.arange(len(paths.cost)), 2))),
        (marks, len(paths.cost)),
    )
    rows = vstack([inside, ends])
    program = hstack([rows, identity(rows.shape[0])]).tocsc()
    price = np.concatenate([paths.cost, size, np.full(marks, ALONE)])
    whole = np.concatenate([np.ones(len(paths.cost)), np.zeros(rows.shape[0])])
    found = milp(
        price, integrality=whole, bounds=Bounds(0.0, 1.0), constraints=LinearConstraint(program, lb=1.0),
        options={"time_limit": 2.0, "mip_rel_gap": 0.0},
    )  # fmt: skip
    use = np.zeros(0, int) if found.x is None else np.flatnonzero(found.x[: len(paths.cost)] > 0.5)
    left = core.copy()
    for k in use:
        _stroke(left, paths.course[k], sight.width + 3.0 * sight.unit, 0.0)
    return _one_each(paths, use), left


def _one_each(paths: _Paths, use: np.ndarray) -> Ints:
    """Return `use` with the cheapest line of each pair."""
    best: dict[tuple[int, int], int] = {}
    for k in use[np.argsort(paths.cost[use], kind="stable")]:
        best.setdefault((int(paths.pair[k, 0]), int(paths.pair[k, 1])), int(k))
    return np.array(sorted(best.values()), np.int32)


def _stroke(image: np.ndarray, course: Floats, width: float, value: float) -> None:
    points = np.round(16 * (course - 0.5)).astype(np.int32)
    cv2.polylines(image, [points.reshape(-1, 1, 2)], False, value, max(round(width), 1), shift=4)


def _explained(sight: _Sight, paths: _Paths, core: np.ndarray) -> tuple[csr_matrix, list[int]]:
    """Return which groups of white pixels each path explains (groups, paths), and how many pixels a group has."""
    number = np.cumsum(core.ravel() > 0).reshape(core.shape)
    count = int(number[-1, -1])
    canvas = np.zeros(core.shape, np.uint8)
    sets = np.zeros((count, len(paths.cost)), bool)
    for k, course in enumerate(paths.course):
        low = np.maximum(np.floor(course.min(0)).astype(int) - 6, 0)
        high = np.ceil(course.max(0)).astype(int) + 6
        box = np.s_[low[1] : high[1], low[0] : high[0]]
        _stroke(canvas, course, sight.width + 1.2 * sight.unit, 1.0)
        hit = (canvas[box] > 0) & (core[box] > 0)
        sets[number[box][hit] - 1, k] = True
        canvas[box] = 0
    packed = np.packbits(sets[sets.any(axis=1)], axis=1)
    if not len(packed):
        return csr_matrix((0, len(paths.cost))), []
    rows, sizes = np.unique(packed, axis=0, return_counts=True)
    return csr_matrix(np.unpackbits(rows, axis=1, count=len(paths.cost)).astype(float)), sizes.tolist()


def _loose_ends(sight: _Sight, left: np.ndarray, place: Floats, radius: float) -> tuple[Floats, Bools]:
    """Return the loose ends (n, 2) of lines in the white that is `left`, and which marks (m,) they start from."""
    touched = np.zeros(len(place), bool)
    # The white of an eye is a line where lid and iris leave little of it.
    light = cv2.dilate(sight.light, np.ones((2 * round(8.0 * sight.unit) + 1,) * 2, np.uint8))
    ends = []
    for tips in _pieces(sight, left):
        length = float(np.hypot(*(tips[1] - tips[0])))
        at = [_aimed_at(place, tips[1 - k], tips[k], radius + 4.0 * sight.unit + 1.2, radius) for k in range(2)]
        known = [k for k in at if k >= 0]
        if length < (LEAST_LENGTH if known else LEAST_STRAY) * sight.unit or not _is_line(sight, *tips):
            continue
        if len(known) == 2 and known[0] != known[1]:
            continue
        doubtful = not known or length < LEAST_STRAY * sight.unit
        if doubtful and _read(light, _course(tips[0], tips[1], 0.0, 12)).mean() > 0.3:
            continue
        touched[known] = True
        far = 1 if at[0] >= 0 else 0 if at[1] >= 0 else int(_gap(place, tips[1]) > _gap(place, tips[0]))
        ends.append(tips[far])
    return np.array(ends).reshape(-1, 2), touched


def _is_line(sight: _Sight, start: Floats, end: Floats) -> bool:
    """Say whether white as bright as a line's runs from start to end, and darkness along both its sides."""
    way = end - start
    across = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-6)
    steps = np.arange(-3.0, 3.01, 0.5) * sight.unit * max(1.0, 0.5 * sight.width / sight.unit)
    bend = np.linspace(-MOST_BEND, MOST_BEND, 9)
    middle = max(bend, key=lambda b: float(_support(sight, _course(start, end, float(b), 24))[0]))
    course = _course(start, end, float(middle), max(int(np.hypot(*way)), 8))
    level = _read(sight.white, course + steps[:, None, None] * across) / sight.peak
    core = level[4:9].max(axis=0)
    sides = np.minimum(level[:2].mean(axis=0), level[-2:].mean(axis=0)), np.maximum(level[0], level[-1])
    return bool(np.median(core) > 0.85 and np.percentile(core, 20) > 0.6 and np.mean(sides[1] < 0.35) > 0.65)


def _aimed_at(place: Floats, start: Floats, end: Floats, reach: float, radius: float) -> int:
    """Return the mark within `reach` of `end` that the line from `start` aims at, or -1."""
    if not len(place):
        return -1
    way = (end - start) / max(float(np.hypot(*(end - start))), 1e-6)
    away = place - end
    off = np.abs(away[:, 0] * way[1] - away[:, 1] * way[0])
    fits = (np.hypot(*away.T) < reach) & (off < 1.2 * radius) & (away @ way > 0.0)
    return int(np.argmin(np.where(fits, off, np.inf))) if fits.any() else -1


def _gap(place: Floats, point: Floats) -> float:
    return float(np.hypot(*(place - point).T).min()) if len(place) else 0.0


def _pieces(sight: _Sight, left: np.ndarray) -> list[Floats]:
    """Return the tips (2, 2) of the thin white pieces in `left`, those in one line joined."""
    count, label, stats, _ = cv2.connectedComponentsWithStats((left > 0).astype(np.uint8), connectivity=8)
    tips = []
    for k in range(1, count):
        x, y, w, h, area = stats[k]
        if max(w, h) < 3.0 * sight.unit:
            continue
        yy, xx = np.nonzero(label[y : y + h, x : x + w] == k)
        points = np.stack([xx + x + 0.5, yy + y + 0.5], axis=1)
        axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
        along = (points - points.mean(0)) @ axis
        reach = float(np.ptp(along)) + 1.0
        bright = sight.white[yy + y, xx + x]
        if area > 1.8 * sight.width * reach or np.percentile(bright, 75) < 0.7 * sight.peak:
            continue
        tips.append(points[[np.argmin(along), np.argmax(along)]])
    tips.sort(key=lambda tip: -float(np.hypot(*(tip[1] - tip[0]))))
    return _linked(sight, tips[:MOST_PIECES])


def _linked(sight: _Sight, tips: list[Floats]) -> list[Floats]:
    """Join pieces that continue each other with white (or marks) between them."""
    k = 0
    while k < len(tips):
        for other in range(k + 1, len(tips)):
            both = np.vstack([tips[k], tips[other]])
            axis = np.linalg.svd(both - both.mean(0))[2]
            along, off = ((both - both.mean(0)) @ axis.T).T
            order = np.argsort(along)
            apart = {int(order[0]) // 2, int(order[1]) // 2} == {0} or {int(order[0]) // 2, int(order[1]) // 2} == {1}
            gap = both[order[1:3]]
            if not apart or np.abs(off).max() > 1.5 * sight.width or np.hypot(*(gap[1] - gap[0])) > 40.0 * sight.unit:
                continue
            if _support(sight, _course(gap[0], gap[1], 0.0, 12))[1] > 0.5:
                tips[k] = both[order[[0, 3]]]
                del tips[other]
                k = -1
                break
        k += 1
    return tips
