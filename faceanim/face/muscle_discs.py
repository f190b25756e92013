"""Coloured discs in a picture: where red, green and blue ones are, to a fraction of a pixel, and which are none of these.

A disc is fitted as coverage with a soft edge, so that resampling and JPEG's blurred colour shift nothing; discs of one
colour that run into each other are fitted together, as 1 - prod(1 - d_i). What covers a disc is left out of its fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from faceanim.ground.arrays import Bools, Floats

LEAST_COLOUR = 0.4
"""How far a mark's channel stands above the other two, at least [full scale]."""
LEAST_SATURATION = 0.6
HUES = (0.0, 120.0, 240.0)
WIDTHS = (20.0, 26.0, 24.0)
"""Hues of red, green and blue marks, and how far a mark's hue may be off [degree]."""
MOST_TOGETHER = 8
SMALLEST_RADIUS = 1.5
MOST_BLOBS = 250
"""Of one colour; a picture with more is no muscle image, and its blobs are noise."""


@dataclass(frozen=True, eq=False)
class Discs:
    """centre : red, green, blue, each (n, 2) [pixel]   radius : usual one [pixel]   wrong : (n, 2) of other colours."""

    centre: tuple[Floats, Floats, Floats]
    radius: float
    wrong: Floats


@dataclass(frozen=True, eq=False)
class _Blobs:
    """Connected pixels of one colour: label image, count, boxes (n, 5) x y w h area, thin radius (n,) [pixel]."""

    label: np.ndarray
    stats: np.ndarray
    thin: Floats


@dataclass(frozen=True, eq=False)
class _Patch:
    """What one blob is fitted to: pixel centres, coverage, weight, each (n,); box corner and shape."""

    x: Floats
    y: Floats
    cover: Floats
    weight: Floats


def find_discs(picture: np.ndarray) -> Discs:
    """Return the discs of `picture` (h, w, 3) uint8 RGB."""
    bands = [np.ascontiguousarray(picture[:, :, k]) for k in range(3)]
    lead = [_lead(bands, k) for k in range(3)]
    strong = cv2.subtract(cv2.max(cv2.max(*bands[:2]), bands[2]), cv2.min(cv2.min(*bands[:2]), bands[2]))
    level = _level(strong, picture)
    none = np.zeros((0, 2))
    if level == 0.0:
        return Discs((none, none, none), 0.0, none)
    blobs = [_mark_blobs(lead[k], level, k, picture) for k in range(3)]
    radius = _usual_radius([b.thin for b, _, _ in blobs])
    centre = []
    for k in range(3):
        usual = _usual_radius([blobs[k][0].thin]) if len(blobs[k][0].thin) >= 3 else radius
        others = cv2.max(lead[(k + 1) % 3], lead[(k + 2) % 3])
        centre.append(_fit_colour(lead[k], others, picture, *blobs[k], usual))
    if radius == 0.0:
        return Discs((none, none, none), 0.0, _wrong(strong, picture, none, level, 0.0))
    return Discs((centre[0], centre[1], centre[2]), radius, _wrong(strong, picture, np.vstack(centre), level, radius))


def _lead(bands: list[np.ndarray], k: int) -> np.ndarray:
    """Return by how much channel k exceeds the greater of the others, int16."""
    return cv2.subtract(bands[k], cv2.max(bands[(k + 1) % 3], bands[(k + 2) % 3]), dtype=cv2.CV_16S)


def _lead_of(colour: Floats, k: int) -> float:
    return float(colour[k] - np.delete(colour, k).max())


def _hue(colour: Floats) -> tuple[float, float]:
    """Return hue [degree] and saturation of an RGB colour."""
    r, g, b = (float(c) for c in colour)
    angle = np.degrees(np.arctan2(np.sqrt(3.0) * (g - b), 2.0 * r - g - b)) % 360.0
    top = max(r, g, b, 1.0)
    return float(angle), (top - min(r, g, b)) / top


