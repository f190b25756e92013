"""Paint the skin texture: every texel knows its place on the head, and the colours are functions of that place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from assets_face import Samples
from assets_outline import HAIR, inside_outline
from numba import njit
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter

SIZE = 2048
QUALITY = 88
SKIN = np.array([207.0, 160.0, 136.0])
HAIR_DARK, HAIR_LIGHT = np.array([40.0, 30.0, 25.0]), np.array([84.0, 64.0, 50.0])
MUCOSA = np.array([142.0, 58.0, 56.0])
LIPS = np.array([182.0, 106.0, 98.0])


@dataclass(frozen=True)
class Texels:
    """What is known at each covered texel: place (k, 3) [mm], ring coordinates, cavity share, lip side."""

    mask: np.ndarray
    place: np.ndarray
    lip: np.ndarray
    lid: np.ndarray
    cavity: np.ndarray


@njit(cache=True)
def _fill(corner, value, picture, covered):
    height, width = covered.shape
    for t in range(corner.shape[0]):
        ax, ay, bx, by, cx, cy = corner[t]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-12:
            continue
        for y in range(max(int(min(ay, by, cy)) - 1, 0), min(int(max(ay, by, cy)) + 2, height)):
            for x in range(max(int(min(ax, bx, cx)) - 1, 0), min(int(max(ax, bx, cx)) + 2, width)):
                w1 = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                w2 = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                w0 = 1.0 - w1 - w2
                if w0 >= -1e-3 and w1 >= -1e-3 and w2 >= -1e-3:
                    covered[y, x] = True
                    for k in range(value.shape[2]):
                        picture[y, x, k] = w0 * value[t, 0, k] + w1 * value[t, 1, k] + w2 * value[t, 2, k]


def texels(samples: Samples, order: np.ndarray, face: dict[str, np.ndarray]) -> Texels:
    """Carry places and labels from the vertices of the fine face to the texture."""
    fields = np.column_stack(
        [samples.points[order], samples.lip_ring[order], samples.lid_ring[order], samples.cavity[order]]
    )
    uv = face["uv"][face["uv_triangles"]].astype(float)
    corner = np.stack([uv[..., 0] * SIZE - 0.5, (1.0 - uv[..., 1]) * SIZE - 0.5], axis=2).reshape(-1, 6)
    picture, covered = np.zeros((SIZE, SIZE, fields.shape[1])), np.zeros((SIZE, SIZE), bool)
    _fill(corner, fields[face["triangles"]], picture, covered)
    f = picture[covered]
    return Texels(covered, f[:, :3], f[:, 3], f[:, 4], f[:, 5])


def noise(place: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise over space with unit cells, about -1 to 1; (k,)."""
    base = np.floor(place).astype(np.int64)
    t = place - base
    t = t * t * (3.0 - 2.0 * t)
    out = np.zeros(len(place))
    for corner in range(8):
        offset = np.array([corner & 1, (corner >> 1) & 1, corner >> 2])
        cell = base + offset
        mix = (cell[:, 0] * 73856093) ^ (cell[:, 1] * 19349663) ^ (cell[:, 2] * 83492791) ^ (seed * 2654435761)
        mix = (mix ^ (mix >> 13)) * 1274126177
        mix = (mix ^ (mix >> 16)) & 0xFFFFF
        weight = np.where(offset, t, 1.0 - t).prod(axis=1)
        out += weight * (mix / 524287.5 - 1.0)
    return out


def step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blob(place: np.ndarray, centre: tuple[float, float, float], size: float | tuple[float, float, float]) -> np.ndarray:
    """Gaussian patch on both sides of the head."""
    q = (np.column_stack([np.abs(place[:, 0]), place[:, 1:]]) - np.array(centre)) / np.array(size)
    return np.exp(-0.5 * (q**2).sum(axis=1))


def _toward(colour: np.ndarray, target: np.ndarray, share: np.ndarray) -> np.ndarray:
    return colour + (target - colour) * share[:, None]


