"""The eyeballs: a globe with a slight cornea, coloured per vertex (pupil, iris with fibres, limbal ring, sclera)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SEGMENTS = 96
PUPIL, COLLARETTE, IRIS = 1.75, 2.9, 5.85  # mm, radii seen from the front
BULGE = 0.2  # mm, cornea above the globe


def _polar(radius: float) -> np.ndarray:
    """Polar angles of the rings, dense over the iris."""
    iris = np.arcsin(np.linspace(0.16, IRIS + 0.7, 38) / radius)
    rest = iris[-1] + (np.pi - iris[-1]) * np.linspace(0.0, 1.0, 24)[1:-1] ** 1.15
    return np.concatenate([iris, rest])


def globe(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) around the origin looking along +z, and triangles (t, 3)."""
    theta = _polar(radius)
    phi = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    t, f = np.meshgrid(theta, phi, indexing="ij")
    cornea = np.clip(1.0 - (radius * np.sin(t) / (IRIS + 0.6)) ** 2, 0.0, 1.0) * (t < np.pi / 2)
    r = radius + BULGE * cornea**1.5
    ring = np.stack([r * np.sin(t) * np.cos(f), r * np.sin(t) * np.sin(f), r * np.cos(t)], axis=2).reshape(-1, 3)
    points = np.vstack([ring, [[0.0, 0.0, radius + BULGE], [0.0, 0.0, -radius]]])
    m, k = len(theta), np.arange(SEGMENTS)
    nxt = (k + 1) % SEGMENTS
    first, last = np.full(SEGMENTS, len(ring)), np.full(SEGMENTS, len(ring) + 1)
    triangles = [np.stack([first, k, nxt], axis=1)]
    for i in range(m - 1):
        a, b = i * SEGMENTS, (i + 1) * SEGMENTS
        triangles += [np.stack([a + k, b + k, b + nxt], axis=1), np.stack([a + k, b + nxt, a + nxt], axis=1)]
    end = (m - 1) * SEGMENTS
    triangles.append(np.stack([end + k, last, end + nxt], axis=1))
    return points, np.vstack(triangles)


def _step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _fibres(phi: np.ndarray, radius: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Radial fibres of the iris: a sum of waves around it whose phase drifts outwards, about -1 to 1."""
    out = np.zeros_like(phi)
    for waves in (5, 9, 14, 19, 23, 31, 37, 44):
        turn, drift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6)
        out += rng.uniform(0.5, 1.0) * np.cos(waves * phi + turn + drift * radius)
    return out / 3.0


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
