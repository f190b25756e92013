"""A slab of skin on fat on muscle, held by two bones beneath, with three muscles on top."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from bodies import two_muscles

from faceanim.body.body import Body
from faceanim.body.solid import ThinLayer, solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.tissue import craniofacial
from faceanim.tissue.material import Material

SIDE, DEPTH, SKIN = 36.0, 10.0, 2.0


def layered_body(cells: int = 6, *, force: float = 300.0, published: bool = False, **changes: Any) -> Body:
    """Return a slab SIDE x SIDE x DEPTH centred on the origin, its outer SKIN mm a layer that a shell may replace.

    The lower side is held by the cranium at x < 0 and by the jaw at x > 0. published : the craniofacial constants
    """
    box = box_tets((cells, cells, 3), (SIDE, SIDE, 3.0))
    heights = np.array([0.0, 0.5 * (DEPTH - SKIN), DEPTH - SKIN, DEPTH])
    level = np.round(box.points[:, 2]).astype(int)
    points = np.stack([box.points[:, 0] - SIDE / 2, box.points[:, 1] - SIDE / 2, heights[level] - DEPTH], axis=1)
    mesh = TetMesh(points, box.tets)
    region = 2 - level[mesh.tets].min(axis=1)
    if published:
        materials = [craniofacial.tissue(name, poisson_ratio=0.45) for name in ("skin", "fat", "muscle")]
    else:
        young = {"skin": 55.0, "fat": 5.0, "muscle": 20.0}
        materials = [Material(name, 1.04e-6, e, 0.45) for name, e in young.items()]
    top = np.flatnonzero(level == 3)
    surface = mesh.boundary
    allowed = surface.points[:, 2] > -1e-9
    body = solid_body(
        mesh, materials, level == 0, region=region, bone=(points[:, 0] > 0).astype(int), bones=("cranium", "jaw"),
        muscles=two_muscles(surface.points, allowed, force), **changes,
    )  # fmt: skip
    solid = body.solid
    assert solid is not None
    layer = ThinLayer.between(mesh, solid.region, 0, top.astype(np.int32), (top - 1).astype(np.int32))
    with_layer = replace(solid, layer=layer)
    return replace(body, volume=lambda: with_layer)
