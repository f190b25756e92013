"""Where muscles sit in a head: points carried from rays to skin and bone, and names by place.

A mark of a muscle image is a ray (Zhang, Prakash & Sung, section 3.2): an insertion lies where it meets the skin, an
attachment where it meets the skull or jaw, the end of a sphincter's axis midway between both (their Eqs 6 and 7 with the
exact intersection in place of the one in the plane of the picture).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from faceanim.face.library import asset_arrays, asset_text
from faceanim.face.muscles import (
    BONES,
    AnyMuscle,
    LidMuscle,
    LinearMuscle,
    SheetMuscle,
    SphincterMuscle,
    Vec,
    moved,
    one_sided,
    parse_muscles,
)
from faceanim.geometry.projection import Cylinder
from faceanim.geometry.rays import barycentric, first_hit
from faceanim.ground.arrays import Bools, Floats, Ints

if TYPE_CHECKING:
    from faceanim.face.face import Face

RINGS = ("orbicularis_oculi_left", "orbicularis_oculi_right", "orbicularis_oris")
"""The sphincters of a muscle image; each drives every ring and lid muscle whose name begins alike."""

PAPER_MUSCLES = (
    "frontalis_inner", "frontalis_outer", "corrugator", "levator_labii_superioris_alaeque_nasi",
    "levator_labii_superioris", "zygomaticus_minor", "zygomaticus_major", "risorius", "depressor_anguli_oris",
    "depressor_labii_inferioris",
)  # fmt: skip
"""The paired muscles among the 23 of Zhang, Prakash & Sung; the other three are the `RINGS`."""

_FAR = 30.0
"""A muscle farther from every known one than this [mm] (in a head of the usual size) gets a name of its own."""
_MIDLINE = 2.0
_NEAREST_PAIRS = 12
_HALVINGS = 18
_FASCIA = 0.1
"""A known origin that lies more than this share of the way from bone to skin springs from fascia and stays there."""


def ring_of(name: str) -> str | None:
    """Return which of the `RINGS` the muscle `name` belongs to, None if to none."""
    side = next((s for s in ("_left", "_right") if name.endswith(s)), "")
    return next((ring for ring in RINGS if name.startswith(ring.removesuffix(side)) and ring.endswith(side)), None)


def tallest_ring(table: Mapping[str, AnyMuscle], ring: str) -> SphincterMuscle | None:
    """Return the muscle with the tallest ring among those of one-sided `table` that belong to `ring`, if any."""
    rows = [m for n, m in table.items() if ring_of(n) == ring and isinstance(m, SphincterMuscle)]
    return max(rows, key=lambda row: row.axes[1], default=None)


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays end: point (n, 3) [mm], nan if nothing was met, found (n,), triangle (n,), bone (n,): 0 cranium, 1 jaw."""

    point: Floats
    found: Bools
    triangle: Ints
    bone: Ints

    def only(self, row: int) -> Hits:
        """Return one of the hits."""
        part = slice(row, row + 1)
        return Hits(self.point[part], self.found[part], self.triangle[part], self.bone[part])


