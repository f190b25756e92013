"""A plan carried out on a skull: closed pieces of bone, and where each of them goes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from faceanim.face.face import Face, Part
from faceanim.face.skull import rotation
from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.distance_field import point_distance, signed_distance_grid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError, unknown_name
from faceanim.surgery import cut
from faceanim.surgery.plan import BONES, FARTHEST, MIRROR, Move, Piece, Place, Plan, piece_names, planes_of

GRID_SPACING = 1.5
SAMPLE = 2.0
"""Surfaces are probed for overlap at about this distance [mm]."""
STRIDE = 6.0
"""Overlap is looked for at least so often along the way of a piece [mm]."""


@dataclass(frozen=True, eq=False)
class Fragment:
    """A piece of bone, closed, and its movement.

    bone : what it was cut out of, 0 cranium, 1 jaw   centre : (3,) of its volume [mm]
    turn : (3,) axis times angle [rad]   shift : (3,) way of its centre [mm]   overlap : see `plan.Piece`
    """

    name: str
    bone: int
    mesh: TriMesh
    centre: Floats
    turn: Floats
    shift: Floats
    overlap: float

    def pose(self, fraction: float = 1.0) -> Floats:
        """Return the pose (4, 4), rest to head frame, after a `fraction` of the way: an even turn, a straight shift."""
        return _pose(self.turn * fraction, self.centre, self.shift * fraction)

    @property
    def travel(self) -> float:
        """The longest way of any of its points [mm]."""
        return float(np.linalg.norm(moved(self.mesh.points, self.pose()) - self.mesh.points, axis=1).max())


def _pose(turn: Floats, centre: Floats, shift: Floats) -> Floats:
    angle = float(np.linalg.norm(turn))
    pose = np.eye(4)
    if angle > 0.0:
        pose[:3, :3] = rotation(turn, angle)
    pose[:3, 3] = centre + shift - pose[:3, :3] @ centre
    return pose


def moved(points: Floats, pose: Floats) -> Floats:
    """Return `points` (n, 3) carried by a `pose` (4, 4)."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


