"""Catmull-Clark subdivision as sparse matrices, and symmetric mixed refinement of a quad mesh.

Every level keeps the vertices of the level before as its first vertices, and positions are always taken on the
limit surface. A coarse, a mixed and a fine mesh built here therefore share their common vertices exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp


@dataclass(frozen=True)
class QuadMesh:
    """Quads and the edge tables subdivision needs.

    faces : (f, 4); edges : (e, 2) sorted pairs; face_edges : (f, 4), edge k joins corners k and k+1.
    """

    n_points: int
    faces: np.ndarray
    edges: np.ndarray
    face_edges: np.ndarray
    boundary: np.ndarray

    @staticmethod
    def build(faces: np.ndarray, n_points: int) -> QuadMesh:
        pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        edges, inverse, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        if count.max() > 2:
            raise ValueError(f"{int((count > 2).sum())} edges have more than two faces")
        return QuadMesh(n_points, faces, edges, inverse.reshape(faces.shape), count == 1)


def _stencil(
    rows: list[np.ndarray], cols: list[np.ndarray], vals: list[np.ndarray], shape: tuple[int, int]
) -> sp.csr_matrix:
    return sp.csr_matrix((np.concatenate(vals), (np.concatenate(rows), np.concatenate(cols))), shape=shape)


def _incidence(mesh: QuadMesh) -> tuple[sp.csr_matrix, sp.csr_matrix, sp.csr_matrix]:
    """Face averages (f, n), edge midpoints (e, n) and vertex-face incidence (n, f)."""
    n, f, e = mesh.n_points, len(mesh.faces), len(mesh.edges)
    face = _stencil([np.repeat(np.arange(f), 4)], [mesh.faces.ravel()], [np.full(4 * f, 0.25)], (f, n))
    mid = _stencil([np.repeat(np.arange(e), 2)], [mesh.edges.ravel()], [np.full(2 * e, 0.5)], (e, n))
    corner = sp.csr_matrix((np.ones(4 * f), (mesh.faces.ravel(), np.repeat(np.arange(f), 4))), shape=(n, f))
    return face, mid, corner


def _boundary_rule(mesh: QuadMesh, weight: float) -> sp.csr_matrix:
    """Rows of boundary vertices: `1 - 2 weight` of itself and `weight` of both boundary neighbours."""
    edges = mesh.edges[mesh.boundary]
    rows = np.concatenate([edges[:, 0], edges[:, 1]])
    cols = np.concatenate([edges[:, 1], edges[:, 0]])
    on = np.unique(rows)
    return _stencil(
        [rows, on], [cols, on], [np.full(len(rows), weight), np.full(len(on), 1 - 2 * weight)], (mesh.n_points,) * 2
    )


def subdivision(mesh: QuadMesh) -> tuple[sp.csr_matrix, QuadMesh]:
    """One Catmull-Clark step: matrix (n + e + f, n) and the new mesh (vertex, edge, then face points)."""
    n, f, e = mesh.n_points, len(mesh.faces), len(mesh.edges)
    face, mid, corner = _incidence(mesh)
    inner = sp.diags((~mesh.boundary).astype(float))
    edge_face = sp.csr_matrix(
        (np.full(4 * f, 0.5), (mesh.face_edges.ravel(), np.repeat(np.arange(f), 4))), shape=(e, f)
    )
    edge = mid - 0.5 * (inner @ mid) + 0.5 * (inner @ (edge_face @ face))
    end = sp.csr_matrix((np.ones(2 * e), (mesh.edges.ravel(), np.repeat(np.arange(e), 2))), shape=(n, e))
    valence = np.asarray(end.sum(axis=1)).ravel()
    on_boundary = np.zeros(n, bool)
    on_boundary[mesh.edges[mesh.boundary].ravel()] = True
    free = sp.diags(np.where(on_boundary, 0.0, 1.0 / valence))
    mean_face = sp.diags(1.0 / valence) @ corner @ face
    mean_mid = sp.diags(1.0 / valence) @ end @ mid
    vertex = free @ (mean_face + 2 * mean_mid + sp.diags(valence - 3.0)) + _boundary_rule(mesh, 1 / 8)
    k = np.arange(4)
    vp, ep, fp = mesh.faces[:, k], n + mesh.face_edges[:, k], n + e + np.arange(f)
    quads = np.stack([vp, ep, np.repeat(fp[:, None], 4, axis=1), np.roll(ep, 1, axis=1)], axis=2).reshape(-1, 4)
    return sp.vstack([vertex, edge, face]).tocsr(), QuadMesh.build(quads, n + e + f)


def limit(mesh: QuadMesh) -> sp.csr_matrix:
    """Positions of the vertices on the limit surface of Catmull-Clark, matrix (n, n)."""
    n, e = mesh.n_points, len(mesh.edges)
    rows = np.concatenate([mesh.edges[:, 0], mesh.edges[:, 1]])
    cols = np.concatenate([mesh.edges[:, 1], mesh.edges[:, 0]])
    adjacent = sp.csr_matrix((np.ones(2 * e), (rows, cols)), shape=(n, n))
    opposite = sp.csr_matrix(
        (np.ones(mesh.faces.size), (mesh.faces.ravel(), np.roll(mesh.faces, 2, axis=1).ravel())), shape=(n, n)
    )
    valence = np.asarray(adjacent.sum(axis=1)).ravel()
    on_boundary = np.zeros(n, bool)
    on_boundary[mesh.edges[mesh.boundary].ravel()] = True
    free = sp.diags(np.where(on_boundary, 0.0, 1.0 / (valence * (valence + 5))))
    return (free @ (sp.diags(valence**2) + 4 * adjacent + opposite) + _boundary_rule(mesh, 1 / 6)).tocsr()


def bilinear(mesh: QuadMesh) -> sp.csr_matrix:
    """Plain averages at edge and face points, (n + e + f, n): for labels and coordinates that must not be smoothed."""
    face, mid, _ = _incidence(mesh)
    return sp.vstack([sp.identity(mesh.n_points), mid, face]).tocsr()


def subdivide_corners(uv: np.ndarray, uv_faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texture corners of a subdivided mesh, in the quad order of `subdivision`: uv (m, 2), uv_faces (4 f, 4)."""
    mesh = QuadMesh.build(uv_faces, len(uv))
    step = bilinear(mesh)
    _, fine = subdivision(mesh)
    return step @ uv, fine.faces


