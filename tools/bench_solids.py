"""Measure the backends of solids: a large nonlinear solve, the modes of a face, and the cost of a frame on a face.

Run `python tools/bench_solids.py` in the repository (about a minute). Every part runs in a process of its own, so that its
peak memory is its own; times are warm, without compilation.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from time import perf_counter
from typing import Any

import numpy as np

from faceanim import Session, load_expression, load_face
from faceanim.backends import backend_class, make_solver
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.tissue.material import Material


def large_solve() -> dict[str, Any]:
    """Return what the equilibrium of 20,400 neo-Hookean elements that sag by most of their length costs."""
    for cells in ((6, 2, 2), (34, 10, 10)):  # the small one compiles
        mesh = box_tets(cells, (1.0, 0.2, 0.2))
        body = solid_body(mesh, Material("rubber", 1000.0, 1.5e5, 0.3), np.flatnonzero(mesh.points[:, 0] < 1e-9))
        control = Control.rest(body)
        control.gravity[:] = (0.0, -9.8, 0.0)
        solver = make_solver("finite_elements", body)
        start = perf_counter()
        state = solver.solve_static(control)
        seconds = perf_counter() - start
    sag = float(-(state.q - solver.elements.points)[:, 1].min())
    return {"elements": len(mesh.tets), "seconds": seconds, "steps": solver.static_report.iterations, "sag": sag}


def face_modes() -> dict[str, Any]:
    """Return what the modes of the default face cost when they are not on disk."""
    body = load_face().body()
    assert body.solid is not None
    start = perf_counter()
    solver = make_solver("modal_warping", body, backend_class("modal_warping").Options(cache=False))
    seconds = perf_counter() - start
    return {"elements": len(body.solid.mesh.tets), "modes": solver.modes.count, "seconds": seconds}


def frames() -> dict[str, Any]:
    """Return the median time of a frame of a smile at 30 frames a second for every real-time backend [ms]."""
    body, face, out = load_face().body(), load_face(), {}
    modal = backend_class("modal_warping").Options
    for name, backend, options in (
        ("mass_spring", "mass_spring", None),
        *((f"modal_warping, {v}", "modal_warping", modal(variant=v)) for v in ("consistent", "rotation_strain")),
        ("octree_mass_spring", "octree_mass_spring", None),
    ):
        session = Session(face, load_expression("happiness"), backend=backend, options=options, body=body, duration=0.7)
        for _ in session.frames(copy=False):
            pass
        out[name] = 1e3 * float(np.median(session.timings.frame))
    return out


PARTS = {"large_solve": large_solve, "face_modes": face_modes, "frames": frames}


def measured(part: str) -> dict[str, Any]:
    """Return what `part` measures, in a process of its own, with its peak memory [MB]."""
    command = [sys.executable, __file__, part]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Measure one part, or all of them."""
    if len(sys.argv) > 1:
        result = PARTS[sys.argv[1]]()
        print(json.dumps({**result, "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0}))
        return
    for part in PARTS:
        print(part, {k: round(v, 2) if isinstance(v, float) else v for k, v in measured(part).items()}, flush=True)


if __name__ == "__main__":
    main()
