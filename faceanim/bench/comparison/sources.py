"""A mark of the program's physics, so that what was measured before a change is not taken for what holds after it."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import faceanim
from faceanim.backends import BACKENDS

ROOMS = ("kernels", "geometry", "tissue", "body", "elements", "face", "expression")
"""Rooms whose code decides what a run of any backend gives and costs."""


@cache
def physics_key(backend: str) -> str:
    """Return a hash of the sources of `ROOMS`, of what backends share and of `backend` itself, 16 letters."""
    package = Path(faceanim.__file__).resolve().parent
    digest = hashlib.sha256()
    module = BACKENDS[backend].partition(":")[0].split(".")
    own = [f"backends/{module[2]}"] if module[:2] == ["faceanim", "backends"] else []
    for room in (*ROOMS, *own):
        sources = sorted((package / room).rglob("*.py"))
        assert sources, f"room {room} holds no sources"
        for path in sources:
            digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    for path in sorted((package / "backends").glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]
