"""Four models of soft tissue against a synthetic truth: what the mixed-element paper's Fig. 8 compares on a patient."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from faceanim.backends.mixed_fem.options import Options
from faceanim.bench.synthetic_truth import (
    EDGE,
    LAYERS,
    PATCH,
    QUALITY,
    SEEDS,
    SMOOTHINGS,
    SPREAD,
    TISSUE_SEED,
    SyntheticTruth,
    Tissues,
    noise,
)  # fmt: skip
from faceanim.face.attach import MUCOSA
from faceanim.face.face import Face
from faceanim.face.library import load_face
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats
from faceanim.ground.cache import content_key, load_arrays, save_arrays
from faceanim.ground.errors import UserError
from faceanim.ground.notes import tell
from faceanim.surgery.distance_map import Statistics, compare, face_regions, statistics
from faceanim.surgery.operation import Operation, moved, operate
from faceanim.surgery.plan import load_plan
from faceanim.surgery.predict import held_weights, predict
from faceanim.tissue import craniofacial

MOVES = ("midface_advance", "midface_lower", "midface_rotate", "mandible_advance", "le_fort_1")
"""The plans that are compared: the paper's four moves of Fig. 6, and a Le Fort I."""
PAPER = {"linear": 79.0, "mass_tensor": 87.0, "nonlinear": 89.0, "mixed": 95.0}
"""Share of one patient's skin within 1.5 mm, Fig. 8 of the paper [%]; mean error of the mixed model 0.5 mm."""
MOVED = 1.0
"""Skin that the truth moves by more than this is the moved region [mm]."""
STILL = 0.2
"""Skin that the truth moves by less than this is registered upon [mm]."""
POISSON = 0.49
_VERSION = "synthetic truth 1"


@dataclass(frozen=True)
class Row:
    """One model on one move.

    noise : seed of the noise on the truth, None = none   fraction : of the move that the model reached
    seconds : of finding the balance, without preparing the solver
    moved, face : figures of those regions; None if it failed
    """

    move: str
    model: str
    noise: int | None
    fraction: float
    seconds: float
    moved: Statistics | None
    face: Statistics | None
    failure: str = ""


@dataclass(frozen=True, eq=False)
class Reference:
    """The truth for one move: `skin` of the finer face, and how far each vertex went, (n,) [mm]."""

    face: Face
    skin: Floats
    way: Floats
    seconds: float
    iterations: int

    def surface(self, seed: int | None = None) -> TriMesh:
        """Return the outer skin, (without the inside of the mouth), as it would be observed with the noise of `seed`."""
        triangles = self.face.mesh.triangles
        outer = triangles[(self.face.region[triangles] != MUCOSA).all(axis=1)]
        skin = TriMesh(self.skin, outer)
        if seed is None:
            return skin
        seen = self.skin + noise(self.skin, skin.vertex_normals, seed)
        return TriMesh(registered(seen, self.face.mesh.points, self.way < STILL), outer)


def registered(points: Floats, onto: Floats, chosen: Bools) -> Floats:
    """Return `points` moved rigidly so that the `chosen` come nearest to `onto`, all (n, 3); Kabsch 1976."""
    a, b = points[chosen], onto[chosen]
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    u, _, v = np.linalg.svd((a - ca).T @ (b - cb))
    turn = (u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v).T
    return (points - ca) @ turn.T + cb


def published(gap: Any) -> Tissues:
    """Return the published tissues, all nearly incompressible, with the head's own gap before the teeth."""
    skin, fat, muscle = (craniofacial.tissue(name, poisson_ratio=POISSON) for name in ("skin", "fat", "muscle"))
    return Tissues(skin, fat, muscle, gap)


@cache
def _truth() -> SyntheticTruth:
    face = load_face("default", density="fine")
    return SyntheticTruth(face, published(face.tissue.materials()[3]))


