"""Three blocks of flesh, pulled, stretched and sheared: the published columns, ours and the truth side by side.

    python docs/examples/muscle_blocks.py [folder]

After Tables 1 to 4 of You, Zhang & Comninos (2000). Writes muscle_blocks.png and prints the tables; ends in the largest
error of the energy-consistent method over the three cases, towards the converged truth [%].
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from faceanim.bench.muscle_blocks import as_text, columns, error

COLOURS = {
    "paper FEM": "#4c72b0", "bricks 8^3": "#76a5d8", "paper WRM": "#c44e52", "collocation": "#dd8452",
    "nitsche": "#55a868", "truth": "#222222",
}  # fmt: skip


def main(out: str | Path) -> float:
    """Write the picture into the folder `out`, print the tables and return the largest error of our method [%]."""
    results = columns()
    figure = Figure(figsize=(12, 4), layout="constrained")
    for axes, (case, table) in zip(figure.subplots(1, 3), results.items(), strict=True):
        exact = table["truth"].values
        for name, column in table.items():
            style = {"linestyle": "--"} if name == "bricks 8^3" else {}
            axes.plot(np.arange(1, 26), 100.0 * (column.values / exact - 1.0), color=COLOURS[name], label=name, **style)
        axes.set(title=case, xlabel="point of the table")
    figure.axes[0].set_ylabel("displacement, distance from the truth [%]")
    figure.axes[0].legend()
    figure.savefig(Path(out) / "muscle_blocks.png", dpi=110)
    print(as_text(results))
    return max(100.0 * error(table["nitsche"].values, table["truth"].values) for table in results.values())


if __name__ == "__main__":
    print(f"largest error: {main(sys.argv[1] if len(sys.argv) > 1 else '.'):.2f} %")
