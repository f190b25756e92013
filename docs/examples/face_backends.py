"""One face, every backend: two expressions in equilibrium, with how far each is from the reference.

    python docs/examples/face_backends.py [folder]

Writes face_backends.png and face_backends.md; ends in how far modal warping is from nonlinear finite elements in a
smile: root mean square distance over the skin [mm].
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from faceanim import Session, load_expression, load_face
from faceanim.backends import BACKENDS
from faceanim.bench.metrics import field_error, movements
from faceanim.cli.drawing import Drawing, Picture
from faceanim.render.sequence import contact_sheet, write_png

REFERENCE = "finite_elements"
EXPRESSIONS = {"happiness": 1.0, "surprise": 0.75}
"""Name and intensity: beyond 0.8 of surprise the reference finds no equilibrium, since the film over the teeth folds."""
HEAD = (
    "| expression | backend | mouth corner [mm] | lid aperture [mm] | from finite elements, RMS / max [mm] "
    "| preparation [s] | equilibrium [s] |\n|---|---|---|---|---|---|---|\n"
)
"""Columns of the table."""


def compare(
    density: str, backends: tuple[str, ...]
) -> tuple[list[list[np.ndarray]], str, dict[tuple[str, str], float]]:
    """Return pictures (a row for each expression), a Markdown table and the RMS distances from the reference [mm]."""
    face = load_face(density=density)
    body = face.body()
    rows, table, rms = [], HEAD, {}
    for name, intensity in EXPRESSIONS.items():
        shapes, lines, pictures = {}, {}, []
        for backend in backends:
            start = perf_counter()
            session = Session(face, load_expression(name), backend=backend, body=body)
            made = perf_counter()
            control, points = session.control(intensity), body.surface.points.copy()
            session.solver.surface(session.solver.solve_static(control), points)
            solved = perf_counter()
            shapes[backend] = points
            moved = movements(face, points, control)
            lines[backend] = (moved["mouth_corner_left_mm"], moved["lid_aperture_left_mm"], made - start, solved - made)
            drawing = Drawing(session, Picture((300, 300), ("front", "three_quarter")), [points])
            pictures.append(drawing.draw(points, intensity).copy())
        for backend, (corner, lid, preparation, equilibrium) in lines.items():
            error = field_error(shapes[backend], shapes[REFERENCE])
            rms[name, backend] = error.rms
            apart = "-" if backend == REFERENCE else f"{error.rms:.2f} / {error.max:.1f}"
            table += (
                f"| {name} | {backend} | {corner:.1f} | {lid:.1f} | {apart} | {preparation:.1f} | {equilibrium:.1f} |\n"
            )
        rows.append(pictures)
    return rows, table, rms


def main(out: str | Path, density: str = "default", backends: tuple[str, ...] = tuple(BACKENDS)) -> float:
    """Write picture and table into the folder `out`; return modal warping's RMS distance in a smile [mm]."""
    rows, table, rms = compare(density, backends)
    folder = Path(out)
    columns = [[row[k] for row in rows] for k in range(len(backends))]
    sheet = contact_sheet(
        columns,
        row_labels=[b.replace("_", " ") for b in backends],
        column_labels=[f"{name}, {share:g}" for name, share in EXPRESSIONS.items()],
    )
    write_png(folder / "face_backends.png", sheet)
    (folder / "face_backends.md").write_text(table, encoding="utf-8")
    return rms["happiness", "modal_warping"]


if __name__ == "__main__":
    print(f"modal warping from finite elements: {main(sys.argv[1] if len(sys.argv) > 1 else '.'):.2f} mm RMS")
