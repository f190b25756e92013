"""A head as the renderer sees it: skin, eyes, teeth, gums, tongue, and the bones beneath."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.ground.arrays import Floats, Ints, floats
from faceanim.ground.errors import UserError, unknown_name
from faceanim.render.camera import Camera
from faceanim.render.colormap import PARTITION, Scale
from faceanim.render.occlusion import vertex_openness
from faceanim.render.overlay import draw_colour_bar, draw_legend
from faceanim.render.renderer import DrawItem, Renderer
from faceanim.render.shading import Bytes, Look, Material, Texture

if TYPE_CHECKING:
    from faceanim.face.face import Face

SKIN = Material(
    colour=(0.80, 0.62, 0.53),
    specular=0.034,
    gloss=0.47,
    matte=0.75,
    wrap=(0.45, 0.20, 0.13),
    glow=(0.40, 0.13, 0.10),
    two_sided=True,
    back=0.35,
    casts=True,
)
PLAIN = replace(SKIN, matte=0.0, specular=0.012, flat=0.25, wrap=(0.3, 0.3, 0.3), glow=(0.1, 0.1, 0.1), casts=False)
_MOUTH = Material(vertex_colour=True, glow=(0.30, 0.11, 0.09), casts=False)
MATERIALS: dict[str, Material] = {
    "eye": Material(
        vertex_colour=True,
        specular=0.04,
        gloss=0.90,
        wrap=(0.30, 0.25, 0.25),
        glow=(0.05, 0.03, 0.03),
        shade_radius=6.0,
        shade=1.7,
    ),
    "teeth": replace(_MOUTH, specular=0.05, gloss=0.72, wrap=(0.30, 0.25, 0.20), shade_radius=9.0, shade=1.3),
    "gums": replace(_MOUTH, specular=0.04, gloss=0.70, wrap=(0.40, 0.20, 0.20), shade_radius=10.0, shade=0.85),
    "tongue": replace(_MOUTH, specular=0.035, gloss=0.60, wrap=(0.40, 0.20, 0.20), shade_radius=12.0, shade=0.90),
    "other": Material(vertex_colour=True, specular=0.03, gloss=0.4),
    "bone": Material(
        colour=(0.87, 0.83, 0.74), specular=0.03, gloss=0.35, wrap=(0.20, 0.15, 0.10), shade_radius=5.0, shade=0.4
    ),
}
"""Materials by the first word of a part's name."""

