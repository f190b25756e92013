"""Pictures of an operation: the face before and after, its movement in colours, the bones with their cuts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.render.camera import Camera
from faceanim.render.colormap import Scale
from faceanim.render.occlusion import vertex_openness
from faceanim.render.overlay import draw_colour_bar, draw_legend, draw_title
from faceanim.render.renderer import DrawItem, Renderer
from faceanim.render.scene import MATERIALS, face_scene
from faceanim.render.sequence import contact_sheet, side_by_side
from faceanim.render.shading import Bytes, Texture
from faceanim.surgery.operation import Operation, moved

VIEWS = ("front", "three_quarter", "side")
BONE = (0.86, 0.82, 0.73)
SPONGY = (0.80, 0.62, 0.52)
"""Colour of bone where it is cut, sRGB."""
PIECES = ((0.20, 0.55, 0.62), (0.86, 0.50, 0.22), (0.45, 0.42, 0.68), (0.36, 0.60, 0.30), (0.75, 0.35, 0.45))
"""Colours of the pieces of bone, sRGB, in turn."""
LABEL = "in front of the old skin (+), behind it (-) [mm]"


def piece_colour(k: int) -> tuple[float, float, float]:
    """Return the colour of the k-th piece."""
    return PIECES[k % len(PIECES)]


def skin_openness(operation: Operation) -> Floats:
    """Return how open to light the skin at rest is, (n,)."""
    mesh = operation.face.mesh
    return vertex_openness(mesh.points, mesh.triangles)


def skin_pictures(
    operation: Operation,
    after: Floats,
    poses: Floats,
    *,
    size: int = 512,
    titles: tuple[str, str] = ("before", "after"),
    openness: Floats | None = None,
) -> tuple[Bytes, Bytes]:
    """Return the face before and after, each in all `VIEWS` side by side: 2 x (size, 3 * size, 3) RGB bytes.

    openness : (n,) of the skin at rest as `skin_openness` gives it, if it is known
    """
    face = replace(operation.face, parts=operation.parts)
    rest, still = operation.face.mesh.points, operation.poses(0.0)
    texture = Texture.of(face.texture)
    bounds = np.concatenate([rest, after])
    openness = skin_openness(operation) if openness is None else openness
    first, second = [], []
    for view in VIEWS:
        scene = face_scene(face, size=size, view=view, texture=texture, bounds=bounds, occlusion=openness)
        first.append(scene.draw(rest, still).copy())
        second.append(scene.draw(after, poses).copy())
    for row, title in ((first, titles[0]), (second, titles[1])):
        draw_title(row[0], title)
    return side_by_side(first), side_by_side(second)


def movement_scale(distance: Floats) -> Scale:
    """Return the two-sided scale of a movement map: symmetric about 0, up to a round number."""
    top = float(np.abs(distance).max(initial=0.0))
    steps = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0)
    high = next((s for s in steps if s >= 0.98 * top), 80.0)
    return Scale(-high, high, LABEL, "two_sided")


def map_picture(
    operation: Operation,
    after: Floats,
    poses: Floats,
    distance: Floats,
    *,
    scale: Scale | None = None,
    size: int = 512,
    title: str = "",
    openness: Floats | None = None,
) -> Bytes:
    """Return the face after the operation coloured by `distance` (n,) [mm], all `VIEWS`, with a bar of colours.

    scale : None = symmetric about 0 and as wide as the values   openness : see `skin_pictures`
    """
    scale = movement_scale(distance) if scale is None else scale
    face = replace(operation.face, parts=operation.parts)
    colours = scale.colours(distance)
    bounds = np.concatenate([face.mesh.points, after])
    openness = skin_openness(operation) if openness is None else openness
    out = []
    for view in VIEWS:
        scene = face_scene(face, mode="values", scale=scale, size=size, view=view, bounds=bounds, occlusion=openness)
        scene.renderer.set_colour(0, colours)
        out.append(scene.renderer.draw([after], poses).copy())
    if title:
        draw_title(out[0], title)
    margin = np.full((size, max(84, size // 6), 3), 247, np.uint8)
    draw_colour_bar(margin, replace(scale, label="[mm]"))
    return side_by_side([*out, margin])


def bones_picture(operation: Operation, poses: Floats, *, size: int = 420) -> Bytes:
    """Return the bones before (above) and after (below) in all `VIEWS`, the pieces in colours of their own."""
    return contact_sheet(
        _bones(operation, [operation.poses(0.0), poses], size),
        row_labels=["before", "after"],
        column_labels=[view.replace("_", " ") for view in VIEWS],
        title=operation.plan.title,
    )


def _bones(operation: Operation, moments: Sequence[Floats], size: int) -> list[list[Bytes]]:
    bone = replace(MATERIALS["bone"], two_sided=True)
    items = []
    for k, mesh in enumerate(operation.bones):
        if len(mesh.triangles):
            colour = BONE if k < 2 else piece_colour(k - 2)
            shade = vertex_openness(mesh.points, mesh.triangles, directions=48)
            wall = operation.walls(k)
            for rows_of, paint in ((~wall, colour), (wall, SPONGY)):  # apart, so that the edge of a cut stays sharp
                if rows_of.any():
                    look = replace(bone, colour=paint)
                    items.append(DrawItem(mesh.points, mesh.triangles[rows_of], look, occlusion=shade, bone=k))
    for part in operation.parts:
        if part.name.startswith("teeth") and len(part.triangles):
            tooth = replace(MATERIALS["teeth"], vertex_colour=False, colour=(0.95, 0.94, 0.90), casts=True)
            items.append(DrawItem(part.points, part.triangles, tooth, bone=part.bone))
    bounds = np.concatenate([moved(m.points, poses[k]) for poses in moments for k, m in enumerate(operation.bones)])
    names = [(f.name.replace("_", " "), piece_colour(k)) for k, f in enumerate(operation.fragments)]
    rows: list[list[Bytes]] = [[] for _ in moments]
    for view in VIEWS:
        renderer = Renderer(size, Camera.named(view, bounds), items)
        for row, poses in zip(rows, moments, strict=True):
            row.append(renderer.draw(None, poses).copy())
    for row in rows:
        draw_legend(row[0], names)
    return rows
