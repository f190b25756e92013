"""The eyeballs: a globe with a slight cornea, coloured per vertex (pupil, iris with fibres, limbal ring, sclera)."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

SEGMENTS, BACK_SEGMENTS = 48, 16  # in front of and behind the widest visible ring
PUPIL, COLLARETTE, IRIS = 1.75, 2.9, 5.85  # mm, radii seen from the front
BULGE = 0.2  # mm, cornea above the globe
RINGS = (1.62, 1.95, 2.3, 2.75, 3.3, 4.1, 4.9, 5.5, 5.85, 6.1, 6.4)  # mm, where the colour changes
SHOWN, BACK = np.radians(84.0), np.radians((112.0, 146.0))  # polar angles: the lids hide all beyond SHOWN


def _rings(radius: float) -> list[tuple[float, int]]:
    """Polar angle and number of vertices of each ring, from the front to the back."""
    iris = np.arcsin(np.array(RINGS) / radius)
    white = iris[-1] + (SHOWN - iris[-1]) * np.linspace(0.0, 1.0, 6)[1:]
    return [(float(t), SEGMENTS) for t in (*iris, *white)] + [(float(t), BACK_SEGMENTS) for t in BACK]


def _between(a: int, n: int, b: int, m: int) -> np.ndarray:
    """Triangles between a ring of n vertices from index a on and one of m (a divisor of n) from b on, outside it."""
    i, k = np.arange(n), n // m
    j, end = i // k, ((i + 1) // k) % m
    near = np.stack([a + i, b + j, a + (i + 1) % n], axis=1)
    step = (i + 1) % k == 0
    return np.vstack([near, np.stack([a + (i + 1) % n, b + j, b + end], axis=1)[step]])


def globe(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) around the origin looking along +z, and triangles (t, 3); coarse where no lid ever opens."""
    rings = _rings(radius)
    t = np.concatenate([np.full(n, angle) for angle, n in rings])
    f = np.concatenate([2 * np.pi * np.arange(n) / n for _, n in rings])
    cornea = np.clip(1.0 - (radius * np.sin(t) / (IRIS + 0.6)) ** 2, 0.0, 1.0) * (t < np.pi / 2)
    r = radius + BULGE * cornea**1.5
    ring = np.stack([r * np.sin(t) * np.cos(f), r * np.sin(t) * np.sin(f), r * np.cos(t)], axis=1)
    points = np.vstack([ring, [[0.0, 0.0, radius + BULGE], [0.0, 0.0, -radius]]])
    first = np.concatenate([[0], np.cumsum([n for _, n in rings])])
    k = np.arange(SEGMENTS)
    triangles = [np.stack([np.full(SEGMENTS, len(ring)), k, (k + 1) % SEGMENTS], axis=1)]
    for i, ((_, n), (_, m)) in enumerate(pairwise(rings)):
        triangles.append(_between(int(first[i]), n, int(first[i + 1]), m))
    k = np.arange(rings[-1][1])
    end = int(first[-2])
    triangles.append(np.stack([end + k, np.full(len(k), len(ring) + 1), end + (k + 1) % len(k)], axis=1))
    return points, np.vstack(triangles)


def _step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _fibres(phi: np.ndarray, radius: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Radial fibres of the iris: a sum of waves around it whose phase drifts outwards, about -1 to 1."""
    out = np.zeros_like(phi)
    for waves in (5, 9, 14, 19, 23):
        turn, drift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6)
        out += rng.uniform(0.5, 1.0) * np.cos(waves * phi + turn + drift * radius)
    return out / 2.4


def colour(points: np.ndarray, seed: int) -> np.ndarray:
    """Colours of the globe's points, (n, 3) sRGB bytes."""
    rng = np.random.default_rng(seed)
    x, y, z = points.T
    radius, phi = np.hypot(x, y), np.arctan2(y, x)
    radius = np.where(z > 0, radius, 12.0)
    fibre = _fibres(phi, radius, rng)
    inner, outer = np.array([112.0, 76.0, 44.0]), np.array([84.0, 68.0, 50.0])
    blend = _step(radius + 0.25 * fibre, COLLARETTE - 0.7, COLLARETTE + 0.9)[:, None]
    iris = inner * (1 - blend) + outer * blend
    iris *= (1.0 + 0.18 * fibre)[:, None]
    iris *= (1.0 - 0.62 * _step(radius, IRIS - 1.15, IRIS))[:, None]
    iris *= (1.0 - 0.30 * _step(y, 0.5, 5.0))[:, None]  # shade of the upper lid
    iris *= (0.55 + 0.45 * _step(radius, PUPIL, PUPIL + 0.45))[:, None]
    pink = _step(np.hypot(1.05 * x, 0.75 * y), 7.0, 12.0) * 0.75
    vein = np.clip(np.cos(17 * phi + 2.1 * np.sin(3 * phi + 0.5 * radius)) - 0.78, 0.0, 1.0) * _step(radius, 7.0, 11.0)
    sclera = np.array([226.0, 220.0, 213.0]) - pink[:, None] * np.array([14.0, 44.0, 44.0])
    sclera -= 0.9 * vein[:, None] * np.array([20.0, 90.0, 90.0])
    sclera[z < 0] = (190.0, 120.0, 112.0)
    edge = _step(radius, IRIS - 0.15, IRIS + 0.5)[:, None]
    out = iris * (1 - edge) + sclera * edge
    hole = 1.0 - _step(radius + 0.05 * fibre, PUPIL - 0.1, PUPIL + 0.16)[:, None]
    out = out * (1 - hole) + np.array([10.0, 8.0, 8.0]) * hole
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def write_eyes(path: Path, centre: np.ndarray, radius: float) -> None:
    """Write both eyeballs; `centre` is that of the left one [mm]."""
    points, triangles = globe(radius)
    shade = colour(points, 3)
    flip = np.array([-1.0, 1.0, 1.0])
    arrays: dict[str, np.ndarray] = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        mirrored = points if sign > 0 else points * flip
        arrays[f"eye_{side}_points"] = mirrored + centre * np.array([sign, 1.0, 1.0])
        arrays[f"eye_{side}_triangles"] = (triangles if sign > 0 else triangles[:, ::-1]).astype(np.int32)
        arrays[f"eye_{side}_colour"] = shade
        arrays[f"eye_{side}_bone"] = np.array(0, np.int32)
        arrays[f"eye_{side}_centre"] = centre * np.array([sign, 1.0, 1.0])
        arrays[f"eye_{side}_radius"] = np.array(radius)
    np.savez_compressed(path, **arrays)
