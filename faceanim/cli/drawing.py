"""What is drawn of a face: one picture per moment, all views side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.bench.metrics import principal_strain
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError
from faceanim.render.colormap import Scale, round_top
from faceanim.render.occlusion import vertex_openness
from faceanim.render.scene import Part, face_scene
from faceanim.render.shading import Texture

if TYPE_CHECKING:
    from faceanim.face.face import Face
    from faceanim.session.session import Session

SKULL_OPACITY = 0.45
WIRE = 0.7
"""Width of triangle edges [pixel]."""


@dataclass(frozen=True)
class Picture:
    """What to draw: `size` (width, height) of one view [pixel]; `colour` is skin, displacement, sets or strain."""

    size: tuple[int, int] = (512, 512)
    views: tuple[str, ...] = ("front",)
    colour: str = "skin"
    wireframe: bool = False
    show_skull: bool = False


class Drawing:
    """Draws the face of a session at any moment.

    moments : (k, n, 3) positions [mm] that must fit into the picture, and whose values the colours must span
    like : another drawing of the same face, to share its texture and shade with
    Raises `UserError` when the node sets are asked of a solver that has none.
    """

    def __init__(
        self,
        session: Session,
        picture: Picture,
        moments: Sequence[Floats] | Floats = (),
        like: Drawing | None = None,
    ) -> None:
        self.session, self.picture = session, picture
        self._values = _values_of(session, picture.colour)
        rest = session.body.surface.points
        bounds = rest
        if len(moments):
            # Each vertex's box over time is enough to frame the picture.
            bounds = np.concatenate([rest, np.min(moments, axis=0), np.max(moments, axis=0)])
        scale = None
        if picture.colour in ("displacement", "strain"):
            scale = _scale(picture.colour, [self._values(points) for points in moments])
        mode = {"skin": "skin", "sets": "partition"}.get(picture.colour, "values")
        self._openness: Floats = (
            vertex_openness(rest, session.body.surface.triangles) if like is None else like._openness
        )
        self._texture: Texture | None = None
        if mode == "skin":
            self._texture = Texture.of(session.face.texture) if like is None else like._texture
        options = {"bounds": bounds, "mode": mode, "scale": scale, "occlusion": self._openness}
        self._scenes = [_scene(session.face, picture, view, texture=self._texture, **options) for view in picture.views]
        width, height = picture.size
        self._out = np.empty((height, width * len(picture.views), 3), np.uint8)

    def draw(self, points: Floats, intensity: float = 0.0) -> np.ndarray:
        """Draw skin at `points` (n, 3) [mm], bones at `intensity` of the expression.

        Returns (height, width * views, 3) RGB bytes, overwritten by the next call.
        """
        pose = self.session.control(intensity).bone_pose
        values = None if self.picture.colour == "skin" else self._values(points)
        width = self.picture.size[0]
        for k, scene in enumerate(self._scenes):
            self._out[:, k * width : (k + 1) * width] = scene.draw(points, pose, values)
        return self._out


def draw_once(face: Face) -> None:
    """Draw `face` at rest, small, in skin and in numbers, so that everything is compiled."""
    options = {"bounds": face.mesh.points, "occlusion": vertex_openness(face.mesh.points, face.mesh.triangles)}
    skin = _scene(face, Picture((64, 64)), "front", mode="skin", texture=Texture.of(face.texture), **options)
    skin.draw(face.mesh.points, np.tile(np.eye(4), (2, 1, 1)))
    scale = Scale(0.0, 1.0, "displacement [mm]")
    seen = _scene(face, Picture((64, 64), show_skull=True), "front", mode="values", scale=scale, **options)
    seen.draw(face.mesh.points, np.tile(np.eye(4), (2, 1, 1)), np.zeros(len(face.mesh.points)))


def _scene(face: Face, picture: Picture, view: str, **options: Any) -> Any:
    bones = []
    if picture.show_skull:
        bones = [
            Part("cranium", face.cranium.points, face.cranium.triangles, bone=0),
            Part("jaw", face.jaw_mesh.points, face.jaw_mesh.triangles, bone=1),
        ]
    return face_scene(
        face,
        size=picture.size,
        view=view,
        bones=bones,
        bone_opacity=SKULL_OPACITY if picture.show_skull else 0.0,
        wire=WIRE if picture.wireframe else 0.0,
        **options,
    )


def _values_of(session: Session, colour: str) -> Callable[[Floats], Any]:
    """Return what gives each vertex its number: millimetres, per cent, or node set."""
    mesh = session.body.surface
    if colour == "displacement":
        return lambda points: np.linalg.norm(points - mesh.points, axis=1)
    if colour == "strain":
        return lambda points: 100.0 * principal_strain(mesh, points)
    if colour == "sets":
        session.warm()
        partition = getattr(session.solver, "partition", None)
        if partition is None:
            raise UserError("--colour sets shows the adaptive partition of backend mass_spring; leave out --full")
        sets = 2 - partition.node_set.astype(np.int64)
        return lambda _: sets
    return lambda _: None


def _scale(colour: str, values: Sequence[Floats]) -> Scale:
    """Return a scale with a round top that spans `values`."""
    share = 1.0 if colour == "displacement" else 0.99
    largest = max((float(np.quantile(np.abs(v), share)) for v in values), default=0.0)
    top = round_top(max(largest, 1.0))
    if colour == "displacement":
        return Scale(0.0, top, "displacement [mm]")
    return Scale(-top, top, "principal strain [%]", "two_sided")


def session_drawer(size: int) -> Callable[[Session, Floats, float], Any]:
    """Return what draws a frame of any session of one face, `size` pixels wide, from its positions and time."""
    drawing: Drawing | None = None

    def draw(session: Session, points: Floats, t: float) -> Any:
        nonlocal drawing
        if drawing is None:
            drawing = Drawing(session, Picture((size, size)))
        drawing.session = session
        return drawing.draw(points, session.timeline.at(t))

    return draw
