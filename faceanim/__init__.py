"""faceanim: real-time, physically based facial animation.

Public names load on first use, so that `import faceanim` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "load_face": "faceanim.face.library",
    "load_expression": "faceanim.expression.library",
    "express": "faceanim.session.session",
    "Session": "faceanim.session.session",
    "make_solver": "faceanim.backends",
    "Control": "faceanim.body.control",
    "Material": "faceanim.tissue.material",
    "box_tets": "faceanim.geometry.shapes",
    "read_volume": "faceanim.geometry.meshio_bridge",
    "solid_body": "faceanim.body.solid",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'faceanim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
