"""Making the results of one run: simulate, draw, measure, record, each into the hidden part of `Results`."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.bench.accuracy import Accuracy, apex_frame, measure
from faceanim.bench.framerate import Row, table_row
from faceanim.bench.metrics import SkinCheck, Soundness, landmark_movement, movements, soundest
from faceanim.cli.drawing import Drawing, Picture
from faceanim.cli.progress import Progress
from faceanim.ground.arrays import Floats
from faceanim.render.sequence import Film, PngSequence, contact_sheet, write_png
from faceanim.session.recording import PointsFile, Results, machine, write_record
from faceanim.session.session import Session

SHEET_VIEWS = ("front", "three_quarter", "side")
SHEET_VIEW = 360
POINTS = "points.npy"

if TYPE_CHECKING:
    from faceanim.bench.comparison.plan import Plan


def faults(found: Soundness, allowed: float = 0.1) -> list[str]:
    """Return what is not sound about the skin, in words; depths below `allowed` [mm] are within the contact's play."""
    words = []
    if found.inverted_triangles:
        words.append(f"{found.inverted_triangles} triangles are turned over")
    depths = {"bone": found.depth_in_bone, "an eyeball": found.depth_in_eyeball}
    words += [f"skin lies {depth:.2g} mm inside {what}" for what, depth in depths.items() if depth > allowed]
    words += [f"{name} cross by {depth:.2g} mm" for name, depth in found.depth_crossed.items() if depth > allowed]
    return words


