"""A bar bends under growing gravity: linear modes, warped modes and nonlinear finite elements side by side.

    python docs/examples/bar_bending.py [folder]

After Fig. 4 of Choi & Ko. Writes bar_bending.png and ends in the error of the warped bar as a share of that of the
linear one under full gravity: root mean square distance from the nonlinear bar, weighted by mass.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from faceanim.bench.claims.choi_ko import FIG_4_GRAVITIES, MODELS, figure_4_bar, figure_4_shapes
from faceanim.bench.gravity_bar import flesh
from faceanim.body.body import Body
from faceanim.render.body_scene import BodyScene
from faceanim.render.sequence import contact_sheet, write_png

COLOURS = {"linear": (0.80, 0.42, 0.33), "warped": (0.33, 0.52, 0.80), "nonlinear": (0.42, 0.68, 0.42)}


def distance(body: Body, a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square distance of two shapes of the surface, weighted by mass."""
    return float(np.sqrt(np.average(((a - b) ** 2).sum(axis=1), weights=body.mass)))


def main(out: str | Path) -> float:
    """Write the picture into the folder `out` and return the warped bar's error over the linear bar's [-]."""
    body = figure_4_bar()
    solid = flesh(body)
    found = [figure_4_shapes(g) for g in FIG_4_GRAVITIES]
    skins = [{name: solid.skin.apply(solid.mesh.points + one.u) for name, one in models.items()} for models in found]
    bounds = np.concatenate([body.surface.points, *(skin for models in skins for skin in models.values())])
    rows = []
    for models in skins:
        row = []
        for name, skin in models.items():
            scene = BodyScene(
                [body.surface.points], [body.surface.triangles], [COLOURS[name]], bounds, size=(300, 300), view="front"
            )
            row.append(scene.draw([skin]).copy())
        rows.append(row)
    labels = [f"g = {g}" for g in FIG_4_GRAVITIES]
    write_png(Path(out) / "bar_bending.png", contact_sheet(rows, row_labels=labels, column_labels=list(MODELS)))
    last = skins[-1]
    return distance(body, last["warped"], last["nonlinear"]) / distance(body, last["linear"], last["nonlinear"])


if __name__ == "__main__":
    print(f"error of warped over linear modes: {main(sys.argv[1] if len(sys.argv) > 1 else '.'):.3f}")
