"""Computed arrays kept on disk by content: what costs seconds once costs milliseconds afterwards."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.ground.folders import user_cache, writable_folder


def content_key(version: str, *parts: Any) -> str:
    """Return a hash of `parts`: arrays by their bytes, shape and type, everything else by its text.

    `version` names the computation; change it when the computation changes.
    """
    digest = hashlib.sha256(version.encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"|{part.dtype}{part.shape}|".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(f"|{part!r}|".encode())
    return digest.hexdigest()[:32]


def _path(kind: str, key: str) -> Path:
    return writable_folder(user_cache() / kind, f"cache of {kind}") / f"{key}.npz"


def load_arrays(kind: str, key: str) -> dict[str, np.ndarray] | None:
    """Return the arrays kept under `key` in the cache called `kind`, or None if there are none that can be read."""
    try:
        with _path(kind, key).open("rb") as held, np.load(held, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # a damaged file raises whatever its damage provokes; it is as good as none
        return None


def save_arrays(kind: str, key: str, **arrays: Any) -> None:
    """Keep `arrays` under `key` in the cache called `kind`; a folder that cannot be written is no error."""
    path = _path(kind, key)
    part = path.with_name(f".{key}.{os.getpid()}.part.npz")
    try:
        np.savez(part, **arrays)
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink()
