"""The flesh of a head as a volume: prisms grown from the skin towards the bone, in layers, split into tetrahedra.

Each prism stands between three columns (`columns`); its nodes on bone are held by that bone. The two lips and the two
lids of an eye are separate flaps, joined at the corners only; skin inside the mouth and behind the lids rides on the
flap that it belongs to. What bone carries rigidly (scalp, ears, collar, the depth of the mouth) takes no part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faceanim.body.solid import Solid, ThinLayer
from faceanim.face.columns import Columns, grow, is_symmetric, stacked
from faceanim.face.tissue_carry import carry
from faceanim.face.tissue_layers import muscular
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.cache import content_key, load_arrays, save_arrays
from faceanim.ground.notes import tell

if TYPE_CHECKING:
    from faceanim.face.face import Face

SKIN_LAYER, FAT, MUSCLE, GAP = range(4)
"""Index of each material of the tissue."""


@dataclass(frozen=True)
class Grain:
    """How fine a volume is: layers between skin and bone; edge [mm] of the skin's triangles far from lips and lids."""

    layers: int
    edge: float


GRAINS = {"coarse": Grain(3, 9.5), "default": Grain(3, 6.7), "fine": Grain(4, 3.5)}
"""By the density of the face: about 10, 20 and 90 thousand elements."""

LEAST_QUALITY = 0.06
"""Every element is at least so well shaped (`TetMesh.quality`)."""
_BLEND = 8.0
_VERSION = "tissue volume 15"


@dataclass(frozen=True, eq=False)
class Flesh:
    """The volume of a head and what became of its skin.

    rigid : (n,) skin vertices that bone carries;  vertex : (m,) the skin vertex of each column
    shortened : (m,) columns cut short to keep their elements sound;  twin : (m,) the mirror image of each column
    """

    solid: Solid
    rigid: Bools
    vertex: Ints
    shortened: Bools
    twin: Ints


def tissue_volume(face: Face) -> Solid:
    """Return the soft tissue of a head as a volume; kept on disk by content."""
    return flesh(face).solid


def flesh(face: Face) -> Flesh:
    """Return the soft tissue of a head with what is known of its making; kept on disk by content."""
    grain = GRAINS.get(face.density, GRAINS["default"])
    key = content_key(_VERSION, grain, LEAST_QUALITY, *_ingredients(face))
    kept = load_arrays("tissue", key)
    if kept is None:
        tell("growing the flesh between skin and bone")
        kept = _grown(face, grain)
        save_arrays("tissue", key, **kept)
    mesh = TetMesh(kept["points"], kept["tets"])
    outer = np.arange(0, len(mesh.points), grain.layers + 1, dtype=np.int32)
    solid = Solid(
        mesh=mesh,
        materials=face.tissue.materials(),
        region=kept["region"],
        bone_weight=kept["bone_weight"],
        skin=Embedding(kept["skin_node"], kept["skin_weight"]),
        damping=face.tissue.solid.damping,
        stiffness_damping=face.tissue.solid.stiffness_damping,
        layer=ThinLayer.between(mesh, kept["region"], SKIN_LAYER, outer, outer + 1),
    )
    return Flesh(solid, kept["rigid"], kept["vertex"], kept["shortened"], kept["twin"])


def _ingredients(face: Face) -> list[object]:
    grids = (face.skull.cranium_grid, face.skull.jaw_grid)
    return [
        face.mesh.points,
        face.mesh.triangles,
        face.region,
        face.bone_weight,
        face.pinned,
        face.mouth_side,
        *(part for grid in grids for part in (grid.values, grid.origin, grid.spacing)),
        *(part for name, eye in face.eyes.items() for part in (name, eye.centre, eye.radius)),
        *(face.contact_sets[name] for name in sorted(face.contact_sets)),
        sorted(face.muscle_table.items(), key=lambda item: item[0]),
    ]


