"""Facial muscle images: from marks on a picture to muscles in a head, and back (Zhang, Prakash & Sung, section 3.2).

A red mark is an insertion, a green one an attachment, a white line joins them; two blue marks are the ends of the
semi-axes of a sphincter. The picture shows the head from the front without perspective, or unrolled about an upright axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from faceanim.face.attach import EAR, SCALP
from faceanim.face.muscle_marks import Marks, find_marks
from faceanim.face.muscle_places import RINGS, Hits, Places
from faceanim.face.muscles import BONES, AnyMuscle, LinearMuscle, SheetMuscle, one_sided
from faceanim.geometry.projection import Cylinder, Front, Projection, Size
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError, unknown_name

if TYPE_CHECKING:
    from faceanim.face.face import Face

KINDS = ("auto", "front", "cylinder")
Severity = Literal["error", "warning"]

MARK_RADIUS, LINE_WIDTH = 3.0, 1.6
"""Of drawn marks and lines, in a picture 512 pixels high [pixel]."""
_SHARED = 2.5
"""Marks of one colour nearer than this, in a picture 512 pixels high [pixel], are drawn as one."""
_GRAZING = (0.5, -0.5, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0)
"""How far above or below a ray bone is looked for that the ray misses [mm], in a head of the usual size."""
_DEEP = 55.0
"""Deepest origin below the skin [mm], in a head of the usual size."""

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)


@dataclass(frozen=True)
class Fault:
    """What is wrong with a muscle image or a list of muscles: a stable `code`, a sentence, and where."""

    code: str
    message: str
    severity: Severity = "error"
    pixel: tuple[float, float] | None = None
    muscle: str | None = None


@dataclass(frozen=True, eq=False)
class Placed:
    """A muscle that was found: its marks [pixel], its ends (3,) [mm] and what carries the origin.

    A ring has its axis ends for insertion and origin, and no bone.
    """

    name: str
    pixels: Floats
    insertion: Floats
    origin: Floats
    bone: str | None


@dataclass(frozen=True, eq=False)
class MuscleMap:
    """What a picture says: `kind` of the picture, one-sided muscles by full name, what was found, what is wrong."""

    kind: str
    table: dict[str, AnyMuscle]
    placed: tuple[Placed, ...]
    faults: tuple[Fault, ...]


def projection_of(face: Face, kind: str) -> Projection:
    """Return how pictures of a `kind` show `face`; raise `UserError` for an unknown kind."""
    if kind not in ("front", "cylinder"):
        raise unknown_name("kind of picture", kind, ("front", "cylinder"))
    points = face.mesh.points
    return Front.of(points) if kind == "front" else Cylinder.of(points)


# From a picture to muscles


def map_picture(picture: np.ndarray, face: Face, kind: str = "auto", *, places: Places | None = None) -> MuscleMap:
    """Return the muscles that a muscle image (h, w, 3) RGB bytes shows on `face`.

    kind : front, cylinder, or auto: the one under which the muscles lie nearer to the known ones
    Raises `UserError` if no muscle can be placed, naming the first thing that is wrong.
    """
    found = read_picture_marks(picture, face, kind, places=places)
    if not found.placed:
        first = f": {found.faults[0].message}" if found.faults else ""
        raise UserError(
            "no muscle was found in the picture; mark insertions red (255, 0, 0), attachments green, join them with a "
            f"white line{first}"
        )
    return found


def read_picture_marks(
    picture: np.ndarray, face: Face, kind: str = "auto", *, places: Places | None = None
) -> MuscleMap:
    """As `map_picture`, but a picture without any muscle gives an empty table."""
    if kind not in KINDS:
        raise unknown_name("kind of picture", kind, KINDS)
    marks = find_marks(picture)
    places = Places(face) if places is None else places
    size = (picture.shape[1], picture.shape[0])
    tried = [_Reading(marks, places, name, size) for name in KINDS[1:] if kind in ("auto", name)]
    return min(tried, key=lambda reading: reading.strangeness).result()


class _Reading:
    """The marks of a picture taken as one of a `kind`; `strangeness` [mm]: how far the muscles are from known ones."""

    def __init__(self, marks: Marks, places: Places, kind: str, size: Size) -> None:
        self.marks, self.places, self.kind = marks, places, kind
        view = projection_of(places.face, kind)
        self.insertion = _skin_under(places, view, marks.insertion, size)
        over_origin = _skin_under(places, view, marks.attachment, size)
        self.over_origin = over_origin
        self.origin = _beneath(places, over_origin)
        over_ring = _skin_under(places, view, marks.axis, size)
        ring = places.layer(*places.across(np.nan_to_num(over_ring.point)))
        self.ring = replace(ring, found=ring.found & over_ring.found)
        attachment, insertion = marks.line[:, 0], marks.line[:, 1]
        self.whole = np.flatnonzero(self.origin.found[attachment] & self.insertion.found[insertion])
        self.names, near = places.names_of(
            self.insertion.point[insertion[self.whole]], self.origin.point[attachment[self.whole]]
        )
        off = len(self.insertion.found) + len(self.origin.found) + len(self.ring.found)
        off -= int(self.insertion.found.sum() + self.origin.found.sum() + self.ring.found.sum())
        self.strangeness = near + 30.0 * off / max(1, len(marks.insertion) + len(marks.attachment) + len(marks.axis))

    def result(self) -> MuscleMap:
        """Return muscles and faults."""
        self.faults = [Fault(f.code, f.message, "error", f.pixel) for f in self.marks.fault]
        self.table: dict[str, AnyMuscle] = {}
        self.placed: list[Placed] = []
        self._off_face()
        for row, name in zip(self.whole, self.names, strict=True):
            self._muscle(name, *self.marks.line[row])
        self._rings()
        if self.placed:
            self.table.update(self.places.lids())
        order = {name: k for k, name in enumerate(self.places.known)}
        table = dict(sorted(self.table.items(), key=lambda item: order.get(item[0], len(order))))
        return MuscleMap(self.kind, table, tuple(self.placed), tuple(self.faults))

    def _fault(self, code: str, message: str, pixel: Floats, severity: Severity = "error", name: str = "") -> None:
        self.faults.append(Fault(code, message, severity, (float(pixel[0]), float(pixel[1])), name or None))

    def _off_face(self) -> None:
        """Marks that meet no skin, and origins without bone beneath."""
        for what, pixels, hits in (
            ("insertion", self.marks.insertion, self.insertion),
            ("attachment", self.marks.attachment, self.over_origin),
            ("axis mark", self.marks.axis, self.ring),
        ):
            for pixel in pixels[~hits.found]:
                self._fault(
                    "off-face", f"this {what} lies off the skin (or on an eyeball); move it onto the face", pixel
                )
        for k in np.flatnonzero(self.over_origin.found & ~self.origin.found):
            message = "this attachment floats: there is no bone beneath it; move it over the skull or the jaw"
            self._fault("floating-origin", message, self.marks.attachment[k])

    def _muscle(self, name: str, attachment: int, insertion: int) -> None:
        places, pixels = self.places, np.stack([self.marks.insertion[insertion], self.marks.attachment[attachment]])
        end, skin = self.insertion.point[insertion], self.over_origin.point[attachment]
        origin, bone = self._on_its_bone(name, attachment)
        deep = float(np.linalg.norm(origin - skin))
        if deep > _DEEP * places.scale:
            message = f"the attachment of {name} floats: the bone beneath it is {deep:.0f} mm under the skin; move it"
            self._fault("floating-origin", message, pixels[1], "error", name)
            return
        region = int(places.face.region[np.linalg.norm(places.face.mesh.points - end, axis=1).argmin()])
        if region in (SCALP, EAR):
            where = "scalp" if region == SCALP else "ear"
            message = f"the insertion of {name} lies on the {where}, which does not move; move it onto the face"
            self._fault("wrong-layer", message, pixels[0], "error", name)
            return
        origin = origin + places.fascia(name) * (skin - origin)
        self.table[name] = places.muscle(name, end, origin, bone)
        self.placed.append(Placed(name, pixels, end, origin, bone))

    def _on_its_bone(self, name: str, attachment: int) -> tuple[Floats, str]:
        """Return the origin on the bone that the known muscle of that name springs from, if that bone is there."""
        point, bone = self.origin.point[attachment], BONES[self.origin.bone[attachment]]
        known = self.places.known.get(name)
        if not isinstance(known, (LinearMuscle, SheetMuscle)) or known.bone == bone:
            return point, bone
        if self.places.fascia(name):
            return point, known.bone
        over = self.over_origin.only(attachment)
        other = _beneath(self.places, over, only=known.bone)
        if other.found[0] and np.linalg.norm(other.point[0] - over.point[0]) < _DEEP * self.places.scale:
            return other.point[0], known.bone
        message = f"the attachment of {name} lies over the {bone}; this muscle springs from the {known.bone}"
        self._fault("wrong-layer", message, self.marks.attachment[attachment], "warning", name)
        return point, bone

    def _rings(self) -> None:
        usable = np.flatnonzero(self.ring.found)
        rings = self.places.rings_of(self.ring.point[usable])
        for ring, pair in rings.items():
            a, b = usable[list(pair)]
            ends = self.ring.point[[a, b]]
            self.table.update(self.places.rings(ring, *ends))
            self.placed.append(Placed(ring, self.marks.axis[[a, b]], ends[0], ends[1], None))
        left = set(usable.tolist()) - {int(usable[i]) for pair in rings.values() for i in pair}
        code = "odd-axis-marks" if len(self.marks.axis) % 2 else "stray-axis-mark"
        for k in sorted(left):
            message = (
                f"of {len(self.marks.axis)} blue marks this one belongs to no sphincter; each of {', '.join(RINGS)} has "
                "two, at the ends of its axes: add the other or remove this"
            )
            self._fault(code, message, self.marks.axis[k])


def _skin_under(places: Places, view: Projection, pixels: Floats, size: Size) -> Hits:
    """Return the skin that a picture shows at `pixels` (n, 2)."""
    return places.skin(*view.rays(pixels, size))


def _beneath(places: Places, skin: Hits, only: str | None = None) -> Hits:
    """Return the outermost bone beneath points of the skin, towards the cylinder's axis.

    A ray that misses all bone by less than `_GRAZING` finds its border: marks at the edge of the jaw are not lost.
    """
    start, way = places.across(np.nan_to_num(skin.point))
    bone = places.bone(start, way, places.cylinder.reach, only)
    point, found, which = bone.point.copy(), bone.found.copy(), bone.bone.copy()
    for height in _GRAZING if only is None else ():
        rows = np.flatnonzero(skin.found & ~found)
        if len(rows):
            lift = np.array([0.0, height * places.scale, 0.0])
            near = places.bone(start[rows] + lift, way[rows], places.cylinder.reach, only)
            found[rows], point[rows], which[rows] = near.found, near.point, near.bone
    return Hits(point, found & skin.found, bone.triangle, which)


# From muscles to a picture


@dataclass(frozen=True, eq=False)
class Drawn:
    """Marks to paint [pixel]: insertion (n, 2), attachment (m, 2), axis (k, 2), line (l, 2) attachment and insertion.

    names : (l,) of the lines;  hidden : names of muscles that this kind of picture cannot show
    """

    insertion: Floats
    attachment: Floats
    axis: Floats
    line: Ints
    names: tuple[str, ...]
    hidden: tuple[str, ...]


def drawn_marks(
    table: Mapping[str, AnyMuscle], face: Face, kind: str, size: Size, *, places: Places | None = None
) -> Drawn:
    """Return where the marks of a list of muscles lie in a picture of a `kind` and `size` (width, height).

    Marks of one colour that would cover each other become one mark, which several lines share.
    """
    places = Places(face) if places is None else places
    view = projection_of(face, kind)
    rows = one_sided(table)
    linear = {n: m for n, m in rows.items() if isinstance(m, (LinearMuscle, SheetMuscle))}
    rings = {r: ends for r in RINGS if (ends := places.axis_ends(rows, r)) is not None}
    end = _shown(places, view, np.array([m.insertion for m in linear.values()]).reshape(-1, 3), size)
    origin = _shown(places, view, np.array([m.origin for m in linear.values()]).reshape(-1, 3), size)
    axis = _shown(places, view, np.concatenate([np.zeros((0, 3)), *rings.values()]), size)
    seen = np.isfinite(end).all(axis=1) & np.isfinite(origin).all(axis=1)
    whole = np.isfinite(axis).all(axis=1).reshape(-1, 2).all(axis=1)
    names = np.array([*linear, *rings], dtype=object)
    near = _SHARED * size[1] / 512.0
    insertion, which_end = _merged(end[seen], near)
    attachment, which_origin = _merged(origin[seen], near)
    return Drawn(
        insertion=insertion,
        attachment=attachment,
        axis=axis[np.repeat(whole, 2)],
        line=np.stack([which_origin, which_end], axis=1).astype(np.int32),
        names=tuple(names[: len(linear)][seen]),
        hidden=tuple(names[~np.concatenate([seen, whole])]),
    )


def _shown(places: Places, view: Projection, points: Floats, size: Size) -> Floats:
    """Return where the skin over `points` (n, 3) lies in a picture, (n, 2); nan where something else is in front."""
    if isinstance(view, Cylinder):
        return view.pixels(points, size)
    skin = places.skin(*places.across(points))
    on_skin = np.linalg.norm(np.nan_to_num(skin.point) - points, axis=1) < 1.0
    shown = np.where((on_skin | ~skin.found)[:, None], points, skin.point)
    pixels = view.pixels(shown, size)
    front = places.skin(*view.rays(pixels, size))
    covered = ~front.found | (np.nan_to_num(front.point)[:, 2] > shown[:, 2] + 2.0 * places.scale)
    return np.where(covered[:, None], np.nan, pixels)


def _merged(points: Floats, near: float) -> tuple[Floats, Ints]:
    """Return marks (m, 2) that stand for `points` (n, 2), and which of them, (n,): groups within `near` share one."""
    group = np.arange(len(points))
    for i in range(len(points)):
        close = np.linalg.norm(points - points[i], axis=1) < near
        group[np.isin(group, group[close])] = group[close].min()
    kept, index = np.unique(group, return_inverse=True)
    centre = np.array([points[group == g].mean(axis=0) for g in kept]).reshape(-1, 2)
    return centre, index.astype(np.int32)


def paint_marks(picture: np.ndarray, drawn: Drawn) -> np.ndarray:
    """Return a copy of `picture` (h, w, 3) RGB bytes with the marks painted over it."""
    out = picture.astype(np.float32)
    unit = picture.shape[0] / 512.0
    for a, i in drawn.line:
        _paint(out, drawn.attachment[a], drawn.insertion[i], 0.5 * LINE_WIDTH * unit, WHITE)
    for marks, colour in ((drawn.attachment, GREEN), (drawn.insertion, RED), (drawn.axis, BLUE)):
        for mark in marks:
            _paint(out, mark, mark, MARK_RADIUS * unit, colour)
    return np.round(out).astype(np.uint8)


def _paint(out: np.ndarray, a: Floats, b: Floats, radius: float, colour: tuple[int, int, int]) -> None:
    """Paint all within `radius` of the segment from `a` to `b` (2,), anti-aliased by the distance from its edge."""
    low = np.maximum(np.floor(np.minimum(a, b) - radius - 1.0), 0).astype(int)
    high = np.minimum(np.ceil(np.maximum(a, b) + radius + 1.0), [out.shape[1], out.shape[0]]).astype(int)
    if (high <= low).any():
        return
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    way = b - a
    share = np.clip(((x - a[0]) * way[0] + (y - a[1]) * way[1]) / max(float(way @ way), 1e-12), 0.0, 1.0)
    far = np.hypot(x - a[0] - share * way[0], y - a[1] - share * way[1])
    cover = np.clip(radius + 0.5 - far, 0.0, 1.0)[:, :, None].astype(np.float32)
    part = out[low[1] : high[1], low[0] : high[0]]
    part += cover * (np.array(colour, dtype=np.float32) - part)