def skin(texel: Texels, marks: dict[str, np.ndarray]) -> np.ndarray:
    """Bare skin: tone, soft variation, pores, redder cheeks, nose and ears, shade around the eyes and of the beard."""
    p = texel.place
    tone = 0.022 * noise(p / 26.0, 1) + 0.016 * noise(p / 9.0, 2) + 0.014 * noise(p / 2.6, 3)
    pores = 0.022 * noise(p / 0.7, 4) + 0.012 * noise(p / 0.35, 5)
    spots = -0.07 * step(noise(p / 1.3, 6), 0.66, 0.88) * step(noise(p / 14.0, 7), 0.0, 0.6)
    colour = SKIN * (1.0 + tone + pores + spots)[:, None]
    red = np.array([198.0, 118.0, 102.0])
    nose = marks["pronasale"]
    blush = 0.42 * blob(p, (37.0, -24.0, 80.0), (17.0, 15.0, 22.0)) * (1.0 + 0.35 * noise(p / 5.0, 8))
    blush += 0.34 * blob(p, (0.0, nose[1], nose[2]), (12.0, 9.0, 12.0))
    blush += 0.30 * blob(p, (14.0, nose[1] - 4, nose[2] - 12), 7.0)
    blush += 0.42 * blob(p, (84.0, 0.0, -6.0), (11.0, 30.0, 18.0)) + 0.10 * blob(p, (0.0, -82.0, 100.0), 14.0)
    colour = _toward(colour, red, np.clip(blush, 0.0, 0.6))
    eye = marks["eye"]
    under = blob(p, (eye[0] - 3.0, eye[1] - 12.5, eye[2] + 9.0), (10.5, 4.2, 9.0))
    upper = blob(p, (eye[0] - 1.0, eye[1] + 8.0, eye[2] + 10.0), (13.0, 5.0, 9.0))
    colour = _toward(colour, np.array([158.0, 104.0, 96.0]), 0.30 * under + 0.24 * upper)
    beard = step(-p[:, 1], 36.0, 50.0) * step(p[:, 2], 20.0, 50.0) * (1.0 - step(-p[:, 1], 96.0, 112.0))
    beard *= 1.0 - 0.85 * blob(p, (44.0, -48.0, 80.0), (15.0, 12.0, 30.0))
    grain = 0.6 + 0.5 * step(noise(p / 0.55, 9), 0.1, 0.7)
    return _toward(colour, np.array([136.0, 108.0, 98.0]), 0.20 * beard * grain)


def mouth(texel: Texels, colour: np.ndarray) -> np.ndarray:
    """Lips with fine vertical creases, and the inside of the mouth, darker with depth."""
    p, ring = texel.place, texel.lip
    edge = ring + 0.14 * noise(p / 1.3, 11) + 0.12 * noise(p / 5.0, 12)
    share = step(edge, -7.55, -6.45) * (ring < 50.0)
    crease = noise(np.column_stack([p[:, 0] / 0.75, p[:, 1] / 5.0, p[:, 2] / 5.0]), 13)
    lips = LIPS * (1.0 + 0.045 * crease + 0.03 * noise(p / 2.0, 14))[:, None]
    lips = _toward(lips, np.array([150.0, 70.0, 68.0]), 0.75 * step(ring, -4.5, -0.5))
    lips = _toward(lips, np.array([196.0, 128.0, 114.0]), 0.45 * (1.0 - step(ring, -7.0, -5.6)))
    colour = _toward(colour, lips, 0.92 * share)
    inside = np.clip(np.maximum(step(ring, -0.8, 0.8) * (ring < 50.0), texel.cavity), 0.0, 1.0)
    deep = MUCOSA * (1.0 - 0.72 * step(ring, 2.0, 8.0))[:, None] * (1.0 + 0.06 * noise(p / 2.0, 15))[:, None]
    return _toward(colour, deep, inside)


def lids(texel: Texels, colour: np.ndarray, marks: dict[str, np.ndarray]) -> np.ndarray:
    """Moist lid margins, the dark line where the lashes stand, and the pink corner near the nose."""
    p, ring, eye = texel.place, texel.lid, marks["eye"]
    side = np.abs(p[:, 0]) - eye[0]
    up = step(p[:, 1] - eye[1] - 0.12 * side, -2.5, 1.0)
    wet = step(ring, -0.35, 0.45)
    corner = step(-side, 8.5, 12.5)
    margin = np.array([204.0, 142.0, 130.0]) * (1.0 + 0.05 * noise(p / 0.8, 16))[:, None]
    margin = _toward(margin, np.array([196.0, 108.0, 100.0]), 0.8 * np.maximum(corner, step(ring, 1.0, 2.2)))
    colour = _toward(colour, margin, wet)
    lash = np.exp(-0.5 * ((ring + 0.15 + 0.25 * up) / (0.42 + 0.40 * up)) ** 2) * (1.0 - corner)
    strand = 0.75 + 0.25 * noise(np.column_stack([p[:, 0] / 0.35, p[:, 1] / 3.0, p[:, 2] / 3.0]), 17)
    colour = _toward(colour, np.array([44.0, 30.0, 26.0]), np.clip(lash * strand * (0.36 + 0.56 * up), 0.0, 0.93))
    fold = np.exp(-0.5 * ((ring + 4.6) / 0.6) ** 2) * up * (1.0 - corner)
    return _toward(colour, np.array([150.0, 98.0, 86.0]), 0.22 * fold)


def hair(texel: Texels, colour: np.ndarray) -> np.ndarray:
    """Short-cropped hair: strands running away from the crown, thinning out at the hairline."""
    p = texel.place
    crown = p - np.array([0.0, 60.0, -42.0])
    reach = np.linalg.norm(crown, axis=1)
    unit = crown / reach[:, None]
    turn = np.arctan2(unit[:, 0], unit[:, 2])
    far = np.arccos(np.clip(unit[:, 1], -1.0, 1.0)) * 85.0
    strand = noise(np.column_stack([turn * 85.0 * np.sin(np.minimum(far / 85.0, 2.0)) / 0.55, far / 5.0, 0 * far]), 21)
    strand = 0.6 * strand + 0.4 * noise(p / np.array([0.8, 1.1, 0.9]), 22)
    inside = inside_outline(p, HAIR) + 1.5 * noise(p / 9.0, 23) + 2.6 * strand
    ear = step(np.hypot((p[:, 1] + 2.0) / 32.0, (p[:, 2] + 2.0) / 20.0), 0.80, 0.98)
    cover = step(inside, -5.0, 8.0) * np.where(np.abs(p[:, 0]) > 60.0, ear, 1.0)
    share = np.clip(1.25 * cover - 0.35 * (1.0 - cover) * (1.0 - strand), 0.0, 1.0)
    tone = HAIR_DARK + (HAIR_LIGHT - HAIR_DARK) * (0.36 + 0.34 * strand + 0.12 * noise(p / 12.0, 25))[:, None]
    return _toward(colour, tone, 0.95 * share)


