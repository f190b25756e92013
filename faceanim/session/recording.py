"""What is kept of a run: `run.json` and, when asked, the positions of every frame."""

from __future__ import annotations

import json
import math
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import RunError, UserError

_PACKAGES = ("numba", "numpy", "scipy", "opencv-python-headless")


def machine() -> dict[str, Any]:
    """Return the processor, its cores, the threads in use and the versions that shape a run."""
    import numba

    from faceanim import __version__

    versions = {"faceanim": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "threads": int(numba.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": versions,
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def plain(value: Any) -> Any:
    """Return `value` as what JSON can hold: numbers that are not finite become None, arrays lists, paths text."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    elif hasattr(value, "__struct_fields__"):
        value = {name: getattr(value, name) for name in value.__struct_fields__}
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return number if math.isfinite(number) else None
    if isinstance(value, np.generic):
        return value.item()
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)


class Results:
    """A folder of results that shows all of them or none: files are made in a hidden folder inside it, then moved.

    folder : made if it is not there    overwrite : replace the results of an earlier run
    Use it as a context; `part(name)` is where to write, `commit()` moves everything, `run.json` last. Whatever ends
    the context before that leaves nothing behind.
    Raises `UserError` for a folder that cannot be written or already holds results.
    """

    KINDS = ("frame_[0-9][0-9][0-9][0-9]*.png", "contact_sheet.png", "points.npy", "run.json")
    LAST = "run.json"

    def __init__(self, folder: Path, *, overwrite: bool = False) -> None:
        self.folder = folder
        self._hidden = folder / f".faceanim-partial-{os.getpid()}"
        held = self._held() if folder.is_dir() else []
        if held and not overwrite:
            raise UserError(
                f"output folder {folder} already holds {len(held)} files of a run ({held[0].name}, ...); "
                "add --force to replace them or choose another --out"
            )
        existing = folder
        while not existing.exists() and existing != existing.parent:
            existing = existing.parent
        if not existing.is_dir():
            raise UserError(f"output folder {folder}: {existing} is a file, not a folder; choose another --out")
        if not os.access(existing, os.W_OK | os.X_OK):
            raise UserError(f"output folder {folder}: {existing} cannot be written; choose another --out")

    def _held(self) -> list[Path]:
        """Return the results of an earlier run: the usual names, and what its run.json lists."""
        held = {path for kind in self.KINDS for path in self.folder.glob(kind)}
        with suppress(OSError, ValueError, TypeError, AttributeError):
            listed = json.loads((self.folder / self.LAST).read_bytes()).get("files", [])
            named = (self.folder / name for name in listed if Path(name).name == name)
            held |= {path for path in named if path.is_file()}
        return sorted(held)

    def __enter__(self) -> Results:
        self._made = not self.folder.exists()
        self._remove_stale()
        try:
            self._hidden.mkdir(parents=True)
        except OSError as error:
            raise UserError(
                f"output folder {self.folder} cannot be written ({error.strerror}); choose another --out"
            ) from error
        return self

    def _remove_stale(self) -> None:
        """Remove what runs that were killed have left hidden in the folder."""
        for path in self.folder.glob(".faceanim-partial-*"):
            process = path.name.rpartition("-")[2]
            if os.name == "posix" and process.isdigit() and not _alive(int(process)):
                shutil.rmtree(path, ignore_errors=True)

    def part(self, name: str) -> Path:
        """Return where to write the result called `name`."""
        return self._hidden / name

    def commit(self) -> None:
        """Remove the results of an earlier run and show these."""
        for path in self._held():
            path.unlink()
        made = sorted(self._hidden.iterdir(), key=lambda path: (path.name == self.LAST, path.name))
        for path in made:
            os.replace(path, self.folder / path.name)

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._hidden, ignore_errors=True)
        if self._made:
            with suppress(OSError):
                self.folder.rmdir()


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def make_folder(folder: Path) -> None:
    """Make `folder` if it is not there; raise `UserError` if that cannot be done or it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except FileExistsError:
        raise UserError(f"output folder {folder} is a file; choose another --out") from None
    except OSError as error:
        raise UserError(f"output folder {folder} cannot be written ({error.strerror}); choose another --out") from error


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn a failure to write into a `RunError` that names `path` and the way out."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunError(f"{path}: cannot be written ({reason}); make room or choose another --out") from error


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Write `record` as JSON."""
    with disk_errors(path):
        path.write_text(json.dumps(plain(record), indent=2, allow_nan=False) + "\n", encoding="utf-8")


class PointsFile:
    """Positions of every frame, (frame, n, 3) [mm], appended one frame at a time to a NumPy .npy file."""

    def __init__(self, path: Path, frames: int, vertices: int) -> None:
        self.path = path
        header = {"descr": "<f8", "fortran_order": False, "shape": (frames, vertices, 3)}
        with disk_errors(path):
            self._file = path.open("wb")
            np.lib.format.write_array_header_1_0(self._file, header)

    def append(self, points: Floats) -> None:
        """Write one frame's points (n, 3)."""
        with disk_errors(self.path):
            self._file.write(np.ascontiguousarray(points, dtype="<f8").data)

    def __enter__(self) -> PointsFile:
        return self

    def __exit__(self, *_: object) -> None:
        with disk_errors(self.path):
            self._file.close()
