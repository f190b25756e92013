"""What is measured on surface points: how far landmarks moved, whether the skin is sound, how far two runs differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faceanim.body.body import Body, PairContact, SphereContact
from faceanim.body.control import Control
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints

if TYPE_CHECKING:
    from faceanim.face.face import Face


@dataclass(frozen=True)
class FieldError:
    """Distance between two sets of points [mm]: the largest and the root mean square over all vertices."""

    max: float
    rms: float


def field_error(points: Floats, reference: Floats) -> FieldError:
    """Return how far `points` (n, 3) lie from `reference` (n, 3)."""
    squared = ((points - reference) ** 2).sum(axis=1)
    return FieldError(float(np.sqrt(squared.max())), float(np.sqrt(squared.mean())))


def worst(errors: list[FieldError]) -> FieldError:
    """Return the largest maximum and the largest RMS of several comparisons."""
    return FieldError(max(e.max for e in errors), max(e.rms for e in errors))


def landmark_movement(face: Face, points: Floats) -> dict[str, list[float]]:
    """Return the displacement (x, y, z) [mm] of every landmark of `face` when its skin is at `points`."""
    return {name: (points[i] - face.mesh.points[i]).tolist() for name, i in face.landmarks.items()}


def movements(face: Face, points: Floats, control: Control) -> dict[str, float]:
    """Return the movements that clinicians measure, for those landmarks that `face` has.

    Mouth corners: distance, and out, up, back [mm]; mouth width [%]; inner and outer brow rise [mm]; lid aperture [mm];
    opening between the incisors [mm]; the largest movement of any vertex [mm].
    """
    rest, at = face.mesh.points, face.landmarks
    out = {"largest_movement_mm": float(np.linalg.norm(points - rest, axis=1).max())}
    for side, outward in (("left", 1.0), ("right", -1.0)):
        corner = at.get(f"cheilion_{side}")
        if corner is not None:
            d = points[corner] - rest[corner]
            out[f"mouth_corner_{side}_mm"] = float(np.linalg.norm(d))
            out[f"mouth_corner_{side}_out_mm"] = float(outward * d[0])
            out[f"mouth_corner_{side}_up_mm"] = float(d[1])
            out[f"mouth_corner_{side}_back_mm"] = float(-d[2])
        brow = at.get(f"mid_supraorbital_{side}")
        if brow is not None:
            out[f"brow_rise_{side}_mm"] = float(points[brow, 1] - rest[brow, 1])
        upper, lower = at.get(f"lid_upper_mid_{side}"), at.get(f"lid_lower_mid_{side}")
        if upper is not None and lower is not None:
            out[f"lid_aperture_{side}_mm"] = float(np.linalg.norm(points[upper] - points[lower]))
    if "cheilion_left" in at and "cheilion_right" in at:
        before, after = (np.linalg.norm(p[at["cheilion_left"]] - p[at["cheilion_right"]]) for p in (rest, points))
        out["mouth_width_change_percent"] = float(100.0 * (after / before - 1.0))
    upper, lower = (getattr(face.skull, f"incisor_{jaw}", None) for jaw in ("upper", "lower"))
    if upper is not None and lower is not None:
        pose = control.bone_pose[1]
        out["incisor_opening_mm"] = float(np.linalg.norm(pose[:3, :3] @ lower + pose[:3, 3] - upper))
    return out


def principal_strain(mesh: TriMesh, points: Floats) -> Floats:
    """Return the principal strain of largest size around each vertex, (n,) [-]: positive stretched, negative squeezed.

    Stretches minus one (Biot), from each triangle's own deformation, averaged by area.
    """
    edges = np.stack([mesh.points[mesh.triangles[:, k]] - mesh.points[mesh.triangles[:, 0]] for k in (1, 2)], axis=1)
    moved = np.stack([points[mesh.triangles[:, k]] - points[mesh.triangles[:, 0]] for k in (1, 2)], axis=1)
    rest_gram = np.einsum("tij,tkj->tik", edges, edges)
    gram = np.einsum("tij,tkj->tik", moved, moved)
    # Squared stretches: eigenvalues of rest_gram^-1 gram, from trace and determinant.
    trace = np.einsum("tii->t", np.linalg.solve(rest_gram, gram))
    det = np.linalg.det(gram) / np.linalg.det(rest_gram)
    root = np.sqrt(np.maximum(0.25 * trace**2 - det, 0.0))
    high, low = (np.sqrt(np.maximum(0.5 * trace + sign * root, 0.0)) - 1.0 for sign in (1.0, -1.0))
    strain = np.where(np.abs(high) >= np.abs(low), high, low)
    total = np.zeros(len(points))
    np.add.at(total, mesh.triangles.ravel(), np.repeat(strain * mesh.areas / 3.0, 3))
    area = mesh.vertex_areas
    return np.divide(total, area, out=np.zeros_like(total), where=area > 0.0)


@dataclass(frozen=True)
class Soundness:
    """What must not happen to skin: triangles turned over, depths below bone, eyeball, opposite lip or lid [mm]."""

    inverted_triangles: int
    depth_in_bone: float
    depth_in_eyeball: float
    depth_crossed: dict[str, float]


class SkinCheck:
    """Checks how sound the skin of `body` is, frame after frame; depths count from what they are at rest."""

    def __init__(self, body: Body) -> None:
        self.body = body
        rest = body.surface.points
        self._turned = _against_surroundings(rest, body.surface.triangles)
        self._crossings = [_Crossing(pair, body.surface) for pair in body.pairs]
        self._bone_rows = _bone_rows(body)

    def at(self, points: Floats, control: Control) -> Soundness:
        """Return how sound the skin is at `points` (n, 3) [mm] under `control`."""
        points = np.asarray(points)
        return Soundness(
            inverted_triangles=int((_against_surroundings(points, self.body.surface.triangles) & ~self._turned).sum()),
            depth_in_bone=self._depth_in_bone(points, control),
            depth_in_eyeball=max((_depth_in_sphere(sphere, points) for sphere in self.body.spheres), default=0.0),
            depth_crossed={crossing.name: crossing.depth(points) for crossing in self._crossings},
        )

    def _depth_in_bone(self, points: Floats, control: Control) -> float:
        deepest = 0.0
        for k, node, at_rest in self._bone_rows:
            grid, pose = self.body.bones[k].grid, control.bone_pose[k]
            assert grid is not None
            local = (points[node] - pose[:3, 3]) @ pose[:3, :3]
            deepest = max(deepest, float((-grid.sample(local) - at_rest).max()))
        return deepest


def _bone_rows(body: Body) -> list[tuple[int, Ints, Floats]]:
    """Return (bone, vertices that may touch it, how deep they are at rest [mm]) for each bone with a grid."""
    contact = body.bone_contact
    rows: list[tuple[int, Ints, Floats]] = []
    for k, bone in enumerate(body.bones if contact is not None else ()):
        assert contact is not None
        node = contact.node[contact.bone == k]
        if bone.grid is not None and len(node):
            rows.append((k, node, np.maximum(-bone.grid.sample(body.surface.points[node]), 0.0)))
    return rows


def soundness(body: Body, points: Floats, control: Control) -> Soundness:
    """Return how sound the skin of `body` is at `points` (n, 3) [mm] under `control`, once; see `SkinCheck`."""
    return SkinCheck(body).at(points, control)


def soundest(checks: list[Soundness]) -> Soundness:
    """Return the worst of each figure over several frames."""
    return Soundness(
        inverted_triangles=max(c.inverted_triangles for c in checks),
        depth_in_bone=max(c.depth_in_bone for c in checks),
        depth_in_eyeball=max(c.depth_in_eyeball for c in checks),
        depth_crossed={name: max(c.depth_crossed[name] for c in checks) for name in checks[0].depth_crossed},
    )


def inverted_triangles(mesh: TriMesh, points: Floats) -> Ints:
    """Return the triangles that face against the skin around them at `points`, but not at rest.

    The skin around a triangle is the sum of its corners' normals (by area), as deformed.
    """
    turned = _against_surroundings(points, mesh.triangles) & ~_against_surroundings(mesh.points, mesh.triangles)
    return np.flatnonzero(turned).astype(np.int32)


def _vertex_normals(points: Floats, triangles: Ints) -> tuple[Floats, Floats]:
    """Return triangle normals scaled by area (t, 3), and unit normals of the vertices (n, 3)."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    facet = 0.5 * np.cross(b - a, c - a)
    corner = triangles.ravel()
    total = np.stack([np.bincount(corner, np.repeat(facet[:, k], 3), len(points)) for k in range(3)], axis=1)
    return facet, total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def _against_surroundings(points: Floats, triangles: Ints) -> Bools:
    facet, normal = _vertex_normals(points, triangles)
    return np.einsum("ij,ij->i", facet, normal[triangles].sum(axis=1)) < 0.0


