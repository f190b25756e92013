"""A comparison from beginning to end, or from where it was stopped: each candidate in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import msgspec

from faceanim.bench.alone import alone
from faceanim.bench.comparison.candidates import Candidate, candidate_of
from faceanim.bench.comparison.reference import key_of, reference, rms
from faceanim.bench.comparison.rows import Comparison, Row, as_json, load
from faceanim.bench.comparison.scenes import FPS, Scene
from faceanim.bench.comparison.sources import physics_key
from faceanim.bench.comparison.trial import Job
from faceanim.ground.cache import content_key
from faceanim.ground.errors import RunError, UserError
from faceanim.ground.files import write_whole

TABLE = "comparison.json"
"""The file in which the rows are kept as they come."""
PATIENCE = 600.0
"""What a candidate may take besides its frames [s]: starting, compiling, preparing."""

Watcher = Callable[[Row], None]


def row_key(scene: Scene, candidate: Candidate) -> str:
    """Return what a row is known by: the scene and its reference, the candidate, the sources of the physics."""
    settings = sorted(candidate.settings.items())
    named = (candidate.backend, candidate.scheme, settings, candidate.density, candidate.steps_per_frame)
    return content_key("row-1", scene.name, key_of(scene), *named, physics_key(candidate.backend))


def blank(scene: Scene, candidate: Candidate) -> Row:
    """Return the row of a candidate that has not been measured."""
    return Row(
        scene.name, row_key(scene, candidate), candidate.label, candidate.backend, candidate.scheme, candidate.density,
        candidate.settings, candidate.step, candidate.steps_per_frame, FPS, "failed", "not measured",
    )  # fmt: skip


@dataclass
class Sweep:
    """A comparison in a folder.

    limit : [s] that the frames of one candidate may take   again : measure anew what is there already
    """

    scene: Scene
    candidates: list[Candidate]
    folder: Path
    limit: float = 300.0
    again: bool = False

    def run(self, machine: str, watcher: Watcher) -> Comparison:
        """Return the comparison; every row is kept as soon as it is there, and `watcher` sees it.

        Raises `UserError` for a table that cannot be read or a second run in the folder, `RunError` if the disk is full.
        """
        with alone(self.folder):
            known = self.known()
            found = reference(self.scene)
            comparison = Comparison(
                self.scene.name, self.scene.title, found.text, found.uncertainty, rms(found.balance), machine
            )
            wanted = [blank(self.scene, one) for one in self.candidates]
            kept = {} if self.again else {row.key: known[row.key] for row in wanted if row.key in known}
            for row, candidate in zip(wanted, self.candidates, strict=True):
                if row.key not in kept:
                    kept[row.key] = self.measured(row, candidate)
                    self.store(replace(comparison, rows=[kept[r.key] for r in wanted if r.key in kept]))
                watcher(kept[row.key])
            return replace(comparison, rows=[kept[row.key] for row in wanted])

    def store(self, comparison: Comparison) -> None:
        """Write the table: the rows of `comparison` and, after them, those of earlier runs that it does not hold."""
        held = {row.key for row in comparison.rows}
        others = [row for key, row in self.known().items() if key not in held and current(row, self.scene)]
        whole = replace(comparison, rows=[*comparison.rows, *others])
        write_whole(self.folder / TABLE, as_json(whole), lasting=True)

    def known(self) -> dict[str, Row]:
        """Return the rows that an earlier run left, by key; raise `UserError` for a table of another scene or none."""
        path = self.folder / TABLE
        if not path.exists():
            return {}
        if path.stat().st_size > MOST_BYTES:
            raise UserError(f"{path} is larger than {MOST_BYTES >> 20} MB: not a table of this program; move it away")
        earlier = load(path.read_bytes(), str(path))
        if earlier.scene != self.scene.name:
            raise UserError(f"{self.folder} holds a comparison of {earlier.scene}; give another --out")
        return {row.key: row for row in earlier.rows}

    def measured(self, row: Row, candidate: Candidate) -> Row:
        """Return the row filled in by a process of its own, whatever becomes of that process."""
        (self.folder / "last_frames").mkdir(exist_ok=True)
        result = self.folder / "last_frames" / f"{row.key}.npz"
        job = Job(self.scene.name, candidate, row, self.limit, str(result))
        started = perf_counter()
        command = [sys.executable, "-m", "faceanim.bench.comparison.trial"]
        try:
            ended = subprocess.run(
                command, input=msgspec.json.encode(job), capture_output=True, timeout=self.limit + PATIENCE,
                env=_environment(), check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return replace(row, outcome="too slow", reason=f"stopped after {perf_counter() - started:.0f} s")
        if ended.returncode != 0:
            last = ended.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
            return replace(row, outcome="failed", reason=f"the process ended with status {ended.returncode}: {last[0]}")
        try:
            return msgspec.json.decode(ended.stdout, type=Row)
        except msgspec.DecodeError as error:
            raise RunError(f"{row.label}: the measuring process answered something else ({error})") from error


MOST_BYTES = 64 << 20


def current(row: Row, scene: Scene) -> bool:
    """Whether a row still says what a run of its candidate would give."""
    return row.scene == scene.name and row.key == row_key(scene, candidate_of(row))


def _environment() -> dict[str, str]:
    """Return the environment of a measuring process: one thread, so that costs compare."""
    one = dict.fromkeys(("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    path = os.pathsep.join(p for p in sys.path if p)
    return {**os.environ, **one, "PYTHONPATH": path}
