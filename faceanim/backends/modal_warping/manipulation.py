"""Dragging and turning nodes: forces on a few nodes such that others meet positions and orientations (section V)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from faceanim.backends.modal_warping.twist import FARTHEST, mean_rotation, mean_rotation_slope, rotation
from faceanim.backends.solver import State, StepReport
from faceanim.ground.arrays import Floats, Ints, floats, ints
from faceanim.ground.errors import UserError, unknown_name

if TYPE_CHECKING:
    from faceanim.backends.modal_warping.solver import SolverModalWarping, StateModalWarping

PRIORITIES = ("position", "orientation", "together")
TURNINGS = ("newton", "unconstrained", "previous")
RCOND, RCOND_REST = 1e-8, 1e-6
"""Relative singular value below which a direction cannot be reached: of the first task, and within its null space."""
DAMPING = 0.03
"""Damping of an over-determined task, relative to its largest singular value."""


def nearest_nodes(solver: SolverModalWarping, vertices: Any) -> Ints:
    """Return the solid nodes nearest at rest to surface `vertices` (k,), held ones left out, (k,)."""
    surface = solver.body.surface.points
    chosen = ints("vertices", np.atleast_1d(vertices), None, below=len(surface))
    free = np.flatnonzero(~solver.solid.held)
    _, near = cKDTree(solver.solid.mesh.points[free]).query(surface[chosen])
    return free[near].astype(np.int32)


def with_neighbours(solver: SolverModalWarping, nodes: Any) -> Ints:
    """Return `nodes` and all free nodes that share an element with one of them, increasing."""
    tets = solver.solid.mesh.tets
    near = np.unique(tets[np.isin(tets, nodes).any(axis=1)])
    return near[~solver.solid.held[near]].astype(np.int32)


@dataclass(frozen=True, eq=False)
class _Answer:
    """How forces follow from what the tasks lack: y = inverse b + correction (c - second inverse b) (Eq. 29)."""

    inverse: Floats
    second: Floats
    correction: Floats | None

    def forces(self, b: Floats, c: Floats) -> Floats:
        """Return y (3 mu,) for the first task's lack `b` and the second's `c`."""
        y = self.inverse @ b
        return np.asarray(y if self.correction is None else y + self.correction @ (c - self.second @ y))


@dataclass(frozen=True, eq=False)
class _Tables:
    """What one step length needs: `reach` gamma Phi_x^T (m, 3 mu), and Phi_c reach and Psi_c reach of the tasks.

    deficient : the first task has more conditions than can be met   answer : for these matrices, computed once
    """

    reach: Floats
    position: Floats
    turning: Floats
    deficient: bool
    answer: _Answer


class Manipulation:
    """Position and orientation constraints on nodes, met in every step by forces on exercised nodes.

    Set `solver.manipulation = Manipulation(solver, position=[7], orientation=[9])`, then before each step
    `move_to(points)` and `turn_to(rotation_vectors)`. Until set, the targets are where the nodes are at rest.

    position, orientation : solid nodes (use `nearest_nodes` for surface vertices); held ones cannot be dragged
    exercised : free nodes on which the forces act; default those of both constraints and the neighbours of the turned
    priority : "position" first and orientation as well as then possible (Eq. 29), "orientation" first, or "together"
    turning : whose Rt the position constraint uses (footnote 4): "newton" that of the answer, by up to `newton_steps`
        steps; "unconstrained" that of the step without constraint (a lasting bias); "previous" the last step's
        (lags while the target moves)

    More conditions than the modes can meet are detected, noted in `solver.notices`, and met as well as possible by
    damped least squares. `position_residual` [mm] and `orientation_residual` [rad] tell how far the last step was off,
    `force` (mu, 3) [mN] what it took.
    """

    def __init__(
        self,
        solver: SolverModalWarping,
        *,
        position: Sequence[int] | Ints = (),
        orientation: Sequence[int] | Ints = (),
        exercised: Sequence[int] | Ints | None = None,
        priority: str = "position",
        turning: str = "newton",
        newton_steps: int = 4,
    ) -> None:
        for kind, value, known in (("priority", priority, PRIORITIES), ("turning", turning, TURNINGS)):
            if value not in known:
                raise unknown_name(kind, value, known)
        if newton_steps < 1:
            raise UserError(f"newton_steps = {newton_steps} must be at least 1")
        if solver.options.variant.startswith("rotation_strain"):
            raise UserError(
                "constraints need the node-wise warp, which variant 'rotation_strain' does not have; choose variant "
                "'warped' or 'consistent'"
            )
        self.solver, self.priority, self.turning, self.newton_steps = solver, priority, turning, newton_steps
        self.position, self.orientation = self._nodes("position", position), self._nodes("orientation", orientation)
        if not len(self.position) + len(self.orientation):
            raise UserError("a manipulation needs at least one node to hold or to turn")
        if exercised is None:
            near = with_neighbours(solver, self.orientation) if len(self.orientation) else self.orientation
            exercised = np.union1d(self.position, near)
        self.exercised = self._nodes("exercised", exercised)
        if not len(self.exercised):
            raise UserError("a manipulation needs at least one exercised node")
        self._rows()
        self.position_target = solver.solid.mesh.points[self.position].copy()
        self.orientation_target: Floats = np.zeros((len(self.orientation), 3))
        self.position_residual = self.orientation_residual = 0.0
        self.force: Floats = np.zeros((len(self.exercised), 3))
        self._tables: dict[bytes, _Tables] = {}

    def _nodes(self, name: str, nodes: Any) -> Ints:
        empty = np.zeros(0, np.int32)
        solid = self.solver.solid
        out = ints(f"{name} nodes", np.asarray(nodes) if len(nodes) else empty, None, below=len(solid.mesh.points))
        if len(np.unique(out)) != len(out):
            raise UserError(f"{name} nodes: a node is listed twice")
        if name != "orientation" and solid.held[out].any():
            node = int(out[np.argmax(solid.held[out])])
            raise UserError(f"{name} node {node} is held by a bone and cannot be dragged; choose a free node")
        return out

    def _rows(self) -> None:
        basis, m = self.solver.modes.basis, self.solver.modes.count
        self.at = basis[self.position]
        self.shapes = basis[self.position][:, :3, :m].reshape(-1, m)
        self.turns = basis[self.position][:, 3:, :m].reshape(-1, m)
        self.orienting = basis[self.orientation][:, 3:, :].reshape(3 * len(self.orientation), basis.shape[2])
        self.reaching = np.ascontiguousarray(basis[self.exercised][:, :3, :m].reshape(-1, m).T)

    def move_to(self, points: Any) -> None:
        """Ask for the position nodes at `points` (k, 3) [mm]; raise `UserError` for another shape or what is not finite."""
        self.position_target = floats("points to move to", points, len(self.position), 3)

    def turn_to(self, rotation_vectors: Any) -> None:
        """Ask for rotation vectors (k, 3) [rad] from rest of the orientation nodes; more than pi means going on turning."""
        self.orientation_target = floats("rotation vectors to turn to", rotation_vectors, len(self.orientation), 3)

    def _tables_of(self, gamma: Floats) -> _Tables:
        key = gamma.tobytes()
        if key not in self._tables:
            if len(self._tables) > 8:
                self._tables.clear()
            self._tables[key] = self._precompute(gamma)
        return self._tables[key]

    def _precompute(self, gamma: Floats) -> _Tables:
        """Return the reach and the matrices of Eqs. 26 and 28; note what cannot be met."""
        m = self.solver.modes.count
        reach = gamma[:, None] * self.reaching
        b, o = self.shapes @ reach, self.orienting[:, :m] @ reach
        first = {"position": b, "orientation": o, "together": _stack(b, o)}[self._first]
        deficient = _rank(first, RCOND) < len(first)
        if deficient:
            way_out = "fewer conditions, more modes or more exercised nodes are needed"
            if self._first == "orientation":
                way_out = "exercise more nodes around the turned one, or keep more modes"
            self.solver.notices.once(
                f"{len(first)} {self._first} conditions exceed what {m} modes and {len(self.exercised)} exercised "
                f"nodes can meet (rank {_rank(first, RCOND)}): met by damped least squares; {way_out}"
            )
        elif _rank(_stack(b, o), RCOND_REST) < len(b) + len(o):
            self.solver.notices.once(
                f"position and orientation conditions cannot all be met (rank {_rank(_stack(b, o), RCOND_REST)} of "
                f"{len(b) + len(o)}): {self._first} goes first; exercise more nodes or keep more modes"
            )
        return _Tables(reach, b, o, deficient, self._answer(b, o, deficient))

    @property
    def _first(self) -> str:
        """Return the task that goes first, given which there are."""
        if self.priority == "together" and len(self.position) and len(self.orientation):
            return "together"
        if not len(self.orientation):
            return "position"
        return "orientation" if self.priority == "orientation" or not len(self.position) else "position"

    def correct(
        self, free: Floats, state: StateModalWarping, twist: Floats, gamma: Floats, report: StepReport
    ) -> Floats:
        """Return the amplitudes (m,) that meet the constraints, from those without them, `free` (m,) (Eqs. 25-29).

        state : at the beginning of the step   twist : (bones, 6) at its end   gamma : (m,) of Eq. 19
        """
        tables, xi = self._tables_of(gamma), twist.ravel()
        before = np.concatenate([state.q, state.twist.ravel()])
        if tables.deficient or self.turning == "newton":
            y, steps = self._newton(free, xi, tables)
            report.iterations = steps
        else:
            w = self._moved(np.concatenate([free, xi]) if self.turning == "unconstrained" else before)[1]
            y = self._once(free, xi, w, tables)
            if self._strays(free, xi, tables.reach @ y):
                self.solver.notices.once(
                    f"turning {self.turning!r} led away from a far target: Newton steps were taken instead"
                )
                y, report.iterations = self._newton(free, xi, tables)
        q = free + tables.reach @ y
        self._measure(q, xi, y, state)
        report.converged = max(self.position_residual, self.orientation_residual) < 1e-3 or not tables.deficient
        return q

    def _moved(self, z: Floats) -> tuple[Floats, Floats]:
        """Return local displacement and rotation of the position nodes, (k, 3) each."""
        moved = self.at @ z
        return moved[:, :3], moved[:, 3:]

    def _mean(self, w: Floats) -> Floats:
        if not self.solver.shape.warped:
            return np.tile(np.eye(3), (len(w), 1, 1))
        return mean_rotation(w)

    def _errors(self, q: Floats, xi: Floats) -> tuple[Floats, Floats]:
        """Return what positions [mm] and rotations [rad] lack at amplitudes `q`, (3k,) each."""
        z = np.concatenate([q, xi])
        u, w = self._moved(z)
        rest = self.solver.solid.mesh.points[self.position]
        at = rest + np.einsum("kij,kj->ki", self._mean(w), u)
        return (self.position_target - at).ravel(), self.orientation_target.ravel() - self.orienting @ z

    def _once(self, free: Floats, xi: Floats, w: Floats, tables: _Tables) -> Floats:
        """Return y = R_x^T F_x with Rt taken at rotations `w` (choices b and c)."""
        z = np.concatenate([free, xi])
        turned = np.linalg.pinv(self._mean(w), rcond=1e-3) if len(w) else np.zeros((0, 3, 3))
        wanted = self.position_target - self.solver.solid.mesh.points[self.position]
        local = np.einsum("kij,kj->ki", turned, wanted) - self._moved(z)[0]
        lacks = self.orientation_target.ravel() - self.orienting @ z
        return tables.answer.forces(*self._ordered(local.ravel(), lacks))

    def _strays(self, free: Floats, xi: Floats, move: Floats) -> bool:
        """Return whether `move` leaves a constrained node turned too far, or much worse off than it was."""
        size = float(np.ptp(self.solver.solid.mesh.points, axis=0).max())
        before, after = (self._weigh(self._errors(q, xi), size) for q in (free, free + move))
        w = self._moved(np.concatenate([free + move, xi]))[1]
        far = bool(len(w)) and float((w**2).sum(axis=1).max()) > FARTHEST**2
        return far or not after < max(1.5 * before, 0.25)

    def _newton(self, free: Floats, xi: Floats, tables: _Tables) -> tuple[Floats, int]:
        """Return y for which the positions are met with the Rt of the answer (choice a), and how many steps it took."""
        y = np.zeros(tables.reach.shape[1])
        most = 12 if tables.deficient else self.newton_steps
        size = float(np.ptp(self.solver.solid.mesh.points, axis=0).max())
        steps = 0
        errors = self._errors(free, xi)
        while steps < most and self._weigh(errors, size) > 1e-13:
            steps += 1
            slope = self._slope(free + tables.reach @ y, xi) @ tables.reach
            answer = self._answer(slope, tables.turning, tables.deficient)
            move = answer.forces(*self._ordered(*errors))
            move, after = self._shorten(free, xi, y, move, tables, errors, size)
            if after is None:
                break
            y, errors = y + move, after
        return y, max(steps, 1)

    def _shorten(
        self, free: Floats, xi: Floats, y: Floats, move: Floats, tables: _Tables, errors: Any, size: float
    ) -> tuple[Floats, Any]:
        """Halve `move` until the errors fall and no constrained node turns too far; (move, None) if they never do."""
        for _ in range(10):
            q = free + tables.reach @ (y + move)
            after = self._errors(q, xi)
            w = self._moved(np.concatenate([q, xi]))[1]
            near = not len(w) or float((w**2).sum(axis=1).max()) < FARTHEST**2
            if near and self._weigh(after, size) < self._weigh(errors, size) * (1.0 - 1e-6):
                return move, after
            if not near:
                self.solver.notices.once("a dragged node has turned by nearly a full turn, where Rt cannot be inverted")
            move = 0.5 * move
        return move, None

    def _weigh(self, errors: tuple[Floats, Floats], size: float) -> float:
        """Return the size of the errors that must fall: those of the first task alone unless all go together."""
        at = float(np.linalg.norm(errors[0])) / size
        turn = float(np.linalg.norm(errors[1]))
        return {"position": at + 1e-3 * turn, "orientation": turn + 1e-3 * at}.get(self._first, at + turn)

    def _slope(self, q: Floats, xi: Floats) -> Floats:
        """Return the derivative of the constrained positions by the amplitudes, (3k, m)."""
        u, w = self._moved(np.concatenate([q, xi]))
        if not self.solver.shape.warped:
            return self.shapes
        k, m = len(u), self.solver.modes.count
        direct = np.einsum("kij,kjm->kim", mean_rotation(w), self.shapes.reshape(k, 3, m))
        turning = np.einsum("kij,kjm->kim", mean_rotation_slope(w, u), self.turns.reshape(k, 3, m))
        return np.asarray((direct + turning).reshape(3 * k, m))

    def _ordered(self, positions: Any, turns: Any) -> tuple[Any, Any]:
        """Return what belongs to the first task, then what belongs to the second."""
        if self._first == "together":
            return _stack(positions, turns), turns[:0]
        return (turns, positions) if self._first == "orientation" else (positions, turns)

    def _answer(self, a: Floats, o: Floats, damped: bool) -> _Answer:
        """Return how to meet a y = b (positions) and o y = c (orientations), by the order of the tasks."""
        first, second = self._ordered(a, o)
        inverse = _inverse(first, damped)
        if not len(second):
            return _Answer(inverse, second, None)
        null = np.eye(first.shape[1]) - np.linalg.pinv(first, rcond=RCOND) @ first
        rest = second @ null
        if np.linalg.norm(rest) < RCOND_REST * np.linalg.norm(second):
            return _Answer(inverse, second, None)
        return _Answer(inverse, second, null @ np.linalg.pinv(rest, rcond=RCOND_REST))

    def _measure(self, q: Floats, xi: Floats, y: Floats, state: State) -> None:
        """Keep the residuals and the forces R_x y, with R at the beginning of the step."""
        at, turn = self._errors(q, xi)
        self.position_residual = float(np.linalg.norm(at.reshape(-1, 3), axis=1).max(initial=0.0))
        self.orientation_residual = float(np.linalg.norm(turn.reshape(-1, 3), axis=1).max(initial=0.0))
        local = y.reshape(-1, 3)
        if self.solver.shape.warped:
            w = self.solver.rotations(state)[self.exercised]
            self.force = np.einsum("kij,kj->ki", rotation(w), local)
        else:
            self.force = local


def _stack(a: Floats, b: Floats) -> Floats:
    return np.concatenate([a, b])


def _rank(a: Floats, rcond: float) -> int:
    values = np.linalg.svd(a, compute_uv=False)
    return int((values > rcond * values.max(initial=0.0)).sum())


def _inverse(a: Floats, damped: bool) -> Floats:
    """Return the pseudo-inverse of `a`, damped if asked."""
    if not damped:
        return np.asarray(np.linalg.pinv(a, rcond=RCOND), dtype=np.float64)
    u, s, v = np.linalg.svd(a, full_matrices=False)
    mu = DAMPING * float(s.max(initial=1e-300))
    return np.asarray((v.T * (s / (s**2 + mu**2))) @ u.T)