def _depth_in_sphere(sphere: SphereContact, points: Floats) -> float:
    return float((sphere.radius - np.linalg.norm(points[sphere.node] - sphere.centre, axis=1)).max(initial=0.0))


def crossing_depth(mesh: TriMesh, pair: PairContact, points: Floats) -> float:
    """Return how deep [mm] one sheet of `pair` has gone through the other (or itself), 0 if nothing crosses."""
    crossing = _Crossing(pair, mesh)
    return max(0.0, crossing.depth(points))


class _Crossing:
    """Edges of two sheets that pass through their triangles, where they did not at rest.

    The depth of a crossing is the distance of the edge's nearer end from the plane of the triangle it goes through.
    """

    def __init__(self, pair: PairContact, mesh: TriMesh) -> None:
        self.name = pair.name
        self._corners = mesh.triangles[np.unique(pair.triangle)]
        sides = np.sort(self._corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        self._edges = np.unique(sides, axis=0) if len(sides) else sides
        self._at_rest: set[int] = set()
        self._at_rest = set(self._crossings(mesh.points)[0].tolist())

    def depth(self, points: Floats) -> float:
        """Return the depth [mm] of the deepest crossing at `points` (n, 3), 0 if there is none."""
        where, depth = self._crossings(points)
        new = ~np.isin(where, list(self._at_rest))
        return float(depth[new].max(initial=0.0))

    def _crossings(self, points: Floats) -> tuple[Ints, Floats]:
        """Return a number for each (edge, triangle) that cross, and its depth [mm]."""
        edge, triangle = self._near(points)
        p, q = (points[self._edges[edge, k]] for k in range(2))
        a, b, c = (points[self._corners[triangle, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        size = np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
        low, high = (np.einsum("ij,ij->i", x - a, normal) / size for x in (p, q))
        cut = low * high < 0.0
        t = low / np.where(cut, low - high, 1.0)
        x = p + t[:, None] * (q - p)
        for u, v in ((a, b), (b, c), (c, a)):
            cut &= np.einsum("ij,ij->i", np.cross(v - u, x - u), normal) >= 0.0
        depth = np.minimum(np.abs(low), np.abs(high))
        return (edge * len(self._corners) + triangle)[cut], depth[cut]

    def _near(self, points: Floats) -> tuple[Ints, Ints]:
        """Return the (edge, triangle) pairs whose boxes overlap and that share no vertex."""
        corner, ends = points[self._corners], points[self._edges]
        order = np.argsort(corner[:, :, 0].min(axis=1), kind="stable") if len(corner) else np.zeros(0, np.int64)
        low, high = corner[order].min(axis=1), corner[order].max(axis=1)
        widest = float((high[:, 0] - low[:, 0]).max(initial=0.0))
        first = np.searchsorted(low[:, 0], ends[:, :, 0].min(axis=1) - widest)
        count = np.searchsorted(low[:, 0], ends[:, :, 0].max(axis=1), side="right") - first
        edge = np.repeat(np.arange(len(ends)), count)
        row = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count - first, count)
        keep = np.ones(len(edge), dtype=bool)
        for k in range(3):
            start, stop = ends[:, :, k].min(axis=1)[edge], ends[:, :, k].max(axis=1)[edge]
            keep &= (low[row, k] <= stop) & (high[row, k] >= start)
        edge, triangle = edge[keep], order[row[keep]]
        shared = (self._edges[edge][:, :, None] == self._corners[triangle][:, None, :]).any(axis=(1, 2))
        return edge[~shared], triangle[~shared]
