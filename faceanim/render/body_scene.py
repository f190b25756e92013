"""Any body's surface as the renderer sees it: plain or in false colours, several side by side in one space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from faceanim.ground.arrays import Floats, Ints, floats
from faceanim.ground.errors import UserError
from faceanim.render.camera import Camera
from faceanim.render.colormap import Scale
from faceanim.render.overlay import draw_colour_bar
from faceanim.render.renderer import DrawItem, Renderer
from faceanim.render.shading import Bytes, Material

STYLE = Material(wire=0.6, specular=0.02, gloss=0.35, wrap=(0.25, 0.22, 0.2), two_sided=True, casts=False)
SIZE = 200.0
"""Extent to which bodies are scaled to be drawn [mm]: light and shadow are made for heads."""


class BodyScene:
    """Draws several bodies with the same camera, in one picture.

    triangles : the (t, 3) of each body   colours : sRGB in [0, 1] of each body, for bodies without values
    bounds : (k, 3) points that stay in the picture   view : a name of `camera.VIEWS`   size : (width, height) [pixel]
    Raises `UserError` for lists of different lengths or an unknown view.
    """

    def __init__(
        self,
        rest: Sequence[Floats],
        triangles: Sequence[Ints],
        colours: Sequence[tuple[float, float, float]],
        bounds: Any,
        *,
        view: str = "front",
        size: tuple[int, int] = (640, 480),
        scale: Scale | None = None,
    ) -> None:
        if not len(rest) == len(triangles) == len(colours):
            raise UserError(f"{len(rest)} bodies need as many lists of triangles and colours")
        frame = floats("bounds", bounds, None, 3)
        self.middle = 0.5 * (frame.min(axis=0) + frame.max(axis=0))
        self.factor = SIZE / float(np.ptp(frame, axis=0).max())
        self.scale = scale
        self._rest = [self._placed(points) for points in rest]
        camera = Camera.named(view, self._placed(frame), aspect=size[0] / size[1])
        items = [
            DrawItem(points, corners, _painted(colour, scale is not None), vertex_colour=_shade(points, colour, scale))
            for points, corners, colour in zip(self._rest, triangles, colours, strict=True)
        ]
        self.renderer = Renderer(size, camera, items)

    def _placed(self, points: Any) -> Floats:
        return np.ascontiguousarray((np.asarray(points) - self.middle) * self.factor)

    def draw(self, points: Sequence[Floats], values: Sequence[Floats] | None = None) -> Bytes:
        """Draw the bodies at `points`, coloured by `values` (n,) each if the scene has a scale; (h, w, 3) RGB bytes."""
        if values is not None:
            if self.scale is None:
                raise UserError("this scene was made without a scale: it shows no values")
            for k, value in enumerate(values):
                self.renderer.set_colour(k, self.scale.colours(floats("values", value, len(self._rest[k]))))
        picture = self.renderer.draw([self._placed(p) for p in points])
        if self.scale is not None:
            draw_colour_bar(picture, self.scale)
        return picture


def _painted(colour: tuple[float, float, float], by_vertex: bool) -> Material:
    return replace(STYLE, colour=colour, vertex_colour=by_vertex)


def _shade(points: Floats, colour: tuple[float, float, float], scale: Scale | None) -> Floats | None:
    return None if scale is None else np.tile(np.asarray(colour), (len(points), 1))
