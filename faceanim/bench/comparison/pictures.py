"""Pictures of a candidate's last frame in false colours of its error, all of a scene on one scale."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.ground.arrays import Floats, Ints, floats
from faceanim.ground.errors import UserError
from faceanim.render.body_scene import BodyScene
from faceanim.render.colormap import Scale
from faceanim.render.overlay import draw_colour_bar
from faceanim.render.scene import face_scene
from faceanim.render.shading import Bytes

if TYPE_CHECKING:
    from faceanim.face.face import Face

LABEL = "error [mm]"
FACE_VIEWS = ("front", "three_quarter")
GREY = (0.7, 0.7, 0.7)


def error_picture(
    rest: Any,
    triangles: Ints,
    points: Any,
    values: Any,
    top: float,
    size: tuple[int, int] = (480, 360),
    *,
    view: str = "three_quarter",
    bounds: Any = None,
) -> Bytes:
    """Return a surface at `points` (n, 3) [mm], coloured by `values` (n,) [mm] from 0 to `top`, (h, w, 3) RGB bytes.

    rest : (n, 3) [mm]   size : (width, height) [pixel]   view : a name of `camera.VIEWS`
    bounds : (k, 3) points to keep in the picture, the same for all pictures that are to be compared; None = rest and
    `points`.  Values above `top` have its colour.
    Raises `UserError` for a `top` that is not positive and for arrays that do not fit or are not finite.
    """
    rest, points, values = _checked(rest, points, values, top)
    frame = np.concatenate([rest, points]) if bounds is None else bounds
    scene = BodyScene([rest], [triangles], [GREY], frame, view=view, size=size, scale=Scale(0.0, top, LABEL))
    return np.array(scene.draw([points], [values]))


def face_error_picture(
    face: Face,
    points: Any,
    values: Any,
    top: float,
    size: int = 360,
    *,
    bone_pose: Any = None,
    bounds: Any = None,
    openness: Any = None,
) -> Bytes:
    """Return the face from the front and from three quarters, coloured by `values`, (size, 2 * size, 3) RGB bytes.

    points, values, top, bounds : as for `error_picture`   bone_pose : (b, 4, 4) of the teeth and what else bones carry
    openness : (n,) from `render.occlusion.vertex_openness` if it is known: it takes most of the time
    """
    rest, points, values = _checked(face.mesh.points, points, values, top)
    frame = np.concatenate([rest, points]) if bounds is None else bounds
    scale = Scale(0.0, top, LABEL)
    out = []
    for view in FACE_VIEWS:
        scene = face_scene(face, mode="values", scale=scale, size=size, view=view, bounds=frame, occlusion=openness)
        scene.renderer.set_colour(0, scale.colours(values))
        out.append(scene.renderer.draw([points], bone_pose).copy())
    picture = np.concatenate(out, axis=1)
    draw_colour_bar(picture, scale)  # one is enough, on the right
    return picture


def _checked(rest: Any, points: Any, values: Any, top: float) -> tuple[Floats, Floats, Floats]:
    if not 0.0 < top < np.inf:
        raise UserError(f"error picture: top is {top} mm; the scale needs a positive end")
    rest = floats("rest", rest, None, 3)
    return rest, floats("points", points, len(rest), 3), floats("values", values, len(rest))
