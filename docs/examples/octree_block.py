"""A block of flesh at four levels of an octree under the same bending and twisting load, side by side.

    python docs/examples/octree_block.py [folder]

Every panel shows the edges of the cells, coloured by how far their ends moved. Coarse cells bend less than they
should: their springs lie in their corners. Prints how much level 1 differs from the leaves [%].
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, assemble
from faceanim.backends.octree_mass_spring.simplify import PAIRS
from faceanim.backends.octree_mass_spring.static import dead_load, equilibrium
from faceanim.backends.octree_mass_spring.transfer import Landmarks, landmark_error
from faceanim.geometry import octree

SIDE = 0.125


def load_of(points: np.ndarray) -> np.ndarray:
    """Return forces (n, 3) that bend and twist the block at x = 2, for the nodes of the leaves."""
    end = np.isclose(points[:, 0], 2.0).astype(float)
    for d in (1, 2):
        end *= np.where(np.isclose(points[:, d], 0.0) | np.isclose(points[:, d], 1.0), 0.5, 1.0)
    end /= end.sum()
    force = np.zeros_like(points)
    force[:, 1] = -1.2 * end * (points[:, 2] - 0.5)
    force[:, 2] = -0.2 * end + 1.2 * end * (points[:, 1] - 0.5)
    return force


def solve(model: Model, leaf: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the nodes (n, 3) of `model` at rest under the load of the leaves' nodes `points`, by virtual work."""
    node, weight = model.embed(leaf, points)
    force = np.zeros_like(model.points)
    for k in range(8):
        np.add.at(force, node[:, k], weight[:, k : k + 1] * load_of(points))
    free = ~np.isclose(model.points[:, 0], 0.0)
    return equilibrium(model, model.points, dead_load(force), free=free)[0]


def draw(axes: object, model: Model, x: np.ndarray, most: float) -> None:
    """Draw the edges of all cells, coloured by displacement up to `most`."""
    pairs = np.unique(np.sort(model.corner[:, PAIRS[:12]].reshape(-1, 2), axis=1), axis=0)
    moved = np.linalg.norm(x - model.points, axis=1)[pairs].mean(axis=1)
    lines = Line3DCollection(x[pairs], colors=plt.get_cmap("viridis")(moved / most), linewidths=0.7)
    axes.add_collection3d(lines)  # type: ignore[attr-defined]
    axes.set(xlim=(0.1, 1.9), ylim=(-0.4, 1.4), zlim=(-0.6, 1.2))  # type: ignore[attr-defined]
    axes.set_box_aspect((1, 1, 1))  # type: ignore[attr-defined]
    axes.view_init(18, -62)  # type: ignore[attr-defined]
    axes.set_axis_off()  # type: ignore[attr-defined]


def main(out: str | Path) -> float:
    """Write octree_block.png into the folder `out`; return the landmark error of level 1 against the leaves [%]."""
    tree = octree.block((16, 8, 8), SIDE)
    count = len(tree.leaves.index)
    lattice = Lattice(tree, np.ones(count), np.full(count, SIDE**3))
    points = tree.leaves.points
    leaf = np.zeros(len(points), dtype=np.int32)
    leaf[tree.leaves.corner.ravel()] = np.repeat(np.arange(count), 8)
    models = [assemble(lattice, np.full(count, level)) for level in range(4)]
    solved = [solve(model, leaf, points) for model in models]
    end = np.flatnonzero(np.isclose(points[:, 0], 2.0))
    marks = Landmarks(leaf[end], points[end])
    errors = [100.0 * landmark_error(marks, models[0], solved[0], m, x)[1] for m, x in zip(models, solved, strict=True)]
    figure = plt.figure(figsize=(14, 4))
    most = float(np.linalg.norm(solved[0] - points, axis=1).max())
    for k, (model, x) in enumerate(zip(models, solved, strict=True)):
        axes = figure.add_subplot(1, 4, k + 1, projection="3d")
        draw(axes, model, x, most)
        axes.set_title(f"level {k}: {len(model.tables.springs.i)} springs, error {errors[k]:.0f} %")
    figure.tight_layout()
    scale = plt.cm.ScalarMappable(plt.Normalize(0.0, most), "viridis")
    figure.colorbar(scale, ax=figure.axes, shrink=0.7, pad=0.02, label="displacement, in widths of the block")
    figure.savefig(Path(out) / "octree_block.png", dpi=110)
    plt.close(figure)
    return errors[1]


if __name__ == "__main__":
    print(f"level 1 differs from the leaves by {main(sys.argv[1] if len(sys.argv) > 1 else '.'):.1f} %")
