"""The bar of the modal warping paper, 1 x 0.2 x 0.2, clamped at x = 0, and what is measured on it.

Units are free: only S = density * gravity * length / E matters.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.bench import gravity_bar
from faceanim.bench.gravity_bar import bar, displaced, hanging, mass_norm, node_at
from faceanim.bench.gravity_bar import modal as solver_of
from faceanim.body.body import Body, Muscles
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.tissue.material import Material

__all__ = [
    "bar", "displaced", "growth", "hanging", "jawed_bar", "mass_norm", "node_at", "solver_of", "tip_nodes",
    "volume_ratios",
]  # fmt: skip


def tip_nodes(body: Body) -> np.ndarray:
    """Return the nodes of the far end."""
    assert body.solid is not None
    x = body.solid.mesh.points[:, 0]
    return np.flatnonzero(x > x.max() - 1e-9)


def growth(solver: Any, u: np.ndarray) -> float:
    """Return V / V0 - 1."""
    return gravity_bar.growth(solver.solid, u)


def volume_ratios(solver: Any, u: np.ndarray) -> np.ndarray:
    """Return det F of every element."""
    return gravity_bar.volume_ratios(solver.solid, u)


def jawed_bar(split: str = "mirrored", **changes: Any) -> Body:
    """Return a block of 40 x 12 x 12 mm held at both ends, by the cranium and by a jaw, with one muscle and drag."""
    mesh = box_tets((10, 3, 3), (40.0, 12.0, 12.0), split=split)
    x = mesh.points[:, 0]
    held = (x < 1e-9) | (x > 39.9)
    surface = mesh.boundary
    middle = np.flatnonzero(np.linalg.norm(surface.points - (20.0, 12.0, 6.0), axis=1) < 7.0).astype(np.int32)
    count = len(middle)
    muscles = Muscles(
        ("pull",), np.array([500.0]), np.zeros(count, np.int32), middle, np.full(count, 1.0 / count),
        np.zeros(count, np.int32), np.tile([2.0, 30.0, 6.0], (count, 1)), np.zeros(count, np.int32), np.ones(count),
    )  # fmt: skip
    fields: dict[str, Any] = {
        "bone": (x > 20.0).astype(int),
        "bones": ("cranium", "jaw"),
        "damping": 60.0,
        "stiffness_damping": 1e-3,
        "muscles": muscles,
    }
    return solid_body(mesh, Material("tissue", 1e-6, 15.0, 0.4), np.flatnonzero(held), **(fields | changes))
