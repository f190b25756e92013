"""The bar of the modal warping paper, 1 x 0.2 x 0.2, clamped at x = 0, and what is measured on it.

Units are free: only S = density * gravity * length / E matters.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.backends.modal_warping.options import Options
from faceanim.backends.modal_warping.solver import SolverModalWarping
from faceanim.body.body import Body, Muscles
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.tissue.material import Material


def bar(
    cells: tuple[int, int, int] = (10, 2, 2),
    young: float = 1.5e5,
    *,
    split: str = "kuhn",
    poisson: float = 0.3,
    size: tuple[float, float, float] = (1.0, 0.2, 0.2),
    **options: Any,
) -> Body:
    """Return the bar with its nodes at x = 0 held."""
    mesh = box_tets(cells, size, split=split)
    material = Material("rubber", 1000.0, young, poisson)
    return solid_body(mesh, material, np.flatnonzero(mesh.points[:, 0] < 1e-9), **options)


def solver_of(body: Body, modes: int = 30, variant: str = "warped", **options: Any) -> SolverModalWarping:
    """Return the solver with these options, computed afresh."""
    return SolverModalWarping(body, Options(modes=modes, variant=variant, **{"cache": False} | options))


def hanging(body: Body, g: float) -> Control:
    """Return the control with gravity `g` along -y."""
    control = Control.rest(body)
    control.gravity = np.array([0.0, -g, 0.0])
    return control


def node_at(body: Body, *point: float) -> int:
    """Return the solid node nearest to `point` at rest."""
    assert body.solid is not None
    return int(np.linalg.norm(body.solid.mesh.points - point, axis=1).argmin())


def tip_nodes(body: Body) -> np.ndarray:
    """Return the nodes of the far end."""
    assert body.solid is not None
    x = body.solid.mesh.points[:, 0]
    return np.flatnonzero(x > x.max() - 1e-9)


def displaced(solver: Any, state: Any) -> np.ndarray:
    """Return the nodal displacements (n, 3)."""
    return np.asarray(solver.nodes(state) - solver.solid.mesh.points)


def growth(solver: Any, u: np.ndarray) -> float:
    """Return V / V0 - 1."""
    return float(volume_ratios(solver, u) @ solver.solid.mesh.volumes / solver.solid.mesh.volumes.sum() - 1.0)


def volume_ratios(solver: Any, u: np.ndarray) -> np.ndarray:
    """Return det F of every element."""
    mesh = solver.solid.mesh
    return np.linalg.det(np.eye(3) + np.einsum("eai,eaj->eij", u[mesh.tets], mesh.gradients))


def mass_norm(mass: Any, u: np.ndarray) -> float:
    """Return |u|_M."""
    return float(np.sqrt(u.ravel() @ (mass @ u.ravel())))


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
