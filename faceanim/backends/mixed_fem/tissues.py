"""Which material each part of a solid gets, and how far it may be stretched."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from faceanim.backends.mixed_fem.options import Model, Options
from faceanim.body.solid import Solid
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.tissue import craniofacial
from faceanim.tissue.material import Material

FLESH = ("skin", "fat", "muscle")
"""Names of the materials that are tissue; others, such as the moist gap before the teeth, keep what they are."""
NEARLY_INCOMPRESSIBLE = 0.49
"""Poisson's ratio of muscle under the published constants: what the paper says of it; its table has .3."""


def materials_of(solid: Solid, options: Options) -> tuple[Material, ...]:
    """Return the materials that the options ask for, in the solid's order."""
    model = options.resolved
    out = list(solid.materials)
    if options.tissue == "craniofacial":
        for k, material in enumerate(out):
            if material.name in FLESH:
                found = craniofacial.tissue(material.name, poisson_ratio=NEARLY_INCOMPRESSIBLE)
                out[k] = replace(found, density=material.density)
    if model.homogeneous:
        out = _one_tissue(solid, out)
    return tuple(out)


def _one_tissue(solid: Solid, materials: list[Material]) -> list[Material]:
    """Return the materials with all tissue replaced by its mean over the volume, modulus by modulus."""
    size = np.bincount(solid.region, solid.mesh.volumes, len(materials))
    flesh = [k for k, m in enumerate(materials) if m.name in FLESH] or list(range(len(materials)))
    share = size[flesh] / size[flesh].sum()
    c10, c01, bulk = (
        float(share @ np.array([getattr(materials[k], name) for k in flesh])) for name in ("c10", "c01", "bulk_modulus")
    )
    for k in flesh:
        materials[k] = Material.mooney_rivlin(materials[k].name, materials[k].density, c10, c01, bulk)
    return materials


def limits_said(materials: tuple[Material, ...], model: Model) -> list[str]:
    """Return what is to be said of the stability of `materials` before a run: one line for each that has a limit."""
    if model.law != "mooney_rivlin":
        return []
    return [
        f"{m.name}: c10 = {m.c10:.4g}, c01 = {m.c01:.4g} kPa lose their stability at a stretch of {m.stretch_limit:.4f}; "
        "law 'tension' has the same tension curve and no such limit"
        for m in materials
        if math.isfinite(m.stretch_limit)
    ]


def largest_stretch(mesh: TetMesh, x: Floats) -> Floats:
    """Return the largest principal stretch of every element, (e,) [-], with its nodes at `x` (n, 3)."""
    F = np.einsum("eai,eaj->eij", x[mesh.tets], mesh.gradients)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(F.transpose(0, 2, 1) @ F)[:, -1]))


def beyond_limit(stretch: Floats, region: Ints, materials: tuple[Material, ...]) -> dict[str, float]:
    """Return, for each material with a limit, the share of its elements that are stretched beyond it."""
    out = {}
    for k, m in enumerate(materials):
        own = region == k
        if math.isfinite(m.stretch_limit) and own.any():
            out[m.name] = float((stretch[own] > m.stretch_limit).mean())
    return out
