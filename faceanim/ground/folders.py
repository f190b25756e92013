"""Folders for files that the program makes for itself."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

_NOTICE: list[str] = []


def user_cache() -> Path:
    """Return the folder for cached files: FACEANIM_CACHE, else XDG_CACHE_HOME/faceanim, else ~/.cache/faceanim."""
    override = os.environ.get("FACEANIM_CACHE")
    if override:
        return Path(override)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "faceanim"


def writable_folder(wanted: Path, purpose: str) -> Path:
    """Return `wanted` if it can be made and written, else a temporary folder, and remember a notice about it."""
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            return wanted
    except OSError as error:
        fallback = Path(tempfile.gettempdir()) / f"faceanim-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
        fallback = fallback / wanted.name
        fallback.mkdir(parents=True, exist_ok=True)
        _NOTICE.append(f"{purpose} folder {wanted} cannot be written ({error.strerror}); using {fallback}")
        return fallback


def cache_notice() -> list[str]:
    """Return what is worth telling the user about cache folders that could not be used."""
    return list(_NOTICE)
