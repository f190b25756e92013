"""Shape functions and quadrature rules of linear and quadratic tetrahedra and triangles, in barycentric coordinates."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError

TET_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
"""Corners beside the nodes 4..9 of a quadratic tetrahedron."""
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [2, 0]])
"""Corners beside the nodes 3..5 of a quadratic triangle."""


def _orbit(*barycentric: float) -> list[tuple[float, ...]]:
    return sorted(set(permutations(barycentric)))


def tet_rule(points: int) -> tuple[Floats, Floats]:
    """Return barycentric points (q, 4) and weights (q,), which sum to 1, of a rule with 1, 4 or 14 points.

    They are exact up to degree 1, 2 and 5. The last is of Walkington, Quadrature on simplices of arbitrary dimension.
    """
    if points == 1:
        orbits = [(1.0, _orbit(0.25, 0.25, 0.25, 0.25))]
    elif points == 4:
        a = (5.0 - np.sqrt(5.0)) / 20.0
        orbits = [(0.25, _orbit(a, a, a, 1.0 - 3.0 * a))]
    elif points == 14:
        a, b, c = 0.31088591926330060980, 0.092735250310891226402, 0.045503704125649649492
        orbits = [
            (0.11268792571801585080, _orbit(a, a, a, 1.0 - 3.0 * a)),
            (0.073493043116361949544, _orbit(b, b, b, 1.0 - 3.0 * b)),
            (0.042546020777081466438, _orbit(c, c, 0.5 - c, 0.5 - c)),
        ]
    else:
        raise UserError(f"quadrature = {points}: 1, 4 or 14 points are known")
    weights = np.concatenate([np.full(len(o), w) for w, o in orbits])
    return np.concatenate([np.array(o) for _, o in orbits]), weights / weights.sum()


def triangle_rule() -> tuple[Floats, Floats]:
    """Return barycentric points (6, 3) and weights (6,), which sum to 1, exact up to degree 4 (Dunavant 1985)."""
    a, b = 0.445948490915965, 0.091576213509771
    points = np.array(_orbit(a, a, 1.0 - 2.0 * a) + _orbit(b, b, 1.0 - 2.0 * b))
    weights = np.repeat([0.223381589678011, 0.109951743655322], 3)
    return points, weights / weights.sum()


def shape_values(order: int, at: Floats, edges: Floats) -> Floats:
    """Return the shape functions, (q, a), at barycentric points `at` (q, c) of a simplex whose mid-nodes are on `edges`."""
    if order == 1:
        return at
    corner = at * (2.0 * at - 1.0)
    middle = 4.0 * at[:, edges[:, 0]] * at[:, edges[:, 1]]
    return np.concatenate([corner, middle], axis=1)


def shape_slopes(order: int, at: Floats, edges: Floats) -> Floats:
    """Return the derivatives of the shape functions by the barycentric coordinates, (q, a, c), at `at` (q, c)."""
    q, c = at.shape
    if order == 1:
        return np.tile(np.eye(c), (q, 1, 1))
    out = np.zeros((q, c + len(edges), c))
    for a in range(c):
        out[:, a, a] = 4.0 * at[:, a] - 1.0
    for k, (i, j) in enumerate(edges):
        out[:, c + k, i] = 4.0 * at[:, j]
        out[:, c + k, j] = 4.0 * at[:, i]
    return out
