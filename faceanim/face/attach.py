"""How the skin of a head is held: which bone carries each vertex, how firmly, and what it must not enter."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from faceanim.body.body import BoneContact, PairContact, SphereContact
from faceanim.face.geodesic import distance_along, harmonic_field
from faceanim.face.tissue import Contact, Hypodermis
from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints

SKIN, LIP, MUCOSA, LID, EAR, SCALP, NECK = range(7)
"""Codes of the skin regions in the face files."""


def mouth_side(mesh: TriMesh, region: Ints, lip_upper: Ints, lip_lower: Ints) -> Ints:
    """Return +1 where the upper lip is nearer along the skin, -1 where the lower lip is, (n,)."""
    upper = distance_along(mesh, lip_upper[region[lip_upper] == LIP])
    lower = distance_along(mesh, lip_lower[region[lip_lower] == LIP])
    return np.where(upper <= lower, 1, -1).astype(np.int32)


def jaw_share(
    mesh: TriMesh, region: Ints, side: Ints, depth_cranium: Floats, depth_jaw: Floats, hypodermis: Hypodermis
) -> Floats:
    """Return the share of each vertex that the jaw carries, (n,) in [0, 1], smooth along the skin.

    The nearer bone draws each vertex the more, the clearer the choice is; around the mouth the lip that a vertex
    belongs to decides; the neck is left to the smooth field between chin and cut.
    """
    nearer = depth_cranium - depth_jaw
    wanted = np.where(nearer > 0, 1.0, 0.0)
    clear = np.clip(np.abs(nearer) / hypodermis.clear_choice, 0.0, 1.0) ** 2
    lips = (region == LIP) | (region == MUCOSA)
    wanted = np.where(lips, np.where(side > 0, 0.0, 1.0), wanted)
    clear = np.where(lips, 0.6, clear)
    loose = region == NECK
    fixed = (region == SCALP) | (region == EAR)
    wanted = np.where(fixed | loose, 0.0, wanted)
    clear = np.where(loose, 0.05, clear)
    share = harmonic_field(mesh, fixed, wanted, clear / hypodermis.blend_length**2)
    return np.clip(share, 0.0, 1.0)


def attachment_stiffness(
    mesh: TriMesh, region: Ints, depth: Floats, margin_distance: Floats, hypodermis: Hypodermis
) -> Floats:
    """Return the stiffness of each vertex's tie to bone, (n,) [mN/mm]: modulus * area / thickness * regional factor.

    Around the mouth and eye openings the tie fades: `margin_distance` (n,) [mm] along the skin from the lip and lid
    margins, 0 there.
    """
    thickness = np.maximum(depth, hypodermis.smallest_thickness)
    factor = np.ones(len(depth))
    for code, value in ((LIP, hypodermis.lip), (LID, hypodermis.lid), (MUCOSA, hypodermis.mucosa)):
        factor[region == code] = value
    skin = (region == SKIN) | (region == NECK)
    ramp = np.clip(margin_distance / hypodermis.fade_length, 0.0, 1.0)
    fade = hypodermis.lip + (1.0 - hypodermis.lip) * ramp**2 * (3.0 - 2.0 * ramp)
    factor = np.where(skin, factor * fade, factor)
    return hypodermis.modulus * mesh.vertex_areas / thickness * factor


def bone_contact(
    points: Floats, candidates: Bools, grids: tuple[DistanceGrid, ...], reach: float, clearance: float
) -> BoneContact:
    """Return the pairs (vertex, bone) that can meet: within `reach` [mm] at rest; none is in contact at rest."""
    nodes, bones, gaps = [], [], []
    index = np.flatnonzero(candidates)
    for b, grid in enumerate(grids):
        distance = grid.sample(points[index])
        near = distance < reach
        nodes.append(index[near])
        bones.append(np.full(int(near.sum()), b))
        gaps.append(np.minimum(clearance, 0.9 * np.maximum(distance[near], 0.0)))
    return BoneContact(
        np.concatenate(nodes).astype(np.int32), np.concatenate(bones).astype(np.int32), np.concatenate(gaps)
    )


def eyeball_contact(
    points: Floats, name: str, centre: Floats, radius: float, contact: Contact, lid_thickness: float
) -> SphereContact:
    """Return the contact of all skin within 5 mm of an eyeball with it; nothing is in contact at rest."""
    gap = np.linalg.norm(points - centre, axis=1) - radius
    node = np.flatnonzero(gap < 5.0).astype(np.int32)
    clearance, thick = (np.minimum(c, 0.9 * np.maximum(gap[node], 0.0)) for c in (contact.eye_clearance, lid_thickness))
    return SphereContact(name, centre, radius, node, clearance, contact.eye_hardness, thick)


def pair_contact(mesh: TriMesh, name: str, upper: Ints, lower: Ints, reach: float, gap: float) -> PairContact:
    """Return the contact of two sheets: each vertex against the other sheet's triangles within `reach` [mm] at rest."""
    node, count, found = [], [], []
    for own, other in ((upper, lower), (lower, upper)):
        inside = np.zeros(len(mesh.points), dtype=bool)
        inside[other] = True
        triangles = np.flatnonzero(inside[mesh.triangles].all(axis=1))
        centres = mesh.points[mesh.triangles[triangles]].mean(axis=1)
        hits = cKDTree(centres).query_ball_point(mesh.points[own], reach, return_sorted=True)
        for i, hit in zip(own, hits, strict=True):
            if hit:
                node.append(i)
                count.append(len(hit))
                found.append(triangles[hit])
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    flat = np.concatenate(found) if found else np.zeros(0)
    return PairContact(name, np.array(node, dtype=np.int32), start, flat.astype(np.int32), gap)
