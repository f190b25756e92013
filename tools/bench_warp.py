"""Time the warp of many vertices against the plain NumPy product in float64, in interleaved rounds.

    python tools/bench_warp.py [--rounds 60] [--vertices 28098] [--modes 31] [--nodes 1883]

Prints minimum and median time of each way to warp a mesh, and its ratio to plain NumPy in float64. Every round runs
each way once, so that a busy machine slows all of them alike. The results are checked against float64 first.

  product     u, w = P q in float64 by NumPy, nothing else         numpy    the same, then Rt(w) u by NumPy
  blocks      float32 in blocks, one thread                        blocks 2 the same, two threads
  compact     16 bits in blocks, one thread
  nodes       nodes warped in blocks, one thread, vertices as means of four nodes
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from faceanim.backends.modal_warping.display import BlockWarp
from faceanim.kernels import warp


def numpy_warp(rest: np.ndarray, flat: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the warped points by plain NumPy in float64; `flat` (6n, m), rows u then w of all points."""
    n = len(rest)
    moved = (flat @ q).reshape(2, n, 3)
    u, w = moved
    s = (w**2).sum(axis=1)
    th = np.sqrt(np.maximum(s, 1e-12))
    a, b = (1.0 - np.cos(th)) / th**2, (1.0 - np.sin(th) / th) / th**2
    once = np.cross(w, u)
    return rest + u + a[:, None] * once + b[:, None] * np.cross(w, once)


class Case:
    """Vertices with modal vectors of their own, and the same number carried by fewer nodes."""

    def __init__(self, vertices: int = 28098, modes: int = 31, nodes: int = 1883, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.rest = random.uniform(-1.0, 1.0, (vertices, 3))
        basis = random.standard_normal((vertices, 6, modes)) / np.sqrt(modes)
        self.q = 0.5 * random.standard_normal(modes)
        self.flat = np.ascontiguousarray(basis.reshape(vertices, 2, 3, modes).transpose(1, 0, 2, 3).reshape(-1, modes))
        self.one, self.two = BlockWarp(self.rest, basis), BlockWarp(self.rest, basis, threads=2)
        self.compact = BlockWarp(self.rest, basis, compact=True)
        self.nodes = BlockWarp(self.rest[:nodes], basis[:nodes])
        self.node = random.integers(0, nodes, (vertices, 4)).astype(np.int32)
        # neighbours in space are neighbours in number, as in a sorted mesh
        first = np.sort(self.node[:, :1], axis=0)
        self.node = np.ascontiguousarray(np.minimum(first + self.node % 40, nodes - 1))
        weight = random.uniform(size=(vertices, 4)).astype(np.float32)
        self.weight = weight / weight.sum(axis=1, keepdims=True)
        self.out = np.zeros((vertices, 3), np.float32)

    def by_nodes(self) -> np.ndarray:
        """Warp the nodes and carry the vertices along."""
        warp.interpolate(self.node, self.weight, self.nodes.points(self.q), 0, len(self.node), self.out)
        return self.out

    def ways(self) -> dict[str, Callable[[], Any]]:
        """Return each way by name."""
        return {
            "product": lambda: self.flat @ self.q,
            "numpy": lambda: numpy_warp(self.rest, self.flat, self.q),
            "blocks": lambda: self.one.points(self.q),
            "blocks 2": lambda: self.two.points(self.q),
            "compact": lambda: self.compact.points(self.q),
            "nodes": self.by_nodes,
        }

    def errors(self) -> tuple[float, float]:
        """Return the largest difference of float32 and of 16 bits from float64, relative to the largest displacement."""
        exact = numpy_warp(self.rest, self.flat, self.q)
        size = np.abs(exact - self.rest).max()
        one, two, compact = (np.abs(w.points(self.q) - exact).max() / size for w in (self.one, self.two, self.compact))
        return float(max(one, two)), float(compact)

    def times(self, rounds: int) -> dict[str, np.ndarray]:
        """Return the times (rounds,) [s] of each way, run in turn."""
        ways = self.ways()
        out = {name: np.zeros(rounds) for name in ways}
        for way in ways.values():
            way()
        for k in range(rounds):
            for name, way in ways.items():
                started = time.perf_counter()
                way()
                out[name][k] = time.perf_counter() - started
        return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--vertices", type=int, default=28098)
    parser.add_argument("--modes", type=int, default=31)
    parser.add_argument("--nodes", type=int, default=1883)
    chosen = parser.parse_args(arguments)
    case = Case(chosen.vertices, chosen.modes, chosen.nodes)
    single, compact = case.errors()
    print(f"{chosen.vertices} vertices, {chosen.modes} modes, {chosen.nodes} nodes")
    print(f"largest error over largest displacement: float32 {single:.1e}, 16 bits {compact:.1e}")
    times = case.times(chosen.rounds)
    least, middle = times["product"].min(), np.median(times["product"])
    print(f"{'way':<10}{'min ms':>9}{'ratio':>8}{'median ms':>11}{'ratio':>8}")
    for name, t in times.items():
        low, mid = t.min(), float(np.median(t))
        print(f"{name:<10}{1e3 * low:>9.3f}{low / least:>8.3f}{1e3 * mid:>11.3f}{mid / middle:>8.3f}")


if __name__ == "__main__":
    main()
