"""Pictures of muscles: the muscle image over the face, seen from the front or unrolled, and the muscles in the head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from faceanim.face.muscle_image import BLUE, GREEN, RED, Drawn, drawn_marks, paint_marks, projection_of
from faceanim.face.muscle_places import RINGS, Places, tallest_ring
from faceanim.face.muscles import AnyMuscle, LinearMuscle, SheetMuscle, one_sided
from faceanim.geometry.projection import Cylinder, Front
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.render.camera import Camera
from faceanim.render.occlusion import vertex_openness
from faceanim.render.overlay import write_text
from faceanim.render.renderer import DrawItem, Renderer
from faceanim.render.scene import MATERIALS, SKIN, face_scene
from faceanim.render.shading import Bytes, Look, Texture

if TYPE_CHECKING:
    from faceanim.face.face import Face

_FOV = 0.3
"""Angle of view that is as good as none [degree]."""
_MUTED, _DARKEST = 0.62, 38.0
"""How the face is toned down under the marks: value * _MUTED + _DARKEST, so that nothing of it is as bright as a line."""
_DIRECTIONS = 24
"""From how many sides the openness to light is looked at in pictures of muscles."""
_SIZES = (64, 4096)


def muscle_image(
    face: Face, table: Mapping[str, AnyMuscle], kind: str = "front", size: int = 512, *, places: Places | None = None
) -> tuple[Bytes, Drawn]:
    """Return the muscle image of a list of muscles over the face, (size, size, 3) RGB bytes, and the marks in it.

    kind : front or cylinder;  an empty table gives the picture to draw marks on
    Raises `UserError` for an unknown kind or a size outside 64..4096.
    """
    if not _SIZES[0] <= size <= _SIZES[1]:
        raise UserError(f"size {size} is outside its limits; give {_SIZES[0]} to {_SIZES[1]}")
    drawn = drawn_marks(table, face, kind, (size, size), places=places)
    return paint_marks(face_picture(face, kind, size), drawn), drawn


@lru_cache(maxsize=8)
def face_picture(face: Face, kind: str, size: int) -> Bytes:
    """Return the face toned down, from the front without perspective or unrolled, (size, size, 3) RGB bytes."""
    view = projection_of(face, kind)
    texture = _texture(face) if size <= 1024 else Texture.of(face.texture)
    shade = _openness(face)
    skin = DrawItem(
        face.mesh.points,
        face.mesh.triangles,
        replace(SKIN, texture=texture),
        face.uv,
        face.uv_triangles,
        occlusion=shade,
    )
    eyes = [p for p in face.parts if p.name.startswith("eye")]
    items = [skin, *(_eye(p) for p in eyes)]
    if isinstance(view, Cylinder):
        items = [_unrolled(item, view) for item in items]
    picture = Renderer(size, _far_camera(view, size), items, look=Look(shadow=isinstance(view, Front))).draw()
    return np.round(_MUTED * picture + _DARKEST).astype(np.uint8)


def _eye(part: Any) -> DrawItem:
    colour = part.colour / 255.0
    return DrawItem(part.points, part.triangles, MATERIALS["eye"], vertex_colour=colour)


def _far_camera(view: Any, size: int) -> Camera:
    """Return a camera so far away that it sees without perspective what `view` shows."""
    high = 0.5 * (view.high - view.low)
    middle = np.array([getattr(view, "centre", 0.0), 0.5 * (view.low + view.high), 0.0])
    distance = high / np.tan(np.radians(0.5 * _FOV))
    near = distance - 4.0 * high
    eye = middle + np.array([0.0, 0.0, distance])
    return Camera(eye, middle, np.array([0.0, 1.0, 0.0]), _FOV, near)


def _unrolled(item: DrawItem, view: Cylinder) -> DrawItem:
    """Return a surface unrolled onto the plane: longitude to the right, the distance from the axis towards the viewer.

    Triangles across the seam are drawn at both borders; those about the axis, which have no longitude, are left out.
    """
    wide = (view.high - view.low) / (2.0 * np.pi)
    angle = view.longitude(item.points)
    radius = np.hypot(item.points[:, 0] - view.axis[0], item.points[:, 2] - view.axis[1])
    corner = angle[item.triangles]
    turned = np.where(corner < corner.max(axis=1, keepdims=True) - np.pi, corner + 2.0 * np.pi, corner)
    flat = np.stack([wide * turned, item.points[:, 1][item.triangles], 0.5 * radius[item.triangles]], axis=2)
    seam = np.flatnonzero(turned.max(axis=1) > np.pi)
    keep = np.flatnonzero(np.ptp(turned, axis=1) < 0.5 * np.pi)
    seam = np.intersect1d(seam, keep)
    back = flat[seam] - [2.0 * np.pi * wide, 0.0, 0.0]
    rows = np.concatenate([keep, seam])
    points, index = _welded(np.concatenate([flat[keep], back]))
    origin = item.triangles[rows].ravel()
    first = np.zeros(len(points), dtype=np.int64)
    first[index.ravel()] = origin
    return replace(
        item,
        points=points,
        triangles=index,
        uv_triangles=None if item.uv_triangles is None else item.uv_triangles[rows],
        vertex_colour=None if item.vertex_colour is None else item.vertex_colour[first],
        occlusion=None if item.occlusion is None else item.occlusion[first],
    )


def _welded(corners: Floats) -> tuple[Floats, Ints]:
    """Return points and triangles of loose `corners` (t, 3, 3), equal corners made one."""
    points, index = np.unique(np.round(corners.reshape(-1, 3), 9), axis=0, return_inverse=True)
    return points, index.reshape(-1, 3).astype(np.int32)


def muscle_views(face: Face, table: Mapping[str, AnyMuscle], size: int = 512, *, places: Places | None = None) -> Bytes:
    """Return the muscles on the skin (above) and on the skull (below), from the front and from both sides of it.

    (2 * size, 3 * size, 3) RGB bytes
    """
    places = Places(face) if places is None else places
    rows = one_sided(table)
    paths = _Paths(rows, places)
    views = ("three_quarter_right", "front", "three_quarter_left")
    skin = [_skin_view(face, paths, view, size) for view in views]
    skull = [_skull_view(face, paths, view, size) for view in views]
    return np.concatenate([np.concatenate(row, axis=1) for row in (skin, skull)])


class _Paths:
    """What to draw of a list of muscles, in space: ends, lines along the skin, rings."""

    def __init__(self, rows: Mapping[str, AnyMuscle], places: Places) -> None:
        linear = [m for m in rows.values() if isinstance(m, (LinearMuscle, SheetMuscle))]
        self.insertion = np.array([m.insertion for m in linear]).reshape(-1, 3)
        self.origin = np.array([m.origin for m in linear]).reshape(-1, 3)
        self.via = [np.array([p for p in (m.origin, m.via, m.insertion) if p is not None]) for m in linear]
        self.over = self._on_skin(places, self.origin)
        share = np.linspace(0.0, 1.0, 6)[:, None, None]
        between = (1.0 - share) * self.over + share * self.insertion
        self.along = self._on_skin(places, between.reshape(-1, 3)).reshape(len(share), -1, 3)
        self.rings = [r for name in RINGS if (r := _ring(rows, places, name)) is not None]

    @staticmethod
    def _on_skin(places: Places, points: Floats) -> Floats:
        hit = places.skin(*places.across(points))
        return np.where(hit.found[:, None], hit.point, points)


def _ring(rows: Mapping[str, AnyMuscle], places: Places, name: str) -> tuple[Floats, Floats] | None:
    """Return the curve of a sphincter on the skin, (k, 3), and its axis ends, (2, 3) [mm]."""
    ring, ends = tallest_ring(rows, name), places.axis_ends(rows, name)
    if ring is None or ends is None:
        return None
    turn = np.linspace(0.0, 2.0 * np.pi, 37)
    x = ring.centre[0] + ring.axes[0] * np.cos(turn)
    y = ring.centre[1] + ring.axes[1] * np.sin(turn)
    far = places.face.mesh.points[:, 2].max() + 10.0
    start = np.stack([x, y, np.full(len(x), far)], axis=1)
    hit = places.skin(start, np.tile([0.0, 0.0, -1.0], (len(x), 1)))
    return hit.point, ends


def _skin_view(face: Face, paths: _Paths, view: str, size: int) -> Bytes:
    camera = Camera.named(view, face.mesh.points)
    scene = face_scene(face, size=size, view=camera, texture=_texture(face), occlusion=_openness(face))
    picture = np.round(_MUTED * scene.draw(face.mesh.points) + _DARKEST).astype(np.uint8)
    depth = scene.renderer.depth().min(axis=2)
    pen = _Pen(picture, camera, depth, 4.0)
    for line in np.swapaxes(paths.along, 0, 1):
        pen.line(line, (255, 255, 255))
    for curve, ends in paths.rings:
        pen.line(curve, (120, 160, 255))
        pen.dots(ends, BLUE, hidden=True)
    pen.dots(paths.over, GREEN)
    pen.dots(paths.insertion, RED)
    return picture


def _skull_view(face: Face, paths: _Paths, view: str, size: int) -> Bytes:
    camera = Camera.named(view, face.mesh.points)
    renderer = Renderer(size, camera, _skull_items(face))
    picture = renderer.draw().copy()
    pen = _Pen(picture, camera, renderer.depth().min(axis=2), 3.0)
    for line in paths.via:
        pen.line(line, (176, 58, 46))
    pen.dots(paths.origin, GREEN)
    pen.dots(paths.insertion, RED)
    for _, ends in paths.rings:
        pen.dots(ends, BLUE, hidden=True)
    return picture


@lru_cache(maxsize=2)
def _skull_items(face: Face) -> list[DrawItem]:
    bone = replace(MATERIALS["bone"], shade_radius=0.0, shade=0.0, casts=True)
    shaded = [
        (m, vertex_openness(m.points, m.triangles, directions=_DIRECTIONS)) for m in (face.cranium, face.jaw_mesh)
    ]
    items = [DrawItem(mesh.points, mesh.triangles, bone, occlusion=openness) for mesh, openness in shaded]
    for part in face.parts:
        if part.name.startswith("teeth"):
            items.append(DrawItem(part.points, part.triangles, MATERIALS["teeth"], vertex_colour=part.colour / 255.0))
    return items


@lru_cache(maxsize=2)
def _texture(face: Face) -> Texture:
    """The skin's texture, no finer than a picture of a few hundred pixels can show."""
    return Texture.of(cv2.resize(face.texture, (1024, 1024), interpolation=cv2.INTER_AREA))


