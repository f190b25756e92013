"""Teeth, gums and tongue, made by formula and set behind the lips of a face.

Crown sizes are the means of Nelson, "Wheeler's Dental Anatomy, Physiology and Occlusion" (14 teeth an arch, without
third molars). Each row stands on a smooth arch and belongs rigidly to its bone.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

MUCOSA = 2
OVERBITE, OVERJET = 2.0, 2.2  # mm; upper over lower incisors, in height and in depth
SHOW = 2.0  # mm; how far the upper incisors reach below the lip line
LIP_GAP = 1.3  # mm; air between the labial mucosa and the teeth
SLOPE = 0.12  # -; the plane of the bite rises backward by this much

# Labial outline of an arch, (sideways, backward) from the incisors [mm].
UPPER_ARCH = ((0, 0), (6, 0.7), (12, 3.2), (17, 7.8), (21, 14.0), (24.5, 22.0), (27, 30.5), (28.8, 42.0), (29.3, 50.0))
LOWER_ARCH = (
    (0, 0),
    (5, 0.8),
    (10, 3.1),
    (14, 6.6),
    (18.2, 13.0),
    (22.0, 21.5),
    (25.0, 30.5),
    (27.2, 41.5),
    (28.2, 50),
)

# kind, width along the arch, depth across it, crown height [mm]
UPPER_TEETH = (
    ("incisor", 8.5, 7.0, 10.5), ("lateral", 6.6, 6.0, 9.2), ("canine", 7.6, 8.0, 10.2), ("premolar", 7.0, 9.0, 8.5),
    ("premolar", 6.8, 9.0, 8.2), ("molar", 10.2, 11.0, 7.6), ("molar", 9.6, 11.0, 7.2),
)  # fmt: skip
LOWER_TEETH = (
    ("lower", 5.3, 6.0, 9.0), ("lower", 5.8, 6.4, 9.3), ("canine", 6.9, 7.6, 10.3), ("premolar", 7.0, 7.7, 8.6),
    ("premolar", 7.1, 8.0, 8.2), ("molar", 11.0, 10.4, 7.6), ("molar", 10.4, 10.2, 7.2),
)  # fmt: skip

# Crown profiles over the height t (0 neck, 1 rim): share of width, and of depth on the labial and lingual side.
PROFILE = {
    "incisor": (
        (0.70, 0.80, 0.93, 1.00, 0.99, 0.93),
        (0.43, 0.49, 0.50, 0.46, 0.36, 0.24),
        (0.46, 0.46, 0.22, 0.02, -0.08, -0.09),
    ),
    "lateral": (
        (0.68, 0.80, 0.94, 1.00, 0.97, 0.86),
        (0.43, 0.49, 0.50, 0.46, 0.36, 0.24),
        (0.46, 0.46, 0.22, 0.02, -0.08, -0.09),
    ),
    "lower": (
        (0.66, 0.76, 0.88, 0.97, 1.00, 0.95),
        (0.43, 0.48, 0.48, 0.43, 0.34, 0.24),
        (0.46, 0.44, 0.24, 0.04, -0.07, -0.09),
    ),
    "canine": (
        (0.70, 0.82, 0.96, 1.00, 0.90, 0.62),
        (0.43, 0.49, 0.50, 0.45, 0.34, 0.20),
        (0.46, 0.47, 0.30, 0.12, 0.00, -0.04),
    ),
    "premolar": (
        (0.72, 0.84, 0.96, 1.00, 0.95, 0.80),
        (0.42, 0.49, 0.50, 0.47, 0.41, 0.32),
        (0.42, 0.48, 0.50, 0.48, 0.43, 0.33),
    ),
    "molar": (
        (0.78, 0.88, 0.97, 1.00, 0.96, 0.84),
        (0.43, 0.49, 0.50, 0.47, 0.42, 0.34),
        (0.43, 0.48, 0.50, 0.49, 0.45, 0.36),
    ),
}
PROFILE_AT = (0.0, 0.15, 0.4, 0.65, 0.85, 1.0)
SQUARENESS = {"incisor": 2.7, "lateral": 2.5, "lower": 2.6, "canine": 2.2, "premolar": 2.3, "molar": 2.9}
ROOT = 5.0  # mm of each tooth hidden in the gum

# Heights of the rings of a crown, -1 root, 0 neck, 1 rim: fewer where the lips and cheeks leave little to be seen.
FRONT_RINGS = (-1.0, -0.12, 0.0, 0.15, 0.36, 0.6, 0.8, 0.93, 1.0)
BACK_RINGS = (-1.0, 0.0, 0.2, 0.5, 0.77, 0.92, 1.0)

IVORY = np.array([236.0, 226.0, 204.0])
NECK_TINT = np.array([224.0, 203.0, 168.0])
EDGE_TINT = np.array([226.0, 224.0, 216.0])
GUM = np.array([206.0, 118.0, 114.0])
GUM_DEEP = np.array([178.0, 78.0, 80.0])
TONGUE = np.array([196.0, 104.0, 104.0])
TONGUE_DEEP = np.array([158.0, 64.0, 70.0])


@dataclass(frozen=True, eq=False)
class Piece:
    """A rigid part: name, bone, points (n, 3) [mm], triangles (t, 3), colour (n, 3) sRGB bytes."""

    name: str
    bone: int
    points: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the parts file."""
        return {
            f"{self.name}_points": self.points,
            f"{self.name}_triangles": self.triangles.astype(np.int32),
            f"{self.name}_colour": np.clip(np.round(self.colour), 0, 255).astype(np.uint8),
            f"{self.name}_bone": np.int32(self.bone),
        }


