"""Time the elastic force kernel against a C++ compiler and NumPy, one core, in interleaved rounds.

    python tools/bench_springs.py [--rounds 60] [--output springs.json]

Prints, for each spring law, microseconds per evaluation and the ratio to the Numba kernel (median and quartiles over
the rounds; each round measures every program once, so that a busy machine slows all of them alike), then the cost of
a compact patch of 1,048 vertices against the mesh of 7,373 it is cut from, and the growth of the cost with size.
Without a C++ compiler those rows are left out. Every program's result is checked against the kernel's.
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
from scipy import sparse

from faceanim.kernels.springs import elastic_force, force_scratch
from faceanim.kernels.tables import Law, Springs

LAWS = (
    Law(0.0, 1.0, 2.0, 1),
    Law(1.0, 1.0, 2.0, 1),
    Law(2.0, 1.0, 2.0, 1),
    Law(0.7, 1.0, 2.0, 1),
    Law(0.7, 1.0, 1.3, 1),
)
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp-simd", "-std=c++17", "-shared", "-fPIC")
Program = Callable[[], Any]


def dome(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (rows * columns, 3) [mm] of a slightly irregular dome and its triangles, numbered row by row."""
    noise = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    points = np.stack([1.0 * columns * v, 1.0 * rows * u, 40 * np.cos(u) * np.cos(v)], axis=-1).reshape(-1, 3)
    points += noise.normal(0, 0.1, points.shape)
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    quads = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return points, quads.reshape(-1, 3).astype(np.int32)


