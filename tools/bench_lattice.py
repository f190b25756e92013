"""Time explicit steps of the octree's lattice against a plain C++ loop over the same springs, in interleaved rounds.

    python tools/bench_lattice.py [--rounds 40] [--output lattice.json]

Prints, for the levels of a block of 16 x 8 x 8 cells, nodes, springs, microseconds per step (fastest of all rounds),
the ratio to g++ -O3 -march=native, the largest stable step and the cost of a simulated second, with how many times
less that is than on the level before. Without a C++ compiler its column is left out. Positions are compared.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, assemble
from faceanim.geometry import octree
from faceanim.kernels import lattice as kernels

FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC")
Program = Callable[[np.ndarray, np.ndarray, int], Any]


def compiled_library(folder: Path) -> ctypes.CDLL | None:
    """Return the C++ peer compiled into `folder`, or None where there is no compiler."""
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        return None
    target = folder / "bench_lattice.so"
    source = Path(__file__).with_suffix(".cpp")
    subprocess.run([compiler, *FLAGS, str(source), "-o", str(target)], check=True)
    return ctypes.CDLL(str(target))


def programs(model: Model, dt: float, library: ctypes.CDLL | None) -> dict[str, Program]:
    """Return the kernel and its peer, each a function of positions, velocities and a number of steps."""
    n, s = len(model.points), model.tables.springs
    load, force, inverse = np.zeros((n, 3)), np.zeros((n, 3)), 1.0 / model.mass
    nobody, still = np.zeros(0, np.int32), np.zeros((0, 3))

    def numba(x: np.ndarray, v: np.ndarray, count: int) -> None:
        kernels.advance(x, v, load, model.tables, inverse, nobody, still, still, still, dt, 0.1, np.inf, count, force)

    out: dict[str, Program] = {"Numba": numba}
    if library is not None:

        def address(array: np.ndarray) -> ctypes.c_void_p:
            return ctypes.c_void_p(array.ctypes.data)

        tables = [address(a) for a in (s.i, s.j, s.stiffness, s.rest, s.low, s.high)]
        tables += [ctypes.c_double(s.ramp), ctypes.c_long(len(s.i)), address(inverse), ctypes.c_long(n)]
        numbers = [ctypes.c_double(dt), ctypes.c_double(0.1)]

        def cpp(x: np.ndarray, v: np.ndarray, count: int) -> None:
            library.advance(
                address(x), address(v), address(load), *tables, *numbers, ctypes.c_long(count), address(force)
            )

        out["C++"] = cpp
    return out


def measure(model: Model, dt: float, library: ctypes.CDLL | None, rounds: int) -> tuple[dict[str, float], float]:
    """Return microseconds per step of every program, the fastest of interleaved rounds, and how far apart they end."""
    count = max(20, 300_000 // len(model.tables.springs.i))
    start = model.points + 0.02 * model.side.min() * np.random.default_rng(0).standard_normal(model.points.shape)
    best: dict[str, float] = {}
    ends = {}
    for _ in range(rounds):
        for name, program in programs(model, dt, library).items():
            x, v = start.copy(), np.zeros_like(start)
            begin = time.perf_counter()
            program(x, v, count)
            best[name] = min(best.get(name, np.inf), 1e6 * (time.perf_counter() - begin) / count)
            ends[name] = x
    return best, float(max(np.abs(end - ends["Numba"]).max() for end in ends.values()))


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Run the comparison, print it and return its rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40, help="rounds of measurement (default %(default)s)")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    options = parser.parse_args(arguments)
    tree = octree.block((16, 8, 8), 0.125)
    count = len(tree.leaves.index)
    at = Lattice(tree, np.ones(count), np.full(count, 0.125**3))
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_library(Path(folder))
        for level in range(4):
            model = assemble(at, np.full(count, level))
            dt = model.largest_step()
            best, apart = measure(model, 0.5 * dt, library, options.rounds)
            second = best["Numba"] / dt
            fewer = rows[-1]["second"] / second if rows else 1.0
            ratio = best["Numba"] / best["C++"] if "C++" in best else np.nan
            springs = len(model.tables.springs.i)
            rows.append({"level": level, "nodes": len(model.points), "springs": springs, **best, "ratio": ratio,
                         "dt": dt, "second": second, "fewer": fewer, "difference": apart})  # fmt: skip
            print(
                f"1/{2**level}: {len(model.points):5d} nodes {springs:6d} springs {best['Numba']:8.2f} us a step, "
                f"ratio to C++ {ratio:.2f}, dt {dt:.4f} s, {second:9.1f} us a second ({fewer:.1f} times less), "
                f"difference {apart:.1e}"
            )
    if options.output is not None:
        options.output.write_text(json.dumps(rows, indent=1) + "\n")
    return rows


if __name__ == "__main__":
    main()