class Arch:
    """A dental arch: its labial outline in the horizontal plane, by arc length from the midline."""

    def __init__(self, outline: tuple[tuple[float, float], ...], front: float) -> None:
        half = np.array(outline, dtype=float)
        whole = np.vstack([half[:0:-1] * [-1.0, 1.0], half])
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(whole, axis=0), axis=1))])
        chord -= chord[len(half) - 1]
        self._curve = CubicSpline(chord, np.stack([whole[:, 0], front - whole[:, 1]], axis=1))
        self.front = front
        self.length = float(chord[-1])

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, tangent to the left and outward normal in (x, z) at arc lengths s (n,), each (n, 2)."""
        tangent = self._curve(s, 1)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        outward = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
        return self._curve(s), tangent, outward

    def beyond(self, x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far (x, z) lie outside the outline [mm] and the outward direction there, (n,) and (n, 2)."""
        s = np.linspace(-self.length, self.length, 801)
        place, _, outward = self.at(s)
        near = ((place[None] - np.stack([x, z], axis=1)[:, None]) ** 2).sum(axis=2).argmin(axis=1)
        away = np.stack([x, z], axis=1) - place[near]
        return (away * outward[near]).sum(axis=1), outward[near]


@dataclass(frozen=True, eq=False)
class Plan:
    """Where the bite lies: lip line (y), and the two arches."""

    lip_line: float
    upper: Arch
    lower: Arch

    def edge(self, upper: bool, z: np.ndarray) -> np.ndarray:
        """Height of the incisal edges and buccal cusps at z [mm]."""
        arch = self.upper if upper else self.lower
        start = self.lip_line - SHOW + (0.0 if upper else OVERBITE)
        back = np.maximum(arch.front - z, 0.0)
        # behind the canines the bite closes: cusps meet instead of overlapping by the overbite
        closing = (0.2 if upper else -0.25) * OVERBITE * np.clip((back - 6.0) / 14.0, 0.0, 1.0)
        return start + SLOPE * back + closing


def plan_bite(face: dict[str, np.ndarray]) -> Plan:
    """Return the plan that sets the teeth just behind the labial mucosa of a face file."""
    points = face["points"]
    names = [str(n) for n in face["landmark_names"]]
    upper, lower = (points[face["landmark_index"][names.index(f"stomion_{k}")]] for k in ("upper", "lower"))
    lip_line = 0.5 * (upper[1] + lower[1])
    inner = points[face["region"] == MUCOSA]
    inner = inner[
        (np.abs(inner[:, 0]) < 20.0) & (np.abs(inner[:, 1] - lip_line) < 9.0) & (inner[:, 2] > upper[2] - 25.0)
    ]
    step = OVERJET + 0.5
    room = []
    for outline, set_back, lip in (
        (UPPER_ARCH, 0.0, inner[:, 1] > lip_line - 3.0),
        (LOWER_ARCH, step, inner[:, 1] < lip_line),
    ):
        drop = PchipInterpolator(*np.array(outline, dtype=float).T)(np.abs(inner[lip, 0]))
        room.append((inner[lip, 2] + drop).min() + set_back)
    front = float(min(room) - LIP_GAP)
    return Plan(lip_line, Arch(UPPER_ARCH, front), Arch(LOWER_ARCH, front - step))


