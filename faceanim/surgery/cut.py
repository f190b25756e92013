"""Cutting closed surfaces along planes: both sides stay closed, and their volumes add up to the whole."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError

_WELD = 1e-9
"""Points nearer than this in each coordinate are one [mm]."""


def volume(mesh: TriMesh) -> float:
    """Return the volume that a closed surface encloses [mm^3]."""
    corner = mesh.points[mesh.triangles]
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0)


def is_closed(mesh: TriMesh) -> bool:
    """Whether every edge is run through as often one way as the other."""
    start, end = mesh.triangles.ravel().astype(np.int64), np.roll(mesh.triangles, -1, axis=1).ravel().astype(np.int64)
    n = len(mesh.points)
    key, place = np.unique(np.concatenate([start * n + end, end * n + start]), return_inverse=True)
    sign = np.repeat([1.0, -1.0], len(start))
    return not np.bincount(place, sign, len(key)).any()


def centroid(mesh: TriMesh) -> Floats:
    """Return the centre of the volume that a closed surface encloses, (3,) [mm]."""
    middle = mesh.points.mean(axis=0)
    corner = mesh.points[mesh.triangles] - middle
    part = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0
    return np.asarray(middle + (part[:, None] * corner.sum(axis=1)).sum(axis=0) / (4.0 * part.sum()))


def welded(points: Floats, triangles: Ints) -> TriMesh:
    """Return a surface whose equal points are one; flat triangles that arise from it are left out."""
    _, first, index = np.unique(np.round(points / _WELD), axis=0, return_index=True, return_inverse=True)
    corners = index.reshape(-1)[triangles].reshape(-1, 3)
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    used, corners = np.unique(corners, return_inverse=True)
    return TriMesh(points[first][used].reshape(-1, 3), corners.reshape(-1, 3).astype(np.int32))


def joined(meshes: Sequence[TriMesh]) -> TriMesh:
    """Return several surfaces as one; walls where two of them lie back to back vanish."""
    if not meshes:
        return TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    start = np.cumsum([0] + [len(m.points) for m in meshes])
    points = np.concatenate([m.points for m in meshes])
    mesh = welded(points, np.concatenate([m.triangles + s for m, s in zip(meshes, start, strict=False)]))
    if not len(mesh.triangles):
        return mesh
    turned = np.sort(mesh.triangles, axis=1)
    _, place = np.unique(turned, axis=0, return_inverse=True)
    place = place.reshape(-1)
    a, b, c = mesh.triangles.T
    even = ((a < b).astype(int) + (b < c) + (c < a)) == 2
    balance = np.bincount(place, np.where(even, 1.0, -1.0))[place]
    keep = np.zeros(len(even), dtype=bool)
    for sign in (True, False):  # of each set of equal triangles, as many as one way of turning is ahead of the other
        wanted = np.flatnonzero((even == sign) & ((balance > 0) == sign) & (balance != 0))
        order = wanted[np.argsort(place[wanted], kind="stable")]
        _, first, count = np.unique(place[order], return_index=True, return_counts=True)
        rank = np.arange(len(order)) - np.repeat(first, count)
        keep[order[rank < np.abs(balance[order])]] = True
    return welded(mesh.points, mesh.triangles[keep])


def parts(mesh: TriMesh) -> list[TriMesh]:
    """Return the parts of a surface that do not hang together, the largest volume first."""
    label = part_labels(mesh)
    found = [welded(mesh.points, mesh.triangles[label == k]) for k in range(int(label.max(initial=-1)) + 1)]
    return sorted(found, key=volume, reverse=True)


def part_labels(mesh: TriMesh) -> Ints:
    """Return the connected part to which each triangle belongs, (t,)."""
    n, t = len(mesh.points), mesh.triangles
    if not len(t):
        return np.zeros(0, dtype=np.int32)
    rows = np.concatenate([t[:, 0], t[:, 1]])
    links = sparse.coo_matrix((np.ones(len(rows)), (rows, np.concatenate([t[:, 1], t[:, 2]]))), shape=(n, n))
    _, label = connected_components(links, directed=False)
    return np.unique(label[t[:, 0]], return_inverse=True)[1].astype(np.int32)


def split(mesh: TriMesh, point: Floats, normal: Floats) -> tuple[TriMesh, TriMesh]:
    """Return what lies on the side of a plane to which `normal` points and what lies on the other, open at the cut.

    A triangle across the plane is divided in a way that depends on its corners alone, so walls that lie back to back
    stay so.
    """
    height = (mesh.points - point) @ normal
    above = height >= 0.0
    side = above[mesh.triangles]
    count = side.sum(axis=1)
    crossing = mesh.triangles[(count > 0) & (count < 3)]
    crossing_above = above[crossing]
    lone_above = crossing_above.sum(axis=1) == 1
    lone = np.argmax(crossing_above == lone_above[:, None], axis=1)
    a, b, c = (crossing[np.arange(len(crossing)), (lone + k) % 3] for k in range(3))
    edge, where = np.unique(np.sort(np.stack([a, b, a, c], axis=1).reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    new = _crossings(mesh.points, height, edge)
    points = np.concatenate([mesh.points, new])
    p, q = (len(mesh.points) + where.reshape(-1, 2)).T
    tip = np.stack([a, p, q], axis=1)
    by_p = _before(points[p], points[q])[:, None]
    first = np.where(by_p, np.stack([p, b, c], axis=1), np.stack([p, b, q], axis=1))
    second = np.where(by_p, np.stack([p, c, q], axis=1), np.stack([q, b, c], axis=1))
    out = []
    for upper in (True, False):
        whole = mesh.triangles[count == (3 if upper else 0)]
        tips, quads = lone_above == upper, lone_above != upper
        rows = np.concatenate([whole, tip[tips], first[quads], second[quads]])
        out.append(welded(points, rows))
    return out[0], out[1]


def _crossings(points: Floats, height: Floats, edge: Ints) -> Floats:
    """Return where the edges (k, 2) meet height zero; the same for an edge met in either direction."""
    i, j = edge.T
    swap = _before(points[j], points[i])
    i, j = np.where(swap, j, i), np.where(swap, i, j)
    share = height[i] / (height[i] - height[j])
    return np.asarray(points[i] + share[:, None] * (points[j] - points[i]))


def _before(p: Floats, q: Floats) -> Bools:
    """Whether `p` (k, 3) comes before `q` in the order of x, then y, then z, (k,)."""
    equal_x, equal_y = p[:, 0] == q[:, 0], p[:, 1] == q[:, 1]
    return np.asarray((p[:, 0] < q[:, 0]) | (equal_x & ((p[:, 1] < q[:, 1]) | (equal_y & (p[:, 2] < q[:, 2])))))


def halves(mesh: TriMesh, point: Floats, normal: Floats) -> tuple[TriMesh, TriMesh]:
    """Return both sides of a closed surface as closed surfaces: first that to which `normal` points.

    The two share the wall along the cut, point by point; where the plane misses, one of them is empty.
    """
    above, below = split(mesh, point, normal)
    if not len(above.triangles) or not len(below.triangles):
        return above, below
    lid = _lid(above, normal)
    return (
        _covered(above, lid),
        _covered(below, lid[:, [0, 2, 1]]),
    )


def _covered(mesh: TriMesh, lid: Floats) -> TriMesh:
    """Return an open surface with the triangles of `lid` (k, 3, 3) added."""
    n = len(mesh.points)
    corners = np.arange(lid.size // 3, dtype=np.int32).reshape(-1, 3) + n
    return welded(np.concatenate([mesh.points, lid.reshape(-1, 3)]), np.concatenate([mesh.triangles, corners]))


def _lid(mesh: TriMesh, normal: Floats) -> Floats:
    """Return triangles (k, 3, 3) that close the border of `mesh`, which lies in a plane; they look against `normal`."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    second = np.cross(first, normal)  # counter-clockwise in (first, second) looks against the normal
    flat = np.stack([mesh.points @ first, mesh.points @ second], axis=1)
    rings = [np.array(ring) for ring in _rings(mesh)]
    rows = []
    for polygon in _with_holes(flat, rings):
        rows += _ears(flat[polygon], polygon)
    return mesh.points[np.array(rows, dtype=np.int64).reshape(-1, 3)]