def patch(points: np.ndarray, triangles: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh of the `size` points nearest to the middle."""
    distance = np.linalg.norm(points - points.mean(axis=0) * [1, 1, 0] - [0, 0, 40], axis=1)
    kept = np.sort(np.argsort(distance, kind="stable")[:size])
    number = np.full(len(points), -1, np.int32)
    number[kept] = np.arange(size)
    inside = number[triangles]
    return points[kept], np.ascontiguousarray(inside[(inside >= 0).all(axis=1)])


def tables(points: np.ndarray, triangles: np.ndarray) -> Springs:
    """Return springs of a membrane of modulus 60 mN/mm with the points at rest."""
    corners = points[triangles]
    edges = [corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)]
    length = np.array([np.linalg.norm(edge, axis=1) for edge in edges])
    area = 0.5 * np.linalg.norm(np.cross(edges[0], edges[1]), axis=1)
    stiffness = 60.0 * area / length**2
    height = 2.0 * area / length
    height_stiffness = 0.5 * np.repeat(stiffness.mean(axis=0)[None], 3, axis=0)
    slots = np.argsort(triangles.T.ravel(), kind="stable").astype(np.int32)
    start = np.concatenate([[0], np.cumsum(np.bincount(triangles.ravel(), minlength=len(points)))]).astype(np.int32)
    columns = tuple(np.ascontiguousarray(triangles[:, k]) for k in range(3))
    return Springs(*columns, length, stiffness, height, height_stiffness, 0.3 * height_stiffness * height, start, slots)


def numba_program(x: np.ndarray, springs: Springs, law: Law, out: np.ndarray) -> Program:
    """Return the kernel, bound to its arguments."""
    scratch = force_scratch(springs)
    return lambda: elastic_force(x, springs, law, scratch, out)


def numpy_program(x: np.ndarray, springs: Springs, law: Law, out: np.ndarray) -> Program:
    """Return the same force written with whole arrays; a sparse matrix adds up the corners."""
    count = springs.a.size
    corners = np.concatenate([springs.a, springs.b, springs.c])
    gather = sparse.csr_matrix((np.ones(3 * count), (corners, np.arange(3 * count))), shape=(len(x), 3 * count))
    a, b, c = springs.a, springs.b, springs.c

    def growth(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = (s / law.s0) ** 2
        p = (1.0 + q) ** (law.alpha - 1.0)
        return p * (1.0 + q), p * (1.0 + (2.0 * law.alpha + 1.0) * q)

    def run() -> None:
        edges = np.stack([x[c] - x[b], x[a] - x[c], x[b] - x[a]])
        squares = np.einsum("ktd,ktd->kt", edges, edges)
        length = np.sqrt(squares)
        twice_area = np.linalg.norm(np.cross(edges[0], edges[1]), axis=1)
        h = twice_area / length
        t = -np.einsum("ktd,ktd->kt", edges, np.roll(edges, 1, axis=0)) / squares
        s = length - springs.edge_length
        secant, tangent = growth(s)
        pull = (springs.edge_stiffness * secant * s / length)[..., None] * edges
        stiff = springs.edge_stiffness * tangent
        s = h - springs.height
        secant, tangent = growth(s)
        push = springs.repulsion * (springs.height / h) ** law.beta
        g = (push - springs.repulsion - springs.height_stiffness * secant * s) / h
        bound = np.maximum(springs.height_stiffness * tangent + law.beta * push / h, np.abs(g))
        bound *= 0.5 * (1.0 + np.abs(t) + np.abs(1.0 - t))
        extra = 2.0 * np.maximum(g, 0.0) * h * h / squares
        rise = -g[..., None] * (np.roll(edges, -2, axis=0) + t[..., None] * edges)  # along the height
        result = np.empty((3, count, 4))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3  # corner k begins edge j and ends edge i
            result[k, :, :3] = rise[k] - t[i][:, None] * rise[i] - (1 - t[j])[:, None] * rise[j] + pull[j] - pull[i]
            own = np.abs(t[i]) * bound[i] + np.abs(1 - t[j]) * bound[j] + extra[i] + extra[j]
            result[k, :, 3] = stiff[i] + stiff[j] + bound[k] + own
        out[:] = gather @ result.reshape(3 * count, 4)

    return run


def compiled_library(folder: Path) -> ctypes.CDLL | None:
    """Return the C++ peer compiled into `folder`, or None where there is no compiler."""
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        return None
    target = folder / "bench_springs.so"
    source = Path(__file__).with_suffix(".cpp")
    subprocess.run([compiler, *FLAGS, str(source), "-o", str(target)], check=True)
    return ctypes.CDLL(str(target))


def cpp_program(
    library: ctypes.CDLL, in_blocks: bool, x: np.ndarray, springs: Springs, law: Law, out: np.ndarray
) -> Program:
    """Return a form of the C++ peer, bound to its arguments."""

    def address(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    numbers = [ctypes.c_double(value) for value in (law.alpha, law.s0, law.beta, law.reaction)]
    sizes = [ctypes.c_long(springs.a.size), ctypes.c_long(len(x))]
    arrays = [address(array) for array in springs[:8]]
    arguments = [ctypes.c_int(in_blocks), address(x), *arrays, *sizes, *numbers, address(out)]
    return lambda: library.elastic_force(*arguments)


def measure(programs: dict[str, Program], rounds: int, repeats: int = 5) -> dict[str, np.ndarray]:
    """Return microseconds of CPU time per call, one figure per round: the fastest of `repeats` calls in a row."""
    for program in programs.values():
        program()
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            best = np.inf
            for _ in range(repeats):
                begin = time.thread_time_ns()
                program()
                best = min(best, time.thread_time_ns() - begin)
            seconds[name].append(best * 1e-3)
    return {name: np.array(values) for name, values in seconds.items()}


def spread(values: np.ndarray) -> str:
    """Return median and quartiles as text."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"{middle:9.2f} [{low:.2f}, {high:.2f}]"


def compare_programs(library: ctypes.CDLL | None, rounds: int) -> list[dict[str, Any]]:
    """Print and return the times of all programs for all laws on 7,373 vertices."""
    points, triangles = dome(101, 73)
    springs = tables(points, triangles)
    x = points + np.random.default_rng(1).normal(0, 0.1, points.shape)
    rows = []
    print(f"{len(x)} vertices, {len(triangles)} triangles; microseconds (median [quartiles]) and ratio to the kernel")
    for law in LAWS:
        outs = {name: np.zeros((len(x), 4)) for name in ("Numba kernel", "C++ plain loop", "C++ in blocks", "NumPy")}
        programs = {"Numba kernel": numba_program(x, springs, law, outs["Numba kernel"])}
        if library is not None:
            for name, in_blocks in (("C++ plain loop", False), ("C++ in blocks", True)):
                programs[name] = cpp_program(library, in_blocks, x, springs, law, outs[name])
        programs["NumPy"] = numpy_program(x, springs, law, outs["NumPy"])
        times = measure(programs, rounds)
        print(f"alpha = {law.alpha}, beta = {law.beta}")
        for name, values in times.items():
            error = np.abs(outs[name] - outs["Numba kernel"]).max() / np.abs(outs["Numba kernel"]).max()
            ratio = values / times["Numba kernel"]
            print(f"  {name:16s}{spread(values)}   ratio {spread(ratio)}   difference {error:.1e}")
            rows.append(
                {"alpha": law.alpha, "beta": law.beta, "program": name, "microseconds": float(np.median(values)),
                 "ratio": float(np.median(ratio)), "difference": float(error)}
            )  # fmt: skip
    return rows


def compare_sizes(rounds: int) -> dict[str, Any]:
    """Print and return the cost of the patch against the full mesh, and the exponent of the cost with size."""
    full = dome(101, 73)
    cases = {"patch": patch(*full, 1048), "full": full}
    cases |= {f"{r * c}": dome(r, c) for r, c in ((60, 50), (101, 74), (170, 155), (330, 310))}
    law = LAWS[1]
    programs = {}
    for name, (points, triangles) in cases.items():
        x = points + np.random.default_rng(1).normal(0, 0.1, points.shape)
        programs[name] = numba_program(x, tables(points, triangles), law, np.zeros((len(points), 4)))
    times = measure(programs, rounds)
    share = times["full"] / times["patch"]
    print(f"full mesh / patch of 1048 vertices: {spread(share)} (vertices: {len(full[0]) / 1048:.2f})")
    sizes = np.array([int(name) for name in times if name.isdigit()])
    middle = np.array([np.median(times[str(size)]) for size in sizes])
    exponent = float(np.polyfit(np.log(sizes), np.log(middle), 1)[0])
    for size, value in zip(sizes, middle, strict=True):
        print(f"  {size:7d} vertices {value:9.1f} us   {1e3 * value / size:6.1f} ns per vertex")
    print(f"cost exponent from {sizes[0]} to {sizes[-1]} vertices: {exponent:.3f}")
    return {"full_over_patch": float(np.median(share)), "exponent": exponent, "vertices": sizes.tolist(),
            "microseconds": middle.tolist()}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the comparison and write its table if asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=60, help="rounds of measurement (default %(default)s)")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_library(Path(folder))
        if library is None:
            print("no C++ compiler found: its rows are left out")
        rows = compare_programs(library, options.rounds)
    sizes = compare_sizes(options.rounds)
    if options.output is not None:
        options.output.write_text(json.dumps({"programs": rows, "sizes": sizes}, indent=1) + "\n")


if __name__ == "__main__":
    main()
