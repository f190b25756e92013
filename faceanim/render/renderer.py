"""The renderer: owns every buffer of a picture and draws frames into them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numba
import numpy as np

from faceanim.ground.arrays import Floats, Ints, floats, ints
from faceanim.ground.errors import RunError, UserError
from faceanim.kernels import raster, shade
from faceanim.render.camera import Camera
from faceanim.render.shading import Bytes, Look, Material, Texture, linear, paint_tables
from faceanim.render.shadow import ShadowMap

BAND_COST, STRIP_COST = 60, 80
"""What clearing and listing a band, and blurring a strip of the shadow, cost, in triangles drawn."""


@dataclass(frozen=True, eq=False)
class DrawItem:
    """One surface of a picture.

    points : (n, 3) [mm], at rest   triangles : (t, 3), counter-clockwise seen from outside
    uv : (m, 2) in [0, 1], v up, `uv_triangles` (t, 3) indices into it (default: `triangles`)
    vertex_colour : (n, 3) sRGB in [0, 1]   occlusion : (n,) or one number, how open to light, 1 = fully (default)
    bone : the bone that carries the surface rigidly, None if its points are given for each frame
    """

    points: Floats
    triangles: Ints
    material: Material
    uv: Floats | None = None
    uv_triangles: Ints | None = None
    vertex_colour: Floats | None = None
    occlusion: Floats | None = None
    bone: int | None = None

    def __post_init__(self) -> None:
        points = floats("points", self.points, None, 3)
        triangles = ints("triangles", self.triangles, None, 3, below=len(points))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "triangles", triangles)
        if self.uv is None and self.material.texture is not None:
            raise UserError("a material with a texture needs `uv`")
        if self.uv is not None:
            uv = floats("uv", self.uv, None, 2)
            corner = triangles if self.uv_triangles is None else self.uv_triangles
            object.__setattr__(self, "uv", uv)
            object.__setattr__(self, "uv_triangles", ints("uv_triangles", corner, len(triangles), 3, below=len(uv)))
        if self.vertex_colour is not None:
            object.__setattr__(self, "vertex_colour", floats("vertex_colour", self.vertex_colour, len(points), 3))
        elif self.material.vertex_colour:
            object.__setattr__(self, "vertex_colour", np.tile(self.material.colour, (len(points), 1)))
        if self.occlusion is not None:
            object.__setattr__(
                self, "occlusion", floats("occlusion", np.broadcast_to(self.occlusion, len(points)), None)
            )


def _split(item: DrawItem) -> tuple[Ints, Ints, Floats | None]:
    """Return vertices of an item that have one place in the texture each: points (n,), triangles (t, 3), uv (n, 2)."""
    if item.uv is None or item.uv_triangles is None:
        return np.arange(len(item.points), dtype=np.int32), item.triangles, None
    pair = np.stack([item.triangles.ravel(), item.uv_triangles.ravel()], axis=1)
    kept, index = np.unique(pair, axis=0, return_inverse=True)
    return kept[:, 0].astype(np.int32), index.reshape(-1, 3).astype(np.int32), item.uv[kept[:, 1]]


def _fans(triangles: Ints, count: int) -> tuple[Ints, Ints]:
    """Opposite edges of the triangles around each point, as (start (count + 1,), list (3 t, 2))."""
    corner = triangles.ravel()
    order = np.argsort(corner, kind="stable")
    start = np.zeros(count + 1, dtype=np.int32)
    np.cumsum(np.bincount(corner, minlength=count), out=start[1:])
    edge = np.stack([np.roll(triangles, -1, axis=1).ravel(), np.roll(triangles, -2, axis=1).ravel()], axis=1)
    return start, np.ascontiguousarray(edge[order], dtype=np.int32)


def _texels(triangles: Ints, uv: Floats | None, texture: Texture | None) -> Floats:
    """Return log2 of the texture's area in each triangle [texel], (t,)."""
    if uv is None or texture is None:
        return np.zeros(len(triangles))
    a, b, c = (uv[triangles[:, k]] for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    height, width = texture.levels[0].shape[:2]
    area: Floats = np.log2(np.maximum(np.abs(ux * vy - uy * vx) * width * height, 1e-12))
    return area


@dataclass(frozen=True, eq=False)
class _Scene:
    """The items as one mesh; `point` (items + 1,) and `vertex` (items + 1,) where each begins; uv (n, 2)."""

    mesh: raster.Mesh
    fans: raster.Fans
    point: Ints
    vertex: Ints
    uv: Floats


def _joined(items: Sequence[DrawItem]) -> _Scene:
    splits = [_split(item) for item in items]
    point = np.cumsum([0] + [len(item.points) for item in items]).astype(np.int32)
    vertex = np.cumsum([0] + [len(origin) for origin, _, _ in splits]).astype(np.int32)
    start, edge = _fans(np.concatenate([q.triangles + p for q, p in zip(items, point, strict=False)]), int(point[-1]))
    origin = np.concatenate([s[0] + p for s, p in zip(splits, point, strict=False)])
    first, count = start[origin], np.diff(start)[origin]
    end = np.cumsum(count)
    take = np.repeat(first - (end - count), count) + np.arange(end[-1])
    number = np.arange(len(items), dtype=np.int32)
    mesh = raster.Mesh(
        triangle=np.concatenate([s[1] + v for s, v in zip(splits, vertex, strict=False)]).astype(np.int32),
        item=np.repeat(number, [len(item.triangles) for item in items]),
        texels=np.concatenate([_texels(s[1], s[2], q.material.texture) for q, s in zip(items, splits, strict=True)]),
    )
    fans = raster.Fans(
        owner=np.repeat(number, np.diff(vertex)),
        origin=origin.astype(np.int32),
        start=np.concatenate([[0], end]).astype(np.int32),
        edge=edge[take],
    )
    uv = np.concatenate([np.zeros((len(origin), 2)) if uv is None else uv for origin, _, uv in splits])
    return _Scene(mesh, fans, point, vertex, uv)


def _contact_steps() -> Floats:
    """Offsets (units of the radius, y up) and weights of the contact shade: two rings, the upper half weighs most."""
    rows = []
    for radius, taps, turn in ((0.3, 6, 0.0), (0.65, 8, 0.2), (1.0, 10, 0.4)):
        for i in range(taps):
            angle = 2.0 * np.pi * (i + turn) / taps
            x, y = radius * np.cos(angle), radius * np.sin(angle)
            rows.append((x, y, (1.2 - 0.6 * radius) * (0.35 + 0.65 * max(np.sin(angle), 0.0))))
    steps = np.array(rows)
    steps[:, 2] /= steps[:, 2].sum()
    return steps


def dealt(cost: Any) -> Ints:
    """Return the bands in an order that gives each thread, which takes its share in one piece, about the same cost.

    cost : (bands,). The order never changes the picture.
    """
    threads = numba.get_num_threads()
    rank = np.argsort(-np.asarray(cost), kind="stable")
    turn = np.arange(len(rank)) % (2 * threads)
    owner = np.where(turn < threads, turn, 2 * threads - 1 - turn)
    return rank[np.argsort(owner, kind="stable")].astype(np.int32)


class Renderer:
    """Draws the same items, moved, again and again, from one camera.

    size : (width, height) [pixel] or one number   items : drawn together, those of a higher `Material.layer` blended
    over the rest with `layer_opacity`; what the first one hides costs little. `draw` returns (height, width, 3) RGB
    bytes, valid until the next call.
    """

    def __init__(
        self,
        size: int | tuple[int, int],
        camera: Camera,
        items: Sequence[DrawItem],
        *,
        look: Look | None = None,
        layer_opacity: float = 0.5,
    ) -> None:
        width, height = (size, size) if isinstance(size, int) else size
        if not (8 <= width <= 8192 and 8 <= height <= 8192):
            raise UserError(f"the picture is {width} x {height} pixels; each side must lie between 8 and 8192")
        if not items:
            raise UserError("there is nothing to draw: `items` is empty")
        if not 0.0 <= layer_opacity <= 1.0:
            raise UserError(f"layer_opacity is {layer_opacity}; it must lie between 0 and 1")
        self.size, self.items, self.look = (width, height), tuple(items), look or Look()
        self.layer_opacity = layer_opacity
        self._layers = sorted({item.material.layer for item in items})
        self._scene = _joined(self.items)
        self._mesh, self._fans = self._scene.mesh, self._scene.fans
        self._points = np.concatenate([item.points for item in items])
        self._threads = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        self._placed = raster.placed_buffers(len(self._fans.origin))
        self._faces = raster.face_buffers(len(self._mesh.triangle))
        self._bands = raster.band_buffers(height, 4 * len(self._mesh.triangle) + 64)
        self._samples = raster.sample_buffers(self._threads, width)
        self._seen = raster.seen_buffers(width, height)
        self._paint = paint_tables([item.material for item in items], self.look, height)
        self._steps = _contact_steps()
        self._moved = np.ones(len(items), np.bool_)
        self._poses: list[Floats | None] = [None] * len(items)
        self._number = np.zeros((self._threads, shade.N_NUMBER, raster.row_length(width)), np.float32)
        self._shadow = self._shadow_map()
        self._kept: raster.Samples | None = None
        self._out = np.zeros((height, width, 3), np.uint8)
        self.camera = camera
        for i, item in enumerate(self.items):
            self.set_occlusion(i, 1.0 if item.occlusion is None else item.occlusion)
            self.set_colour(i, item.material.colour if item.vertex_colour is None else item.vertex_colour)
            if item.material.texture is not None and not item.material.vertex_colour:
                self._placed.vertex[self._vertices(i), 4:6] = self._scene.uv[self._vertices(i)]

    def _shadow_map(self) -> ShadowMap:
        casts = np.array([self.look.shadow and q.material.casts and q.material.layer == 0 for q in self.items])
        points = [q.points[q.triangles.ravel()] for q, c in zip(self.items, casts, strict=True) if c]
        return ShadowMap(self._mesh, casts, np.concatenate([np.zeros((0, 3)), *points]), len(self._fans.origin))

    @property
    def camera(self) -> Camera:
        """The camera; may be replaced between frames."""
        return self._camera

    @camera.setter
    def camera(self, camera: Camera) -> None:
        self._camera = camera
        self._numbers = camera.numbers(*self.size)
        self._moved[:] = True
        self._shadow.aim(camera, self._paint.light[0, :3].astype(np.float64))

    def _slice(self, item: int) -> slice:
        return slice(int(self._scene.point[item]), int(self._scene.point[item + 1]))

    def _vertices(self, item: int) -> slice:
        return slice(int(self._scene.vertex[item]), int(self._scene.vertex[item + 1]))

    def _spread(self, item: int, values: Any) -> Any:
        """Values of an item's vertices, from those of its points (n, ...)."""
        return np.asarray(values)[self._fans.origin[self._vertices(item)] - self._scene.point[item]]

    def set_occlusion(self, item: int, value: Any) -> None:
        """Set how open to light the points of an item are, (n,) or one number in [0, 1]."""
        self._placed.vertex[self._vertices(item), 3] = value if np.ndim(value) == 0 else self._spread(item, value)

    def set_colour(self, item: int, colour: Any) -> None:
        """Set the colours of an item's points, (n, 3) or one, sRGB in [0, 1]; has no effect under a texture."""
        light = linear(colour)
        self._placed.vertex[self._vertices(item), 4:7] = light if light.ndim == 1 else self._spread(item, light)

    def _place(self, points: Mapping[int, Any] | Sequence[Any] | None, bone_pose: Any) -> None:
        given = points if isinstance(points, Mapping) else dict(enumerate(points or ()))
        for i, item in enumerate(self.items):
            target = self._points[self._slice(i)]
            new = given.get(i)
            if new is not None:
                if np.shape(new) != target.shape:
                    raise UserError(f"item {i} has {len(target)} vertices; points of shape {np.shape(new)} were given")
                target[:] = new
                self._moved[i], self._poses[i] = True, None
            elif item.bone is not None and bone_pose is not None:
                pose = np.ascontiguousarray(bone_pose[item.bone], dtype=np.float64)
                last = self._poses[i]
                if last is None or not np.array_equal(pose, last):
                    raster.carry(item.points, pose, target)
                    self._moved[i], self._poses[i] = True, pose.copy()

    def _cover(self, layer: int, listed: bool = True) -> None:
        """Find what is seen of one layer: the list of fragments, or (not `listed`) all samples."""
        cast = layer == self._layers[0] and self._shadow.moved(self._moved)
        if len(self._layers) > 1:  # what the other layer left in the tables is of no use
            self._moved[:] = True
        tables = (self._numbers, self._mesh, self._placed, self._faces, self._paint.material)
        raster.setup_pass(float(layer), self._moved, *tables, cast, self._shadow.caster)
        self._moved[:] = False
        need = raster.band_pass(self._faces.rank, self._bands)
        if need > len(self._bands.member):
            self._bands = raster.band_buffers(self.size[1], int(1.5 * need))
            raster.band_pass(self._faces.rank, self._bands)
        cost = np.diff(self._bands.start[::2]) + BAND_COST
        order = dealt(np.append(cost, np.full(self._shadow.strips if cast else 0, STRIP_COST)))
        tail = (self._faces, self._bands, self._samples, self._seen, self._shadow.depths)
        raster.coverage_pass(order, listed, self._mesh.item, *tail)

    def _prepare(self) -> None:
        """Normals and projection of all vertices."""
        if not isfinite(float(self._points.sum())):
            bad = int(np.argmax(~np.isfinite(self._points).all(axis=1)))
            item = int(np.searchsorted(self._scene.point, bad, side="right")) - 1
            raise RunError(f"vertex {bad - self._scene.point[item]} of item {item} has a position that is not finite")
        raster.place_pass(self._moved, self._fans, self._points, self._numbers, self._placed, self._shadow.caster)

    def depth(self) -> Floats:
        """Return the depth [mm] of the four samples of each pixel as last placed, (h, w, 4), inf where nothing is."""
        self._prepare()
        width, height = self.size
        used, bands = self._samples, len(self._bands.start) // 2
        if self._kept is None:
            self._kept = raster.sample_buffers(bands, width, self._threads)
        self._samples = self._kept
        try:
            self._cover(self._layers[0], listed=False)
        finally:
            self._samples = used
        number = self._kept.sample[..., : raster.BLOCK].reshape(bands * raster.BAND, -1, 4)[:height, :width]
        with np.errstate(divide="ignore"):
            return raster.DEEPEST * self.camera.near / number

    def draw(self, points: Mapping[int, Any] | Sequence[Any] | None = None, bone_pose: Any = None) -> Bytes:
        """Draw one frame.

        points : new positions (n, 3) [mm] by item (a mapping, or a sequence with None for items that stay)
        bone_pose : (b, 4, 4), rest frame to head frame [mm], carries the items that have a `bone`
        Returns (height, width, 3) RGB bytes, overwritten by the next call.
        Raises `UserError` for points of a wrong shape, `RunError` for positions that are not finite.
        """
        self._place(points, bone_pose)
        self._prepare()
        for layer in self._layers:
            self._cover(layer)
            opacity = -1.0 if layer == self._layers[0] else self.layer_opacity
            order = dealt(np.add.reduceat(self._seen.found, np.arange(0, self.size[1], raster.BAND)))
            seen = (self._placed.vertex, self._faces.plane, self._seen)
            tail = (self._paint, self._shadow.shadow, self._steps, self._number, self._out)
            shade.shade_pass(order, opacity, self._mesh, self._numbers, *seen, *tail)
        return self._out
