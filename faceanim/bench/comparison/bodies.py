"""The bodies of the comparison's simple scenes: bars and a block of flesh, and a patch of skin and fat on bone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from faceanim.body.body import PULL_TO_POINT, Attachment, Body, Muscles
from faceanim.body.solid import solid_body
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.tissue.material import Material

DENSITY = 1.04e-6
"""Of all flesh [kg/mm^3]."""
BAR = (100.0, 20.0, 20.0)
BLOCK = (50.0, 10.0, 10.0)
CELLS = {"coarse": (10, 2, 2), "default": (20, 4, 4), "fine": (40, 8, 8)}
"""Cubes of the bar and of the block along x, y and z."""
PATCH = (60.0, 60.0, 8.0)
PATCH_CELLS = {"coarse": (12, 12, 4), "default": (24, 24, 4), "fine": (48, 48, 4)}
SKIN_DEPTH = 2.0
"""Thickness of the patch's skin [mm], one cube; the fat below takes the rest."""
SKIN = Material("skin", DENSITY, 55.0, 0.45)
FAT = Material("fat", DENSITY, 5.0, 0.45)


def bar(
    density: str,
    material: Material,
    *,
    size: tuple[float, float, float] = BAR,
    both_ends: bool = False,
    damping: float = 20.0,
    stiffness_damping: float = 0.0,
) -> Body:
    """Return a bar along x, held at x = 0 by the cranium and, with `both_ends`, at its far end by the jaw."""
    mesh = box_tets(CELLS[density], size)
    x = mesh.points[:, 0]
    far = x > size[0] - 1e-9
    held = (x < 1e-9) | (far if both_ends else False)
    bones = ("cranium", "jaw") if both_ends else ("cranium",)
    return solid_body(
        mesh, material, held, bone=far.astype(int) * both_ends, bones=bones,
        damping=damping, stiffness_damping=stiffness_damping,
    )  # fmt: skip


def patch(density: str) -> Body:
    """Return skin on fat on bone, 60 x 60 x 8 mm, its surface the skin's outside; two bones beneath, one muscle.

    Backends of solids see the layers; those of sheets the skin as a membrane (modulus times thickness), tied to bone by
    the fat's shear stiffness G / t per area, which also passes shear on sideways (G t / 3 of a layer whose displacement
    falls linearly to the bone). The cranium holds the left half, the jaw the right one, changing over between x = -10
    and 10 mm; the rim moves with them. The muscle pulls a disc of 16 mm towards a point on the bone.
    """
    nx, ny, nz = PATCH_CELLS[density]
    mesh = box_tets((nx, ny, nz), PATCH)
    mesh = TetMesh(mesh.points - [30.0, 30.0, 0.0], mesh.tets)
    x, y, z = mesh.points.T
    rim = (np.abs(np.abs(x) - 30.0) < 1e-9) | (np.abs(np.abs(y) - 30.0) < 1e-9)
    held = (z < 1e-9) | rim
    share = np.clip((x + 10.0) / 20.0, 0.0, 1.0)
    share = share**2 * (3.0 - 2.0 * share)
    skin = (mesh.points[mesh.tets, 2].mean(axis=1) > PATCH[2] - SKIN_DEPTH).astype(np.int32)
    plain = solid_body(
        mesh, (FAT, SKIN), held, region=skin, bone=0, bones=("cranium", "jaw"), damping=19.0, stiffness_damping=0.055
    )
    assert plain.solid is not None
    weight = np.where(held[:, None], np.stack([1.0 - share, share], axis=1), 0.0)
    top = np.flatnonzero(z > PATCH[2] - 1e-9).astype(np.int32)
    number = np.full(len(z), -1, dtype=np.int32)
    number[top] = np.arange(len(top))
    triangles = number[mesh.boundary_triangles]
    surface = TriMesh(mesh.points[top], triangles[(triangles >= 0).all(axis=1)])
    solid = replace(plain.solid, bone_weight=weight, skin=Embedding.of_nodes(top))
    depth, shear = PATCH[2] - SKIN_DEPTH, FAT.shear_modulus
    area = surface.vertex_areas
    t = len(surface.triangles)
    return replace(
        plain,
        surface=surface,
        mass=area * PATCH[2] * DENSITY,
        membrane_modulus=np.full(t, SKIN.young_modulus * SKIN_DEPTH),
        damping=shear / depth * 0.055 / (PATCH[2] * DENSITY),
        pinned=rim[top],
        attachment=Attachment(
            np.stack([1.0 - share, share], axis=1)[top], area * shear / depth, shear=np.full(t, shear * depth / 3.0)
        ),
        muscles=_one_muscle(surface.points, area * ~rim[top]),
        volume=lambda: solid,
    )


def _one_muscle(points: np.ndarray, area: np.ndarray) -> Muscles:
    """Return a muscle that pulls the skin around x = 8 mm towards a point on the bone."""
    r = np.hypot(points[:, 0] - 8.0, points[:, 1])
    node = np.flatnonzero((r < 8.0 - 1e-9) & (area > 0.0)).astype(np.int32)
    weight = area[node] * (1.0 - (r[node] / 8.0) ** 2) ** 2
    k = len(node)
    zeros = np.zeros(k, np.int32)
    return Muscles(
        ("pull",), np.array([900.0]), zeros, node, weight / weight.sum(), np.full(k, PULL_TO_POINT, np.int32),
        np.tile([-22.0, 0.0, 2.0], (k, 1)), zeros, np.ones(k),
    )  # fmt: skip
