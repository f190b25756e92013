"""Who is whose neighbour in a triangle mesh: edges, incident triangles, breadth-first waves, colouring."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError


class Lists(NamedTuple):
    """Ragged lists: those of item i are `item[start[i]:start[i + 1]]`."""

    start: Ints
    item: Ints

    def of(self, i: int) -> Ints:
        """Return the list of item `i`."""
        return self.item[self.start[i] : self.start[i + 1]]


def grouped(owner: Ints, item: Ints, n: int) -> Lists:
    """Return for each of `n` owners its items, in the order given; `owner` and `item` are (k,)."""
    order = np.argsort(owner, kind="stable")
    start = np.zeros(n + 1, dtype=np.int32)
    np.cumsum(np.bincount(owner, minlength=n), out=start[1:])
    return Lists(start, np.ascontiguousarray(np.asarray(item, dtype=np.int32)[order]))


def edges(triangles: Ints) -> Ints:
    """Return every edge once, (e, 2) with the smaller index first, sorted."""
    pairs = np.concatenate([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]])
    return np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int32)


def edge_of_corner(triangles: Ints) -> tuple[Ints, Ints]:
    """Return the edges and, (t, 3), which of them lies opposite each corner."""
    pairs = np.stack([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]], axis=1)
    unique, index = np.unique(np.sort(pairs.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    return unique.astype(np.int32), index.reshape(-1, 3).astype(np.int32)


def vertex_triangles(triangles: Ints, n: int) -> Lists:
    """Return the triangles at each of `n` vertices, in increasing order."""
    return grouped(triangles.ravel(), np.repeat(np.arange(len(triangles)), 3), n)


def neighbours(triangles: Ints, n: int) -> Lists:
    """Return the vertices that share an edge with each of `n` vertices, in increasing order."""
    e = edges(triangles)
    both = np.concatenate([e, e[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    return grouped(both[:, 0], both[:, 1], n)


def waves(adjacent: Lists, seed: Bools, allowed: Bools | None = None) -> Ints:
    """Return the breadth-first distance [edges] of each vertex from the `seed` vertices, (n,); -1 = not reached.

    Only vertices in `allowed` are entered (seeds always count as reached, with 0).
    """
    n = len(adjacent.start) - 1
    if seed.shape != (n,):
        raise UserError(f"seed has shape {seed.shape}; ({n},) is needed")
    distance = np.where(seed, 0, -1).astype(np.int32)
    front = np.flatnonzero(seed)
    step = 0
    while front.size:
        step += 1
        near = np.unique(np.concatenate([adjacent.of(int(i)) for i in front]))
        near = near[distance[near] < 0]
        front = near if allowed is None else near[allowed[near]]
        distance[front] = step
    return distance


def colours(adjacent: Lists) -> Ints:
    """Return a colour per vertex such that no two neighbours share one, (n,): greedy, in index order."""
    n = len(adjacent.start) - 1
    out = np.full(n, -1, dtype=np.int32)
    for i in range(n):
        taken = set(out[adjacent.of(i)].tolist())
        colour = 0
        while colour in taken:
            colour += 1
        out[i] = colour
    return out


def mirror_images(points: Floats) -> Ints | None:
    """Return the vertex at the mirror image (x -> -x) of each of `points` (n, 3), or None if some image is no vertex."""
    if not len(points):
        return None
    distance, image = cKDTree(points).query(points * [-1.0, 1.0, 1.0])
    paired = np.array_equal(image[image], np.arange(len(points)))
    return image.astype(np.int32) if paired and distance.max() < 1e-6 else None