def crown(kind: str, width: float, depth: float, height: float) -> tuple[np.ndarray, ...]:
    """Return one tooth in its own frame (x to the left, y towards the edge, z labial; y = 0 at the neck) with shades.

    Points (n, 3) [mm], triangles (t, 3), height share (n,) in [-1, 1].
    """
    around, heights, insides = (
        (14, BACK_RINGS, (0.66, 0.3)) if kind in ("premolar", "molar") else (18, FRONT_RINGS, (0.5,))
    )
    theta = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    power = 2.0 / SQUARENESS[kind]
    cx = np.sign(np.cos(theta)) * np.abs(np.cos(theta)) ** power
    cz = np.sign(np.sin(theta)) * np.abs(np.sin(theta)) ** power
    tables = [PchipInterpolator(PROFILE_AT, row) for row in PROFILE[kind]]
    rings, shade = [], []
    for t in heights:
        w, b, l = (float(f(max(t, 0.0))) for f in tables)
        taper = 1.0 + 0.32 * min(t, 0.0)
        x = 0.5 * width * w * taper * cx
        middle, half = 0.5 * depth * (b - l), 0.5 * depth * (b + l) * taper
        z = middle + half * cz + (0.36 if kind == "lower" else 0.16) * ROOT * min(t, 0.0)
        y = height * t if t >= 0.0 else ROOT * t
        # the neck follows the gum: it dips between the teeth on the labial side
        y = y + 0.16 * height * (1.0 - max(t, 0.0)) ** 2 * np.abs(cx) ** 2 * (t >= 0.0)
        rings.append(np.stack([x, y + _rim_drop(kind, x / (0.5 * width), z / depth, height) * max(t, 0.0) ** 3, z], 1))
        shade.append(np.full(around, t))
    rim = rings[-1]
    for s in insides:
        inner = rim * [s, 1.0, s] + [0.0, 0.0, (1.0 - s) * rim[:, 2].mean()]
        inner[:, 1] = height + _occlusal(kind, inner[:, 0] / (0.5 * width), inner[:, 2] / depth, height, s)
        rings.append(inner)
        shade.append(np.full(around, 1.0))
    points = np.vstack([*rings, rings[-1].mean(axis=0)[None], rings[0].mean(axis=0)[None]])
    triangles = _tube(len(rings), around, len(points) - 2, len(points) - 1)
    return points, triangles, np.concatenate([*shade, [1.0], [-1.0]])


def _rim_drop(kind: str, u: np.ndarray, v: np.ndarray, height: float) -> np.ndarray:
    """How the rim leaves the plane y = height: cusps, rounded corners [mm]."""
    if kind == "canine":
        return -0.26 * height * np.abs(u) ** 1.2
    if kind in ("incisor", "lateral", "lower"):
        corner = 0.05 if kind == "lower" else 0.075
        return -corner * height * np.abs(u) ** 3
    cusps = 1.0 if kind == "premolar" else 2.0
    wave = 0.5 - 0.5 * np.cos(np.pi * (u + 1.0) * cusps) if cusps == 2.0 else 1.0 - np.abs(u) ** 1.5
    lingual = np.where(v < 0.0, 0.6, 0.0)
    return -0.9 * (1.0 - wave) - lingual


def _occlusal(kind: str, u: np.ndarray, v: np.ndarray, height: float, s: float) -> np.ndarray:
    """Height of the chewing surface over y = height, inside the rim [mm]."""
    rim = _rim_drop(kind, u / s, v / s, height)
    if kind == "molar":
        return rim * s + 0.35 * np.sin(np.pi * s) - 1.5 * (1.0 - s)
    if kind == "premolar":
        return rim * s + 0.4 * np.sin(np.pi * s) - 1.3 * (1.0 - s) * (1.0 - np.abs(v))
    return _rim_drop(kind, u, v, height) + 0.18 * (1.0 - s)


