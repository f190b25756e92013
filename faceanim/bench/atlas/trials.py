"""One trial of a stability map: step a solver or ask for its equilibrium, and judge what came out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from time import process_time
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import eigsh

from faceanim.bench.atlas.cells import CONVERGED, INVERTED, NOT_FINITE, REFUSED, WRONG, Cell
from faceanim.body.assembly import mass_matrix, stiffness_matrix
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats

FLOWN = 20.0
"""Farther from the body than this many times its size is flown away."""
LEAST_STEPS = 40
MOST_STEPS = 4000
SETTLED = 8.0
"""Time constants of the slowest vibration after which the body has come to rest."""
DENSE = 600
"""Unknowns up to which all eigenvalues are computed."""
LAST = 5
"""The last so many steps are judged: what still oscillates has not converged."""
STILL = 1e-6
"""A body that moves by less than this share of the scale in a step is at rest."""
SHAKE = 0.02
"""Random displacement put on every vertex at the start, in movements, so that every mode is there to grow."""


@dataclass(frozen=True, eq=False)
class Goal:
    """The right answer: surface `points` (n, 3) [mm], errors relative to `scale` [mm], the largest that converges.

    compared : (n,) vertices whose error counts, None = all
    """

    body: Body
    points: Floats
    scale: float
    tolerance: float
    compared: Bools | None = None

    @property
    def size(self) -> float:
        """Longest side of the body [mm]."""
        return float(np.ptp(self.body.surface.points, axis=0).max())

    def error(self, points: Floats) -> float:
        """Return the largest distance from the right answer, relative; inf if that is no number."""
        away = np.linalg.norm(points - self.points, axis=1)
        off = float(away.max() if self.compared is None else away[self.compared].max()) / self.scale
        return off if math.isfinite(off) else math.inf

    def flown(self, points: Floats) -> bool:
        """Whether anything is not finite or far away."""
        return not (np.abs(points - self.points).max() < FLOWN * self.size)

    def turned_over(self, points: Floats) -> int:
        """Return how many triangles look the other way than in the right answer."""
        triangles = self.body.surface.triangles
        here, there = TriMesh(points, triangles).normals_by_area, TriMesh(self.points, triangles).normals_by_area
        return int((np.einsum("ti,ti->t", here, there) < 0.0).sum())

    def judged(self, solver: Any, state: Any, error: float, steps: int, reason: str = "") -> Cell:
        """Return the cell of a state whose `error` is known."""
        points = surface(solver, state, self.body)
        if self.flown(points):
            return Cell(NOT_FINITE, reason or "not finite, or flown away", None, steps)
        triangles, elements = self.turned_over(points), inverted_elements(solver, state, self.body)
        if triangles or elements:
            what = f"{elements} elements inverted" if elements else f"{triangles} triangles turned over"
            return Cell(INVERTED, f"{what}; error {error:.3g}", error, steps)
        if error <= self.tolerance:
            return Cell(CONVERGED, reason, error, steps)
        return Cell(WRONG, (f"{reason}; " if reason else "") + f"error {error:.3g}", error, steps)


def goal_of(body: Body, points: Floats, before: Floats, tolerance: float) -> Goal:
    """Return the goal `points`, errors relative to the largest movement from `before`."""
    movement = float(np.linalg.norm(points - before, axis=1).max())
    return Goal(body, points, max(movement, 1e-9), tolerance)


def surface(solver: Any, state: Any, body: Body) -> Floats:
    """Return the surface of a state, (n, 3) [mm]."""
    out = np.full_like(body.surface.points, np.nan)
    solver.surface(state, out)
    return out


def nodes_of(solver: Any, state: Any, body: Body) -> Floats | None:
    """Return where the nodes of the body's volume are, (n, 3) [mm], None where the solver does not tell."""
    if body.solid is None:
        return None
    count = len(body.solid.mesh.points)
    if hasattr(solver, "nodes"):
        return np.asarray(solver.nodes(state))
    if hasattr(solver, "elements") and state.q.ndim == 2 and len(state.q) >= count:
        return np.asarray(state.q[:count])
    return None


def inverted_elements(solver: Any, state: Any, body: Body) -> int:
    """Return how many elements, or cells of a lattice, are turned inside out, 0 where the solver does not tell."""
    if hasattr(solver, "rig") and hasattr(state, "level"):
        return int((solver.rig(state.level).model.least_volume(state.q) <= 0.0).sum())
    nodes = nodes_of(solver, state, body)
    if nodes is None or body.solid is None:
        return 0
    mesh = body.solid.mesh
    return int((TetMesh(nodes, mesh.tets).volumes * np.sign(mesh.volumes) <= 0.0).sum())


