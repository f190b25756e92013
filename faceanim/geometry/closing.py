"""Open surfaces made closed, so that they have an inside: each rim gets a strip between its two sides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints, ints
from faceanim.ground.errors import UserError

FLIPS = 20
"""Rounds in which flat triangles are flipped away at most."""


def closed(surface: TriMesh) -> TriMesh:
    """Return `surface` with a strip of triangles across every rim, from one end of the rim to the other.

    Vertices at the same place count as one. A rim may be bent to a horseshoe, as that of the gums is: the strip goes
    along it. Raises `UserError` for a rim that does not run round, as where parts touch at a single vertex.
    """
    points, index = np.unique(surface.points, axis=0, return_inverse=True)
    triangles = index.reshape(-1)[surface.triangles].astype(np.int32)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    strips = [strip(points, rim) for rim in rims(triangles)]
    return TriMesh(points, np.ascontiguousarray(np.concatenate([triangles, *strips])))


def rims(triangles: Ints) -> list[Ints]:
    """Return the vertices along each rim of `triangles` (t, 3), in the direction of their own edges."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    span = int(edges.max(initial=0)) + 1
    loose = ~np.isin(edges[:, 0] * span + edges[:, 1], edges[:, 1] * span + edges[:, 0])
    following = dict(edges[loose].tolist())
    if len(following) != loose.sum():
        raise UserError("a rim of the surface passes twice through a vertex; take its parts one by one")
    out = []
    while following:
        start, after = following.popitem()
        rim = [start]
        while after != start:
            if after not in following:
                raise UserError(f"a rim of the surface ends at vertex {after}; orient its triangles alike")
            rim.append(after)
            after = following.pop(after)
        out.append(ints("rim", np.array(rim), None))
    return out


def strip(points: Floats, rim: Ints) -> Ints:
    """Return triangles (r - 2, 3) that close a `rim` (r,): both ways from one end, by the shorter crossing each time.

    An end is the vertex farthest from the rim's middle.
    """
    place = points[rim]
    first = int(np.argmax(np.linalg.norm(place - place.mean(axis=0), axis=1)))
    rim = np.roll(rim, -first)
    i, j, r = 0, 0, len(rim)
    out = []
    while i + j < r - 1:
        here, there = rim[i], rim[-j % r]
        ahead, behind = rim[i + 1], rim[(-j - 1) % r]
        across = np.linalg.norm(points[ahead] - points[there]), np.linalg.norm(points[here] - points[behind])
        if here == there:
            i += 1
        elif across[0] <= across[1]:
            out.append((ahead, here, there))
            i += 1
        else:
            out.append((there, behind, here))
            j += 1
    return np.array([row for row in out if len(set(row)) == 3], dtype=np.int32).reshape(-1, 3)


def unfolded(surface: TriMesh, smallest_height: float = 1e-5) -> TriMesh:
    """Return a closed `surface` without flat triangles, such as cuts leave: the longest side of each is flipped.

    A flat triangle has a corner on its longest side; the triangle beyond that side is divided there instead.
    """
    triangles = surface.triangles.copy()
    points = surface.points
    for _ in range(FLIPS):
        flat = np.flatnonzero(
            TriMesh(points, triangles).heights.reshape(len(triangles), -1).min(axis=1) < smallest_height
        )
        if not len(flat):
            break
        done: set[int] = set()
        for t in flat.tolist():
            corner = points[triangles[t]]
            k = int(np.argmax(np.linalg.norm(np.roll(corner, -1, axis=0) - corner, axis=1)))
            a, c, b = np.roll(triangles[t], -k)
            beyond = np.flatnonzero((triangles == c).any(axis=1) & (triangles == a).any(axis=1))
            other = [s for s in beyond.tolist() if s != t and _follows(triangles[s], c, a)]
            if t in done or not other or other[0] in done:
                continue
            d = next(v for v in triangles[other[0]] if v not in (a, c))
            triangles[t], triangles[other[0]] = (a, d, b), (d, c, b)
            done |= {t, other[0]}
    a, b, c = triangles.T
    return TriMesh(points, np.ascontiguousarray(triangles[(a != b) & (b != c) & (c != a)]))


def _follows(triangle: Ints, one: int, next_one: int) -> bool:
    """Whether the side from vertex `one` to `next_one` is one of the triangle's, in that direction."""
    return any(triangle[k] == one and triangle[(k + 1) % 3] == next_one for k in range(3))


def together(surfaces: Sequence[TriMesh]) -> TriMesh:
    """Return several surfaces as one, each made `closed` and `unfolded`; they may overlap, as a tooth and its bone do."""
    made = [unfolded(closed(surface)) for surface in surfaces]
    start = np.cumsum([0, *(len(m.points) for m in made)])
    triangles = [m.triangles + s for m, s in zip(made, start, strict=False)]
    return TriMesh(
        np.concatenate([m.points for m in made]),
        np.ascontiguousarray(np.concatenate(triangles), dtype=np.int32),
    )