def _tube(rings: int, around: int, top: int, bottom: int) -> np.ndarray:
    """Triangles of stacked rings, counter-clockwise seen from above, closed by two poles; outward normals."""
    i = np.arange(around)
    j = (i + 1) % around
    out = []
    for r in range(rings - 1):
        a, b = r * around, (r + 1) * around
        out += [np.stack([a + i, b + j, a + j], 1), np.stack([a + i, b + i, b + j], 1)]
    last = (rings - 1) * around
    out += [np.stack([last + i, np.full(around, top), last + j], 1), np.stack([i, j, np.full(around, bottom)], 1)]
    return np.vstack(out)


def place_teeth(plan: Plan, upper: bool) -> tuple[Piece, list[tuple[float, float, float]]]:
    """Return the row of teeth and, for each, its arc length, width and the height of its neck."""
    arch, teeth = (plan.upper, UPPER_TEETH) if upper else (plan.lower, LOWER_TEETH)
    points, triangles, colour, places = [], [], [], []
    count, start = 0, 0.0
    for order, (kind, width, depth, height) in enumerate(teeth):
        s = start + 0.5 * width
        start += 0.985 * width
        p, t, share = crown(kind, width, depth, height)
        lean = np.radians((8.0 if upper else 12.0) if order < 3 else (4.0 if order < 5 else 2.0))
        p = p - [0.0, height, 0.5 * depth]
        turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(lean), np.sin(lean)], [0.0, -np.sin(lean), np.cos(lean)]])
        p = p @ turn
        place, tangent, outward = (v[0] for v in arch.at(np.array([s])))
        edge = plan.edge(upper, np.array([place[1]]))[0] + _EDGE_STEP[upper][order]
        up = -1.0 if upper else 1.0
        flat = place + p[:, :1] * tangent + p[:, 2:] * outward
        world = np.stack([flat[:, 0], edge + up * p[:, 1], flat[:, 1]], axis=1)
        t = t[:, ::-1] if upper else t
        for side in (1.0, -1.0):
            points.append(world * [side, 1.0, 1.0])
            triangles.append((t if side > 0 else t[:, ::-1]) + count)
            colour.append(_enamel(share) * _shadow(world, arch, 0.2))
            count += len(world)
        places.append((s, width, edge - up * height))
    name = "teeth_upper" if upper else "teeth_lower"
    return Piece(name, int(not upper), np.vstack(points), np.vstack(triangles), np.vstack(colour)), places


_EDGE_STEP = {True: (0.0, 0.7, 0.1, 0.3, 0.2, 0.1, 0.1), False: (0.0, 0.1, 0.3, 0.0, 0.0, 0.0, 0.0)}


def _shadow(points: np.ndarray, arch: Arch, share: float) -> np.ndarray:
    """Factor (n, 1) that darkens what lies deep in the mouth, by `share` at 50 mm."""
    back = np.clip((arch.front - points[:, 2:]) / 50.0, 0.0, 1.0)
    return 1.0 - share * back**1.5


def _enamel(share: np.ndarray) -> np.ndarray:
    low = np.clip(1.0 - share / 0.45, 0.0, 1.0)[:, None]
    high = np.clip((share - 0.72) / 0.28, 0.0, 1.0)[:, None]
    return IVORY + 0.8 * low * (NECK_TINT - IVORY) + 0.6 * high * (EDGE_TINT - IVORY)


