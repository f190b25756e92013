"""How the skin of a head rides on the volume beneath it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faceanim.face.attach import LID, LIP, MUCOSA
from faceanim.face.columns import Columns
from faceanim.face.geodesic import distance_along
from faceanim.geometry.distance_field import point_distance
from faceanim.geometry.embedding import barycentric, embed
from faceanim.geometry.rays import barycentric as flat_barycentric
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints

if TYPE_CHECKING:
    from faceanim.face.face import Face

MOUTH_DEPTH = (6.0, 18.0)
"""Skin inside the mouth goes with the flesh up to the first distance from the lips, with the bones from the second [mm]."""
_SUPPORT = 4.0
"""Depth of the node that carries skin lying outside every element, with the three above it [mm]."""


@dataclass(frozen=True, eq=False)
class Carrier:
    """Twelve nodes and weights for each skin vertex, (n, 12): four in the flesh, then four for each of two bones.

    done : (n,) which are filled
    """

    node: Ints
    weight: Floats
    done: Bools

    def mirrored(self, face: Face, twin: Ints) -> Carrier:
        """Return the carrier of all skin from that of one side; `twin` (m,) the mirror image of each node."""
        other = face.mirror[self.done]
        node, weight, done = self.node.copy(), self.weight.copy(), self.done.copy()
        fill = ~self.done[other]
        source = np.flatnonzero(self.done)[fill]
        node[other[fill]], weight[other[fill]] = twin[self.node[source]], self.weight[source]
        done[other[fill]] = True
        return Carrier(node, weight, done)


def carry(
    face: Face, columns: Columns, mesh: TetMesh, bone_weight: Floats, layers: int, *, half: bool
) -> tuple[Carrier, Bools]:
    """Return what carries each skin vertex, and which vertices bone carries, (n,).

    mesh : elements of `columns`   bone_weight : (n_node, 2)   half : only the skin at x >= 0 is filled
    """
    points = face.mesh.points
    n = len(points)
    carrier = Carrier(np.zeros((n, 12), dtype=np.int32), np.zeros((n, 12)), np.zeros(n, dtype=bool))
    wanted = (points[:, 0] >= 0.0) if half else np.ones(n, dtype=bool)
    inside = np.isin(face.region, (LIP, MUCOSA, LID))
    outer = np.flatnonzero(wanted & ~inside & ~face.pinned)
    _fill(carrier, outer, *_on_prisms(points[outer], columns, mesh, layers))
    share = _bone_share(face)
    rigid = (share >= 1.0) & wanted
    flaps = _flaps(face, columns, mesh, layers)
    for allowed, which in flaps:
        row = np.flatnonzero(wanted & inside & which & ~rigid)
        if len(row):
            _fill(carrier, row, *_on_elements(points[row], mesh, allowed))
    if half:
        centre = (points[:, 0] == 0.0) & ~rigid
        _flatten(carrier, np.flatnonzero(centre & ~inside), points, mesh, np.ones(len(mesh.tets), dtype=bool))
        for allowed, which in flaps:
            _flatten(carrier, np.flatnonzero(centre & inside & which), points, mesh, allowed)
    carrier.weight[wanted] *= 1.0 - share[wanted, None]
    _carry_rigid(carrier, np.flatnonzero(wanted & (share > 0.0)), share, face, mesh, bone_weight)
    carrier.done[wanted] = True
    return carrier, rigid


def _fill(carrier: Carrier, row: np.ndarray, node: Ints, weight: Floats) -> None:
    carrier.node[row, :4], carrier.weight[row, :4] = node, weight


def _bone_share(face: Face) -> Floats:
    """Return how far the bones themselves carry each skin vertex, (n,) in [0, 1]: pinned skin, the depth of the mouth."""
    lips = np.flatnonzero(face.region == LIP).astype(np.int32)
    near, far = MOUTH_DEPTH
    share = np.zeros(len(face.mesh.points))
    if len(lips):
        t = np.clip((distance_along(face.mesh, lips) - near) / (far - near), 0.0, 1.0)
        share = np.where(face.region == MUCOSA, t * t * (3.0 - 2.0 * t), 0.0)
    return np.where(face.pinned, 1.0, share)


def _on_prisms(points: Floats, columns: Columns, mesh: TetMesh, layers: int) -> tuple[Ints, Floats]:
    """Return carriers of visible skin: elements of the nearest prism that contain it, else the prism as a whole."""
    _, nearest = point_distance(points, TriMesh(columns.top, columns.triangles))
    best = np.full(len(points), -np.inf)
    node, weight = np.zeros((len(points), 4), dtype=np.int32), np.zeros((len(points), 4))
    for k in range(3 * layers):
        tet = nearest * 3 * layers + k
        w = barycentric(mesh, tet, points)
        better = w.min(axis=1) > best + 1e-12
        best[better], node[better], weight[better] = w.min(axis=1)[better], mesh.tets[tet[better]], w[better]
    out = np.flatnonzero(best < 0.0)
    node[out], weight[out] = _on_pyramid(points[out], columns.triangles[nearest[out]], columns, mesh, layers)
    return node, weight


def _on_pyramid(points: Floats, corner: Ints, columns: Columns, mesh: TetMesh, layers: int) -> tuple[Ints, Floats]:
    """Return as carriers the three nodes on the skin and one deeper node: of the nearest of the longer columns."""
    top = corner * (layers + 1)
    flat = flat_barycentric(mesh.points[top], points)
    length = np.linalg.norm(columns.foot - columns.top, axis=1)[corner]
    best = (np.minimum(length, _SUPPORT) + 0.1 * flat).argmax(axis=1)
    column = np.take_along_axis(corner, best[:, None], axis=1)[:, 0]
    stack = mesh.points.reshape(-1, layers + 1, 3)[column]
    deep = np.linalg.norm(stack - stack[:, :1], axis=2) >= _SUPPORT
    level = np.where(deep.any(axis=1), deep.argmax(axis=1), layers)
    node = np.concatenate([top, (column * (layers + 1) + level)[:, None]], axis=1)
    return node.astype(np.int32), four_weights(mesh.points[node], points)


def four_weights(corner: Floats, points: Floats) -> Floats:
    """Return the weights (k, 4), summing to 1, that make `points` (k, 3) of four corners each (k, 4, 3)."""
    sides = (corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1)
    rest = np.linalg.solve(sides, (points - corner[:, 0])[:, :, None])[:, :, 0]
    return np.concatenate([1.0 - rest.sum(axis=1, keepdims=True), rest], axis=1)


def _on_elements(points: Floats, mesh: TetMesh, allowed: Bools) -> tuple[Ints, Floats]:
    out = embed(mesh, points, among=np.flatnonzero(allowed).astype(np.int32), candidates=40)
    return out.node, out.weight


def _flaps(face: Face, columns: Columns, mesh: TetMesh, layers: int) -> list[tuple[Bools, Bools]]:
    """Return for each flap (lips, lids) the elements that may carry it, (e,), and the skin that belongs to it, (n,)."""
    tet_columns = columns.vertex[mesh.tets // (layers + 1)]
    out = []
    mouth = np.isin(face.region, (LIP, MUCOSA))
    for side in (1, -1):
        own = face.mouth_side == side
        out.append((own[tet_columns].any(axis=1), mouth & own))
    for eye in face.eyes:
        upper, lower = (face.contact_sets[f"lid_{lid}_{eye}"] for lid in ("upper", "lower"))
        if (face.region[upper] != LID).all() or (face.region[lower] != LID).all():
            continue
        far = distance_along(face.mesh, upper[face.region[upper] == LID])
        near = distance_along(face.mesh, lower[face.region[lower] == LID])
        for own in (far <= near, far > near):
            out.append((own[tet_columns].any(axis=1), (face.region == LID) & own & (np.minimum(far, near) < 15.0)))
    return out


def _carry_rigid(
    carrier: Carrier, row: np.ndarray, share: Floats, face: Face, mesh: TetMesh, bone_weight: Floats
) -> None:
    """Fill in what bones carry of the skin, `share` (n,): four distant nodes of each bone, blended as the bones are."""
    for bone in range(bone_weight.shape[1]):
        held = np.flatnonzero(bone_weight[:, bone] > 1.0 - 1e-12)
        if len(held) < 4:
            held = np.argsort(-bone_weight[:, bone], kind="stable")[:40].astype(np.int64)
        frame = held[_spread(mesh.points[held])]
        corner = np.broadcast_to(mesh.points[frame], (len(row), 4, 3))
        part = slice(4 + 4 * bone, 8 + 4 * bone)
        carrier.node[row, part] = frame
        amount = (share * face.bone_weight[:, bone])[row, None]
        carrier.weight[row, part] = amount * four_weights(corner, face.mesh.points[row])


def _spread(points: Floats) -> Ints:
    """Return four of the points that span a large tetrahedron, (4,)."""
    first = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    second = int(np.argmax(np.linalg.norm(points - points[first], axis=1)))
    side = points[second] - points[first]
    area = np.cross(points - points[first], side)
    third = int(np.argmax(np.linalg.norm(area, axis=1)))
    fourth = int(np.argmax(np.abs((points - points[first]) @ np.cross(side, points[third] - points[first]))))
    return np.array([first, second, third, fourth], dtype=np.int32)


def _flatten(carrier: Carrier, row: np.ndarray, points: Floats, mesh: TetMesh, allowed: Bools) -> None:
    """Let the skin in the middle ride on nodes of the middle only, so that it stays there."""
    middle = mesh.points[:, 0] == 0.0
    faces = mesh.tets[(middle[mesh.tets].sum(axis=1) == 3) & allowed]
    flat = faces[middle[faces]].reshape(-1, 3)
    for i in row:
        w = carrier.weight[i]
        if np.abs(w[~middle[carrier.node[i]]]).max(initial=0.0) < 1e-12:
            continue
        near = flat[np.argsort(np.linalg.norm(mesh.points[flat].mean(axis=1) - points[i], axis=1))[:12]]
        w3 = flat_barycentric(mesh.points[near], np.broadcast_to(points[i], (len(near), 3)))
        k = int(np.argmax(w3.min(axis=1)))
        carrier.node[i], carrier.weight[i] = near[k][0], 0.0
        carrier.node[i, :3], carrier.weight[i, :3] = near[k], w3[k]
