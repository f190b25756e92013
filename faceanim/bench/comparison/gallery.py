"""Every candidate's last frame in false colour of its error, on one scale for the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from faceanim.bench.comparison.pictures import error_picture, face_error_picture
from faceanim.bench.comparison.reference import reference
from faceanim.bench.comparison.rows import Comparison, Row
from faceanim.bench.comparison.scenes import Scene
from faceanim.ground.arrays import Floats
from faceanim.ground.notes import tell
from faceanim.render.colormap import round_top
from faceanim.render.occlusion import vertex_openness
from faceanim.render.sequence import write_png

NEIGHBOURS = 3
"""Between probes the error is the mean of this many, weighted by nearness."""
SHOWN = 0.75
"""The colours end at this quantile of the candidates' 95 % errors, so that the worst do not make all others look right."""
FOLDER = "pictures"


def draw_all(scene: Scene, comparison: Comparison, folder: Path) -> Comparison:
    """Draw every row whose last frame is there into `folder`/pictures; return the comparison that names the pictures."""
    (folder / FOLDER).mkdir(exist_ok=True)
    gallery = _Gallery(scene, comparison)
    rows = []
    for k, row in enumerate(comparison.rows):
        tell("drawing", k, len(comparison.rows))
        points = _last_frame(folder, row)
        if points is None or points.shape != scene.stage(row.density).body.surface.points.shape:
            rows.append(replace(row, picture=None))
            continue
        name = f"{FOLDER}/{row.key}.png"
        write_png(folder / name, gallery.draw(row, points))
        rows.append(replace(row, picture=name))
    return replace(comparison, rows=rows)


def _last_frame(folder: Path, row: Row) -> Floats | None:
    """Return the surface (n, 3) that a run left, None if it left none that can be read."""
    try:
        with np.load(folder / "last_frames" / f"{row.key}.npz", allow_pickle=False) as file:
            points = np.asarray(file["points"], dtype=np.float64)
    except (OSError, ValueError, KeyError):
        return None
    return points if np.isfinite(points).all() else None


class _Gallery:
    """Draws the rows of one scene."""

    def __init__(self, scene: Scene, comparison: Comparison) -> None:
        self.scene, self.wanted = scene, reference(scene).motion[-1]
        errors = [row.rest.p95 for row in comparison.rows if row.counts and row.rest is not None]
        self.top = round_top(float(np.quantile(errors, SHOWN)) if errors else 1.0)
        rest = scene.stage("coarse").body.surface.points
        self.bounds = np.concatenate([rest, scene.probes + self.wanted])
        self._openness: dict[str, Floats] = {}

    def draw(self, row: Row, points: Floats) -> np.ndarray:
        """Return the picture of a row whose last frame is `points`."""
        stage = self.scene.stage(row.density)
        values = self._errors(row.density, points)
        if stage.face is None:
            mesh = stage.body.surface
            return error_picture(mesh.points, mesh.triangles, points, values, self.top, bounds=self.bounds)
        if row.density not in self._openness:
            self._openness[row.density] = vertex_openness(stage.face.mesh.points, stage.face.mesh.triangles)
        pose = stage.ask(self.scene.share(self.scene.duration)).bone_pose
        return face_error_picture(
            stage.face, points, values, self.top, bone_pose=pose, bounds=self.bounds,
            openness=self._openness[row.density],
        )  # fmt: skip

    def _errors(self, density: str, points: Floats) -> Floats:
        """Return the error of every surface vertex (n,) [mm]: measured at the probes, between them interpolated."""
        body = self.scene.stage(density).body
        vertex = self.scene.probe_vertices(density)
        error = np.linalg.norm(points[vertex] - self.scene.probes - self.wanted, axis=1)
        gap, near = cKDTree(self.scene.probes).query(body.surface.points, k=NEIGHBOURS)
        weight = 1.0 / (gap + 1e-6)
        out = (weight * error[near]).sum(axis=1) / weight.sum(axis=1)
        return np.where(body.pinned, 0.0, out)
