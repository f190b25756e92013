"""The tables that kernels read: NamedTuples of bare arrays (read-only) and numbers, so that Numba caches their types."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F8 = NDArray[np.float64]
I4 = NDArray[np.int32]


class Law(NamedTuple):
    """The spring law of Zhang, Prakash & Sung, Eqs. 1-4 and 14, without hidden units.

    Edge spring, s = l - d:          force -k (1 + (s/s0)^2)^alpha s along the edge
    Edge repulsion spring, s = h - d: force -k (1 + (s/s0)^2)^alpha s + r ((d/h)^beta - 1) along the height

    reaction : 1 = the repulsion pushes back on its edge (gradient of an energy), 0 = on the corner alone (the paper)
    """

    alpha: float
    s0: float
    beta: float
    reaction: int


class Springs(NamedTuple):
    """Structural springs and edge repulsion springs of t triangles over n vertices, stored by triangle.

    Row k of a (3, t) array belongs to corner k: the edge opposite it, and the height from it onto that edge.
    An inner edge appears in both of its triangles, each carrying its own share of the stiffness.

    a, b, c : (t,) corners, counter-clockwise
    edge_length : (3, t) rest length [mm]        edge_stiffness : (3, t) this triangle's share [mN/mm]
    height : (3, t) rest height [mm]             height_stiffness : (3, t) [mN/mm]
    repulsion : (3, t) [mN], zeta * height_stiffness * height
    corner_start : (n + 1,), corner : (3 t,) : slots k * t + triangle that vertex i is corner k of
    """

    a: I4
    b: I4
    c: I4
    edge_length: F8
    edge_stiffness: F8
    height: F8
    height_stiffness: F8
    repulsion: F8
    corner_start: I4
    corner: I4


class Tethers(NamedTuple):
    """Springs from vertices to anchors that the bones carry.

    rest : (n, 3) [mm]   bone_weight : (n, n_bone) [-], rows sum to 1   stiffness : (n,) [mN/mm]
    alpha [-], s0 [mm] : growth of the stiffness, as in `Law`
    The shear layer ties the displacements of neighbours: rows start[i]..start[i + 1] of `neighbour`,
    `shear` [mN/mm] and `shear_growth` [mN/mm^3]
    """

    rest: F8
    bone_weight: F8
    stiffness: F8
    alpha: float
    s0: float
    start: I4
    neighbour: I4
    shear: F8
    shear_growth: F8


class Layer(NamedTuple):
    """The shear layer by triangle, for vector loops; `Tethers` has the same by vertex.

    shear [mN/mm], growth [mN/mm^3] : (3, t) this triangle's share for the edge opposite each corner
    """

    shear: F8
    growth: F8


class Fibres(NamedTuple):
    """Muscle pulls sorted by vertex: rows start[i]..start[i + 1] pull vertex i.

    start : (n + 1,)   muscle, kind, bone : (e,)   strength : (e,) max_force * weight [mN]
    point : (e, 3) [mm] in the bone's rest frame, or a unit vector   softening : (e,) [mm]
    """

    start: I4
    muscle: I4
    kind: I4
    bone: I4
    strength: F8
    point: F8
    softening: F8


class BoneGrids(NamedTuple):
    """Signed distances of all bones, one flat array.

    values : flat float32 [mm]   offset : (n_bone,) first sample, -1 = no grid   shape : (n_bone, 3)
    origin : (n_bone, 3) [mm]    spacing : (n_bone,) [mm]
    """

    values: NDArray[np.float32]
    offset: I4
    shape: I4
    origin: F8
    spacing: F8


class Colliders(NamedTuple):
    """Unilateral contacts, all with penalty pressure per depth `pressure` [mN/mm per mm^2].

    bone_node, bone : (cb,)                 bone_clearance, bone_area : (cb,) [mm], [mm^2]
    sphere_node : (cs,)   sphere : (cs, 4) centre and radius + clearance [mm]   sphere_area : (cs,) [mm^2]
    pair_node : (cp,)   pair_start : (cp + 1,)   pair_triangle : (k,)   pair_gap, pair_area : (cp,) [mm], [mm^2]
    corners : (t, 3) of the surface
    pressure, stiffening : penalty [mN/mm^3] and the depth at which its stiffness has grown fourfold [mm]
    """

    bone_node: I4
    bone: I4
    bone_clearance: F8
    bone_area: F8
    sphere_node: I4
    sphere: F8
    sphere_area: F8
    pair_node: I4
    pair_start: I4
    pair_triangle: I4
    pair_gap: F8
    pair_area: F8
    corners: I4
    pressure: float
    stiffening: float


class Planes(NamedTuple):
    """Contacts near enough to matter, each as a half space, refreshed by `contact.find`; written, not read-only.

    Gap of contact c: normal . (x[node 0] - sum_k weight_k x[node k]) - offset; nodes 1-3 are -1 against rigid things.

    count : (2,) all contacts, and those of lips and lids, which come first
    node : (c, 4)   weight, normal : (c, 3)   offset : (c,) [mm]   stiffness : (c,) [mN/mm]
    What the search for pair contacts remembers from call to call, none of which changes what it finds:
    nearest : (cp,) the triangle nearest to each vertex last time   apart : (cp,) lower bound of the distance [mm]
    before : (n, 3) positions at the last call   ball : (t, 4) bounding spheres of the triangles
    looks : (n, 3) vertex normals of the sheets   seen : (cb, 4) place in the bone's frame and distance, last time
    """

    count: I4  # type: ignore[assignment]
    node: I4
    weight: F8
    normal: F8
    offset: F8
    stiffness: F8
    nearest: I4
    apart: F8
    before: F8
    ball: F8
    looks: F8
    seen: F8


class Scene(NamedTuple):
    """What does not change while a patch moves; `free` vertices come first in every array."""

    free: int
    springs: Springs
    layer: Layer
    law: Law
    tethers: Tethers
    fibres: Fibres
    colliders: Colliders
    grids: BoneGrids


class Moment(NamedTuple):
    """What the control sets for one moment, written by the drivers.

    anchor : (n, 3) [mm]   pose : (n_bone, 4, 4)   planes : `Planes`   shift : (n, 3) work, positions minus anchors
    The fibres of the muscles that act, packed: rows first[i]..first[i + 1] pull vertex i.
    first : (n + 1,)   target : (e, 3) [mm] or unit vector   pull : (e,) [mN]
    softening : (e,) [mm], negative where the target is a direction
    """

    anchor: F8
    pose: F8
    first: I4
    target: F8
    pull: F8
    softening: F8
    planes: Planes
    shift: F8


class Factor(NamedTuple):
    """A sparse lower triangular matrix L in rows of its own order, and its transpose, without their diagonals.

    order : (n,) vertex of each row   inverse_diagonal : (n,)   copies : (n,) factor of the right-hand side
    lower_start : (n + 1,)   lower_column, lower : (e,) rows of L   upper_start, upper_column, upper : those of L^T
    """

    order: I4
    inverse_diagonal: F8
    copies: F8
    lower_start: I4
    lower_column: I4
    lower: F8
    upper_start: I4
    upper_column: I4
    upper: F8


class Half(NamedTuple):
    """How one half of a symmetric body stands for the whole; without ghosts and middle, all of it is there.

    ghost, source : (g,) vertices beyond the plane x = 0 and those whose mirror images they are
    middle : free vertices on the plane   copies : (m, 3) how often each free vertex occurs, 2 or 1, thrice
    """

    ghost: I4
    source: I4
    middle: I4
    copies: F8


class Drive(NamedTuple):
    """A control as the kernels see it: `activation` (m,), `pose` (n_bone, 4, 4)."""

    activation: F8
    pose: F8
