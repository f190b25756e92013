"""A mark of the program's physics, so that what was measured before a change is not taken for what holds after it."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import faceanim

ROOMS = ("kernels", "geometry", "tissue", "body", "elements", "backends", "face", "expression")
"""Rooms whose code decides what a run gives and costs."""


@cache
def physics_key() -> str:
    """Return a hash of the sources of `ROOMS`, 16 letters."""
    package = Path(faceanim.__file__).resolve().parent
    digest = hashlib.sha256()
    for room in ROOMS:
        sources = sorted((package / room).rglob("*.py"))
        assert sources, f"room {room} holds no sources"
        for path in sources:
            digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]
