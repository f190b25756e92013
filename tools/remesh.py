"""Remeshing for the asset build: a surface from a signed distance grid, and its decimation by quadric errors.

Both keep a mesh mirror symmetric about x = 0 by working on the half x >= 0, whose boundary stays in that plane.
"""

from __future__ import annotations

import heapq
from typing import Any

import numba
import numpy as np

Array = np.ndarray[Any, Any]


def half_surface(values: Array, origin: Array, spacing: float) -> tuple[Array, Array]:
    """Return the zero surface of a grid on its half x >= 0, as points and triangles (dual contouring by means).

    The grid must be mirror symmetric with an even number of samples along x, so that x = 0 runs through cells.
    Each cell that the surface crosses gets one vertex, the mean of the crossings of its edges; each crossed grid edge
    gets the quad of the four cells around it.
    """
    if values.shape[0] % 2 or abs(origin[0] + 0.5 * (values.shape[0] - 1) * spacing) > 1e-9:
        raise ValueError("half_surface: the grid needs an even number of samples along x, centred on x = 0")
    cells = tuple(n - 1 for n in values.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    quads = []
    base = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in values.shape), indexing="ij"), axis=-1)
    number = np.arange(int(np.prod(cells))).reshape(cells)
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(0, -1), slice(1, None)
        a, b = values[tuple(low)], values[tuple(high)]
        crossed = (a < 0) != (b < 0)
        index = np.argwhere(crossed)
        share = a[crossed] / (a[crossed] - b[crossed])
        point = base[tuple(low)][crossed]
        point[:, axis] += share
        u, v = (axis + 1) % 3, (axis + 2) % 3
        around = []
        for du, dv in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
            cell = index.copy()
            cell[:, u] += du
            cell[:, v] += dv
            np.add.at(total, tuple(cell.T), point)
            np.add.at(count, tuple(cell.T), 1.0)
            around.append(number[tuple(cell.T)])
        quad = np.stack(around, axis=1)
        outward = a[crossed] < 0
        quads.append(np.where(outward[:, None], quad, quad[:, ::-1]))
    quad = np.vstack(quads)
    middle = cells[0] // 2
    quad = quad[(np.unravel_index(quad, cells)[0] >= middle).all(axis=1)]
    used, packed = np.unique(quad, return_inverse=True)
    points = total.reshape(-1, 3)[used] / count.reshape(-1)[used][:, None] * spacing + origin
    points[np.unravel_index(used, cells)[0] == middle, 0] = 0.0
    packed = packed.reshape(-1, 4)
    return points, np.vstack([packed[:, [0, 1, 2]], packed[:, [0, 2, 3]]]).astype(np.int64)


def mirrored(points: Array, triangles: Array) -> tuple[Array, Array, Array]:
    """Return the whole mesh of a half x >= 0: points, triangles and the mirror index of each vertex."""
    off = points[:, 0] != 0.0
    twin = np.where(off, len(points) + np.cumsum(off) - 1, np.arange(len(points)))
    whole = np.vstack([points, points[off] * [-1.0, 1.0, 1.0]])
    mirror = np.concatenate([twin, np.flatnonzero(off)])
    return whole, np.vstack([triangles, twin[triangles][:, ::-1]]), mirror


