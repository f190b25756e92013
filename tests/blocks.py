"""A block of flesh between two bones, with a muscle that pulls to a point and one that pulls along a direction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from faceanim.body.body import PULL_ALONG, PULL_TO_POINT, Body, Muscles
from faceanim.body.control import Control
from faceanim.body.solid import Solid, solid_body
from faceanim.geometry.embedding import embed
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.surface import TriMesh
from faceanim.tissue.material import Material

SOFT = Material("soft", 1.04e-6, 15.0, 0.4)
FIRM = Material("firm", 1.10e-6, 40.0, 0.3, 0.2)


def pulling(nodes: np.ndarray, force: float = 60.0) -> Muscles:
    """Return two muscles on the surface vertices `nodes`."""
    k = len(nodes)
    along = np.array([0.0, 0.6, 0.8])
    point = np.concatenate([np.tile([14.0, 22.0, 3.0], (k, 1)), np.tile(along, (k, 1))])
    kind = np.repeat([PULL_TO_POINT, PULL_ALONG], k).astype(np.int32)
    both = np.tile(nodes, 2).astype(np.int32)
    return Muscles(
        ("to", "along"), np.array([force, force]), np.repeat([0, 1], k).astype(np.int32), both, np.full(2 * k, 1.0 / k),
        kind, point, np.repeat([1, 0], k).astype(np.int32), np.full(2 * k, 1.0),
    )  # fmt: skip


def block(*, cranium: float = 0.1, jaw_from: float = 19.9, jaw_below: float = 0.1, **changes: Any) -> Body:
    """Return a block of 20 x 8 x 8 mm: the cranium holds x < `cranium`, the jaw x > `jaw_from`, y < `jaw_below`."""
    mesh = box_tets((5, 2, 2), (20.0, 8.0, 8.0))
    x = mesh.points
    jaw = (x[:, 0] > jaw_from) & (x[:, 1] < jaw_below)
    held = (x[:, 0] < cranium) | jaw
    region = (mesh.points[mesh.tets].mean(axis=1)[:, 0] > 10.0).astype(int)
    surface = x[mesh.boundary_nodes]
    nodes = np.flatnonzero((np.abs(surface[:, 0] - 10.0) < 3.0) & (surface[:, 1] > 7.9))
    fields: dict[str, Any] = {
        "region": region, "bone": jaw.astype(int), "bones": ("cranium", "jaw"), "damping": 40.0,
        "stiffness_damping": 1e-3, "muscles": pulling(nodes),
    }  # fmt: skip
    return solid_body(mesh, (SOFT, FIRM), held, **(fields | changes))


def skinned(body: Body) -> Body:
    """Return `body` with a surface that lies inside its elements instead of on their nodes."""
    assert body.solid is not None
    solid = body.solid
    middle = solid.mesh.points.mean(axis=0)
    surface = TriMesh(middle + 0.93 * (body.surface.points - middle), body.surface.triangles)
    skin = embed(solid.mesh, surface.points)
    inner = Solid(solid.mesh, solid.materials, solid.region, solid.bone_weight, skin)
    return replace(body, surface=surface, volume=lambda: inner)


def turned_jaw(degrees: float) -> np.ndarray:
    """Return the jaw's pose (4, 4) turned about z through the block's middle."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    centre = np.array([10.0, 4.0, 4.0])
    pose[:3, 3] = centre - pose[:3, :3] @ centre
    return pose


def pull(body: Body, activation: Any = 0.0, jaw: float = 0.0) -> Control:
    """Return a control with these activations and the jaw turned by `jaw` [degrees]."""
    control = Control.rest(body)
    control.activation[:] = activation
    control.bone_pose[1] = turned_jaw(jaw)
    return control