def _is_hue(colour: Floats, k: int) -> bool:
    hue, saturation = _hue(colour)
    off = abs((hue - HUES[k] + 180.0) % 360.0 - 180.0)
    return off <= WIDTHS[k] and saturation >= LEAST_SATURATION


def _labelled(mask: np.ndarray, joined: np.ndarray | None = None) -> _Blobs:
    """Return the connected parts of `mask`, those that touch in `joined` as one."""
    shape = mask if joined is None else joined
    count, label, stats, _ = cv2.connectedComponentsWithStats(shape.view(np.uint8), connectivity=8)
    y, x = np.nonzero(mask)
    at = label[y, x]
    area = np.bincount(at, minlength=count).astype(float)
    n = np.maximum(area, 1.0)
    mx, my = np.bincount(at, x, count) / n, np.bincount(at, y, count) / n
    dx, dy = x - mx[at], y - my[at]
    xx, yy = np.bincount(at, dx * dx, count) / n + 1 / 12, np.bincount(at, dy * dy, count) / n + 1 / 12
    xy = np.bincount(at, dx * dy, count) / n
    # The variance of a disc across any axis is r^2 / 4; overlapping discs keep it across their thin axis.
    least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    stats[:, cv2.CC_STAT_AREA] = area
    return _Blobs(label, stats, 2.0 * np.sqrt(np.maximum(least, 0.0)))


def _level(strong: np.ndarray, picture: np.ndarray) -> float:
    """Return how colourful the marks are (difference of greatest and least channel, 0..255); 0 if there are none."""
    blobs = _labelled(strong > 255 * LEAST_COLOUR)
    largest = 0.02 * strong.size
    peaks = []
    for k in range(1, len(blobs.stats)):
        x, y, w, h, area = blobs.stats[k]
        if 6 <= area <= largest and w * h <= 4 * largest:
            inside = strong[y : y + h, x : x + w][blobs.label[y : y + h, x : x + w] == k]
            peaks.append(float(np.sort(inside)[-3]))
    return float(np.percentile(peaks, 75)) if peaks else 0.0


