"""A cut through the flesh of a head: its layers, the nodes that bone holds, and the bone behind them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import RunError, UserError

if TYPE_CHECKING:
    from faceanim.face.face import Face

COLOURS = {"skin": "#e3b092", "fat": "#f3dd8a", "muscle": "#b5483f", "gap": "#9fd0e0", "bone": "#b9b4a6"}
"""Colour of each material."""


def sections(points: Floats, tets: Ints, axis: int, place: float) -> tuple[list[Floats], Ints]:
    """Return the polygons (3 or 4, 3) in which elements meet the plane x[axis] = `place` [mm], and their elements.

    Corners are in order around each polygon; elements that only touch the plane are left out.
    """
    side = points[tets, axis] > place
    cut = np.flatnonzero(side.any(axis=1) & ~side.all(axis=1))
    out = []
    for tet, above in zip(tets[cut], side[cut], strict=True):
        up, down = tet[above], tet[~above]
        pairs = [(u, d) for u in up for d in down]
        if len(pairs) == 4:
            pairs = [pairs[0], pairs[1], pairs[3], pairs[2]]
        u, d = points[[p for p, _ in pairs]], points[[q for _, q in pairs]]
        share = (place - d[:, axis]) / (u[:, axis] - d[:, axis])
        out.append(d + share[:, None] * (u - d))
    return out, cut.astype(np.int32)


def draw_cut(
    face: Face, path: str | Path, *, axis: str = "x", place: float = 0.0, title: str | None = None, dpi: int = 150
) -> Path:
    """Draw a plane cut through the flesh of `face` as a PNG; return its path.

    axis : "x" (seen from the subject's left), "y" (from above) or "z" (from the front);  place : of the plane [mm]
    Raises `UserError` for an unknown axis or a plane that meets no flesh, `RunError` if the file cannot be written.
    """
    if axis not in "xyz" or len(axis) != 1:
        raise UserError(f"cut: axis {axis!r} must be x, y or z")
    solid = face.body().solid
    assert solid is not None
    k = "xyz".index(axis)
    polygons, element = sections(solid.mesh.points, solid.mesh.tets, k, place)
    if not polygons:
        low, high = solid.mesh.points[:, k].min(), solid.mesh.points[:, k].max()
        raise UserError(f"cut: the plane {axis} = {place:g} meets no flesh; it spans {low:.0f}..{high:.0f} mm")
    across, up = {"x": (2, 1), "y": (0, 2), "z": (0, 1)}[axis]
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    axes = figure.add_subplot()
    _bone(axes, face, k, place, across, up)
    names = [m.name for m in solid.materials]
    colours = [COLOURS[names[r]] for r in solid.region[element]]
    flat = [p[:, [across, up]] for p in polygons]
    axes.add_collection(PolyCollection(flat, facecolors=colours, edgecolors="#00000055", linewidths=0.3))
    held = _near(solid.mesh.points, solid.held, k, place)
    axes.plot(*solid.mesh.points[held][:, [across, up]].T, "k.", markersize=2.5)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel(f"{'xyz'[across]} [mm]")
    axes.set_ylabel(f"{'xyz'[up]} [mm]")
    axes.set_title(title or f"flesh at {axis} = {place:g} mm ({len(solid.mesh.tets)} elements; dots: nodes on bone)")
    axes.legend(handles=[Patch(color=COLOURS[n], label=n) for n in (*names, "bone")], loc="lower left", fontsize=8)
    path = Path(path)
    try:
        figure.savefig(path, dpi=dpi, format="png")
    except OSError as error:
        raise RunError(f"{path} could not be written ({error.strerror or error}); choose another folder") from error
    return path


def _near(points: Floats, held: Bools, k: int, place: float) -> Bools:
    """Return the held nodes within a millimetre and a half of the plane."""
    return np.asarray(held & (np.abs(points[:, k] - place) < 1.5))


def _bone(axes: object, face: Face, k: int, place: float, across: int, up: int) -> None:
    """Fill the bone with its teeth where the plane meets it."""
    for grid in (face.skull.cranium_grid, face.skull.jaw_grid):
        ends = [grid.origin + 0.0, grid.origin + grid.spacing * (np.array(grid.values.shape) - 1)]
        u = np.arange(ends[0][across], ends[1][across], 0.7)
        v = np.arange(ends[0][up], ends[1][up], 0.7)
        points = np.zeros((len(v), len(u), 3))
        points[..., k], points[..., across], points[..., up] = place, u[None], v[:, None]
        depth = grid.sample(points.reshape(-1, 3)).reshape(len(v), len(u))
        if depth.min() < 0:
            axes.contourf(u, v, depth, levels=[-1e3, 0.0], colors=[COLOURS["bone"]])  # type: ignore[attr-defined]
