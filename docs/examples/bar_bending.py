"""A bar bends under growing gravity: linear modes, warped modes and nonlinear finite elements side by side.

    python docs/examples/bar_bending.py [folder]

After Fig. 4 of Choi & Ko. Writes bar_bending.png and ends in the error of the warped bar as a share of that of the
linear one under full gravity: root mean square distance from the nonlinear bar, weighted by mass.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from faceanim.backends import backend_class, make_solver
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.render.body_scene import BodyScene
from faceanim.render.sequence import contact_sheet, write_png
from faceanim.tissue.material import Material

GRAVITY = (1.96, 4.9, 9.8)
COLOURS = {"linear": (0.80, 0.42, 0.33), "warped": (0.33, 0.52, 0.80), "nonlinear": (0.42, 0.68, 0.42)}


def bar() -> Body:
    """Return the bar of the paper's figures, a fifth as thick as long: rho g L / E = 0.065 at the largest gravity."""
    mesh = box_tets((20, 4, 4), (1.0, 0.2, 0.2))
    return solid_body(mesh, Material("rubber", 1000.0, 1.5e5, 0.3), np.flatnonzero(mesh.points[:, 0] < 1e-9))


def equilibria(body: Body, gravity: float) -> dict[str, np.ndarray]:
    """Return the surface (n, 3) of the bar at rest under `gravity`, by each model."""
    modal = backend_class("modal_warping").Options
    control = Control.rest(body)
    control.gravity[:] = (0.0, -gravity, 0.0)
    shapes = {}
    for name, backend, options in (
        ("linear", "modal_warping", modal(modes=30, variant="linear")),
        ("warped", "modal_warping", modal(modes=30, variant="warped")),
        ("nonlinear", "finite_elements", None),
    ):
        solver = make_solver(backend, body, options)
        shapes[name] = body.surface.points.copy()
        solver.surface(solver.solve_static(control), shapes[name])
    return shapes


def distance(body: Body, a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square distance of two shapes of the surface, weighted by mass."""
    return float(np.sqrt(np.average(((a - b) ** 2).sum(axis=1), weights=body.mass)))


def main(out: str | Path) -> float:
    """Write the picture into the folder `out` and return the warped bar's error over the linear bar's [-]."""
    body = bar()
    results = [equilibria(body, g) for g in GRAVITY]
    bounds = np.concatenate([body.surface.points, *(shape for result in results for shape in result.values())])
    rows = []
    for result in results:
        row = []
        for name, shape in result.items():
            scene = BodyScene(
                [body.surface.points], [body.surface.triangles], [COLOURS[name]], bounds, size=(300, 300), view="front"
            )
            row.append(scene.draw([shape]).copy())
        rows.append(row)
    labels = [f"g = {g}" for g in GRAVITY]
    write_png(Path(out) / "bar_bending.png", contact_sheet(rows, row_labels=labels, column_labels=list(COLOURS)))
    last = results[-1]
    return distance(body, last["warped"], last["nonlinear"]) / distance(body, last["linear"], last["nonlinear"])


if __name__ == "__main__":
    print(f"error of warped over linear modes: {main(sys.argv[1] if len(sys.argv) > 1 else '.'):.3f}")
