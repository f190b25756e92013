"""Quadratic triangular prisms: six nodes of a quadratic triangle on each of three levels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from faceanim.elements import shapes
from faceanim.elements.factor import Cholesky, Factor, has_cholesky
from faceanim.elements.tetrahedra import LAWS, Elements
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints, ints
from faceanim.ground.errors import UserError, unknown_name
from faceanim.tissue.material import Material

_GAUSS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
_GAUSS_WEIGHT = np.array([5.0, 8.0, 5.0]) / 18.0


def line_values(at: Floats) -> Floats:
    """Return the three quadratic shape functions of a line, (q, 3), at `at` (q,) in [0, 1]; nodes at 0, 1/2 and 1."""
    t = np.asarray(at)
    return np.stack([(1.0 - t) * (1.0 - 2.0 * t), 4.0 * t * (1.0 - t), t * (2.0 * t - 1.0)], axis=1)


def line_slopes(at: Floats) -> Floats:
    """Return their derivatives, (q, 3)."""
    t = np.asarray(at)
    return np.stack([4.0 * t - 3.0, 4.0 - 8.0 * t, 4.0 * t - 1.0], axis=1)


class Wedges(Elements):
    """Layers of wedges on a triangulated sheet of columns, quadratic in all directions; otherwise like `Elements`.

    points : (b (2 layers + 1), 3) [mm], row base * (2 layers + 1) + level: bases are the columns, then one on each edge
    node : (e, 18), row triangle * layers + layer; level by level, corners then mid-edges
    triangles : (t, 3) columns   edges : (k, 2) columns beside each mid-edge base
    """

    def __init__(
        self,
        levels: Floats,
        triangles: Ints,
        materials: Material | Sequence[Material],
        region: Any = None,
        *,
        law: str = "neo_hookean",
    ) -> None:
        """Compile the tables.

        levels : (m, layers + 1, 3) [mm] nodes of each column from the outside in; sides and mid-nodes are straight
        triangles : (t, 3), outside to the left   materials, region : as for `Elements`, one index for each wedge
        Raises `UserError` for an unknown law or wedges that are inverted or flat.
        """
        if law not in LAWS:
            raise unknown_name("elastic law", law, LAWS)
        m, count, _ = levels.shape
        self.triangles, self.layers = ints("triangles", triangles, None, 3, below=m), count - 1
        self.law, self._law = law, LAWS[law]
        self.materials = (materials,) if isinstance(materials, Material) else tuple(materials)
        e = len(self.triangles) * self.layers
        zero = np.zeros(e, dtype=np.int32)
        self.region = zero if region is None else ints("region", region, e, below=len(self.materials))
        self._columns(levels)
        self.mesh = TetMesh(self.points, np.zeros((0, 4), dtype=np.int32))
        self._quadrature, self.order, self.extra = 18, 2, 0
        self.cells = self._cells()
        self._allocate()
        self._pattern(None)

    def _columns(self, levels: Floats) -> None:
        pairs = np.sort(self.triangles[:, shapes.TRIANGLE_EDGES].reshape(-1, 2), axis=1)
        self.edges, index = np.unique(pairs, axis=0, return_inverse=True)
        m, count, _ = levels.shape
        base = np.concatenate([levels, levels[self.edges].mean(axis=1)])
        height = 2 * count - 1
        points = np.empty((len(base), height, 3))
        points[:, ::2] = base
        points[:, 1::2] = 0.5 * (base[:, :-1] + base[:, 1:])
        self.points = np.ascontiguousarray(points.reshape(-1, 3))
        six = np.concatenate([self.triangles, m + index.reshape(-1, 3)], axis=1)
        first = six[:, None, None, :] * height + 2 * np.arange(self.layers)[None, :, None, None]
        node = first + np.arange(3)[None, None, :, None]
        self.node = np.ascontiguousarray(node.reshape(-1, 18), dtype=np.int32)

    def factorisation(self, free: Bools) -> Factor:
        """Return what solves with the tangent over the freedoms that are `free`: by Cholesky's method if it is there."""
        return Cholesky(self, free) if has_cholesky() else Factor(self, free)

    def rule(self, points: int) -> tuple[Floats, Floats, Floats]:
        """Return shape values (q, 18), gradients (e, q, 18, 3) [1/mm] and weights (e, q) [mm^3] of the one rule, q = 18."""
        flat, share = shapes.triangle_rule()
        at, depth = np.tile(flat, (3, 1)), np.repeat(_GAUSS, len(flat))
        weight = np.tile(share, 3) * np.repeat(_GAUSS_WEIGHT, len(flat))
        values, slopes = wedge_shapes(at, depth)
        corner = self.points[self.node]
        jacobian = np.einsum("eai,qaj->eqij", corner, slopes)
        # the levels run inwards while the triangles are seen from outside: the map mirrors
        volume = -0.5 * np.linalg.det(jacobian) * weight
        if not volume.min() > 0:
            raise UserError(f"wedge {int(np.argmin(volume.min(axis=1)))} is inverted or flat")
        gradient = np.einsum("qaj,eqji->eqai", slopes, np.linalg.inv(jacobian))
        return values, gradient, volume


def wedge_shapes(at: Floats, depth: Floats) -> tuple[Floats, Floats]:
    """Return the 18 shape functions (q, 18) and their slopes (q, 18, 3) by two triangle coordinates and the depth.

    at : (q, 3) barycentric coordinates   depth : (q,) in [0, 1] from the first level to the third
    """
    flat = shapes.shape_values(2, at, shapes.TRIANGLE_EDGES)
    slope = shapes.shape_slopes(2, at, shapes.TRIANGLE_EDGES)
    across = slope[:, :, 1:] - slope[:, :, :1]
    line, along = line_values(depth), line_slopes(depth)
    q = len(at)
    values = np.einsum("qk,qa->qka", line, flat).reshape(q, 18)
    slopes = np.concatenate(
        [np.einsum("qk,qac->qkac", line, across), np.einsum("qk,qa->qka", along, flat)[..., None]], axis=3
    )
    return values, slopes.reshape(q, 18, 3)
