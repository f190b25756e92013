"""How deep a point is in a bone: a signed distance in an envelope of tetrahedra along its surface, positive inside.

Algorithm 1 and eqs 7-9 of the mixed-element paper on craniofacial surgery, made good where they fail: the distance is
signed, starts at infinity, is taken to the triangle (not its plane), and a tetrahedron with a node outside the
envelope is no contact on the outer side, or counts as buried on the inner one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from faceanim.geometry.distance_field import point_distance, winding_vote
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.topology import edge_of_corner
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints, floats, frozen
from faceanim.ground.errors import UserError, unknown_name
from faceanim.kernels import bone_field as kernels

DIAGONAL = float(np.sqrt(3.0))
"""Longest edge of a tetrahedron over the spacing of the lattice."""
REACH = 1.5
"""How many such edges a reading between the nodes reaches around a point, at most."""
READINGS = {"linear": kernels.LINEAR, "mean": kernels.MEAN, "spline": kernels.SPLINE, "nearest": kernels.NEAREST}
"""How distances are read between the nodes -> its number in the kernels; see `kernels.bone_field.sample`."""
STEP = 3.0
"""A bone moves by less than this at a time [mm], as in the paper."""
BESIDE = np.array([1.23e-5, 1.71e-5, 1.58e-5])
LARGEST = 40_000_000


class FieldTable(NamedTuple):
    """A field as the kernels read it.

    first : (3,) lattice index of the first node   spacing : (1,) [mm]   slot : (nx, ny, nz) number of each node or mark
    depth : (m,) [mm]   gradient : (m, 3) [-], unit means of the tetrahedra's   coefficient : (m,) [mm], of the spline
    """

    first: Ints
    spacing: Floats
    slot: Ints
    depth: Floats
    gradient: Floats
    coefficient: Floats
    triangle: Ints
    corners: Floats
    face: Floats
    edge: Floats
    vertex: Floats
    ring_start: Ints
    ring: Ints


class Depth(NamedTuple):
    """What a field says about points.

    depth : (n,) [mm], positive inside, minus infinity beyond the envelope, infinity where buried
    inward : (n, 3) [-], its gradient, in the frame that the points are given in; zero where it is not known
    buried : (n,) bool, behind the envelope
    """

    depth: Floats
    inward: Floats
    buried: np.ndarray


class PseudoNormals(NamedTuple):
    """Angle-weighted normals: face (t, 3), edge (t, 3, 3) opposite each corner, vertex (t, 3, 3)."""

    face: Floats
    edge: Floats
    vertex: Floats


def reject_open(surface: TriMesh) -> None:
    """Raise `UserError` if `surface` is not closed, or looks inwards.

    Closed: every edge is passed as often one way as the other. Edges of four triangles, where two parts of a bone
    touch, are allowed.
    """
    t = surface.triangles
    if not len(t):
        raise UserError("the bone's surface has no triangles; a closed surface is needed")
    pairs = np.concatenate([t[:, [1, 2]], t[:, [2, 0]], t[:, [0, 1]]])
    way = np.where(pairs[:, 0] < pairs[:, 1], 1.0, -1.0)
    unique, index = np.unique(np.sort(pairs, axis=1), axis=0, return_inverse=True)
    loose = np.flatnonzero(np.bincount(index.ravel(), way, len(unique)))
    if len(loose):
        a, b = (int(i) for i in unique[loose[0]])
        raise UserError(
            f"the bone's surface is not watertight: {len(loose)} edges border a hole or a turned triangle (the first "
            f"joins vertices {a} and {b}); close it, or orient its triangles alike"
        )
    volume = float(np.einsum("ti,ti->", surface.points[t[:, 0]], surface.normals_by_area) / 3.0)
    if not volume > 0.0:
        raise UserError(f"the bone's surface holds {volume:.4g} mm^3, so it looks inwards; turn its triangles")


def pseudo_normals(surface: TriMesh) -> PseudoNormals:
    """Return the angle-weighted normals by which the side of a point is told (Baerentzen & Aanaes, IEEE TVCG 2005).

    Their proof asks for a region with a closed, oriented border, not for a manifold.
    """
    t = surface.triangles
    face = surface.normals_by_area / np.maximum(surface.areas, 1e-300)[:, None]
    edges, which = edge_of_corner(t)
    along = np.zeros((len(edges), 3))
    at = np.zeros_like(surface.points)
    corner = surface.points[t]
    for k in range(3):
        np.add.at(along, which[:, k], face)
        one, other = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.einsum("ti,ti->t", one, other))
        np.add.at(at, t[:, k], angle[:, None] * face)
    parts = (face, along[which], at[t])
    return PseudoNormals(*(np.ascontiguousarray(part) for part in parts))


def prism_boxes(surface: TriMesh, thickness: float, *, grown: bool = True) -> tuple[Floats, Floats]:
    """Return the boxes, 2 x (t, 3) [mm], in which a node may have each triangle as its nearest.

    grown : the triangle's box, larger by `thickness` all around: it holds every prism of that thickness on either
    side. Else the box of the prism between the triangle and its corners moved inwards along the vertex normals, as
    the paper has it; these lean, so the box misses nodes that are nearer than `thickness`.
    """
    corner = surface.points[surface.triangles]
    if grown:
        return corner.min(axis=1) - thickness, corner.max(axis=1) + thickness
    moved = corner - thickness * surface.vertex_normals[surface.triangles]
    both = np.concatenate([corner, moved], axis=1)
    return both.min(axis=1), both.max(axis=1)


@dataclass(frozen=True, eq=False)
class BoneField:
    """The depth below the surface of a bone, in its rest frame, known down to `thickness` and out to `margin` [mm].

    table : the lattice   mended : nodes whose side the pseudo-normals told wrong, as they do where a surface is folded
    onto itself
    """

    surface: TriMesh
    thickness: float
    margin: float
    table: FieldTable = field(repr=False)
    mended: int = 0

    @property
    def spacing(self) -> float:
        """Side of the lattice's cubes [mm]."""
        return float(self.table.spacing[0])

    @property
    def step(self) -> float:
        """How far a bone may move at a time, so that what it meets is still in the envelope [mm]."""
        return self.thickness - REACH * DIAGONAL * self.spacing

    @cached_property
    def mesh(self) -> TetMesh:
        """The envelope's whole tetrahedra; the nodes are those of `table.depth`."""
        where = np.argwhere(self.table.slot >= 0)
        points = np.empty((len(where), 3))
        points[self.table.slot[tuple(where.T)]] = (where + self.table.first) * self.spacing
        scratch = _scratch()
        slot, first = self.table.slot, self.table.first
        out = np.zeros((kernels.tetrahedra(slot, first, *scratch, False, np.zeros((0, 4), np.int32)), 4), np.int32)
        kernels.tetrahedra(slot, first, *scratch, True, out)
        return TetMesh(points, out)

    def sample(self, points: Any, pose: Any = None, *, reading: str = "spline", last: Any = None) -> Depth:
        """Return how deep `points` (n, 3) [mm] are in the bone carried by `pose` (4, 4).

        reading : "linear" is eqs 7-9; "mean" has the same depth and a direction that does not jump, the nodes' mean;
        "spline" is once continuously differentiable, and its direction is the exact gradient of its depth; "nearest"
        is exact but for details finer than the lattice, and its direction jumps where the nearest triangle changes
        last : (n, 3) directions that are kept where a point is buried
        Raises `UserError` for a pose that is not rigid and for an unknown reading.
        """
        if reading not in READINGS:
            raise unknown_name("reading", reading, READINGS)
        place = floats("points", points, None, 3)
        turn = None
        if pose is not None:
            frame = rigid_pose("the bone's pose", pose)
            turn = frame[:3, :3]
            place = np.ascontiguousarray((place - frame[:3, 3]) @ turn)
        out, state = np.zeros((len(place), 4)), np.zeros(len(place), dtype=np.int32)
        kernels.sample_points(self.table, place, READINGS[reading], *_scratch(), out, state)
        depth = np.choose(state, [np.full(len(place), -np.inf), out[:, 0], np.full(len(place), np.inf)])
        inward = np.where((state == kernels.WITHIN)[:, None], out[:, 1:], 0.0)
        if turn is not None:
            inward = inward @ turn.T
        buried = state == kernels.BURIED
        if last is not None:
            inward = np.where(buried[:, None], floats("last", last, len(place), 3), inward)
        return Depth(depth, np.ascontiguousarray(inward), buried)

    def exact(self, points: Any, pose: Any = None) -> Floats:
        """Return the exact depth of `points` (n, 3) below the triangles, (n,) [mm]; slower, for judging."""
        place = floats("points", points, None, 3)
        if pose is not None:
            frame = rigid_pose("the bone's pose", pose)
            place = np.ascontiguousarray((place - frame[:3, 3]) @ frame[:3, :3])
        _, triangle = point_distance(place, self.surface)
        out = np.empty(len(place))
        kernels.point_depths(self.table, place, triangle, *_scratch(), np.zeros(4), out)
        return out


