"""A map of what should not matter: order of nodes and elements, winding, units, slivers, seams, light parts, idling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy.spatial import cKDTree

from faceanim.bench.atlas import bodies
from faceanim.bench.atlas.bodies import PLAIN, Tune
from faceanim.bench.atlas.cells import CONVERGED, NOT_FINITE, WRONG, Axis, Cell, Plan
from faceanim.bench.atlas.maps import ACTIVE, FRAME, Effort, map_of, warmed_all
from faceanim.bench.atlas.schemes import Contender
from faceanim.bench.atlas.trials import Goal, goal_of, inverted_elements, said_of, settling_steps, stepped, surface
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import RunError

Mesh = TriMesh | TetMesh
UNITS = {"units of 10 mm": 0.1, "units of 1 m": 0.001, "units of 0.1 mm": 10.0, "units of 1 um": 1000.0}
IDLE = "idle steps"
DRIFT = 1e-6
"""Largest drift while idle, in sizes of the body."""
TOLERANCE = 0.02
SPOILT = 0.1
"""Where the mesh itself is another one."""


@dataclass(frozen=True)
class Nuisance:
    """A change of mesh or numbers that should leave the answer as it is."""

    mesh: Callable[[Mesh], Mesh] = lambda mesh: mesh
    tune: Tune = PLAIN
    tolerance: float = TOLERANCE


def _elements(mesh: Mesh) -> Ints:
    return mesh.tets if isinstance(mesh, TetMesh) else mesh.triangles


def _again(mesh: Mesh, points: Floats, elements: Ints) -> Mesh:
    return type(mesh)(points, np.ascontiguousarray(elements, dtype=np.int32))


def nodes_permuted(mesh: Mesh) -> Mesh:
    """Number the nodes anew, in random order."""
    new = np.random.default_rng(1).permutation(len(mesh.points))
    points = np.empty_like(mesh.points)
    points[new] = mesh.points
    return _again(mesh, points, new.astype(np.int32)[_elements(mesh)])


def elements_permuted(mesh: Mesh) -> Mesh:
    """Put the elements in random order, each beginning with another corner."""
    e = _elements(mesh)
    turn = [1, 2, 0] if e.shape[1] == 3 else [1, 2, 0, 3]
    return _again(mesh, mesh.points, e[np.random.default_rng(1).permutation(len(e))][:, turn])


def winding_reversed(mesh: Mesh) -> Mesh:
    """Turn every element round: triangles look back, tetrahedra have a negative volume."""
    e = _elements(mesh).copy()
    e[:, [1, 2]] = e[:, [2, 1]]
    return _again(mesh, mesh.points, e)


def slivers(mesh: Mesh) -> Mesh:
    """Move one inner node nearly into the side that faces it: an element a thousandth as high as it is wide."""
    inner = _inner(mesh)
    e = _elements(mesh)
    element = e[np.flatnonzero((e == inner).any(axis=1))[0]]
    points = mesh.points.copy()
    side = points[element[element != inner]].mean(axis=0)
    points[inner] = side + 1e-3 * (points[inner] - side)
    return _again(mesh, points, e)


def doubled(mesh: Mesh) -> Mesh:
    """Double an inner node and give the copy to one of its elements: a crack without width."""
    inner, e = _inner(mesh), _elements(mesh).copy()
    row = int(np.flatnonzero((e == inner).any(axis=1))[0])
    e[row][e[row] == inner] = len(mesh.points)
    return _again(mesh, np.concatenate([mesh.points, mesh.points[inner : inner + 1]]), e)


def unused(mesh: Mesh) -> Mesh:
    """Add a copy of an inner node that no element uses."""
    inner = _inner(mesh)
    return _again(mesh, np.concatenate([mesh.points, mesh.points[inner : inner + 1]]), _elements(mesh))


def _inner(mesh: Mesh) -> int:
    """Return the node nearest to the middle of the body."""
    return int(np.argmin(np.linalg.norm(mesh.points - mesh.points.mean(axis=0), axis=1)))


NUISANCES = {
    "nodes permuted": Nuisance(nodes_permuted),
    "elements permuted": Nuisance(elements_permuted),
    "negative winding": Nuisance(winding_reversed),
    **{name: Nuisance(tune=Tune(scale=scale)) for name, scale in UNITS.items()},
    "a sliver": Nuisance(slivers, tolerance=SPOILT),
    "a doubled node": Nuisance(doubled, tolerance=SPOILT),
    "an unused node": Nuisance(unused),
    "mass ratio 1e4": Nuisance(tune=Tune(light=1e4)),
}


def nuisance_plans(scene: str, whom: Sequence[Contender], effort: Effort) -> list[Plan]:
    """Return one map, nuisance against contender."""
    by_label = {who.label: who for who in whom}
    mesh: Mesh = bodies.skin_mesh() if scene == "sheet" else bodies.bar_mesh()
    make: Callable[..., Body] = bodies.skin if scene == "sheet" else bodies.bar
    plain = make(mesh)

    def trial(what: str, label: str) -> Cell:
        who = by_label[label]
        if what == IDLE:
            return idle(who, plain, effort)
        nuisance = NUISANCES[what]
        return changed(who, plain, make(nuisance.mesh(mesh), nuisance.tune), nuisance, effort)

    planned = map_of(
        "nuisance", scene, None, Axis.of_words("what is changed", [*NUISANCES, IDLE]),
        Axis.of_words("scheme", list(by_label)), tolerance=TOLERANCE,
        caption="The answer, by a static search and by steps, against that of the plain body by the same. Idle: so many "
        f"steps of 1/60 s at rest without drifting by {DRIFT:g} of the size.",
    )  # fmt: skip
    return [Plan(planned, trial, None, 2.0 * effort.guard, partial(warmed_all, whom, plain))] if by_label else []


def changed(who: Contender, plain: Body, other: Body, nuisance: Nuisance, effort: Effort) -> Cell:
    """Return whether the `other` body answers as the `plain` one."""
    scale = nuisance.tune.scale
    solver, control = who.make(other), bodies.pull(other, ACTIVE)
    away, near = cKDTree(plain.surface.points).query(other.surface.points / scale)

    def goal(answer: Floats) -> Goal:
        expected = other.surface.points + scale * (answer - plain.surface.points)[near]
        made = goal_of(other, expected, other.surface.points, nuisance.tolerance)
        return replace(made, compared=away < 1e-6)

    still, steps = _plain_answers(who, plain)
    found, aim = solver.solve_static(control), goal(still)
    cell = aim.judged(solver, found, aim.error(surface(solver, found, other)), 1, said_of(solver))
    if cell.outcome != CONVERGED:
        return Cell(cell.outcome, f"static search: {cell.reason}", cell.error, 1)
    if steps is None:
        return Cell(NOT_FINITE, "the plain body already does not bear steps of 1/60 s under this scheme")
    return stepped(solver, solver.rest(), goal(steps), control=lambda k: control, dt=FRAME,
                   steps=settling_steps(plain, FRAME), deadline=effort.seconds, last=1)  # fmt: skip


@lru_cache(maxsize=64)
def _plain_answers(who: Contender, plain: Body) -> tuple[Floats, Floats | None]:
    """Return the plain body's equilibrium and where steps of the same scheme bring it, None if they fail."""
    solver, control = who.make(plain), bodies.pull(plain, ACTIVE)
    still = surface(solver, solver.solve_static(control), plain)
    state = solver.rest()
    try:
        for _ in range(settling_steps(plain, FRAME)):
            solver.step(state, state, control, FRAME)
    except RunError:
        return still, None
    end = surface(solver, state, plain)
    return still, end if np.isfinite(end).all() else None


def idle(who: Contender, body: Body, effort: Effort) -> Cell:
    """Return whether a body at rest stays there for as many steps as the effort allows."""
    solver, control = who.make(body), Control.rest(body)
    rest = surface(solver, solver.rest(), body)
    goal = Goal(body, rest, float(np.ptp(rest, axis=0).max()), DRIFT)
    state = solver.rest()
    cell = stepped(solver, state, goal, control=lambda k: control, dt=FRAME, steps=effort.idle, deadline=effort.seconds,
                   last=1)  # fmt: skip
    if cell.outcome == NOT_FINITE or inverted_elements(solver, state, body):
        return cell
    drift = goal.error(surface(solver, state, body))
    outcome = CONVERGED if drift <= DRIFT else WRONG
    return Cell(outcome, f"{cell.steps} idle steps, drift {drift:.2g} of the size", drift, cell.steps)