def brow_strokes(face: dict[str, np.ndarray], eye: np.ndarray) -> np.ndarray:
    """Cover of the eyebrow hairs over the texture, (SIZE, SIZE) in [0, 1]: single strokes along the brow ridge."""
    p, t = face["points"], face["triangles"]
    at = np.zeros((len(p), 2))
    at[t.ravel()] = face["uv"][face["uv_triangles"]].reshape(-1, 2)
    near = (np.abs(p[:, 1] - eye[1] - 25.0) < 20.0) & (p[:, 2] > 55) & (np.abs(p[:, 0]) < 66) & (face["region"] == 0)
    to_uv = LinearNDInterpolator(p[near][:, :2], at[near])
    knots = np.array([[10.0, 16.0], [18.0, 18.4], [28.0, 20.6], [36.0, 21.4], [44.0, 19.8], [52.5, 15.4]])
    half = np.array([2.7, 3.5, 3.1, 2.5, 1.6, 0.5])
    rng = np.random.default_rng(7)
    cover = np.zeros((SIZE, SIZE))
    for sign in (1.0, -1.0):
        for _ in range(430):
            s = rng.beta(1.15, 1.2)
            x = knots[0, 0] + s * (knots[-1, 0] - knots[0, 0])
            middle, width = np.interp(x, knots[:, 0], knots[:, 1]), np.interp(x, knots[:, 0], half)
            across = np.clip(rng.normal(0.0, 0.48), -1.05, 1.05)
            slope = np.interp(s, [0.0, 0.12, 0.35, 0.65, 1.0], [1.35, 0.95, 0.45, 0.02, -0.40])
            slope += rng.normal(0.0, 0.10) - 0.38 * across * (1 - s)
            length = rng.uniform(4.5, 8.0) * (1.0 - 0.35 * s)
            k = np.linspace(-0.35, 0.65, 7)[:, None] * length
            way = np.array([np.cos(slope), np.sin(slope)])
            line = np.array([x, middle + across * width]) + k * way - 0.018 * k**2 * np.array([-0.2, 1.0])
            uv = to_uv((line + np.array([0.0, eye[1]])) * np.array([sign, 1.0]))
            if not np.isfinite(uv).all():
                continue
            pixel = np.stack([uv[:, 0] * SIZE - 0.5, (1.0 - uv[:, 1]) * SIZE - 0.5], axis=1)
            _draw(pixel, cover, rng.uniform(0.22, 0.52) * np.interp(s, [0.0, 0.15, 1.0], [0.45, 1.0, 1.0]))
    soft = gaussian_filter(cover, 5.0)
    return np.clip(gaussian_filter(cover, 0.5) * 0.85 + 0.30 * np.clip(soft, 0.0, 0.75), 0.0, 0.88)


def _draw(pixel: np.ndarray, cover: np.ndarray, strength: float) -> None:
    """Add one tapering hair to `cover` inside its own small window."""
    low = np.floor(pixel.min(axis=0)).astype(int) - 3
    high = np.ceil(pixel.max(axis=0)).astype(int) + 4
    patch = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    points = np.rint((pixel - low) * 16).astype(np.int32)
    cv2.polylines(patch, [points[:4]], False, 120, 2, cv2.LINE_AA, 4)
    cv2.polylines(patch, [points], False, 230, 1, cv2.LINE_AA, 4)
    view = cover[low[1] : high[1], low[0] : high[0]]
    view += (1.0 - view) * strength * patch / 255.0


def paint(samples: Samples, order: np.ndarray, face: dict[str, np.ndarray], eye: np.ndarray, path: Path) -> None:
    """Paint the texture over the fine face and write it as JPEG; `order` gives the sample index of each vertex."""
    index = dict(zip(face["landmark_names"].tolist(), face["landmark_index"].tolist()))
    marks = {name: face["points"][i] for name, i in index.items()}
    marks["eye"] = eye
    texel = texels(samples, order, face)
    colour = lids(texel, hair(texel, mouth(texel, skin(texel, marks))), marks)
    brow = brow_strokes(face, eye)[texel.mask]
    colour = _toward(colour, np.array([62.0, 46.0, 38.0]), brow)
    picture = np.zeros((SIZE, SIZE, 3))
    picture[texel.mask] = colour
    _, nearest = distance_transform_edt(~texel.mask, return_indices=True)
    picture = picture[nearest[0], nearest[1]]
    data = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    cv2.imwrite(str(path), data[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