def bone_field(
    surface: TriMesh,
    *,
    spacing: float = 1.0,
    step: float = STEP,
    thickness: float | None = None,
    margin: float | None = None,
    grown: bool = True,
) -> BoneField:
    """Return the signed distance in an envelope along the closed `surface` of a bone (Algorithm 1, corrected).

    spacing : side of the lattice's cubes [mm]   step : how far the bone moves at a time at most [mm]
    thickness : of the envelope inside [mm], zeta of the paper; None = just what `step` asks for
    margin : the same outside; None = one and a half edges of a tetrahedron   grown : see `prism_boxes`
    Raises `UserError` for a surface that is open, for an envelope thinner than a step and one and a half edges of a
    tetrahedron, and for a lattice that is too large.
    """
    for name, value in (("spacing", spacing), ("step", step)):
        if not (np.isfinite(value) and value > 0.0):
            raise UserError(f"bone field: {name} = {value} must be positive and finite")
    around = REACH * DIAGONAL * spacing
    inner = step + around if thickness is None else float(thickness)
    outer = around if margin is None else float(margin)
    if not inner >= (step + around) * (1.0 - 1e-12):
        raise UserError(
            f"bone field: the envelope's thickness {inner:g} mm is too thin for steps of {step:g} mm and tetrahedra "
            f"with edges of {DIAGONAL * spacing:.3g} mm; it must be at least a step and {REACH:g} edges, "
            f"{step + around:.3g} mm, or the steps smaller"
        )
    if not outer >= around * (1.0 - 1e-12):
        raise UserError(f"bone field: margin = {outer:g} mm must be at least {REACH:g} edges, {around:.3g} mm")
    reject_open(surface)
    surface.reject_degenerate()
    return _filled(surface, float(spacing), inner, outer, grown)