def build_gums(plan: Plan, upper: bool, places: list[tuple[float, float, float]], per_tooth: int = 6) -> Piece:
    """Return the gum of one arch: a ridge along the row, scalloped round each neck, with a papilla between teeth."""
    arch = plan.upper if upper else plan.lower
    teeth = UPPER_TEETH if upper else LOWER_TEETH
    up = -1.0 if upper else 1.0
    bounds = np.concatenate([[0.0], [s + 0.5 * w for s, w, _ in places]])
    s = np.concatenate([np.linspace(a, b, per_tooth, endpoint=False) for a, b in pairwise(bounds)])
    s = np.concatenate([s, bounds[-1] + np.array([0.0, 1.5, 2.5])])
    tooth = np.clip(np.searchsorted(bounds, s + 1e-9) - 1, 0, len(places) - 1)
    centre, width = (np.array([p[k] for p in places])[tooth] for k in (0, 1))
    neck = np.interp(s, [p[0] for p in places], [p[2] for p in places])
    depth = np.interp(s, [p[0] for p in places], [t[2] for t in teeth])
    u = np.clip((s - centre) / (0.5 * width), -1.0, 1.0)
    papilla = np.interp(s, [0, 25, 45, 60], [3.0, 2.4, 1.6, 1.2]) * np.abs(u) ** 2.2
    fade = np.clip((bounds[-1] + 2.51 - s) / 3.0, 0.0, 1.0) ** 0.5
    crest = 0.5 + papilla * fade
    lean = np.interp(s, [0, 18, 26, 60], [0.14 if upper else 0.2, 0.14 if upper else 0.2, 0.07, 0.035])
    rows = []
    for q, w, level in _GUM_SECTION:
        # q: across, 1 labial .. -1 lingual; w: bulge beyond the neck [mm]; level: 1 at the margin, down to the fold
        recess = 0.5 * np.abs(u) ** 2 * (level > 0.5)
        half = (0.5 * depth * 0.86 + w - recess) * fade
        y = np.where(level > 0.0, crest * level, level * 9.0)
        z = q * half - 0.5 * depth - 0.03 * depth + lean * (y - np.array([t[3] for t in teeth])[tooth])
        rows.append((z, y))
    across = np.stack([r[0] for r in rows], axis=1)
    along = neck[:, None] + up * np.stack([r[1] for r in rows], axis=1)
    place, _, outward = arch.at(s)
    half_points = np.stack(
        [place[:, :1] + across * outward[:, :1], along, place[:, 1:] + across * outward[:, 1:]], axis=2
    )
    whole = np.concatenate([half_points[:0:-1] * [-1.0, 1.0, 1.0], half_points])
    whole[len(half_points) - 1, :, 0] = 0.0
    n, m = whole.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    triangles = np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    triangles = triangles[:, ::-1] if upper else triangles
    shade = np.clip(np.array([r[2] for r in _GUM_SECTION]), -1.0, 1.0)
    mix = np.clip(-shade, 0.0, 1.0)[None, :, None] * np.ones((n, 1, 1))
    colour = (GUM + mix * (GUM_DEEP - GUM)).reshape(-1, 3) * _shadow(whole.reshape(-1, 3), arch, 0.3)
    return Piece("gums_upper" if upper else "gums_lower", int(not upper), whole.reshape(-1, 3), triangles, colour)


_GUM_SECTION = (
    (1.0, 0.6, -1.0), (1.0, 1.2, -0.5), (1.0, 1.0, -0.15), (1.0, 0.85, 0.3), (1.0, 0.6, 0.75), (1.0, 0.2, 0.97),
    (0.8, 0.0, 1.0), (-0.8, 0.0, 1.0), (-1.0, 0.2, 0.97), (-1.0, 0.6, 0.75), (-1.0, 0.85, 0.3), (-1.0, 1.2, -0.4),
    (-1.0, 0.4, -1.0),
)  # fmt: skip
"""Section of a gum: place across, bulge [mm], level (above 0 in shares of the margin, below 0 in shares of 9 mm)."""