def _mark_blobs(lead: np.ndarray, level: float, colour: int, picture: np.ndarray) -> tuple[_Blobs, list[int], float]:
    """Return blobs of one colour, the numbers of those that are marks, and the colour's usual strength."""
    first = _labelled(lead > max(0.55 * level, 255 * LEAST_COLOUR))
    peaks = [_peak(lead, first, k) for k in range(1, len(first.stats)) if first.stats[k, 4] >= 4]
    amount = float(np.median(peaks)) if peaks else level
    mask = lead > 0.5 * amount
    blobs = _labelled(mask, cv2.dilate(mask.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    marks = []
    for k in range(1, len(blobs.stats)):
        x, y, w, h, area = blobs.stats[k]
        if area < 4 or blobs.thin[k] < 0.4 * SMALLEST_RADIUS or _peak(lead, blobs, k) < 0.7 * amount:
            continue
        box = np.s_[y : y + h, x : x + w]
        inside = (blobs.label[box] == k) & (lead[box] > 0.75 * min(amount, _peak(lead, blobs, k)))
        if _is_hue(np.median(picture[box][inside], axis=0), colour):
            marks.append(k)
    return _Blobs(blobs.label, blobs.stats, blobs.thin[marks]), marks, amount


def _peak(lead: np.ndarray, blobs: _Blobs, k: int) -> float:
    x, y, w, h = blobs.stats[k, :4]
    box = np.s_[y : y + h, x : x + w]
    inside = np.sort(lead[box][blobs.label[box] == k])
    return float(inside[-min(3, len(inside))])


def _usual_radius(thin: list[Floats]) -> float:
    known = np.concatenate(thin) if thin else np.zeros(0)
    known = known[known >= SMALLEST_RADIUS]
    return float(np.median(known)) if len(known) else 0.0


def _fit_colour(
    lead: np.ndarray,
    others: np.ndarray,
    picture: np.ndarray,
    blobs: _Blobs,
    marks: list[int],
    amount: float,
    usual: float,
) -> Floats:
    """Return the centres (n, 2) of the discs of one colour; usual : their radius [pixel], about."""
    least = max(4.0, 0.2 * np.pi * usual**2)
    marks = [k for k in marks if least <= blobs.stats[k, 4] <= 14 * np.pi * usual**2]
    if usual == 0.0 or not 0 < len(marks) <= MOST_BLOBS:
        return np.zeros((0, 2))
    paint = _paint(lead, picture, blobs, marks, amount)
    patches = [_patch(lead, others, picture, blobs, k, paint) for k in marks]
    singles = [p for p in patches if p.cover.sum() < 1.25 * np.pi * usual**2]
    fits = [_fit(p, _middle(p), usual, 0.5, free=2) for p in singles[:24]]
    good = [f for f in fits if f[3] < 0.12 and 0.6 * usual < f[1] < 1.6 * usual]
    radius = float(np.median([f[1] for f in good])) if good else usual
    soft = float(np.median([f[2] for f in good])) if good else 0.5
    noise = float(np.median([f[3] for f in good])) if good else 0.03
    found = [_discs_of(p, radius, soft, max(1.6 * noise, 0.025)) for p in patches]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _patch(lead: np.ndarray, others: np.ndarray, picture: np.ndarray, blobs: _Blobs, k: int, paint: Floats) -> _Patch:
    """Return coverage by `paint` (3,) RGB and weight of the pixels in and around blob k."""
    reach = 3 + int(0.3 * blobs.thin.max(initial=0.0))
    x, y, w, h = blobs.stats[k, :4]
    x0, y0 = max(x - reach, 0), max(y - reach, 0)
    box = np.s_[y0 : y + h + reach, x0 : x + w + reach]
    label, colour = blobs.label[box], picture[box].astype(float)
    covered = (
        cv2.dilate((others[box] > 0.4 * _lead_of(paint, int(paint.argmax()))).view(np.uint8), np.ones((3, 3), np.uint8))
        > 0
    )
    around = (label == 0) & ~covered
    if around.any():
        bright = colour.min(axis=2)
        around &= bright < np.median(bright[around]) + 45.0
    ground = np.median(colour[around], axis=0) if around.any() else np.full(3, 110.0)
    # A pixel is ground + paint + the white of a line. The lead of paint is blind to light and shade, so the share of
    # paint is read from that, less the lead of the ground where no line covers it.
    shares = np.linalg.lstsq(np.stack([paint - ground, 255.0 - ground], axis=1), (colour - ground).reshape(-1, 3).T)[0]
    line = np.clip(shares[1].reshape(label.shape), 0.0, 1.0)
    full = _lead_of(paint, int(paint.argmax()))
    tint = float(np.clip(_lead_of(ground, int(paint.argmax())) / full, -0.5, 0.5))
    cover = np.clip((lead[box] / full - (1.0 - line) * tint) / (1.0 - tint), -0.3, 1.15)
    yy, xx = np.nonzero(((label == k) | (label == 0)) & ~covered)
    return _Patch(xx + x0 + 0.5, yy + y0 + 0.5, cover[yy, xx], np.where(label == k, 1.0, 0.7)[yy, xx])


def _paint(lead: np.ndarray, picture: np.ndarray, blobs: _Blobs, marks: list[int], amount: float) -> Floats:
    """Return the usual RGB colour (3,) of marks where they are not mixed with what surrounds them."""
    full = []
    for k in marks[:64]:
        x, y, w, h = blobs.stats[k, :4]
        box = np.s_[y : y + h, x : x + w]
        value = np.where(blobs.label[box] == k, lead[box], -999)
        inside = value >= min(0.96 * float(value.max()), 0.96 * amount)
        full.append(np.median(picture[box][inside].astype(float), axis=0))
    return np.median(full, axis=0)


def _middle(patch: _Patch) -> Floats:
    mass = np.maximum(patch.cover, 0.0) * (patch.cover > 0.3)
    total = max(float(mass.sum()), 1e-9)
    return np.array([[(mass * patch.x).sum() / total, (mass * patch.y).sum() / total]])


def _cover(patch: _Patch, centre: Floats, radius: float, soft: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return coverage (n,), share left by other discs (k, n), edge density (k, n), vectors from centres (k, n, 2)."""
    away = np.stack([patch.x - centre[:, :1], patch.y - centre[:, 1:]], axis=2)
    deep = (radius - np.hypot(away[:, :, 0], away[:, :, 1])) / soft
    clear = np.maximum(1.0 - ndtr(deep), 1e-9)
    left = clear.prod(axis=0)
    return 1.0 - left, left / clear, np.exp(-0.5 * deep**2) / (np.sqrt(2.0 * np.pi) * soft), away


def _fit(
    patch: _Patch, centre: Floats, radius: float, soft: float, free: int = 0
) -> tuple[Floats, float, float, float]:
    """Fit discs to a patch; return centres (k, 2), radius, softness of the edge, and root mean square misfit.

    free : 0 moves the centres only, 1 the common radius too, 2 the softness too
    """
    value = np.concatenate([centre.ravel(), [radius, soft]])
    k, n = len(centre), 2 * len(centre) + free

    def misfit(value: Floats) -> tuple[Floats, Floats]:
        cover, share, edge, away = _cover(patch, value[: 2 * k].reshape(-1, 2), value[-2], value[-1])
        length = np.maximum(np.hypot(away[:, :, 0], away[:, :, 1]), 1e-6)
        pull = share * edge
        columns = [(pull / length)[:, :, None] * away]
        rows = np.moveaxis(columns[0], 1, 2).reshape(2 * k, -1)
        deep = (value[-2] - length) / value[-1]
        rows = np.concatenate([rows, pull.sum(0)[None], -(pull * deep).sum(0)[None]])[:n]
        return (patch.cover - cover) * patch.weight, rows * patch.weight

    damping, (rest, slope) = 1e-3, misfit(value)
    best = float(rest @ rest)
    for _ in range(25):
        normal = slope @ slope.T
        step = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-9), slope @ rest)
        trial = value.copy()
        trial[:n] += np.clip(step, -0.5 * radius, 0.5 * radius)
        trial[-2:] = np.clip(trial[-2:], [0.5 * radius, 0.2], [2.0 * radius, max(2.0, 0.5 * radius)])
        rest_new, slope_new = misfit(trial)
        now = float(rest_new @ rest_new)
        if now < best:
            small = best - now < 1e-5 * best and float(np.abs(step[: 2 * k]).max()) < 0.01
            value, rest, slope, best, damping = trial, rest_new, slope_new, now, damping * 0.2
            if small:
                break
        else:
            damping *= 6.0
            if damping > 1e6:
                break
    size = max(float((patch.weight**2).sum()), 1.0)
    return value[: 2 * k].reshape(-1, 2), float(value[-2]), float(value[-1]), float(np.sqrt(best / size))


def _discs_of(patch: _Patch, radius: float, soft: float, noise: float) -> Floats:
    """Return the centres (k, 2) of as many discs as it takes to explain a patch."""
    area = float(np.clip(patch.cover, 0.0, 1.0).sum()) / (np.pi * radius**2)
    whole = area > 0.85
    best = _fit(patch, _middle(patch), radius, soft, free=1 if whole else 0)
    single = best
    if best[3] > noise and area > 1.08:
        best = _fit(patch, _middle(patch), radius, soft)
        for _ in range(MOST_TOGETHER):
            more = min(
                (_fit(patch, start, radius, soft) for start in _starts(patch, best[0], radius, soft)), key=_misfit
            )
            apart = _least_distance(more[0]) > 0.6 * radius
            if not apart or _astray(patch, more[0]) > 0.8 * radius or more[3] > 0.85 * best[3]:
                break
            best = more
            if best[3] < noise:
                break
        if best[3] > 0.8 * single[3]:
            best = single
    return best[0] if best[3] < 0.22 else np.zeros((0, 2))


def _misfit(fit: tuple[Floats, float, float, float]) -> float:
    return fit[3]


def _astray(patch: _Patch, centre: Floats) -> float:
    """Return how far the remotest centre is from the blob's own pixels [pixel]."""
    own = np.stack([patch.x, patch.y], axis=1)[patch.weight == 1.0]
    return float(np.hypot(*(centre[:, None] - own[None]).T).min(axis=0).max()) if len(own) else 0.0


def _least_distance(points: Floats) -> float:
    apart = np.hypot(*(points[:, None] - points[None]).T)
    return float((apart + 1e9 * np.eye(len(points))).min())


def _starts(patch: _Patch, centre: Floats, radius: float, soft: float) -> list[Floats]:
    """Return guesses (k + 1, 2) with one disc more: one added where most is missing, or each one split."""
    missing = (patch.cover - _cover(patch, centre, radius, soft)[0]) * (patch.weight == 1.0)
    place = np.stack([patch.x, patch.y], axis=1)
    worst = place[np.argmax(missing)]
    gone = np.maximum(missing, 0.0)
    near = gone * (np.hypot(*(place - worst).T) < radius)
    spot = (near @ place) / max(float(near.sum()), 1e-9)
    owner = np.argmin(np.hypot(*(place[:, None] - centre[None]).transpose(2, 0, 1)), axis=1)
    towards = spot - centre[np.argmin(np.hypot(*(centre - spot).T))]
    length = max(float(np.hypot(*towards)), 1e-6)
    starts = [np.vstack([centre, spot - towards / length * 0.5 * radius])]
    for k in range(len(centre)):
        mine = place[(owner == k) & (patch.cover > 0.4)]
        if len(mine) > 4:
            spread = np.cov((mine - mine.mean(0)).T)
            axis = np.linalg.eigh(spread)[1][:, 1] * 0.5 * radius
            starts.append(np.vstack([np.delete(centre, k, axis=0), mine.mean(0) + axis, mine.mean(0) - axis]))
    return starts


def _wrong(strong: np.ndarray, picture: np.ndarray, marks: Floats, level: float, radius: float) -> Floats:
    """Return the middles (n, 2) of disc-like blobs of strong colour that are none of the marks."""
    mask = (strong > max(0.5 * level, 255 * LEAST_COLOUR)).astype(np.uint8)
    for x, y in marks:
        cv2.circle(
            mask, (round(16 * (x - 0.5)), round(16 * (y - 0.5))), round(16 * (1.25 * radius + 1.0)), 0, -1, shift=4
        )
    blobs = _labelled(mask > 0)
    out = []
    for k in range(1, len(blobs.stats)):
        x, y, w, h, area = blobs.stats[k]
        size = 2.0 * radius if radius else float(max(w, h))
        disc = 0.25 * np.pi * size**2
        round_enough = area > 0.5 * w * h and max(w, h) < 1.8 * min(w, h) and blobs.thin[k] >= SMALLEST_RADIUS
        if not (0.3 * disc <= area <= 16.0 * disc and round_enough):
            continue
        if _stands_out(picture, blobs, k):
            out.append((x + 0.5 * w, y + 0.5 * h))
    return np.array(out).reshape(-1, 2)


def _stands_out(picture: np.ndarray, blobs: _Blobs, k: int) -> bool:
    """Say whether blob k is an even spot of a hue that no mark has, unlike what surrounds it."""
    x, y, w, h = (int(v) for v in blobs.stats[k, :4])
    gap = max(2, w // 2)
    y0, x0 = max(y - gap, 0), max(x - gap, 0)
    box = np.s_[y0 : y + h + gap, x0 : x + w + gap]
    inside: Bools = blobs.label[box] == k
    near = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    spot = picture[box][inside].astype(float)
    colour = np.percentile(spot, 50, axis=0)
    if near.all() or _hue(colour)[1] < LEAST_SATURATION or any(_is_hue(colour, c) for c in range(3)):
        return False
    around = np.median(picture[box][~near].astype(float), axis=0)
    tint = (colour - colour.mean()) - (around - around.mean())
    return float(np.abs(tint).max()) > 60.0 and float(np.median(np.abs(spot - colour))) < 30.0
