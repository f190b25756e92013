"""Flesh as a volume: tetrahedra with materials, the nodes that bones hold, and the surface that it carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from faceanim.body.body import Attachment, Body, Bone, Muscles
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import FACES, TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material
from faceanim.tissue.spring_law import SpringLaw


@dataclass(frozen=True, eq=False)
class ThinLayer:
    """An outer layer one element thick, which a model may replace by a shell.

    region : the material of its elements   outer, inner : (m,) nodes on either side, pair by pair
    triangles : (t, 3) over the pairs, outside to the left
    """

    region: int
    outer: Ints
    inner: Ints
    triangles: Ints

    @classmethod
    def between(cls, mesh: TetMesh, region: Ints, which: int, outer: Ints, inner: Ints) -> ThinLayer:
        """Return the layer of the elements of material `which` between the nodes `outer` (m,) and `inner` (m,)."""
        pair = np.full(len(mesh.points), -1, dtype=np.int32)
        pair[outer] = np.arange(len(outer))
        outside = pair[mesh.tets] >= 0
        on_top = (region == which) & (outside.sum(axis=1) == 3)
        faces = FACES[np.argmin(outside[on_top], axis=1)]
        return cls(which, outer, inner, pair[np.take_along_axis(mesh.tets[on_top], faces, axis=1)])


@dataclass(frozen=True, eq=False)
class Solid:
    """The volume of a body, in its rest frame.

    mesh : e elements over n nodes   materials : one per region   region : (e,) index into `materials`
    bone_weight : (n, n_bone) [-]; a node held by bones has a row that sums to 1 and goes where their weighted poses
    take it, a free node a row of zeros
    skin : the body's surface vertices as carried by the nodes
    layer : the skin as a layer of the mesh, None = there is none
    damping [1/s], stiffness_damping [s] : Rayleigh coefficients xi and zeta, the force -(xi M + zeta K) v; they stand
    for those of the body, which are made for a sheet
    """

    mesh: TetMesh
    materials: tuple[Material, ...]
    region: Ints
    bone_weight: Floats
    skin: Embedding
    damping: float = 0.0
    stiffness_damping: float = 0.0
    layer: ThinLayer | None = None

    def __post_init__(self) -> None:
        e, n = len(self.mesh.tets), len(self.mesh.points)
        if self.region.shape != (e,) or (e and not 0 <= self.region.min() <= self.region.max() < len(self.materials)):
            raise UserError(f"solid: region must give each of the {e} elements one of {len(self.materials)} materials")
        sums = self.bone_weight.sum(axis=1)
        if self.bone_weight.ndim != 2 or len(sums) != n:
            raise UserError(f"solid: bone_weight has shape {self.bone_weight.shape}; ({n}, number of bones) is needed")
        if n and np.minimum(np.abs(sums), np.abs(sums - 1.0)).max() > 1e-9:
            raise UserError("solid: a row of bone_weight must sum to 1 (held) or be zero (free)")

    @cached_property
    def held(self) -> Bools:
        """Nodes that the bones carry, (n,)."""
        return np.asarray(self.bone_weight.sum(axis=1) > 0.5)

    @cached_property
    def density(self) -> Floats:
        """(e,) [kg/mm^3]."""
        return np.array([m.density for m in self.materials])[self.region]

    @cached_property
    def node_mass(self) -> Floats:
        """A quarter of the mass of the elements at each node, (n,) [kg]."""
        share = np.repeat(self.density * self.mesh.volumes / 4.0, 4)
        return np.asarray(np.bincount(self.mesh.tets.ravel(), share, len(self.mesh.points)), dtype=np.float64)

    def lame(self) -> tuple[Floats, Floats]:
        """Return lambda and mu of every element, 2 x (e,) [kPa]."""
        pairs = np.array([(m.lame_first, m.shear_modulus) for m in self.materials])[self.region]
        return np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])

    def reject_bad(self) -> None:
        """Raise `UserError` for inverted or flat elements, loose nodes, or a part of the volume that no bone holds."""
        self.mesh.reject_bad()
        count = int(self.mesh.parts.max()) + 1
        held = np.zeros(count, dtype=bool)
        np.logical_or.at(held, self.mesh.parts, self.held[self.mesh.tets].any(axis=1))
        if not held.all():
            part = int(np.argmin(held))
            size = int((self.mesh.parts == part).sum())
            whole = "the body is free" if count == 1 else f"part {part} of {count} ({size} elements) is free"
            raise UserError(
                f"{whole}: no bone holds any of its nodes, so it would float away; hold at least three nodes"
            )


def solid_body(
    mesh: TetMesh,
    material: Material | Sequence[Material],
    held: Any,
    *,
    region: Any = None,
    bone: Any = 0,
    bones: Sequence[str] = ("cranium",),
    damping: float = 0.0,
    stiffness_damping: float = 0.0,
    muscles: Muscles | None = None,
    surface: TriMesh | None = None,
    skin: Embedding | None = None,
) -> Body:
    """Return a body made of flesh alone: its surface is the boundary of `mesh`, or what it carries.

    held : (n,) bool or node indices held by a bone   bone : which one, a number or (n,), index into `bones`
    region : (e,) index into the materials (default: all 0)
    damping, stiffness_damping : Rayleigh coefficients xi [1/s] and zeta [s]
    surface, skin : another surface and its vertices as carried by the nodes (see `geometry.filling.filled`)
    Raises `UserError` for elements that are inverted or flat.
    """
    mesh.reject_bad()
    n = len(mesh.points)
    holds = np.zeros(n, dtype=bool)
    which = np.asarray(held)
    holds[which if which.dtype == bool else which.astype(np.int64)] = True
    weight = np.zeros((n, len(bones)))
    weight[holds, np.broadcast_to(np.asarray(bone), (n,))[holds]] = 1.0
    materials = (material,) if isinstance(material, Material) else tuple(material)
    regions = np.zeros(len(mesh.tets), dtype=np.int32) if region is None else np.asarray(region, dtype=np.int32)
    if surface is None or skin is None:
        surface, skin = mesh.boundary, Embedding.of_nodes(mesh.boundary_nodes)
    solid = Solid(mesh, materials, regions, weight, skin, damping, stiffness_damping)
    young = np.array([m.young_modulus for m in materials])[regions]
    thickness = float(mesh.volumes.sum() / surface.areas.sum())
    pinned = (holds[skin.node] | (skin.weight == 0.0)).all(axis=1)
    anchored = np.where(pinned[:, None], skin.apply(weight), np.eye(len(bones))[0])
    return Body(
        surface=surface,
        mass=surface.vertex_areas / surface.areas.sum() * solid.node_mass.sum(),
        membrane_modulus=np.full(len(surface.triangles), float(np.average(young, weights=mesh.volumes)) * thickness),
        law=SpringLaw(),
        damping=damping,
        pinned=pinned,
        attachment=Attachment(anchored, np.zeros(len(pinned))),
        muscles=Muscles.none() if muscles is None else muscles,
        bones=tuple(Bone(name) for name in bones),
        volume=lambda: solid,
    )
