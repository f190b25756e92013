"""Tetrahedral meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from faceanim.geometry.surface import TriMesh
from faceanim.geometry.topology import Lists, grouped
from faceanim.ground.arrays import Floats, Ints, floats, frozen, ints
from faceanim.ground.errors import UserError

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int32)
"""Corners of the face opposite each corner, counter-clockwise seen from outside."""


@dataclass(frozen=True, eq=False)
class TetMesh:
    """A tetrahedral mesh: `points` (n, 3) [mm] and `tets` (e, 4); det(x1 - x0, x2 - x0, x3 - x0) > 0."""

    points: Floats
    tets: Ints

    def __init__(self, points: Any, tets: Any) -> None:
        p = floats("points", points, None, 3)
        object.__setattr__(self, "points", frozen(p.copy()))
        object.__setattr__(self, "tets", frozen(ints("tets", tets, None, 4, below=len(p)).copy()))

    @cached_property
    def edge_vectors(self) -> Floats:
        """Columns x1 - x0, x2 - x0, x3 - x0 of every element, (e, 3, 3) [mm]."""
        corner = self.points[self.tets]
        return np.ascontiguousarray((corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1))

    @cached_property
    def volumes(self) -> Floats:
        """Signed volumes, (e,) [mm^3]."""
        return np.linalg.det(self.edge_vectors) / 6.0

    @cached_property
    def gradients(self) -> Floats:
        """Gradients of the four shape functions, (e, 4, 3) [1/mm]; u's gradient is sum_a u_a g_a^T."""
        inverse = np.linalg.inv(self.edge_vectors)
        return np.ascontiguousarray(np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1))

    @cached_property
    def node_tets(self) -> Lists:
        """The elements at each node, in increasing order."""
        return grouped(self.tets.ravel(), np.repeat(np.arange(len(self.tets)), 4), len(self.points))

    @cached_property
    def boundary_triangles(self) -> Ints:
        """Faces that belong to one element only, (t, 3) nodes, counter-clockwise seen from outside."""
        faces = self.tets[:, FACES].reshape(-1, 3)
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        return np.ascontiguousarray(faces[np.sort(first[count == 1])], dtype=np.int32)

    @cached_property
    def boundary_nodes(self) -> Ints:
        """Nodes on the boundary, (k,) increasing."""
        return np.unique(self.boundary_triangles).astype(np.int32)

    @cached_property
    def boundary(self) -> TriMesh:
        """The boundary as a surface of its own; its vertex k is node `boundary_nodes[k]`."""
        index = np.searchsorted(self.boundary_nodes, self.boundary_triangles)
        return TriMesh(self.points[self.boundary_nodes], index.astype(np.int32))

    @cached_property
    def parts(self) -> Ints:
        """The connected part that each element belongs to, (e,), 0 the first; elements are joined by shared nodes."""
        e, n = len(self.tets), len(self.points)
        rows = np.repeat(np.arange(e), 4)
        member = sparse.coo_matrix((np.ones(4 * e), (rows, e + self.tets.ravel())), shape=(e + n, e + n))
        _, label = connected_components(member, directed=False)
        _, part = np.unique(label[:e], return_inverse=True)
        return part.astype(np.int32)

    @cached_property
    def loose_nodes(self) -> Ints:
        """Nodes that no element uses, (k,)."""
        return np.flatnonzero(np.bincount(self.tets.ravel(), minlength=len(self.points)) == 0).astype(np.int32)

    @cached_property
    def quality(self) -> Floats:
        """Shape of every element, (e,) [-]: 12 (3 V)^(2/3) / sum of squared edges; 1 regular, 0 flat, negative inverted."""
        corner = self.points[self.tets]
        pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
        squares = sum(((corner[:, a] - corner[:, b]) ** 2).sum(axis=1) for a, b in pairs)
        return 12.0 * np.sign(self.volumes) * (3.0 * np.abs(self.volumes)) ** (2.0 / 3.0) / np.maximum(squares, 1e-300)

    def reject_bad(self, least: float = 1e-9) -> None:
        """Raise `UserError` naming the first element that is inverted or flat (`quality` below `least`), or a loose node."""
        if not len(self.tets):
            raise UserError("the volume has no elements; a mesh of tetrahedra is needed")
        if self.loose_nodes.size:
            raise UserError(
                f"the volume has {self.loose_nodes.size} nodes without element (node {self.loose_nodes[0]})"
            )
        bad = np.flatnonzero(self.quality < least)
        if bad.size:
            e = int(bad[0])
            what = "inverted" if self.volumes[e] < 0 else "flat"
            raise UserError(
                f"element {e} (nodes {self.tets[e].tolist()}) is {what}: volume {self.volumes[e]:.3g} mm^3; "
                f"{bad.size} of {len(self.tets)} elements are; turn, weld or remove them"
            )