@dataclass(frozen=True, eq=False)
class Operation:
    """A plan carried out on the skull of a face.

    rest : what is left of cranium and jaw, closed   fragments : the pieces, in the order of the plan
    parts : what the mouth holds, each rigid, its `bone` an index into `names`: a tooth goes with the bone it stands in
    cuts : every plane that was cut along as point (3,) and unit normal (3,)
    """

    plan: Plan
    face: Face
    rest: tuple[TriMesh, TriMesh]
    fragments: tuple[Fragment, ...]
    parts: tuple[Part, ...]
    cuts: tuple[tuple[Floats, Floats], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all bones: cranium, jaw, then the pieces."""
        return (*BONES, *(f.name for f in self.fragments))

    @property
    def bones(self) -> tuple[TriMesh, ...]:
        """Surfaces of all bones at rest, in the order of `names`."""
        return (*self.rest, *(f.mesh for f in self.fragments))

    @property
    def parents(self) -> Ints:
        """The bone out of which each was cut, itself for cranium and jaw, (n_bone,)."""
        return np.array([0, 1, *(f.bone for f in self.fragments)], dtype=np.int32)

    @property
    def travel(self) -> float:
        """The longest way of any point of bone [mm]."""
        return max(f.travel for f in self.fragments)

    def poses(self, fraction: float = 1.0) -> Floats:
        """Return the poses of all bones after a `fraction` of the way, (n_bone, 4, 4)."""
        return np.stack([np.eye(4), np.eye(4), *(f.pose(fraction) for f in self.fragments)])

    def teeth(self, bone: int) -> list[TriMesh]:
        """Return the teeth and gums that a bone carries."""
        return [TriMesh(p.points, p.triangles) for p in self.parts if p.bone == bone and p.touches]

    def walls(self, bone: int) -> Bools:
        """Return which triangles of a bone lie in a cut, (t,)."""
        mesh = self.bones[bone]
        corner = mesh.points[mesh.triangles]
        out = np.zeros(len(corner), dtype=bool)
        for point, normal in self.cuts:
            out |= (np.abs((corner - point) @ normal) < 1e-6).all(axis=1)
        return out

    @cached_property
    def grids(self) -> tuple[DistanceGrid, ...]:
        """Signed distance to every bone without teeth, at rest, cut off so near the surface that it tells the side."""
        return tuple(
            signed_distance_grid([bone], spacing=GRID_SPACING, margin=2 * GRID_SPACING, band=GRID_SPACING)
            for bone in self.bones
        )

    @cached_property
    def probes(self) -> tuple[Floats, ...]:
        """Points spread over every bone, at rest."""
        return tuple(samples(bone) for bone in self.bones)

    def depth(self, bone: int, points: Floats) -> Floats:
        """Return how deep `points` (n, 3) at rest lie inside a bone without teeth, (n,) [mm], 0 outside."""
        out = np.zeros(len(points))
        inside = np.flatnonzero(self.grids[bone].sample(points) < 0.0)
        if len(inside):
            out[inside] = _distance(points[inside], self.bones[bone])
        return out


def operate(face: Face, plan: Plan) -> Operation:
    """Return the operation that `plan` describes on the skull of `face`.

    Raises `UserError` naming piece and cause for unknown landmarks, cuts that miss, moves too far, and moves through
    other bone.
    """
    rest = [face.cranium, face.jaw_mesh]
    fragments: list[Fragment] = []
    cuts: list[tuple[Floats, Floats]] = []
    for piece in plan.piece:
        bone = BONES.index(piece.bone)
        planes = planes_of(piece, lambda place: place_of(face, place))
        for k, name in enumerate(piece_names(piece)):
            if k:
                planes = [(words, MIRROR * point, MIRROR * normal) for words, point, normal in planes]
            cuts += [(point, normal) for _, point, normal in planes]
            what = f"piece {name!r}"
            mesh, rest[bone] = cut.cut_out(
                rest[bone], planes, f"{what} of the {piece.bone}", largest=piece.keep == "largest"
            )
            fragments.append(_fragment(face, piece, name, bone, mesh, mirrored=bool(k)))
    operation = Operation(plan, face, (rest[0], rest[1]), tuple(fragments), (), tuple(cuts))
    operation = replace(operation, parts=_parts(face, operation))
    _reject_far(operation)
    _reject_overlap(operation)
    return operation


def place_of(face: Face, place: Place) -> Floats:
    """Return the point that a place names, (3,) [mm]: numbers, a landmark of the skull, or one of the skin.

    Raises `UserError` for an unknown landmark, naming the nearest.
    """
    if not isinstance(place, str):
        return np.asarray(place, dtype=np.float64)
    skull = face.skull
    special = {n: getattr(skull, n) for n in ("incisor_upper", "incisor_lower", "condyle_left", "condyle_right")}
    if place in special:
        return np.asarray(special[place], dtype=np.float64)
    if place in skull.landmarks:
        return skull.landmarks[place]
    if place in face.landmarks:
        return np.asarray(face.mesh.points[face.landmarks[place]])
    raise unknown_name("landmark", place, {*special, *skull.landmarks, *face.landmarks})


def _fragment(face: Face, piece: Piece, name: str, bone: int, mesh: TriMesh, *, mirrored: bool) -> Fragment:
    """Return a piece with all its moves made into one turn about its centre and one shift."""
    centre = cut.centroid(mesh)
    total = np.eye(4)
    for move in piece.move:
        total = _one_move(face, move, moved(centre[None], total)[0], mirrored=mirrored) @ total
    shift = moved(centre[None], total)[0] - centre
    return Fragment(name, bone, mesh, centre, rotation_vector(total[:3, :3]), shift, piece.overlap)


def _one_move(face: Face, move: Move, centre: Floats, *, mirrored: bool) -> Floats:
    """Return one move as a matrix (4, 4); the mirror image of a turn is about the mirrored axis, the other way."""
    pose = np.eye(4)
    flip = MIRROR if mirrored else np.ones(3)
    if move.translation is not None:
        pose[:3, 3] = flip * np.asarray(move.translation)
        return pose
    assert move.axis is not None and move.degrees is not None
    about = centre if move.about == "centroid" else flip * place_of(face, move.about)
    sign = -1.0 if mirrored else 1.0
    pose[:3, :3] = rotation(flip * np.asarray(move.axis), sign * math.radians(move.degrees))
    pose[:3, 3] = about - pose[:3, :3] @ about
    return pose


def rotation_vector(matrix: Floats) -> Floats:
    """Return axis times angle [rad], (3,), of a rotation (3, 3) by less than half a turn."""
    skew = 0.5 * np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine = float(np.linalg.norm(skew))
    angle = math.atan2(sine, 0.5 * (float(np.trace(matrix)) - 1.0))
    return skew * (angle / sine) if sine > 1e-12 else np.zeros(3)


def _parts(face: Face, operation: Operation) -> tuple[Part, ...]:
    """Return the parts of eyes and mouth; each that hangs together goes with the piece of its bone that is nearest."""
    out: list[Part] = []
    for part in face.parts:
        pieces = [2 + k for k, f in enumerate(operation.fragments) if f.bone == part.bone]
        if not pieces or not part.name.startswith(("teeth", "gums", "tongue")):
            out.append(part)
            continue
        mesh = TriMesh(part.points, part.triangles)
        label = cut.part_labels(mesh)
        bones = [part.bone, *pieces]
        centre = part.points[part.triangles].mean(axis=1)
        distance = np.stack([_distance(centre, operation.bones[b]) for b in bones])
        total = np.stack([np.bincount(label, row) for row in distance])
        nearest = np.array(bones)[np.argmin(total, axis=0)][label]
        out += [
            replace(part, triangles=np.ascontiguousarray(part.triangles[nearest == b]), bone=b)
            for b in bones
            if (nearest == b).any()
        ]
    return tuple(out)


def _distance(points: Floats, bone: TriMesh) -> Floats:
    return point_distance(points, bone)[0]


def _reject_far(operation: Operation) -> None:
    for fragment in operation.fragments:
        if fragment.travel > FARTHEST:
            raise UserError(
                f"piece {fragment.name!r} would be carried {fragment.travel:.0f} mm; at most {FARTHEST:g} mm are "
                "possible in an operation: check translation, degrees and `about`"
            )


def _reject_overlap(operation: Operation) -> None:
    """Raise `UserError` for a piece that goes into other bone by more than it is allowed, on its way or at the end.

    The way is that of `Operation.poses`.
    """
    stages = max(1, math.ceil(operation.travel / STRIDE))
    for bone, k in product(range(2, len(operation.names)), range(stages)):
        fragment = operation.fragments[bone - 2]
        depth, where, other = deepest(operation, bone, (k + 1) / stages)
        if depth > fragment.overlap:
            x, y, z = where
            raise UserError(
                f"piece {fragment.name!r} would go {depth:.1f} mm into {_words(operation, other)} at x {x:.0f}, y {y:.0f}, "
                f"z {z:.0f} mm; move it less or elsewhere, cut it smaller, or allow it with overlap = "
                f"{math.ceil(10 * depth + 0.5) / 10:g} if that bone is taken away"
            )


def _words(operation: Operation, bone: int) -> str:
    name = operation.names[bone]
    return f"the {'rest of the ' if bone in operation.parents[2:] else ''}{name}" if bone < 2 else f"piece {name!r}"


def deepest(operation: Operation, bone: int, fraction: float) -> tuple[float, Floats, int]:
    """Return how much deeper than at rest a bone lies in any other after a `fraction` of the way: depth, place, which.

    Surfaces are probed about every `SAMPLE` mm, those of the bone in the others and those of the others in it.
    """
    poses = operation.poses(fraction)
    best, where, which = 0.0, np.zeros(3), bone
    for other in range(len(poses)):
        if other == bone or not len(operation.bones[other].triangles):
            continue
        for a, b in ((bone, other), (other, bone)):
            points = operation.probes[a]
            head = moved(points, poses[a])
            there = moved(head, np.linalg.inv(poses[b]))
            low, high = operation.bones[b].points.min(axis=0), operation.bones[b].points.max(axis=0)
            near = np.flatnonzero(((there >= low) & (there <= high)).all(axis=1))
            if not len(near):
                continue
            extra = operation.depth(b, there[near]) - operation.depth(b, points[near])
            k = int(np.argmax(extra))
            if extra[k] > best:
                best, where, which = float(extra[k]), head[near[k]], other
    return best, where, which


def samples(mesh: TriMesh) -> Floats:
    """Return points spread evenly over a surface, (k, 3) [mm]: inside each triangle, about `SAMPLE` apart."""
    corner = mesh.points[mesh.triangles]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    rows = np.clip(np.ceil(longest / SAMPLE).astype(int), 1, 64)
    out = [np.zeros((0, 3))]
    for n in np.unique(rows):
        i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
        inside = i + j < n
        u, v = (i[inside] + 1 / 3) / n, (j[inside] + 1 / 3) / n
        weight = np.stack([1.0 - u - v, u, v], axis=1)
        out.append(np.einsum("ka,tai->tki", weight, corner[rows == n]).reshape(-1, 3))
    return np.concatenate(out)


def bone_shares(operation: Operation, points: Floats, weight: Floats, blend: float) -> Floats:
    """Return how far each bone carries `points` (n, 3) that cranium and jaw carried by `weight` (n, 2), (n, n_bone).

    What a bone carried is shared out among what was cut from it, by nearness; the change takes `blend` [mm].
    """
    out = np.zeros((len(points), len(operation.names)))
    for bone in range(2):
        group = np.flatnonzero(operation.parents == bone)
        row = np.flatnonzero(weight[:, bone] > 0.0)
        if len(group) == 1 or not len(row):
            out[:, bone] = weight[:, bone]
            continue
        distance = np.stack([_to_bone(operation, int(b), points[row]) for b in group], axis=1)
        share = np.zeros_like(distance)
        for k in range(len(group)):
            t = np.clip(0.5 + (np.delete(distance, k, axis=1).min(axis=1) - distance[:, k]) / blend, 0.0, 1.0)
            share[:, k] = t * t * (3.0 - 2.0 * t)
        share /= share.sum(axis=1, keepdims=True)
        out[np.ix_(row, group)] = share * weight[row, bone][:, None]
    return out


def _to_bone(operation: Operation, bone: int, points: Floats) -> Floats:
    """Return the distance to a bone with its teeth and gums, (n,) [mm]."""
    surfaces: Sequence[TriMesh] = (operation.bones[bone], *operation.teeth(bone))
    return np.min([_distance(points, surface) for surface in surfaces], axis=0)


def bite(operation: Operation, poses: Floats) -> dict[str, float]:
    """Return how far the upper incisors stand before the lower ones ("overjet") and overlap them ("overbite") [mm].

    poses : (n_bone, 4, 4); each incisor goes with the bone that carries its tooth, and the jaw does not give way.
    """
    tips = []
    for name, tip in (("upper", operation.face.skull.incisor_upper), ("lower", operation.face.skull.incisor_lower)):
        parts = [p for p in operation.parts if p.name == f"teeth_{name}" and len(p.triangles)]
        if not parts:
            return {}
        nearest = min(parts, key=lambda part: float(_distance(tip[None], TriMesh(part.points, part.triangles))[0]))
        tips.append(moved(tip[None], poses[nearest.bone])[0])
    upper, lower = tips
    return {"overjet": float(upper[2] - lower[2]), "overbite": float(lower[1] - upper[1])}