COLOUR_MODES = ("skin", "plain", "values", "partition")


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid thing in the head: `name` chooses its material ("eye_left" -> "eye"), `bone` carries it.

    points : (n, 3) [mm] at rest   triangles : (t, 3)   colour : (n, 3) sRGB bytes or None for the material's own
    """

    name: str
    points: Floats
    triangles: Ints
    colour: Any = None
    bone: int = 0


def _front(part: Part) -> Part:
    """An eyeball without its back, which never shows."""
    low, high = part.points[:, 2].min(), part.points[:, 2].max()
    return replace(part, triangles=part.triangles[part.points[part.triangles, 2].max(axis=1) > 0.6 * low + 0.4 * high])


def _part_item(part: Part, layer: int = 0) -> DrawItem:
    part = _front(part) if part.name.startswith("eye") else part
    material = replace(MATERIALS.get(part.name.split("_")[0], MATERIALS["other"]), layer=layer)
    colour = None if part.colour is None else np.asarray(part.colour, dtype=np.float64) / 255.0
    if colour is not None:
        material = replace(material, vertex_colour=True)
    return DrawItem(part.points, part.triangles, material, vertex_colour=colour, bone=part.bone)


def _bone_item(part: Part) -> DrawItem:
    item = _part_item(replace(part, name="bone"), layer=1)
    return replace(item, occlusion=vertex_openness(part.points, part.triangles, directions=48))


class HeadScene:
    """Draws one head from one camera, frame after frame; made by `head_scene`.

    mode : "skin" (texture), "plain" (uniform), "values" (`values` through `scale`, with a colour bar), "partition"
    (node sets 0 dynamic, 1 quasi-static, 2 static, with a legend)
    """

    def __init__(self, renderer: Renderer, mode: str, scale: Scale | None) -> None:
        self.renderer, self.mode, self.scale = renderer, mode, scale

    def draw(self, points: Any, bone_pose: Any = None, values: Any = None) -> Bytes:
        """Draw the skin at `points` (n, 3) [mm] with the parts on their bones; return (h, w, 3) RGB bytes.

        bone_pose : (b, 4, 4), rest to head frame; bones stand at rest without it
        values : (n,) numbers of mode "values", or node sets of mode "partition"; kept from frame to frame
        The picture is overwritten by the next call. Raises as `Renderer.draw` does.
        """
        if values is not None:
            if self.mode not in ("values", "partition"):
                raise UserError(f"this scene is drawn in mode {self.mode!r}, which shows no values")
            self.renderer.set_colour(0, self._colours(values))
        picture = self.renderer.draw([points], bone_pose)
        if self.mode == "values" and self.scale is not None:
            draw_colour_bar(picture, self.scale)
        elif self.mode == "partition":
            draw_legend(picture, PARTITION)
        return picture

    def _colours(self, values: Any) -> Floats:
        n = len(self.renderer.items[0].points)
        if np.shape(values) != (n,):
            raise UserError(f"values has shape {np.shape(values)}; ({n},) is needed, one for each vertex")
        if self.mode == "partition":
            palette = np.array([colour for _, colour in PARTITION])
            sets = np.asarray(values)
            if sets.min(initial=0) < 0 or sets.max(initial=0) >= len(palette):
                raise UserError("a node set is 0 (dynamic), 1 (quasi-static) or 2 (static)")
            return palette[sets.astype(np.int64)]
        assert self.scale is not None
        return self.scale.colours(floats("values", values, n))


def face_scene(face: Face, *, mode: str = "skin", **options: Any) -> HeadScene:
    """Make the scene of a face with its eyes, teeth, gums and tongue; `options` as `head_scene` takes them."""
    skin = mode == "skin"
    return head_scene(
        face.mesh.points,
        face.mesh.triangles,
        uv=face.uv if skin else None,
        uv_triangles=face.uv_triangles if skin else None,
        parts=[Part(part.name, part.points, part.triangles, part.colour, part.bone) for part in face.parts],
        mode=mode,
        **options,
    )


def head_scene(
    points: Any,
    triangles: Any,
    *,
    size: int | tuple[int, int] = 512,
    view: str | Camera = "front",
    uv: Any = None,
    uv_triangles: Any = None,
    texture: Texture | None = None,
    parts: Sequence[Part] = (),
    bones: Sequence[Part] = (),
    bone_opacity: float = 0.5,
    bounds: Any = None,
    mode: str = "skin",
    scale: Scale | None = None,
    wire: float = 0.0,
    occlusion: Any = None,
    look: Look | None = None,
) -> HeadScene:
    """Make a scene from plain arrays.

    points, triangles : skin at rest, (n, 3) [mm] and (t, 3)   uv, uv_triangles, texture : skin texture, v up
    view : a name of `camera.VIEWS`, or a camera   bounds : (k, 3) points to keep in the picture, default the skin
    parts : eyes, teeth, gums, tongue   bones : skull and jaw, seen through the skin with `bone_opacity` (0 = off)
    mode, scale : see `HeadScene`   wire : width of triangle edges drawn on the skin [pixel]
    occlusion : (n,) how open to light each skin vertex is; computed from the rest shape if None
    Raises `UserError` for unknown names and arrays that do not fit.
    """
    if mode not in COLOUR_MODES:
        raise unknown_name("colour mode", mode, COLOUR_MODES)
    if mode == "values" and scale is None:
        raise UserError("mode 'values' needs a `scale`: what the colours mean")
    skin = replace(SKIN if mode == "skin" else PLAIN, wire=wire)
    if mode == "skin" and texture is not None:
        skin = replace(skin, texture=texture)
    elif mode == "plain":
        skin = replace(skin, colour=(0.72, 0.70, 0.68))
    elif mode != "skin":
        skin = replace(skin, vertex_colour=True)
    width, height = (size, size) if isinstance(size, int) else size
    camera = view if isinstance(view, Camera) else None
    if camera is None:
        frame = points if bounds is None else bounds
        camera = Camera.named(str(view), frame, aspect=width / height)
    openness = vertex_openness(points, triangles) if occlusion is None else occlusion
    items = [DrawItem(points, triangles, skin, uv, uv_triangles, occlusion=openness)]
    items += [_part_item(part) for part in parts]
    if bones and bone_opacity > 0.0:
        items += [_bone_item(part) for part in bones]
        items += [_part_item(part, layer=1) for part in parts if part.name.startswith("teeth")]
    return HeadScene(Renderer((width, height), camera, items, look=look, layer_opacity=bone_opacity), mode, scale)