@lru_cache(maxsize=2)
def _openness(face: Face) -> Floats:
    return vertex_openness(face.mesh.points, face.mesh.triangles, directions=_DIRECTIONS)


class _Pen:
    """Draws into a picture what no nearer surface hides: `depth` (h, w) [mm], `slack` [mm] below it still shows."""

    def __init__(self, picture: Bytes, camera: Camera, depth: Floats, slack: float) -> None:
        self.picture, self.camera, self.depth, self.slack = picture, camera, depth, slack
        self.unit = picture.shape[0] / 512.0

    def _seen(self, points: Floats) -> tuple[Floats, np.ndarray]:
        height, width = self.depth.shape
        place = self.camera.project(points, width, height)
        x = np.clip(place[:, 0].astype(int), 0, width - 1)
        y = np.clip(place[:, 1].astype(int), 0, height - 1)
        return place[:, :2], place[:, 2] < self.depth[y, x] + self.slack

    def line(self, points: Floats, colour: tuple[int, int, int]) -> None:
        """Draw a line through `points` (k, 3) where it shows."""
        share = np.linspace(0.0, 1.0, 12, endpoint=False)[:, None]
        fine = np.concatenate([a + share * (b - a) for a, b in pairwise(points)] + [points[-1:]])
        fine = fine[np.isfinite(fine).all(axis=1)]
        place, seen = self._seen(fine)
        fixed = np.round(16.0 * (place - 0.5)).astype(int)
        for k in np.flatnonzero(seen[:-1] & seen[1:]):
            ends = (tuple(map(int, fixed[k])), tuple(map(int, fixed[k + 1])))
            cv2.line(self.picture, *ends, colour, max(1, round(1.5 * self.unit)), cv2.LINE_AA, 4)

    def dots(self, points: Floats, colour: tuple[int, int, int], *, hidden: bool = False) -> None:
        """Draw a dark-rimmed disc at each of `points` (k, 3) that shows (or all that face the eye, if `hidden`)."""
        place, seen = self._seen(points)
        for k in np.flatnonzero(seen | hidden):
            centre = tuple(int(v) for v in np.round(16.0 * (place[k] - 0.5)))
            for radius, ink in ((3.6, (20, 20, 20)), (2.8, colour)):
                cv2.circle(self.picture, centre, round(16 * radius * self.unit), ink, -1, cv2.LINE_AA, 4)


def marked_copy(picture: Bytes, rings: Sequence[tuple[int, tuple[float, float], str]]) -> Bytes:
    """Return a copy of `picture` (h, w, 3) with a numbered ring at each pixel: red for an error, amber for a warning.

    rings : number, (x, y) [pixel], "error" or "warning";  a small picture is enlarged
    """
    grow = max(1, round(900 / max(picture.shape[:2])))
    out: Bytes = np.ascontiguousarray(picture.repeat(grow, axis=0).repeat(grow, axis=1))
    unit = out.shape[0] / 512.0
    for number, (x, y), severity in rings:
        centre = (round(grow * x - 0.5), round(grow * y - 0.5))
        colour = (235, 30, 30) if severity == "error" else (250, 180, 20)
        for width, ink in ((4, (15, 15, 15)), (2, colour)):
            cv2.circle(out, centre, round(8 * unit), ink, max(1, round(width * unit)), cv2.LINE_AA)
        right = min(centre[0] + round(9 * unit), out.shape[1] - round(24 * unit))
        write_text(
            out, str(number), right, max(centre[1] - round(6 * unit), round(14 * unit)), scale=0.5 * unit, bold=True
        )
    return out