def _filled(surface: TriMesh, spacing: float, inner: float, outer: float, grown: bool) -> BoneField:
    low = np.floor((surface.points.min(axis=0) - outer) / spacing).astype(np.int32) - 1
    high = np.ceil((surface.points.max(axis=0) + outer) / spacing).astype(np.int32) + 1
    shape = tuple(int(n) for n in high - low + 1)
    if np.prod(shape, dtype=np.float64) > LARGEST:
        raise UserError(f"bone field: a lattice of {shape} nodes is too large; take a spacing above {spacing:g} mm")
    squared, nearest = np.full(shape, np.inf), np.full(shape, -1, dtype=np.int32)
    corners, normals = _corners(surface), pseudo_normals(surface)
    boxes = prism_boxes(surface, max(inner, outer), grown=grown)
    kernels.splat(corners, *(np.ascontiguousarray(b) for b in boxes), low, spacing, squared, nearest)
    slot = nearest.copy()
    # lines a little beside the nodes pass through no edge of a surface with round coordinates
    vote = winding_vote(corners, (low + BESIDE) * spacing, spacing, shape)
    count, mended = kernels.enclose(squared, nearest, vote, corners, *normals, low, spacing, inner, outer, slot)
    depth, gradient, coefficient = np.empty(count), np.zeros((count, 3)), np.empty(count)
    triangle = np.empty(count, dtype=np.int32)
    kernels.collect(slot, squared, nearest, depth, triangle)
    kernels.node_gradients(slot, depth, low, spacing, *_scratch(), gradient)
    kernels.spline_coefficients(slot, depth, coefficient)
    tables = (
        low,
        np.array([spacing]),
        slot,
        depth,
        gradient,
        coefficient,
        triangle,
        corners,
        *normals,
        *_rings(surface),
    )
    return BoneField(surface, inner, outer, FieldTable(*(frozen(a) for a in tables)), int(mended))


def _rings(surface: TriMesh) -> tuple[Ints, Ints]:
    """Return the triangles that share a corner with each triangle, packed."""
    t = surface.triangles
    at = sparse.csr_matrix((np.ones(t.size), (np.repeat(np.arange(len(t)), 3), t.ravel())))
    shared = (at @ at.T).tocsr()
    return shared.indptr.astype(np.int32), shared.indices.astype(np.int32)


def _corners(surface: TriMesh) -> Floats:
    return np.ascontiguousarray(surface.points[surface.triangles])


def _scratch() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64), np.zeros(4, dtype=np.int64)


def rigid_pose(name: str, pose: Any) -> Floats:
    """Return `pose` as checked (4, 4) float64; raise `UserError` if it is not a rotation and a translation."""
    frame = floats(name, pose, 4, 4)
    turn = frame[:3, :3]
    away = float(np.abs(turn.T @ turn - np.eye(3)).max())
    if away > 1e-6 or np.linalg.det(turn) < 0.0 or not np.array_equal(frame[3], [0.0, 0.0, 0.0, 1.0]):
        raise UserError(
            f"{name} is not rigid: its rotation is off by {away:.2g}, its determinant {np.linalg.det(turn):.3g}, its "
            f"last row {frame[3].tolist()}; give a rotation matrix, a translation [mm] and (0, 0, 0, 1)"
        )
    return frame
