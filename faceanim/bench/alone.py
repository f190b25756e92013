"""One run at a time in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from faceanim.ground.errors import UserError
from faceanim.ground.files import not_written


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Let no second run write into `folder` meanwhile; raise `UserError` if one does already.

    The system gives the lock back however the process ends.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".running").open("a")
    except OSError as error:
        raise not_written(folder / ".running", error) from error
    with file:
        if not _locked(file.fileno()):
            raise UserError(f"another run is writing into {folder}; wait for it, or give another --out")
        yield


def _locked(file: int) -> bool:
    """Take the lock; True where the system has none."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