def stepped(
    solver: Any, state: Any, goal: Goal, *, control: Callable[[int], Control], dt: float, steps: int, deadline: float,
    last: int = LAST,
) -> Cell:  # fmt: skip
    """Return what `steps` steps of `dt` [s] from `state` come to; step k runs under `control(k)`.

    deadline : seconds of computing after which it is stopped: then it has converged already, or gave no answer
    last : so many steps at the end are judged
    """
    started, worst = process_time(), 0.0
    points, done = surface(solver, state, goal.body), 0
    before = points.copy()
    for k in range(steps):
        solver.step(state, state, control(k), dt)
        done = k + 1
        if steps - k <= last or k % 8 == 0:
            before[:] = points
            solver.surface(state, points)
            if goal.flown(points):
                return Cell(NOT_FINITE, f"not finite, or flown away, after {done} steps", None, done)
            worst = max(worst, goal.error(points)) if steps - k <= last else 0.0
        if process_time() - started > deadline:
            said = f"no answer within {deadline:g} s: {done} of {steps} steps"
            cell = goal.judged(solver, state, goal.error(surface(solver, state, goal.body)), done, said)
            return cell if cell.outcome in (CONVERGED, NOT_FINITE) else Cell(REFUSED, said, cell.error, done)
    reason = ""
    if worst > goal.tolerance:
        way = float(np.linalg.norm(points - before, axis=1).max()) / goal.scale
        reason = "at rest elsewhere" if way < STILL else f"still moves, by {way:.2g} in the last step"
    return goal.judged(solver, state, worst, done, reason)


def shaken(solver: Any, state: Any, body: Body, amount: float) -> Any:
    """Move every unknown that is a position by about `amount` [mm] at random, in place, and return the state."""
    if holds_positions(solver, state, body):
        state.q += amount * np.random.default_rng(11).standard_normal(state.q.shape)
    return state


def holds_positions(solver: Any, state: Any, body: Body) -> bool:
    """Whether the unknowns are positions of points that fill the body."""
    q = state.q
    if q.ndim != 2 or q.shape[1:] != (3,) or len(q) < 4:
        return False
    box = np.ptp(body.surface.points, axis=0)
    return bool((np.ptp(solver.rest().q, axis=0) < 2.0 * box + 1.0).all())


def slowest_rate(square: float, drag: float) -> float:
    """Return how fast a vibration of squared frequency `square` [1/s^2] dies under `drag` [1/s], [1/s]."""
    half = 0.5 * drag
    return half if square >= half * half else square / (half + math.sqrt(half * half - square))


@lru_cache(maxsize=64)
def slowest_square(body: Body) -> float:
    """Return the squared frequency of the body's slowest vibration [1/s^2], of its volume or of its skin's tethers.

    For skin that of the hypodermis alone, which is a little too low: tension only makes it faster.
    """
    if body.solid is None:
        free = ~body.pinned
        return float(np.median(body.attachment.stiffness[free] / body.mass[free]))
    free = np.repeat(~body.solid.held, 3)
    k: sparse.csr_matrix = stiffness_matrix(body.solid)[free][:, free]
    m: sparse.csr_matrix = mass_matrix(body.solid)[free][:, free]
    if k.shape[0] > DENSE:
        start = np.random.default_rng(0).standard_normal(k.shape[0])
        return float(eigsh(k, k=1, M=m, sigma=0.0, which="LM", return_eigenvectors=False, v0=start)[0])
    return float(eigh(k.toarray(), m.toarray(), eigvals_only=True, subset_by_index=[0, 0])[0])


def settling_steps(body: Body, dt: float, *, constants: float = SETTLED) -> int:
    """Return after how many steps of `dt` [s] the body has come to rest."""
    drag = body.damping if body.solid is None else body.solid.damping
    rate = slowest_rate(slowest_square(body), drag)
    seconds = constants / rate if rate > 0.0 else math.inf
    if seconds > MOST_STEPS * dt:
        return MOST_STEPS
    return int(np.clip(math.ceil(seconds / dt), LEAST_STEPS, MOST_STEPS))


def said_of(solver: Any) -> str:
    """Return what the solver says of its static search."""
    report = getattr(solver, "static_report", None)
    unfinished = ["the search says that it did not converge"] if getattr(report, "converged", True) is False else []
    return "; ".join([*unfinished, *getattr(solver, "notices", [])])


def carried_rest(body: Body, control: Control) -> Floats:
    """Return the rest shape where the bones carry its vertices, (n, 3) [mm]."""
    x = body.surface.points
    places = np.einsum("bij,nj->nbi", control.bone_pose[:, :3, :3], x) + control.bone_pose[None, :, :3, 3]
    return np.asarray(np.einsum("nb,nbi->ni", body.attachment.bone_weight, places))