def _rings(mesh: TriMesh) -> list[list[int]]:
    """Return the closed chains of edges that a lid must have, as vertices in order."""
    n = len(mesh.points)
    start, end = mesh.triangles.ravel().astype(np.int64), np.roll(mesh.triangles, -1, axis=1).ravel().astype(np.int64)
    key, place = np.unique(np.concatenate([start * n + end, end * n + start]), return_inverse=True)
    balance = np.bincount(place, np.repeat([1.0, -1.0], len(start)), len(key)).astype(int)
    onward: dict[int, list[int]] = {}
    for code, times in zip(key[balance > 0].tolist(), balance[balance > 0].tolist(), strict=True):
        onward.setdefault(code % n, []).extend([code // n] * times)
    rings = []
    for seed in list(onward):
        while onward.get(seed):
            chain, at = [seed], onward[seed].pop()
            while at != seed:
                if at in chain:  # a ring that touches itself falls into two
                    k = chain.index(at)
                    rings.append(chain[k:])
                    chain = chain[:k]
                chain.append(at)
                at = onward[at].pop()
            rings.append(chain)
    return [ring for ring in rings if len(ring) > 2]


def _area(ring: Floats) -> float:
    following = np.roll(ring, -1, axis=0)
    return 0.5 * float((ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum())


def _inside(point: Floats, ring: Floats) -> bool:
    a, b = ring, np.roll(ring, -1, axis=0)
    across = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (point[1] - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return bool((across & (x > point[0])).sum() % 2)


def _with_holes(flat: Floats, rings: Iterable[Ints]) -> list[list[int]]:
    """Return polygons without holes: each hole is joined to the outline around it by a bridge, run through twice."""
    rings = list(rings)
    areas = [_area(flat[ring]) for ring in rings]
    outer = [(area, ring.tolist()) for area, ring in zip(areas, rings, strict=True) if area >= 0.0]
    owned: dict[int, list[Ints]] = {}
    for area, ring in zip(areas, rings, strict=True):
        if area >= 0.0:
            continue
        around = [
            k for k, (size, ring_out) in enumerate(outer) if size > -area and _inside(flat[ring[0]], flat[ring_out])
        ]
        if around:
            owned.setdefault(min(around, key=lambda k: outer[k][0]), []).append(ring)
        else:
            outer.append((area, ring.tolist()))
    polygons = []
    for k, (_, polygon) in enumerate(outer):
        for hole in sorted(owned.get(k, ()), key=lambda ring: -float(flat[ring, 0].max())):
            polygon = _bridged(flat, polygon, hole)
        polygons.append(polygon)
    return polygons


def _bridged(flat: Floats, polygon: list[int], hole: Ints) -> list[int]:
    """Return the polygon with a hole cut open to it along the shortest line that crosses neither."""
    start = int(np.argmax(flat[hole, 0]))
    ring = np.roll(hole, -start)
    tip = flat[ring[0]]
    loop = flat[polygon]
    order = np.argsort(((loop - tip) ** 2).sum(axis=1), kind="stable")
    ends = np.concatenate([loop, flat[ring]]), np.concatenate([np.roll(loop, -1, axis=0), flat[np.roll(ring, -1)]])
    best = next((int(k) for k in order if not _crosses(tip, loop[k], *ends).any()), int(order[0]))
    return [*polygon[: best + 1], *ring.tolist(), int(ring[0]), *polygon[best:]]


def _crosses(p: Floats, q: Floats, a: Floats, b: Floats) -> Bools:
    """Whether the line from `p` to `q` properly crosses those from `a` (k, 2) to `b`."""
    sides = _turn(p, q, a) * _turn(p, q, b) < 0.0
    return np.asarray(sides & (_turn(a, b, p) * _turn(a, b, q) < 0.0))


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    ab, ac = b - a, c - a
    return np.asarray(ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0])


def _ears(flat: Floats, polygon: list[int]) -> list[tuple[int, int, int]]:
    """Return triangles that fill a polygon, given by its plane points (m, 2) in order, by cutting off ears.

    Of all ears the best shaped goes first. If none is left (a section that crosses itself), the corner that turns
    least is cut: the lid then folds, but still closes.
    """
    left = list(range(len(polygon)))
    out = []
    while len(left) > 3:
        ring = flat[left]
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        turn = _turn(before, ring, after)
        longest = (
            ((after - before) ** 2).sum(axis=1) + ((ring - before) ** 2).sum(axis=1) + ((after - ring) ** 2).sum(axis=1)
        )
        shape = turn / np.maximum(longest, 1e-30)
        order = np.argsort(-shape, kind="stable")
        chosen = next((int(k) for k in order if shape[k] > 1e-12 and _is_ear(ring, int(k))), None)
        if chosen is None:
            chosen = int(np.argmin(np.abs(turn)))
        m = len(left)
        out.append((polygon[left[chosen - 1]], polygon[left[chosen]], polygon[left[(chosen + 1) % m]]))
        del left[chosen]
    out.append((polygon[left[0]], polygon[left[1]], polygon[left[2]]))
    return out


def _is_ear(ring: Floats, k: int) -> bool:
    """Whether no corner of the polygon lies in the triangle at its corner `k`; corners of equal place do not count."""
    a, b, c = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
    inside = (_turn(a, b, ring) >= 0.0) & (_turn(b, c, ring) >= 0.0) & (_turn(c, a, ring) >= 0.0)
    own = (ring == a).all(axis=1) | (ring == b).all(axis=1) | (ring == c).all(axis=1)
    return not bool((inside & ~own).any())


def cut_out(
    mesh: TriMesh, planes: Sequence[tuple[str, Floats, Floats]], what: str, *, largest: bool = False
) -> tuple[TriMesh, TriMesh]:
    """Return what of a closed surface lies within all `planes`, and the rest, both closed.

    planes : (words that name it, point (3,), normal (3,) into the piece)   what : names piece and bone in errors
    largest : of what is cut out take only the largest part that hangs together
    Raises `UserError` if the piece is empty or the whole bone, naming the plane that misses.
    """
    piece = mesh
    off: list[TriMesh] = []
    for name, point, normal in planes:
        height = (piece.points - point) @ normal
        inside, outside = halves(piece, point, normal)
        if not len(inside.triangles):
            raise UserError(
                f"{what}: {name} leaves nothing: what the cuts before it left ends {-float(height.max()):.1f} mm "
                "short of it; move the plane or turn its normal round"
            )
        off = [joined(split(o, point, normal)) for o in off]
        if len(outside.triangles):
            off.append(outside)
        piece = inside
    if not off:
        names = ", ".join(name.rstrip(",") for name, _, _ in planes)
        raise UserError(f"{what}: it is the whole bone, since {names} cut nothing off; move a plane through the bone")
    if largest:
        found = parts(piece)
        piece = found[0]
        off += found[1:]
    return piece, joined(off)