class Places:
    """The places of a head's muscles.

    known : the built-in muscles, one-sided, carried to this head by its landmarks;  scale : of the head [-], 1 = built-in
    cylinder : how this head is unrolled
    """

    def __init__(self, face: Face) -> None:
        self.face = face
        self.cylinder = Cylinder.of(face.mesh.points)
        linear, offset = _registration(face)
        self.scale = float(abs(np.linalg.det(linear)) ** (1.0 / 3.0))
        table = one_sided(parse_muscles(asset_text("muscles.toml"), "muscles.toml"))
        self.known: dict[str, AnyMuscle] = {n: moved(m, linear, offset, self.scale) for n, m in table.items()}

    # Rays

    def skin(self, start: Floats, direction: Floats) -> Hits:
        """Return where rays (n, 3), (n, 3) first meet the skin; an eyeball in front of it stops them."""
        far, triangle = first_hit(start, direction, self.face.mesh, np.inf)
        for eye in self.face.eyes.values():
            far = np.where(_sphere_hit(start, direction, eye.centre, eye.radius) < far, np.inf, far)
        return _hits(start, direction, far, triangle, np.zeros(len(far), dtype=np.int32))

    def bone(self, start: Floats, direction: Floats, reach: float = np.inf, only: str | None = None) -> Hits:
        """Return where rays first meet bone (or `only` the one of that name) within `reach` [mm]."""
        meshes = (self.face.cranium, self.face.jaw_mesh)
        wanted = [k for k, name in enumerate(BONES) if only in (None, name)]
        hits = [first_hit(start, direction, meshes[k], reach) for k in wanted]
        far, nearest = np.stack([h[0] for h in hits]), np.argmin([h[0] for h in hits], axis=0)
        triangle = np.stack([h[1] for h in hits])[nearest, np.arange(len(start))]
        return _hits(start, direction, far.min(axis=0), triangle, np.array(wanted, dtype=np.int32)[nearest])

    def layer(self, start: Floats, direction: Floats) -> Hits:
        """Return midway between skin and bone along rays: half the depth of the nearest bone below the skin.

        The bone along the ray itself would jump where it passes between teeth or grazes the temple.
        """
        skin = self.skin(start, direction)
        corner = self.face.mesh.triangles[skin.triangle]
        share = barycentric(self.face.mesh.points[corner], skin.point)
        depth = np.einsum("ij,ij->i", share, self.face.depth[corner])
        return replace(skin, point=skin.point + 0.5 * depth[:, None] * direction)

    def skin_along(self, start: Any, direction: Any) -> Floats | None:
        """Return the first skin that one ray (3,), (3,) meets, (3,) [mm]; None if it meets none."""
        hit = self.skin(*_one(start, direction))
        return hit.point[0] if hit.found[0] else None

    def bone_along(self, start: Any, direction: Any) -> tuple[Floats, str] | None:
        """Return the first bone that one ray (3,), (3,) meets, (3,) [mm], and its name; None if it meets none."""
        hit = self.bone(*_one(start, direction))
        return (hit.point[0], BONES[hit.bone[0]]) if hit.found[0] else None

    def ring_layer(self, start: Any, direction: Any) -> Floats | None:
        """Return midway between skin and bone under the skin that one ray meets, (3,) [mm]; None off the face."""
        skin = self.skin_along(start, direction)
        if skin is None:
            return None
        hit = self.layer(*self.across(skin[None]))
        return hit.point[0] if hit.found[0] else None

    def across(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the rays (n, 3), (n, 3) that run through `points` (n, 3) towards the cylinder's axis."""
        unit = (1, 1)
        return self.cylinder.rays(self.cylinder.pixels(points, unit), unit)

    # Names

    def distance(self, insertion: Floats, origin: Floats, name: str) -> float:
        """Return how far a muscle is from the known one called `name` [mm]: of both ends, the insertion counts more."""
        m: Any = self.known[name]
        ends = np.linalg.norm(insertion - np.array(m.insertion)), np.linalg.norm(origin - np.array(m.origin))
        return float(0.6 * ends[0] + 0.4 * ends[1]) / self.scale

    def names_of(self, insertion: Floats, origin: Floats, taken: Collection[str] = ()) -> tuple[list[str], float]:
        """Return a name for every muscle from its ends (n, 3), (n, 3), and the mean distance to the known ones [mm].

        Each known name is given once, so that the sum of all distances is least; the rest are "muscle_1_left", ...
        """
        free = [n for n, m in self.known.items() if isinstance(m, (LinearMuscle, SheetMuscle)) and n not in taken]
        cost = np.full((len(insertion), len(free) + len(insertion)), _FAR)
        for i, j in np.ndindex(len(insertion), len(free)):
            cost[i, j] = min(self.distance(insertion[i], origin[i], free[j]), 2.0 * _FAR)
        row, column = linear_sum_assignment(cost)
        used, names = set(taken), [""] * len(insertion)
        for i, j in zip(row, column, strict=True):
            names[i] = free[j] if j < len(free) else self._own_name(insertion[i], used)
            used.add(names[i])
        return names, float(cost[row, column].mean()) if len(row) else 0.0

    def name_of(self, insertion: Any, origin: Any, taken: Collection[str] = ()) -> str:
        """Return the name of one muscle by its ends (3,), (3,); none of `taken`."""
        return self.names_of(np.array([insertion]), np.array([origin]), taken)[0][0]

    def _own_name(self, insertion: Floats, used: Collection[str]) -> str:
        x = insertion[0] - self.cylinder.axis[0]
        side = "" if abs(x) < _MIDLINE else "_left" if x > 0 else "_right"
        return next(n for k in range(1, len(used) + 2) if (n := f"muscle_{k}{side}") not in used)

    def rings_of(self, ends: Floats) -> dict[str, tuple[int, int]]:
        """Return which two of the axis ends (n, 3) belong to each ring, so that the rings lie as known ones do.

        Two ends make a ring no farther than usual from the known one; of an odd number one is left over.
        """
        pairs = list(combinations(range(len(ends)), 2))
        choices: list[list[tuple[float, tuple[int, ...]]]] = []
        for ring in self._tallest:
            near = sorted((self._ring_cost(ends[list(p)], ring), p) for p in pairs)[:_NEAREST_PAIRS]
            choices.append([(cost, p) for cost, p in near if cost < 2.0 * _FAR] + [(4.0 * _FAR, ())])
        best: float = np.inf
        chosen: tuple[tuple[int, ...], ...] = ((),) * len(choices)
        for way in product(*choices):
            members = [i for _, p in way for i in p]
            total = sum(cost for cost, _ in way)
            if total < best and len(set(members)) == len(members):
                best, chosen = total, tuple(p for _, p in way)
        return {r: (p[0], p[1]) for r, p in zip(self._tallest, chosen, strict=True) if p}

    def ring_name(self, end_a: Any, end_b: Any, taken: Collection[str] = ()) -> str:
        """Return which of the `RINGS` not `taken` two axis ends (3,), (3,) belong to; the nearest."""
        free = [r for r in self._tallest if r not in taken] or list(self._tallest)
        return min(free, key=lambda r: self._ring_cost(np.array([end_a, end_b], dtype=np.float64), r))

    @cached_property
    def _tallest(self) -> dict[str, SphincterMuscle]:
        """The known muscle with the tallest ring, for each of the `RINGS`."""
        return {ring: m for ring in RINGS if (m := tallest_ring(self.known, ring)) is not None}

    def _ring_cost(self, ends: Floats, ring: str) -> float:
        known = self._tallest[ring]
        centre, axes = _ellipse(ends, np.array(known.centre))
        off = np.hypot(*(centre - known.centre[:2])) + 0.5 * np.abs(axes - known.axes).sum()
        return float(off) / self.scale

    # Muscles

    def muscle(self, name: str, insertion: Any, origin: Any, bone: str) -> LinearMuscle | SheetMuscle:
        """Return the muscle `name` between two points (3,), (3,) [mm]; force, width and bend are the known one's."""
        start, end = _vec(origin), _vec(insertion)
        known = self.known.get(name)
        if not isinstance(known, (LinearMuscle, SheetMuscle)):
            return LinearMuscle(start, end, 1500.0 * self.scale**2, 15.0 * self.scale, bone=bone, paired=False)
        via = None if known.via is None else _vec(_bent(known, np.array(start), np.array(end)))
        return msgspec.structs.replace(known, origin=start, insertion=end, via=via, bone=bone)

    def rings(self, ring: str, end_a: Any, end_b: Any) -> dict[str, AnyMuscle]:
        """Return the muscles that the ring of two axis ends (3,), (3,) drives; centre and axes move together."""
        tallest = self._tallest[ring]
        centre, axes = _ellipse(np.array([end_a, end_b], dtype=np.float64), np.array(tallest.centre))
        shift = np.append(centre - tallest.centre[:2], 0.0)
        share = axes / tallest.axes
        out: dict[str, AnyMuscle] = {}
        for name, m in self.known.items():
            if ring_of(name) == ring and isinstance(m, SphincterMuscle):
                wide = (round(float(m.axes[0] * share[0]), 3), round(float(m.axes[1] * share[1]), 3))
                out[name] = msgspec.structs.replace(m, centre=_vec(np.array(m.centre) + shift), axes=wide)
        return out

    def lids(self) -> dict[str, AnyMuscle]:
        """Return the lid muscles, which follow from the eyes alone."""
        return {n: m for n, m in self.known.items() if isinstance(m, LidMuscle)}

    def axis_ends(self, table: Mapping[str, AnyMuscle], ring: str) -> Floats | None:
        """Return the two axis ends that draw a ring of one-sided `table`, (2, 3) [mm]; None if it has none there.

        The lateral and the upper end of its tallest muscle, midway between skin and bone.
        """
        m = tallest_ring(table, ring)
        if m is None:
            return None
        out = -1.0 if ring.endswith("_right") else 1.0
        x, y = m.centre[0], m.centre[1]
        return np.array([self._layer_at(x + out * m.axes[0], y), self._layer_at(x, y + m.axes[1])])

    def _layer_at(self, x: float, y: float) -> Floats:
        """Return the point midway between skin and bone whose front view is (x, y), (3,) [mm]; the nearest if none is."""
        best, side = np.full(3, np.nan), 1.0 if x > self.cylinder.axis[0] else -1.0
        low, high = 0.0, 0.5 * np.pi
        for _ in range(_HALVINGS):  # the layer's x grows with longitude, over the front of a head
            turn = 0.5 * (low + high)
            way = np.array([[side * np.sin(turn), 0.0, np.cos(turn)]])
            foot = np.array([[self.cylinder.axis[0], y, self.cylinder.axis[1]]])
            hit = self.layer(foot + self.cylinder.reach * way, -way)
            if hit.found[0] and not abs(hit.point[0, 0] - x) > abs(best[0] - x):
                best = hit.point[0]
            too_far = hit.found[0] and side * (hit.point[0, 0] - x) > 0.0
            low, high = (low, turn) if too_far else (turn, high)
        return best

    def fascia(self, name: str) -> float:
        """Return the share of the way from bone to skin at which the known muscle `name` springs from fascia, or 0."""
        return self._fascia.get(name, 0.0)

    @cached_property
    def _fascia(self) -> dict[str, float]:
        rows = {n: m for n, m in self.known.items() if isinstance(m, (LinearMuscle, SheetMuscle))}
        origin = np.array([m.origin for m in rows.values()])
        start, way = self.across(origin)
        skin, bone = self.skin(start, way), self.bone(start, way, self.cylinder.reach)
        deep = np.linalg.norm(bone.point - skin.point, axis=1)
        with np.errstate(invalid="ignore"):
            share = np.einsum("ij,ij->i", bone.point - origin, way) / deep
        known = skin.found & bone.found & (share > _FASCIA) & (share < 1.0)
        return {n: float(s) for n, s, k in zip(rows, share, known, strict=True) if k}


def _registration(face: Face) -> tuple[Floats, Floats]:
    """Return the affine map (3, 3), (3,) that carries the built-in head's landmarks to those of `face`."""
    data = asset_arrays("face_coarse.npz")
    own = dict(zip((str(n) for n in data["landmark_names"]), data["points"][data["landmark_index"]], strict=True))
    names = [n for n in own if n in face.landmarks]
    source = np.array([own[n] for n in names])
    target = face.mesh.points[[face.landmarks[n] for n in names]]
    if len(names) < 4 or np.abs(source - target).max() < 1e-6:
        return np.eye(3), np.zeros(3)
    fit = np.linalg.lstsq(np.column_stack([source, np.ones(len(source))]), target, rcond=None)[0]
    return fit[:3].T, fit[3]


def _hits(start: Floats, direction: Floats, far: Floats, triangle: Ints, bone: Ints) -> Hits:
    found = np.isfinite(far)
    step = np.where(found, far, np.nan)
    return Hits(start + step[:, None] * direction, found, triangle, bone)


def _one(start: Any, direction: Any) -> tuple[Floats, Floats]:
    way = np.asarray(direction, dtype=np.float64)
    return np.asarray(start, dtype=np.float64)[None], (way / np.linalg.norm(way))[None]


def _sphere_hit(start: Floats, direction: Floats, centre: Floats, radius: float) -> Floats:
    """Return how far rays run to a sphere, (n,); inf where they miss it."""
    back = np.einsum("ij,ij->i", start - centre, direction)
    inside = back**2 - np.einsum("ij,ij->i", start - centre, start - centre) + radius**2
    with np.errstate(invalid="ignore"):
        far = -back - np.sqrt(inside)
    return np.where((inside > 0.0) & (far > 0.0), far, np.inf)


def _ellipse(ends: Floats, near: Floats) -> tuple[Floats, Floats]:
    """Return centre (x, y) and semi-axes of the upright ellipse with axis ends `ends` (2, 3): of the two, the nearer."""
    best: tuple[float, Floats, Floats] | None = None
    for p, q in ((ends[0], ends[1]), (ends[1], ends[0])):
        centre = np.array([q[0], p[1]])
        axes = np.array([abs(p[0] - q[0]), abs(q[1] - p[1])])
        off = float(np.hypot(*(centre - near[:2])))
        if best is None or off < best[0]:
            best = (off, centre, axes)
    assert best is not None
    return best[1], best[2]


def _vec(point: Any) -> Vec:
    x, y, z = (round(float(v), 3) + 0.0 for v in point)
    return (x, y, z)


def _bent(known: LinearMuscle | SheetMuscle, origin: Floats, insertion: Floats) -> Floats:
    """Return where a known muscle's bend goes with its ends, (3,): each end takes along what is near it."""
    start, end, via = np.array(known.origin), np.array(known.insertion), np.array(known.via)
    way = end - start
    share = float(np.clip((via - start) @ way / (way @ way), 0.0, 1.0))
    return via + (1.0 - share) * (origin - start) + share * (insertion - end)