def build_tongue(plan: Plan) -> Piece:
    """Return the tongue: a smooth body on the floor of the mouth, its tip behind the lower incisors."""
    front = plan.lower.front - 9.0
    t = np.array([0.0, 0.015, 0.05, 0.1, 0.17, 0.26, 0.36, 0.47, 0.58, 0.7, 0.82, 0.93, 0.98, 1.0])
    z = front - 60.0 * t
    half = PchipInterpolator([0, 0.05, 0.17, 0.36, 0.6, 0.85, 1.0], [0.5, 6.5, 11.5, 15.0, 17.5, 19.0, 12.0])(t)
    top = PchipInterpolator([0, 0.05, 0.2, 0.5, 0.8, 1.0], [-4.5, -2.8, -1.3, 0.4, -1.5, -10.0])(t)
    thick = PchipInterpolator([0, 0.05, 0.2, 0.5, 0.85, 1.0], [0.8, 4.2, 8.5, 17.0, 20.0, 12.0])(t)
    base = plan.edge(False, z) - 1.5
    around = 28
    theta = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    cx = np.sign(np.cos(theta)) * np.abs(np.cos(theta)) ** 0.8
    cy = np.sin(theta)
    rings = []
    for k in range(len(t)):
        groove = 0.9 * np.exp(-((half[k] * cx / 2.2) ** 2)) * (cy > 0) * np.clip(t[k] / 0.1, 0, 1)
        middle = base[k] + top[k] - 0.5 * thick[k]
        y = middle + 0.5 * thick[k] * np.where(cy > 0, np.abs(cy) ** 0.7, -(np.abs(cy) ** 0.9)) - groove
        rings.append(np.stack([half[k] * cx, y, np.full(around, z[k])], axis=1))
    points = np.vstack([*rings, rings[-1].mean(0)[None] - [0, 0, 1.0], rings[0].mean(0)[None] + [0, 0, 0.4]])
    triangles = _tube(len(rings), around, len(points) - 2, len(points) - 1)
    up = np.concatenate([np.tile(cy, len(rings)), [0.0, 0.0]])
    mix = np.clip(0.35 - 0.6 * up, 0.0, 1.0)[:, None]
    centre = (1.0 - np.exp(-((points[:, :1] / 2.5) ** 2))) * 0.12 + 0.9
    colour = (TONGUE + mix * (TONGUE_DEEP - TONGUE)) * centre * _shadow(points, plan.lower, 0.5)
    return Piece("tongue", 1, points, triangles, colour)


def shape_alveolus(points: np.ndarray, plan: Plan, upper: bool) -> np.ndarray:
    """Return bone vertices (n, 3) with the tooth-bearing rim trimmed to the necks of the planned teeth [mm]."""
    arch, teeth = (plan.upper, UPPER_TEETH) if upper else (plan.lower, LOWER_TEETH)
    up = -1.0 if upper else 1.0
    out = points.copy()
    near = np.flatnonzero((points[:, 2] > arch.front - 50.0) & (np.abs(points[:, 1] - plan.lip_line) < 26.0))
    x, y, z = points[near].T
    back = arch.front - z
    height = np.interp(back, [0.0, 12.0, 25.0, 40.0], [teeth[k][3] for k in (0, 2, 4, 6)])
    crest = plan.edge(upper, z) - up * (height + 0.3)
    over, outward = arch.beyond(x, z)
    rim = (np.abs(over + 5.0) < 12.0) * np.clip((46.0 - back) / 6.0, 0.0, 1.0)
    excess = np.maximum(up * (y - crest), 0.0)
    out[near, 1] = y - up * rim * excess
    below = np.maximum(-up * (out[near, 1] - crest), 0.0)
    limit = -0.4 - np.interp(back, [0.0, 12.0, 25.0], [0.15, 0.15, 0.06]) * (height + np.minimum(below, 3.0))
    fade = np.clip((11.0 - below) / 8.0, 0.0, 1.0) * np.clip((34.0 - back) / 12.0, 0.0, 1.0)
    shift = np.maximum(over - limit, 0.0) * fade * (over < 8.0) * (rim > 0.0)
    out[near, 0] -= shift * outward[:, 0]
    out[near, 2] -= shift * outward[:, 1]
    return out


def build_mouth(plan: Plan) -> tuple[dict[str, Piece], tuple[np.ndarray, np.ndarray]]:
    """Return the pieces by name and the tips of the upper and lower central incisors at the midline, (3,) each."""
    out: dict[str, Piece] = {}
    tips = []
    for upper in (True, False):
        teeth, places = place_teeth(plan, upper)
        gums = build_gums(plan, upper, places)
        out[teeth.name], out[gums.name] = teeth, gums
        front = teeth.points[np.abs(teeth.points[:, 0]) < 6.0]
        tip = front[front[:, 1].argmin() if upper else front[:, 1].argmax()]
        tips.append(np.array([0.0, tip[1], tip[2]]))
    out["tongue"] = build_tongue(plan)
    return out, (tips[0], tips[1])