def reference(move: str, step: float = 3.0) -> Reference:
    """Return the truth for a move; it takes minutes the first time and is then kept on disk.

    step : farthest that a bone is moved at once [mm]
    """
    face = load_face("default", density="fine")
    operation = operate(face, load_plan(move))
    declared = (EDGE, LAYERS, QUALITY, SMOOTHINGS, PATCH, SPREAD, TISSUE_SEED, POISSON)
    moves = [part for f in operation.fragments for part in (f.mesh.points, f.turn, f.shift)]
    key = content_key(_VERSION, declared, face.mesh.points, face.mesh.triangles, *moves)
    kept = load_arrays("truth", key)
    if kept is None:
        tell(f"the truth for {move}")
        kept = _solved(_truth(), operation, step)
        save_arrays("truth", key, **kept)
    way = np.linalg.norm(kept["skin"] - face.mesh.points, axis=1)
    return Reference(face, kept["skin"], way, float(kept["seconds"]), int(kept["iterations"]))


def _solved(truth: SyntheticTruth, operation: Operation, step: float) -> dict[str, np.ndarray]:
    started = perf_counter()
    held = truth.wedges.points[truth.held]
    weight = held_weights(operation, held, truth.held_shares, truth.column_vertex(truth.held))
    goal = np.einsum("kb,bki->ki", weight, np.stack([moved(held, pose) for pose in operation.poses()]))
    middle = held[:, 0] == 0.0
    if np.abs(goal[middle, 0]).max(initial=0.0) > 1e-6:
        raise UserError("the truth is one side of a head: it takes moves that are alike on both sides only")
    skin = truth.solve(goal, 1.0 / math.ceil(operation.travel / step))
    return {
        "skin": skin,
        "seconds": np.array(perf_counter() - started),
        "iterations": np.array(truth.report.iterations),
    }


def run(move: str, model: str, known: Reference, **changes: Any) -> Iterator[Row]:
    """Yield the figures of a model on a move: against the bare truth, then with each noise.

    changes : further options of the model, for ablations
    A balance in which elements are turned inside out means nothing: it counts as failed, and has no figures.
    """
    face = load_face("default")
    options = replace(Options(model=model, tissue="craniofacial"), **changes)
    name = model + "".join(f" {k}={v}" for k, v in sorted(changes.items()))
    found = predict(face, load_plan(move), backend="mixed_fem", options=options)
    inverted = found.solver.inverted
    failure = found.failure or (f"{inverted} elements are inverted" if inverted else None)
    if failure is not None:
        yield Row(move, name, None, found.fraction, found.seconds["solve"], None, None, failure)
        return
    predicted = TriMesh(found.points, face.mesh.triangles)
    _, nearest = cKDTree(known.face.mesh.points).query(face.mesh.points)
    visible = face_regions(face)["face"]
    gone = visible & (known.way[nearest] > MOVED)
    area = face.mesh.vertex_areas
    for seed in (None, *SEEDS):
        distance = compare(predicted, known.surface(seed))
        figures = [statistics(distance[mask], area[mask]) for mask in (gone, visible)]
        yield Row(move, name, seed, 1.0, found.seconds["solve"], figures[0], figures[1])


def at_rest() -> Statistics:
    """Return how far the skins of the two densities are apart before any move: what no model can be blamed for."""
    coarse, fine = load_face("default"), load_face("default", density="fine")
    visible = face_regions(coarse)["face"]
    way = np.zeros(len(fine.mesh.points))
    distance = compare(coarse.mesh, Reference(fine, fine.mesh.points, way, 0.0, 0).surface())
    return statistics(distance[visible], coarse.mesh.vertex_areas[visible])


ABLATIONS: tuple[dict[str, Any], ...] = tuple(
    {"homogeneous": homogeneous, "shell": shell, "pressure": pressure}
    for homogeneous in (True, False)
    for shell in (False, True)
    for pressure in (False, True)
)
"""What the step from the nonlinear to the mixed model changes, one thing at a time."""