class Production:
    """One run of `faceanim express`; call `simulate`, `draw`, `measure`, `record` in this order.

    start : when the command began, on the clock of `perf_counter`
    """

    def __init__(
        self,
        session: Session,
        picture: Picture,
        results: Results,
        progress: Progress,
        start: float,
        plan: Plan | None = None,
    ) -> None:
        self.plan = plan
        self.session, self.picture, self.results, self.progress = session, picture, results, progress
        self.start, self.first_picture = start, 0.0
        self.apex = apex_frame(session)
        self.accuracy: Accuracy | None = None
        self.soundness: Soundness | None = None
        self.drawing_seconds: list[float] = []
        self.files: list[str] = []
        self.positions: Floats = np.empty((0, 0, 3))

    def intensity(self, frame: int) -> float:
        """Return how far the expression is at a frame, in [0, 1]."""
        return self.session.timeline.at(frame / self.session.fps) if frame else 0.0

    def simulate(self) -> None:
        """Step through all frames; positions go to a file, so that long runs need no memory."""
        session, path = self.session, self.results.part(POINTS)
        self.progress.stage("preparing (the first run compiles, about a minute)")
        session.warm()
        self.progress.stage("simulating", session.frame_count)
        with PointsFile(path, session.frame_count, len(session.body.surface.points)) as file:
            for frame in session.frames(copy=False):
                file.append(frame.points)
                self.progress.advance()
        self.positions = np.load(path, mmap_mode="r")
        for notice in getattr(session.solver, "notices", ()):
            self.progress.note(f"{session.backend}: {notice}")

    def measure(self, *, trajectory: bool) -> None:
        """Measure errors against better runs, and whether the skin is sound in every frame."""
        session = self.session
        self.progress.stage("measuring accuracy", 2 + trajectory)
        for accuracy in measure(session, self.positions, trajectory=trajectory):
            self.accuracy = accuracy
            self.progress.advance()
        self.progress.stage("checking the skin", session.frame_count)
        skin, checks = SkinCheck(session.body), []
        for frame in range(session.frame_count):
            checks.append(skin.at(self.positions[frame], session.control(self.intensity(frame))))
            self.progress.advance()
        self.soundness = soundest(checks)
        for fault in faults(self.soundness):
            self.progress.note(f"warning: {fault} in the worst frame")

    def draw(self, *, film: bool) -> None:
        """Draw every frame into PNG files and the film, then the contact sheet."""
        drawing = Drawing(self.session, self.picture, self._telling_moments())
        pictures = PngSequence(self.results.part("."))
        name = re.sub(r"[^\w+=.-]", "_", self.session.expression.name) + ".mp4"
        self.progress.stage("drawing", self.session.frame_count)
        with ExitStack() as writers:
            writers.enter_context(pictures)
            movie = writers.enter_context(Film(self.results.part(name), self.session.fps)) if film else None
            for frame in range(self.session.frame_count):
                start = perf_counter()
                picture = drawing.draw(self.positions[frame], self.intensity(frame))
                self.drawing_seconds.append(perf_counter() - start)
                self.files.append(pictures.write(picture).name)
                self.first_picture = self.first_picture or perf_counter() - self.start
                if movie is not None:
                    movie.write(picture)
                self.progress.advance()
        if film:
            self.files.append(name)
        self._sheet(drawing)

    def _telling_moments(self) -> Floats:
        """Return positions of some moments that span the whole movement, (k, n, 3) [mm]."""
        some = np.unique(np.linspace(0, self.apex, 6).astype(int))
        return np.asarray(self.positions[some])

    def _sheet(self, like: Drawing) -> None:
        """Write the contact sheet: views from top to bottom, moments from left to right."""
        views = self.picture.views if len(self.picture.views) > 1 else SHEET_VIEWS
        width, height = self.picture.size
        shrink = min(1.0, SHEET_VIEW / max(width, height))
        size = (max(16, round(width * shrink)), max(16, round(height * shrink)))
        drawing = Drawing(self.session, replace(self.picture, size=size, views=views), self._telling_moments(), like)
        frames = self._sheet_frames()
        strips = [drawing.draw(self.positions[frame], self.intensity(frame)).copy() for frame in frames]
        rows = [[strip[:, k * size[0] : (k + 1) * size[0]] for strip in strips] for k in range(len(views))]
        sheet = contact_sheet(
            rows,
            row_labels=[view.replace("_", " ") for view in views],
            column_labels=[f"{frame / self.session.fps:.2f} s" for frame in frames],
            title=f"{self.session.expression.name}  {self.session.expression.formula}",
        )
        write_png(self.results.part("contact_sheet.png"), sheet)
        self.files.append("contact_sheet.png")

    def _sheet_frames(self) -> list[int]:
        """Return the frames of the contact sheet: rest, half-way up, apex, half-way down."""
        line, fps, last = self.session.timeline, self.session.fps, self.session.frame_count - 1
        times = (0.0, line.delay + 0.5 * line.onset, None, line.apex_end + 0.5 * line.offset)
        return sorted({self.apex if t is None else min(last, round(t * fps)) for t in times})

    def record(self, *, keep_points: bool) -> None:
        """Write run.json, the last of the results."""
        if keep_points:
            self.files.append(POINTS)
        self.files.append("run.json")
        write_record(self.results.part("run.json"), self._record())
        if not keep_points:
            self.results.part(POINTS).unlink()

    def _record(self) -> dict[str, Any]:
        session, apex = self.session, np.asarray(self.positions[self.apex])
        return {
            "expression": {
                "name": session.expression.name,
                "action_units": session.expression.formula,
                "muscles": session.expression.muscles,
                "jaw": session.drive.jaw,
                "activation": {
                    name: value for name, value in zip(session.body.muscles.names, session.drive.activation) if value
                },
                "source": session.expression.source,
            },
            "face": {
                "name": session.face.name,
                "density": session.face.density,
                "muscles": session.face.muscle_source,
                "vertices": len(apex),
                "triangles": len(session.body.surface.triangles),
            },
            "time": {
                "timeline": session.timeline,
                "fps": session.fps,
                "frames": session.frame_count,
                "steps_per_frame": session.steps_per_frame,
                "step_s": session.dt,
            },
            "backend": {"name": session.backend, "options": session.options},
            "plan": None if self.plan is None else self.plan.record(),
            "picture": self.picture,
            "machine": machine(),
            "table_1": self.row(),
            "seconds": {
                "preparation": session.timings.preparation,
                "until_first_picture": self.first_picture,
                "until_record": perf_counter() - self.start,
            },
            "accuracy_mm": self.accuracy,
            "skin_worst_frame_mm": self.soundness,
            "apex": {
                "frame": self.apex,
                "movements": movements(session.face, apex, session.control(self.intensity(self.apex))),
                "landmarks_mm": landmark_movement(session.face, apex),
            },
            "files": self.files,
        }

    def row(self) -> Row:
        """Return this run's row of the paper's Table 1."""
        return table_row(self.session, self.drawing_seconds, self.accuracy)

    def closing_line(self) -> str:
        """Return one line: what was made, how fast, how accurate."""
        row = self.row()
        pictures = self.session.frame_count
        others = [name for name in self.files if not name.startswith("frame_")]
        accuracy = ""
        if self.accuracy is not None:
            parts = []
            if self.accuracy.partition is not None:
                parts.append(f"{self.accuracy.partition.max:.2g} mm from the full run")
            if self.accuracy.rest is not None:
                parts.append(f"{self.accuracy.rest.max:.2g} mm from the true equilibrium")
            if self.accuracy.trajectory is not None:
                share = 100.0 * (self.accuracy.trajectory_share or 0.0)
                parts.append(
                    f"{share:.2g} % off the converged trajectory (at most {self.accuracy.trajectory.max:.2g} mm)"
                )
            accuracy = f"; at most {', '.join(parts)} (movement {self.accuracy.largest_movement:.1f} mm)"
        return (
            f"{self.session.expression.name}: {pictures} frames, {', '.join(others)} in {self.results.folder}; "
            f"simulated {row.real_time or 0.0:.0f} times faster than real time, "
            f"drawn at {1e3 / (row.drawing_ms or 1e3):.0f} frames/s{accuracy}"
        )