def _cost(points: np.ndarray, normal: np.ndarray, a: int, b: int, c: int) -> float:
    """Shape cost of a triangle: 1 when equilateral, large when thin, very large when folded against `normal`."""
    u, v, w = points[b] - points[a], points[c] - points[a], points[c] - points[b]
    cross = np.cross(u, v)
    double_area = float(np.sqrt(cross @ cross)) + 1e-12
    ratio = float(max(u @ u, v @ v, w @ w)) / (1.1547 * double_area)
    turn = float(cross @ normal) / double_area
    return ratio**2 + (0.0 if turn > 0.5 else 50.0 * (0.5 - turn) + 5.0)


def triangulate(points: np.ndarray) -> list[tuple[int, int, int]]:
    """Best triangulation of a small polygon in space by dynamic programming: corner triples in its own order."""
    n = len(points)
    centre = points.mean(axis=0)
    normal = np.cross(points - centre, np.roll(points, -1, axis=0) - centre).sum(axis=0)
    normal /= np.linalg.norm(normal) + 1e-12
    best = np.zeros((n, n))
    split = np.zeros((n, n), int)
    for span in range(2, n):
        for i in range(n - span):
            j = i + span
            costs = [best[i, k] + best[k, j] + _cost(points, normal, i, k, j) for k in range(i + 1, j)]
            split[i, j] = i + 1 + int(np.argmin(costs))
            best[i, j] = min(costs)
    out: list[tuple[int, int, int]] = []
    stack = [(0, n - 1)]
    while stack:
        i, j = stack.pop()
        if j - i >= 2:
            k = int(split[i, j])
            out.append((i, k, j))
            stack += [(i, k), (k, j)]
    return out