def _grown(face: Face, grain: Grain) -> dict[str, np.ndarray]:
    half = is_symmetric(face)
    columns = grow(face, grain.edge, grain.layers, LEAST_QUALITY, half=half)
    twin = np.arange(len(columns.vertex), dtype=np.int32)
    points, tets = stacked(columns.top, columns.foot, columns.wall, columns.triangles, grain.layers)
    weight = bone_shares(face, columns, grain.layers)
    carrier, rigid = carry(face, columns, TetMesh(points, tets), weight, grain.layers, half=half)
    region = _regions(face, columns, TetMesh(points, tets), grain.layers)
    vertex, shortened = columns.vertex, columns.shortened
    if half:
        middle = columns.top[:, 0] == 0.0
        twin, count = _twins(middle)
        node = (twin[:, None] * (grain.layers + 1) + np.arange(grain.layers + 1)).ravel()
        m = len(node)
        full = np.zeros((count * (grain.layers + 1), 3))
        full[:m], full[node] = points, points * [-1.0, 1.0, 1.0]
        held = np.zeros((len(full), weight.shape[1]))
        held[:m], held[node] = weight, weight
        points, weight = full, held
        tets = np.concatenate([tets, node[tets][:, [0, 2, 1, 3]]])
        region = np.concatenate([region, region])
        other = columns.top[:, 0] != 0.0
        carrier, rigid = carrier.mirrored(face, node), rigid | rigid[face.mirror]
        vertex = np.concatenate([vertex, face.mirror[vertex[other]]])
        shortened = np.concatenate([shortened, shortened[other]])
        back = np.arange(count, dtype=np.int32)
        back[: len(twin)], back[twin] = twin, np.arange(len(twin))
        twin = back
    return {
        "points": points,
        "tets": tets.astype(np.int32),
        "region": region,
        "bone_weight": weight,
        "skin_node": carrier.node.astype(np.int32),
        "skin_weight": carrier.weight,
        "rigid": rigid,
        "vertex": vertex.astype(np.int32),
        "shortened": shortened,
        "twin": twin,
    }


def _twins(middle: Bools) -> tuple[Ints, int]:
    """Return the number of each column's mirror image (those in the middle are their own) and of columns in all."""
    twin = np.arange(len(middle), dtype=np.int32)
    side = np.flatnonzero(~middle)
    twin[side] = len(middle) + np.arange(len(side))
    return twin, len(middle) + len(side)


def bone_shares(face: Face, columns: Columns, layers: int) -> Floats:
    """Return the share of each bone in holding each node, (n, 2); zero where it is free."""
    weight = np.zeros((len(columns.vertex), layers + 1, 2))
    skull = face.skull
    nearer = skull.cranium_grid.sample(columns.foot) - skull.jaw_grid.sample(columns.foot)
    t = np.clip(0.5 + nearer / _BLEND, 0.0, 1.0)
    jaw = t * t * (3.0 - 2.0 * t)
    on = columns.on_bone
    share = np.where(columns.gap[:, None], face.bone_weight[columns.vertex], np.stack([1.0 - jaw, jaw], axis=1))
    weight[on, layers] = share[on]
    rigid = face.pinned[columns.vertex]
    weight[rigid] = face.bone_weight[columns.vertex[rigid]][:, None]
    return weight.reshape(-1, 2)


def _regions(face: Face, columns: Columns, mesh: TetMesh, layers: int) -> Ints:
    """Return the material of each element, (e,): the outer layer skin, beneath it muscle where muscles run, else fat."""
    layer = (mesh.tets % (layers + 1)).min(axis=1)
    muscle = muscular(face, columns, mesh, layers)
    region = np.where(layer == 0, SKIN_LAYER, np.where(muscle, MUSCLE, FAT))
    gap = (layer == layers - 1) & columns.gap[mesh.tets // (layers + 1)].all(axis=1)
    return np.where(gap, GAP, region).astype(np.int32)
