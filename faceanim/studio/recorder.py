"""Recording what is seen on the page: positions as they come, then frames, a film and a record of how it was made."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.ground.errors import FaceanimError, RunError, UserError
from faceanim.studio.drawing import DRAWING
from faceanim.studio.engine import STEP, Setup
from faceanim.studio.simulation import Moment

LONGEST = 60.0
"""A recording stops by itself after this time [s]."""
SIZE = (640, 720)
"""Width and height of the frames [pixel]."""
_RAW = "points.raw"


class Recorder:
    """Writes recordings into numbered folders below `work`.

    on_progress(kind, text, share) : "drawing", "done", "error"; called from the recorder's thread
    """

    def __init__(self, face: Any, work: Path, on_progress: Callable[[str, str, float], None]) -> None:
        self.face, self.work, self.on_progress = face, work, on_progress
        self._lock = threading.RLock()
        self._file: Any = None
        self._folder = work
        self._poses: list[np.ndarray] = []
        self._setup: Setup | None = None
        self._failure = ""
        self._thread: threading.Thread | None = None
        self.count = 0

    @property
    def running(self) -> bool:
        """Whether moments are being recorded."""
        return self._file is not None

    def start(self, setup: Setup) -> Path:
        """Begin a recording and return its folder; raise `UserError` if one is still being drawn or cannot be."""
        with self._lock:
            if self.running or (self._thread is not None and self._thread.is_alive()):
                raise UserError("the last recording is still being written; wait a moment")
            self._folder = _next_folder(self.work)
            self._file = (self._folder / _RAW).open("wb")
            self._poses, self._setup, self._failure, self.count = [], setup, "", 0
            return self._folder

    def add(self, moment: Moment) -> None:
        """Record a moment, if a recording runs; the positions go to disk at once."""
        with self._lock:
            if self._file is None:
                return
            try:
                self._file.write(np.ascontiguousarray(moment.points, dtype="<f8").data)
            except OSError as error:
                self._failure = f"{self._folder}: cannot be written ({error.strerror}); the recording stopped"
            self._poses.append(moment.jaw_pose)
            self.count += 1
            if self._failure or self.count >= LONGEST / STEP:
                self.stop()

    def stop(self) -> None:
        """End the recording; frames and film are drawn in a thread of their own."""
        with self._lock:
            if self._file is None:
                return
            self._file.close()
            self._file = None
            self._thread = threading.Thread(target=self._write, name="studio-draw", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the recording and wait until it is written."""
        self.stop()
        if self._thread is not None:
            self._thread.join()

    def _write(self) -> None:
        try:
            if self._failure:
                raise RunError(self._failure)
            if not self.count:
                raise RunError("nothing was recorded")
            self._draw()
        except (FaceanimError, OSError) as error:
            self.on_progress("error", str(error), 0.0)
        else:
            self.on_progress("done", f"{self.count} frames in {self._folder}", 1.0)

    def _draw(self) -> None:
        from faceanim.render.sequence import Film, PngSequence
        from faceanim.session.recording import PointsFile

        n = len(self.face.mesh.points)
        raw = self._folder / _RAW
        positions = np.memmap(raw, dtype="<f8", mode="r", shape=(self.count, n, 3))
        with PointsFile(self._folder / "points.npy", self.count, n) as file:
            for points in positions:
                file.append(points)
        self.on_progress("drawing", "", 0.0)
        with DRAWING:
            scene = _scene(self.face, positions)
        with PngSequence(self._folder) as pictures, Film(self._folder / "recording.mp4", 1.0 / STEP) as film:
            for k, points in enumerate(positions):
                with DRAWING:
                    picture = scene.draw(points, np.stack([np.eye(4), self._poses[k]])).copy()
                pictures.write(picture)
                film.write(picture)
                self.on_progress("drawing", "", (k + 1) / self.count)
        self._record()
        del positions
        raw.unlink()

    def _record(self) -> None:
        from faceanim.session.recording import machine, write_record

        assert self._setup is not None
        record = {
            "face": {"name": self.face.name, "density": self.face.density, "vertices": len(self.face.mesh.points)},
            "time": {"fps": 1.0 / STEP, "frames": self.count, "step_s": STEP},
            "backend": {"name": self._setup.backend, "options": self._setup.options},
            "jaw_pose": np.array(self._poses),
            "machine": machine(),
            "files": ["points.npy", "recording.mp4"],
        }
        write_record(self._folder / "run.json", record)


def _scene(face: Any, positions: np.ndarray) -> Any:
    """Return what draws the skin from the front, with room for every moment of `positions` (k, n, 3)."""
    from faceanim.render.scene import face_scene
    from faceanim.render.shading import Texture

    some = positions[:: max(1, len(positions) // 20)]
    bounds = np.concatenate([face.mesh.points, some.min(axis=0), some.max(axis=0)])
    return face_scene(face, size=SIZE, texture=Texture.of(face.texture), bounds=bounds)


def _next_folder(work: Path) -> Path:
    """Make and return the next free recording-001, recording-002, ... below `work`."""
    for number in range(1, 1000):
        folder = work / f"recording-{number:03d}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"{folder} cannot be made ({error.strerror}); choose another --work") from error
        return folder
    raise UserError(f"{work} holds 999 recordings; choose another --work")
