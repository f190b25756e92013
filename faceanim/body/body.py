"""A body: one surface with its tissue, what holds it, what pulls it and what it must not enter.

Everything is frozen, in mm, kg, s (hence mN and kPa), in the head frame (x to the subject's left, y up, z forward).
Bone 0 is always there and stands still in the head frame (the cranium); further bones (the jaw) get their pose from
the `Control`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.tissue.spring_law import SpringLaw

if TYPE_CHECKING:
    from faceanim.body.solid import Solid

PULL_TO_POINT = 0
PULL_ALONG = 1


@dataclass(frozen=True, eq=False)
class Attachment:
    """Skin fastened to bone by the hypodermis: a spring from each vertex to an anchor that the bones carry.

    The anchor of vertex i is sum_b bone_weight[i, b] * (pose_b applied to x_rest[i]); hence no force at rest.
    Force on i: -k (1 + (s/s0)^2)^alpha (x_i - a_i), s = |x_i - a_i|.

    Beyond its springs the hypodermis is a layer that resists shear (a Pasternak foundation): with u = x - a, it stores
    shear / 2 * |grad u|^2 per area, which keeps a compressed skin from crumpling. Connective tissue stiffens as it
    shears: at a gradient of `shear_limit` the stiffness has doubled, and a fold, which needs a gradient of 1, is dear.

    bone_weight : (n, n_bone) [-], rows sum to 1
    stiffness : (n,) [mN/mm], zero where nothing lies beneath
    shear : (t,) [mN/mm], shear modulus times effective depth of the layer under each triangle; None = no such layer
    shear_limit : (t,) [-]; None or inf = it never stiffens
    """

    bone_weight: Floats
    stiffness: Floats
    alpha: float = 1.0
    s0: float = 5.0
    shear: Floats | None = None
    shear_limit: Floats | None = None


@dataclass(frozen=True, eq=False)
class Muscles:
    """Every muscle of a body as fibres, one (muscle, vertex) pair a row, grouped by muscle.

    A fibre pulls its vertex with activation * max_force * weight; the weights of one muscle sum to 1.
    kind PULL_TO_POINT : along d / sqrt(|d|^2 + softening^2), d = pose_bone(point) - x (linear muscle, sphincter)
    kind PULL_ALONG    : along the unit vector `point`, turned by the bone (sheet muscle)

    names : (m,)   max_force : (m,) [mN]
    muscle, node, kind, bone : (e,)   weight : (e,) [-]   point : (e, 3) [mm] or unit vector   softening : (e,) [mm]
    """

    names: tuple[str, ...]
    max_force: Floats
    muscle: Ints
    node: Ints
    weight: Floats
    kind: Ints
    point: Floats
    bone: Ints
    softening: Floats

    @classmethod
    def none(cls) -> Muscles:
        """Return no muscles."""
        ints, floats = np.zeros(0, dtype=np.int32), np.zeros(0)
        return cls((), floats, ints, ints, floats, ints, np.zeros((0, 3)), ints, floats)


@dataclass(frozen=True, eq=False)
class Bone:
    """A rigid bone: `grid` is its signed distance in its own rest frame (None = nothing to collide with).

    surface : the bone with its teeth, closed, in the same frame, for flesh that slides on it (None = nothing to slide on)
    """

    name: str
    grid: DistanceGrid | None = None
    surface: TriMesh | None = None


@dataclass(frozen=True, eq=False)
class BoneContact:
    """Vertices kept at least `clearance` (c,) [mm] outside a bone: pairs (`node` (c,), `bone` (c,))."""

    node: Ints
    bone: Ints
    clearance: Floats


@dataclass(frozen=True, eq=False)
class SphereContact:
    """Vertices `node` (c,) kept at least `clearance` (c,) [mm] outside a fixed sphere (an eyeball).

    hardness : [-] factor on the body's contact stiffness
    thick_clearance : (c,) [mm] the same where flesh has a volume: its inside and its outside must not meet; None = equal
    """

    name: str
    centre: Floats
    radius: float
    node: Ints
    clearance: Floats
    hardness: float = 1.0
    thick_clearance: Floats | None = None


@dataclass(frozen=True, eq=False)
class PairContact:
    """Two sheets of the same skin that may touch but not cross (lip on lip, lid on lid).

    Each vertex in `node` (c,) is kept outside the triangles of the other side, whose indices into the surface are
    `triangle[start[k]:start[k + 1]]` (those near enough at rest to ever be met); both directions are listed.
    `gap` [mm] is the distance kept.
    """

    name: str
    node: Ints
    start: Ints
    triangle: Ints
    gap: float


@dataclass(frozen=True, eq=False)
class Body:
    """What a backend needs to know of flesh, and nothing of faces.

    mass : (n,) [kg]            membrane_modulus : (t,) [kPa mm], Young's modulus times thickness
    damping : [1/s], the force -damping * mass * v   pinned : (n,) carried rigidly by the bones (weights of `attachment`)
    contact_stiffness : [mN/mm per mm^2], penalty pressure per depth
    volume : makes `solid` when it is first asked for, None = only the surface is known
    """

    surface: TriMesh
    mass: Floats
    membrane_modulus: Floats
    law: SpringLaw
    damping: float
    pinned: Bools
    attachment: Attachment
    muscles: Muscles
    bones: tuple[Bone, ...] = (Bone("cranium"),)
    bone_contact: BoneContact | None = None
    spheres: tuple[SphereContact, ...] = ()
    pairs: tuple[PairContact, ...] = ()
    contact_stiffness: float = 20.0
    labels: dict[str, Ints] = field(default_factory=dict)
    volume: Callable[[], Solid] | None = None

    def __post_init__(self) -> None:
        n, t, b = len(self.surface.points), len(self.surface.triangles), len(self.bones)
        for name, array, shape in (
            ("mass", self.mass, (n,)),
            ("membrane_modulus", self.membrane_modulus, (t,)),
            ("pinned", self.pinned, (n,)),
            ("attachment.bone_weight", self.attachment.bone_weight, (n, b)),
            ("attachment.stiffness", self.attachment.stiffness, (n,)),
            ("attachment.shear", self.attachment.shear, (t,)),
            ("attachment.shear_limit", self.attachment.shear_limit, (t,)),
        ):
            if array is None:
                continue
            if array.shape != shape:
                raise UserError(f"body: {name} has shape {array.shape}; {shape} is needed")
        if not (np.isfinite(self.mass).all() and (self.mass > 0).all()):
            raise UserError("body: every mass must be positive and finite")
        if self.muscles.node.size and not 0 <= self.muscles.node.min() <= self.muscles.node.max() < n:
            raise UserError(f"body: a muscle pulls a vertex outside 0..{n - 1}")
        self.surface.reject_degenerate()

    @cached_property
    def solid(self) -> Solid | None:
        """The flesh as a volume, if it is known; growing a face's takes seconds the first time."""
        if self.volume is None:
            return None
        solid, n, b = self.volume(), len(self.surface.points), len(self.bones)
        if (len(solid.skin.node), solid.bone_weight.shape[1]) != (n, b):
            raise UserError(f"body: its solid must carry all {n} surface vertices and know all {b} bones")
        return solid
