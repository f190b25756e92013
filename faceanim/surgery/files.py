"""What an operation leaves for other programs: meshes for ParaView and others, tables, figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.body.solid import Solid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats
from faceanim.surgery.operation import Operation, moved
from faceanim.surgery.pictures import BONE, piece_colour


def ply(mesh: TriMesh, colours: Any = None, **values: Any) -> bytes:
    """Return a surface as binary PLY.   colours : (n, 3) sRGB in [0, 1]   values : name -> (n,), written as float32"""
    import trimesh

    paint = None
    if colours is not None:
        paint = np.round(255.0 * np.clip(np.asarray(colours), 0.0, 1.0)).astype(np.uint8)
    out = trimesh.Trimesh(mesh.points, mesh.triangles, vertex_colors=paint, process=False)
    out.vertex_attributes.update({name: np.asarray(v, dtype=np.float32) for name, v in values.items()})
    data = out.export(file_type="ply")
    assert isinstance(data, bytes)
    return data


def bones_ply(operation: Operation, poses: Floats) -> bytes:
    """Return all bones where the operation leaves them as one PLY; `bone` numbers them as `Operation.names` does."""
    meshes = operation.bones
    start = np.cumsum([0] + [len(m.points) for m in meshes])
    points = np.concatenate([moved(m.points, pose) for m, pose in zip(meshes, poses, strict=True)])
    triangles = np.concatenate([m.triangles + s for m, s in zip(meshes, start, strict=False)])
    number = np.repeat(np.arange(len(meshes)), np.diff(start))
    colours = np.array([BONE if k < 2 else piece_colour(k - 2) for k in range(len(meshes))])
    return ply(TriMesh(points, triangles.astype(np.int32)), colours[number], bone=number)


def strains(solid: Solid, nodes: Floats) -> dict[str, Floats]:
    """Return what each element has suffered, name -> (e,): volume ratio, largest and least stretch, equivalent strain.

    The equivalent (von Mises) strain is sqrt(2/3 e:e) of the deviator e of the logarithmic strain; where an element is
    inverted its least stretch is negative and the strain that of the magnitudes.
    """
    mesh = solid.mesh
    gradient = np.einsum("eai,eaj->eij", nodes[mesh.tets], mesh.gradients)
    ratio = np.linalg.det(gradient)
    stretch = np.linalg.svd(gradient, compute_uv=False)
    log = np.log(np.maximum(stretch, 1e-9))
    deviator = log - log.mean(axis=1, keepdims=True)
    stretch[:, 2] *= np.sign(ratio)
    return {
        "volume_ratio": ratio,
        "largest_stretch": stretch[:, 0],
        "least_stretch": stretch[:, 2],
        "von_mises_strain": np.sqrt(2.0 / 3.0 * (deviator**2).sum(axis=1)),
    }
