"""A bar, or a face by a corner of its mouth, is twisted and dragged: two constraints on one node of warped modes.

    python docs/examples/twist_and_drag.py [bar|face] [folder]

Writes the frames, a film and a contact sheet; ends in the largest constraint residual: how far, as a share of the
body's width or in radians, the node was from where it was asked to be.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.backends.modal_warping.manipulation import Manipulation, with_neighbours
from faceanim.backends.modal_warping.options import Options
from faceanim.backends.modal_warping.solver import SolverModalWarping
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.face.library import load_face
from faceanim.geometry.shapes import box_tets
from faceanim.render.camera import Camera
from faceanim.render.scene import face_scene, head_scene
from faceanim.render.sequence import Film, PngSequence, contact_sheet, write_png
from faceanim.render.shading import Texture
from faceanim.tissue.material import Material

RATE = 30.0


def soft_bar() -> Body:
    """Return a bar of 100 x 20 x 20 mm, held at x = 0."""
    mesh = box_tets((20, 4, 4), (100.0, 20.0, 20.0))
    tissue = Material("tissue", 1e-6, 15.0, 0.4)
    return solid_body(mesh, tissue, np.flatnonzero(mesh.points[:, 0] < 1e-9), damping=2.0, stiffness_damping=0.002)


def nearest_node(body: Body, point: Any) -> int:
    """Return the solid node nearest to `point` (3,) [mm] at rest."""
    assert body.solid is not None
    return int(np.linalg.norm(body.solid.mesh.points - np.asarray(point), axis=1).argmin())


def dragged(
    body: Body, node: int, moves: np.ndarray, turns: np.ndarray, *, dt: float = 1.0 / RATE, modes: int = 40
) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yield the surface (n, 3) [mm] and both residuals [mm], [rad] while `node` of the body's solid follows a path.

    moves : (frames, 3) from where it rests [mm]   turns : (frames, 3) rotation vectors [rad]
    """
    solver = SolverModalWarping(body, Options(modes=modes, variant="consistent"))
    around = with_neighbours(solver, with_neighbours(solver, [node]))
    solver.manipulation = Manipulation(solver, position=[node], orientation=[node], exercised=around)
    rest = solver.solid.mesh.points[[node]]
    state, control, surface = solver.rest(), Control.rest(body), body.surface.points.copy()
    for move, turn in zip(moves, turns, strict=True):
        solver.manipulation.move_to(rest + move)
        solver.manipulation.turn_to(turn[None])
        solver.step(state, state, control, dt)
        solver.surface(state, surface)
        yield surface.copy(), solver.manipulation.position_residual, solver.manipulation.orientation_residual


def path(frames: int, move: Any, turn: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return moves (frames, 3) [mm] and turns (frames, 3) [rad]: first the whole `turn`, then the `move`, both eased."""
    s = np.clip(np.arange(1, frames + 1)[:, None] / frames * 2.0 - [[0.0, 1.0]], 0.0, 1.0)
    twist, drag = (s**2 * (3.0 - 2.0 * s)).T
    return drag[:, None] * np.asarray(move), twist[:, None] * np.asarray(turn)


def bar_story(frames: int) -> tuple[Body, Any, list[Any]]:
    """Return a bar, how to draw it, and what becomes of it: half a turn of its end, which is then dragged."""
    body = soft_bar()
    moves, turns = path(frames, (-15.0, 30.0, 15.0), (np.pi, 0.0, 0.0))
    story = list(dragged(body, nearest_node(body, (100.0, 10.0, 10.0)), moves, turns))
    surface, shapes = body.surface, [shape for shape, _, _ in story]
    view = Camera.named("three_quarter", np.concatenate([surface.points, *shapes]), aspect=4 / 3)
    scene = head_scene(surface.points, surface.triangles, size=(480, 360), view=view, mode="plain", wire=0.8)
    return body, scene, story


def face_story(frames: int) -> tuple[Body, Any, list[Any]]:
    """Return a face, how to draw it, and what becomes of it: half a smile, pulled at a corner of the mouth."""
    face = load_face()
    body = face.body()
    corner = face.mesh.points[face.landmarks["cheilion_left"]]
    moves, turns = path(frames, (9.0, 7.0, -3.0), (0.0, 0.0, np.radians(12.0)))
    story = list(dragged(body, nearest_node(body, corner), moves, turns, modes=120))
    scene = face_scene(face, size=(420, 420), texture=Texture.of(face.texture))
    return body, scene, story


STORIES = {"bar": bar_story, "face": face_story}


def draw(scene: Any, shapes: list[np.ndarray], out: Path, title: str) -> None:
    """Write frames, film and contact sheet of the surface at `shapes` into the folder `out`."""
    pictures = []
    frames = PngSequence(out / "frames", overwrite=True)
    with frames, Film(out / "twist_and_drag.mp4", RATE, overwrite=True) as film:
        for shape in shapes:
            picture = scene.draw(shape).copy()
            frames.write(picture)
            film.write(picture)
            pictures.append(picture)
    chosen = np.linspace(0, len(pictures) - 1, 6).astype(int)
    rows = [[pictures[k] for k in chosen[:3]], [pictures[k] for k in chosen[3:]]]
    write_png(out / "twist_and_drag.png", contact_sheet(rows, title=title))


def main(out: str | Path, what: str = "bar", frames: int = 90) -> float:
    """Write the pictures into the folder `out` and return the largest constraint residual [-]."""
    body, scene, story = STORIES[what](frames)
    draw(scene, [shape for shape, _, _ in story], Path(out), f"a {what}, twisted, then dragged")
    length = float(np.ptp(body.surface.points[:, 0]))
    return max(max(at / length, turn) for _, at, turn in story)


if __name__ == "__main__":
    asked = sys.argv[1] if len(sys.argv) > 1 else "bar"
    if asked not in STORIES:
        sys.exit(f"what to twist? one of {', '.join(STORIES)}")
    print(f"largest constraint residual: {main(sys.argv[2] if len(sys.argv) > 2 else f'twisted_{asked}', asked):.1e}")
