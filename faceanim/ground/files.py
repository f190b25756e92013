"""Writing files so that no half of one is ever seen."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from faceanim.ground.errors import RunError


def write_whole(path: Path, data: bytes, *, lasting: bool = False) -> None:
    """Write a file in one go: under another name first, then renamed; `lasting` waits until the disk has it.

    Raises `RunError` if that fails; a former file of that name is then still there.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            if lasting:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        raise not_written(path, error) from error


def not_written(path: Path, error: OSError) -> RunError:
    """Return the error for a file that could not be written."""
    reason = error.strerror or error
    return RunError(f"{path} could not be written ({reason}); free some space or choose another folder")