def mixed_triangles(
    mesh: QuadMesh, selected: np.ndarray, points: np.ndarray, mirror_face: np.ndarray, corners: tuple[np.ndarray, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Conforming triangles with the `selected` quads split in four and the others cut where a neighbour is split.

    points : (n + e + f, 3) positions of vertices, edge and face points.
    mirror_face : (f,) index of the mirrored quad; only the quad of lower index is triangulated, the other copies it.
    corners : texture faces (f, 4) and the number of texture points; texture indices follow the same numbering.
    Returns triangles (t, 3) and texture triangles (t, 3) in the numbering of the subdivided mesh.
    """
    uv_mesh = QuadMesh.build(corners[0], corners[1])
    split_edge = np.zeros(len(mesh.edges), bool)
    split_edge[mesh.face_edges[selected].ravel()] = True
    n, e = mesh.n_points, len(mesh.edges)
    m, ue = uv_mesh.n_points, len(uv_mesh.edges)
    triangles: list[list[int]] = []
    uv_triangles: list[list[int]] = []
    for f in range(len(mesh.faces)):
        if mirror_face[f] < f:
            continue
        polygons, uv_polygons = _polygons(mesh, uv_mesh, f, bool(selected[f]), split_edge, (n, e, m, ue))
        g = int(mirror_face[f])
        twin, uv_twin = _polygons(mesh, uv_mesh, g, bool(selected[g]), split_edge, (n, e, m, ue))
        for poly, uv_poly, pair in zip(polygons, uv_polygons, _match(polygons, twin, uv_twin, points)):
            for a, b, c in triangulate(points[poly]):
                triangles += [[poly[a], poly[b], poly[c]], [pair[0][a], pair[0][c], pair[0][b]]]
                uv_triangles += [[uv_poly[a], uv_poly[b], uv_poly[c]], [pair[1][a], pair[1][c], pair[1][b]]]
    return np.array(triangles), np.array(uv_triangles)


def _polygons(
    mesh: QuadMesh, uv_mesh: QuadMesh, f: int, split: bool, split_edge: np.ndarray, size: tuple[int, int, int, int]
) -> tuple[list[list[int]], list[list[int]]]:
    """Polygons a quad falls into and their texture corners: four quads, or one polygon with its split edges."""
    n, e, m, ue = size
    v, d, t, td = mesh.faces[f], mesh.face_edges[f], uv_mesh.faces[f], uv_mesh.face_edges[f]
    if split:
        quads = [[v[k], n + d[k], n + e + f, n + d[k - 1]] for k in range(4)]
        uv_quads = [[t[k], m + td[k], m + ue + f, m + td[k - 1]] for k in range(4)]
        return [[int(i) for i in q] for q in quads], [[int(i) for i in q] for q in uv_quads]
    poly: list[int] = []
    uv_poly: list[int] = []
    for k in range(4):
        poly.append(int(v[k]))
        uv_poly.append(int(t[k]))
        if split_edge[d[k]]:
            poly.append(int(n + d[k]))
            uv_poly.append(int(m + td[k]))
    return [poly], [uv_poly]


def _match(
    polygons: list[list[int]], twin: list[list[int]], uv_twin: list[list[int]], points: np.ndarray
) -> list[tuple[list[int], list[int]]]:
    """For each polygon, its mirror image's corners in the same order, as (indices, texture indices)."""
    flat = [(p, t) for q, u in zip(twin, uv_twin) for p, t in zip(q, u)]
    where = points[[p for p, _ in flat]] * np.array([-1.0, 1.0, 1.0])
    owner = np.repeat(np.arange(len(twin)), [len(q) for q in twin])
    out = []
    for poly in polygons:
        centre = points[poly].mean(axis=0)
        which = int(np.argmin([np.linalg.norm(where[owner == k].mean(axis=0) - centre) for k in range(len(twin))]))
        index = np.flatnonzero(owner == which)
        pick = [index[int(np.argmin(((where[index] - points[i]) ** 2).sum(axis=1)))] for i in poly]
        out.append(([flat[k][0] for k in pick], [flat[k][1] for k in pick]))
    return out
