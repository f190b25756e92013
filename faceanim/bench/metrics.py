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
        self._gaps = [_PairGap(pair, body.surface.triangles) for pair in body.pairs]
        normals = _vertex_normals(rest, body.surface.triangles)[1]
        self._rest_gaps = [gap.measure(rest, normals) for gap in self._gaps]
        self._bone_rows = _bone_rows(body)

    def at(self, points: Floats, control: Control) -> Soundness:
        """Return how sound the skin is at `points` (n, 3) [mm] under `control`."""
        points = np.asarray(points)
        normals = _vertex_normals(points, self.body.surface.triangles)[1]
        crossed = {
            gap.pair.name: float(
                np.max(np.maximum(-gap.measure(points, normals), 0.0) - np.maximum(-rest, 0.0), initial=0.0)
            )
            for gap, rest in zip(self._gaps, self._rest_gaps)
        }
        return Soundness(
            inverted_triangles=int((_against_surroundings(points, self.body.surface.triangles) & ~self._turned).sum()),
            depth_in_bone=self._depth_in_bone(points, control),
            depth_in_eyeball=max((_depth_in_sphere(sphere, points) for sphere in self.body.spheres), default=0.0),
            depth_crossed=crossed,
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
    """Return how deep [mm] a vertex of one sheet lies behind the other sheet, beyond what is so at rest."""
    gap = _PairGap(pair, mesh.triangles)
    before, after = (gap.measure(p, _vertex_normals(p, mesh.triangles)[1]) for p in (mesh.points, points))
    return float(np.max(np.maximum(-after, 0.0) - np.maximum(-before, 0.0), initial=0.0))


class _PairGap:
    """Signed distance of each vertex of a pair contact to the other sheet, where that is within `reach` [mm]."""

    def __init__(self, pair: PairContact, triangles: Ints, reach: float = 4.0) -> None:
        self.pair, self.reach = pair, reach
        count = np.diff(pair.start)
        self._watched = np.flatnonzero(count)
        self._owner = np.repeat(np.arange(len(self._watched)), count[self._watched])
        self._first = pair.start[:-1][self._watched]
        unique, self._triangle = np.unique(pair.triangle, return_inverse=True)
        self._corners = triangles[unique]

    def measure(self, points: Floats, normals: Floats) -> Floats:
        """Return the distances (c,) [mm], negative behind; `reach` where no triangle is near."""
        gap = np.full(len(self.pair.node), self.reach)
        if not len(self._owner):
            return gap
        node = self.pair.node[self._watched]
        row = self._candidates(points, node)
        corners = self._corners[self._triangle[row]]
        x = points[node[self._owner[row]]]
        bary = closest_on_triangles(x, *(points[corners[:, k]] for k in range(3)))
        foot = np.einsum("ek,ekj->ej", bary, points[corners])
        normal = np.einsum("ek,ekj->ej", bary, normals[corners])
        distance = np.linalg.norm(x - foot, axis=1)
        sign = np.where(np.einsum("ij,ij->i", x - foot, normal) < 0.0, -1.0, 1.0)
        order = np.argsort(-distance, kind="stable")
        order = order[distance[order] < self.reach]
        gap[self._watched[self._owner[row[order]]]] = (sign * distance)[order]
        return gap

    def _candidates(self, points: Floats, node: Ints) -> Ints:
        """Return the (vertex, triangle) rows that can hold the nearest triangle, by the triangles' bounding spheres."""
        corner = points[self._corners]
        centre = corner.mean(axis=1)
        size = np.sqrt(((corner - centre[:, None]) ** 2).sum(axis=2).max(axis=1))[self._triangle]
        apart = points[node][self._owner] - centre[self._triangle]
        distance = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        bound = np.minimum.reduceat(distance + size, self._first)
        low = distance - size
        return np.flatnonzero((low <= bound[self._owner]) & (low < self.reach)).astype(np.int32)


def closest_on_triangles(x: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the barycentric coordinates (e, 3) of the point of triangle (a, b, c)[e] closest to x[e], all (e, 3)."""
    ab, ac, ax = b - a, c - a, x - a
    d00, d01, d11 = (np.einsum("ij,ij->i", p, q) for p, q in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = (np.einsum("ij,ij->i", ax, p) for p in (ab, ac))
    det = np.maximum(d00 * d11 - d01 * d01, 1e-30)
    v, w = (d11 * d20 - d01 * d21) / det, (d00 * d21 - d01 * d20) / det
    best = np.stack([1.0 - v - w, v, w], axis=1)
    outside = (best < 0.0).any(axis=1)
    corners, zero = (a, b, c), np.zeros(len(x))
    nearest = np.full(len(x), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corners[j] - corners[i]
        length = np.maximum(np.einsum("ij,ij->i", edge, edge), 1e-30)
        t = np.clip(np.einsum("ij,ij->i", x - corners[i], edge) / length, 0.0, 1.0)
        distance = np.linalg.norm(x - corners[i] - t[:, None] * edge, axis=1)
        closer = outside & (distance < nearest)
        nearest = np.where(closer, distance, nearest)
        weights = [zero, zero, zero]
        weights[i], weights[j] = 1.0 - t, t
        best = np.where(closer[:, None], np.stack(weights, axis=1), best)
    return best