def drop_specks(points: Array, triangles: Array, smallest: int) -> tuple[Array, Array]:
    """Return the mesh without connected parts of fewer than `smallest` triangles and without unused points."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    i, j = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    _, label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (len(points),) * 2), directed=False)
    part = label[triangles[:, 0]]
    kept = triangles[np.bincount(part)[part] >= smallest]
    used, packed = np.unique(kept, return_inverse=True)
    return points[used], packed.reshape(-1, 3)


def decimate(points: Array, triangles: Array, target: int, weight: Array) -> tuple[Array, Array]:
    """Return a half mesh with `target` vertices, cheapest quadric errors first (Garland & Heckbert 1997).

    weight : (n,) how dear a deviation is at each vertex [-]. Boundary vertices (x = 0) stay in the plane.
    """
    points, triangles = points.copy(), triangles.copy()
    edge = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edge, axis=0, return_counts=True)
    border = np.zeros(len(points), dtype=np.bool_)
    border[unique[count == 1].ravel()] = True
    alive = _collapse(points, triangles, unique, border, weight, target)
    used, packed = np.unique(triangles[alive], return_inverse=True)
    return points[used], packed.reshape(-1, 3)


@numba.njit(cache=False)
def _quadric(q, points, a, b, c, w):
    n = np.cross(points[b] - points[a], points[c] - points[a])
    area = np.sqrt((n * n).sum())
    if area < 1e-12:
        return
    n = n / area
    d = -(n * points[a]).sum()
    plane = np.array([n[0], n[1], n[2], d])
    for i in range(4):
        for j in range(4):
            q[i, j] += w * area * plane[i] * plane[j]


@numba.njit(cache=False)
def _error(q, p):
    h = np.array([p[0], p[1], p[2], 1.0])
    return (h * (q @ h)).sum()


@numba.njit(cache=False)
def _best(points, quadrics, border, a, b):
    """Cost and place of collapsing the edge (a, b): one end or the middle, on the boundary if one end is."""
    q = quadrics[a] + quadrics[b]
    best, place = np.inf, points[a].copy()
    for k in range(3):
        p = points[a] if k == 0 else (points[b] if k == 1 else 0.5 * (points[a] + points[b]))
        if border[a] != border[b] and not ((k == 0 and border[a]) or (k == 1 and border[b])):
            continue
        e = _error(q, p) + 1e-6 * ((points[a] - points[b]) ** 2).sum()
        if e < best:
            best, place = e, p.copy()
    return best, place


@numba.njit(cache=False)
def _ring(head, follow, triangles, alive, v, out):
    n = 0
    corner = head[v]
    while corner >= 0:
        t = corner // 3
        if alive[t]:
            for k in range(3):
                w = triangles[t, k]
                if w != v:
                    known = False
                    for m in range(n):
                        known = known or out[m] == w
                    if not known and n < len(out):
                        out[n] = w
                        n += 1
        corner = follow[corner]
    return n


@numba.njit(cache=False)
def _flips(points, triangles, alive, head, follow, v, other, place):
    corner = head[v]
    while corner >= 0:
        t = corner // 3
        if alive[t] and not (triangles[t] == other).any():
            k = corner % 3
            b, c = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
            old = np.cross(points[b] - points[v], points[c] - points[v])
            new = np.cross(points[b] - place, points[c] - place)
            lo, ln = np.sqrt((old * old).sum()), np.sqrt((new * new).sum())
            longest = max(((points[b] - place) ** 2).sum(), ((points[c] - place) ** 2).sum())
            longest = max(longest, ((points[b] - points[c]) ** 2).sum())
            if ln < 0.06 * longest or (old * new).sum() < 0.3 * lo * ln:
                return True
        corner = follow[corner]
    return False


@numba.njit(cache=False)
def _collapse(points, triangles, edges, border, weight, target):
    n, m = len(points), len(triangles)
    quadrics = np.zeros((n, 4, 4))
    head, follow = np.full(n, -1), np.full(3 * m, -1)
    alive = np.ones(m, dtype=np.bool_)
    for t in range(m):
        for k in range(3):
            v = triangles[t, k]
            _quadric(quadrics[v], points, triangles[t, 0], triangles[t, 1], triangles[t, 2], weight[v])
            follow[3 * t + k] = head[v]
            head[v] = 3 * t + k
    stamp = np.zeros(n, dtype=np.int64)
    heap = [(0.0, 0, 0, 0) for _ in range(0)]
    for e in range(len(edges)):
        a, b = edges[e]
        heap.append((_best(points, quadrics, border, a, b)[0], a, b, 0))
    heapq.heapify(heap)
    left = n
    ring_a, ring_b = np.empty(256, dtype=np.int64), np.empty(256, dtype=np.int64)
    while left > target and len(heap) > 0:
        _cost, a, b, s = heapq.heappop(heap)
        if stamp[a] < 0 or stamp[b] < 0 or stamp[a] + stamp[b] != s:
            continue
        na = _ring(head, follow, triangles, alive, a, ring_a)
        nb = _ring(head, follow, triangles, alive, b, ring_b)
        common = 0
        for i in range(na):
            for j in range(nb):
                common += ring_a[i] == ring_b[j]
        if common != (1 if border[a] and border[b] else 2):
            continue
        place = _best(points, quadrics, border, a, b)[1]
        if _flips(points, triangles, alive, head, follow, a, b, place):
            continue
        if _flips(points, triangles, alive, head, follow, b, a, place):
            continue
        corner, last = head[b], -1
        while corner >= 0:
            t = corner // 3
            if alive[t]:
                if (triangles[t] == a).any():
                    alive[t] = False
                triangles[t, corner % 3] = a
            last = corner
            corner = follow[corner]
        if last >= 0:
            follow[last] = head[a]
            head[a] = head[b]
        points[a] = place
        quadrics[a] += quadrics[b]
        border[a] = border[a] or border[b]
        stamp[a] += stamp[b] + 1
        stamp[b] = -1
        left -= 1
        na = _ring(head, follow, triangles, alive, a, ring_a)
        for i in range(na):
            w = ring_a[i]
            low, high = min(a, w), max(a, w)
            heapq.heappush(heap, (_best(points, quadrics, border, low, high)[0], low, high, stamp[a] + stamp[w]))
    return alive
