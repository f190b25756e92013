"""Small meshes with springs, and their forces and Hessians."""

import numpy as np

from faceanim.kernels.springs import elastic_force, force_scratch
from faceanim.kernels.tables import Law, Springs


def sheet(rows: int, columns: int, irregular: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return a curved, irregular sheet with a spacing of 2 mm; irregular > 0.3 makes many obtuse triangles."""
    u, v = np.meshgrid(2.0 * np.arange(rows), 2.0 * np.arange(columns), indexing="ij")
    points = np.stack([u, v, 0.1 * u + 0.002 * v * v], axis=-1).reshape(-1, 3)
    points += np.random.default_rng(7).uniform(-irregular, irregular, points.shape)
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return points, triangles.astype(np.int32)


def springs_of(points: np.ndarray, triangles: np.ndarray, seed: int = 1) -> Springs:
    """Return springs with `points` at rest and random positive stiffnesses."""
    noise = np.random.default_rng(seed)
    corners = points[triangles]
    edges = [corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)]
    length = np.array([np.linalg.norm(edge, axis=1) for edge in edges])
    height = np.linalg.norm(np.cross(edges[0], edges[1]), axis=1) / length
    edge_stiffness, height_stiffness, repulsion = noise.uniform(1.0, 20.0, (3, 3, len(triangles)))
    slots = np.argsort(triangles.T.ravel(), kind="stable").astype(np.int32)
    start = np.concatenate([[0], np.cumsum(np.bincount(triangles.ravel(), minlength=len(points)))]).astype(np.int32)
    a, b, c = (np.ascontiguousarray(triangles[:, k]) for k in range(3))
    return Springs(a, b, c, length, edge_stiffness, height, height_stiffness, repulsion, start, slots)


def evaluate(x: np.ndarray, springs: Springs, law: Law) -> np.ndarray:
    out = np.full((len(x), 4), np.nan)
    elastic_force(x, springs, law, force_scratch(springs), out)
    return out


def deformed(points: np.ndarray, size: float = 0.3) -> np.ndarray:
    return points * [1.15, 0.9, 1.0] + np.random.default_rng(5).normal(0.0, size, points.shape)


def hessian(x: np.ndarray, springs: Springs, law: Law) -> np.ndarray:
    step = 1e-5
    columns = []
    for i in range(x.size):
        moved = np.stack([x, x])
        moved[0].flat[i] += step
        moved[1].flat[i] -= step
        ahead, behind = (evaluate(np.ascontiguousarray(m), springs, law)[:, :3] for m in moved)
        columns.append((behind - ahead).ravel() / (2 * step))
    return np.array(columns)
