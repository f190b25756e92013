"""The mixed finite element backend, and the models that it is compared with, behind the `Solver` protocol."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from faceanim.backends.mixed_fem.options import Options
from faceanim.backends.mixed_fem.skin import ShellPulls, ShellTerm, Skin, node_mass
from faceanim.backends.mixed_fem.tissues import beyond_limit, largest_stretch, limits_said, materials_of
from faceanim.backends.newton_solver import SolverNewton
from faceanim.backends.nodal import carry, solid_of
from faceanim.backends.pulls import Pulls, coupled
from faceanim.backends.solver import State
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.elements.mixed import MixedElements
from faceanim.elements.newton import Report, Term
from faceanim.elements.tetrahedra import Elements
from faceanim.ground.arrays import Floats

FIRST_PULL = 0.25
"""Activation that is tried at once from rest."""


class SolverMixedFem(SolverNewton):
    """Muscle and fat as tetrahedra that do not lock, skin as a shell; or one of the simpler models.

    State: positions and velocities of the nodes, (k, 3); with a shell, its rotation vectors follow in further rows.
    stretch_beyond : share of each tissue's elements that the last equilibrium stretches beyond the Mooney-Rivlin limit
    """

    name = "mixed_fem"
    Options: ClassVar[type] = Options
    elements: Elements

    def __init__(self, body: Body, options: Any = None) -> None:
        super().__init__(body)
        self.options: Options = Options() if options is None else options
        self.model = self.options.resolved
        self.solid = solid_of(body, self.name)
        self.materials = materials_of(self.solid, self.options)
        self.notices.extend(limits_said(self.materials, self.model))
        self.stretch_beyond: dict[str, float] = {}
        self.skin: Skin | None = None
        self.shell: ShellTerm | None = None
        if self.model.shell and self.solid.layer is None:
            self.notices.once("this body has no skin layer that a shell could replace: all of it is tetrahedra")
        if self.model.shell and self.solid.layer is not None:
            self._build_mixed()
        else:
            self._build_solid()
        self.matrix = self.solid.skin.matrix(len(self.solid.mesh.points))
        self._hold()
        self._matrices()

    def _elements(self, mesh: Any, region: Any, **extra: Any) -> Elements:
        kind = MixedElements if self.model.pressure else Elements
        return kind(mesh, self.materials, region, law=self.model.law or self.options.law, **extra)

    def _build_solid(self) -> None:
        solid, body = self.solid, self.body
        self.elements = self._elements(solid.mesh, solid.region, coupled=coupled(body, solid.skin))
        self.node_mass = solid.node_mass
        self.pulls: Pulls = Pulls(body, self.elements, solid.skin, mass=self.node_mass)

    def _build_mixed(self) -> None:
        solid, body = self.solid, self.body
        assert solid.layer is not None
        material = self.materials[solid.layer.region]
        self.skin = skin = Skin(solid, solid.layer, material, self.model.law or self.options.law)
        together = np.concatenate([skin.coupled, coupled(body, skin.inner(solid.skin))]).astype(np.int32)
        self.elements = self._elements(skin.flesh, skin.region, coupled=together, extra=len(skin.arm))
        self.node_mass = node_mass(solid, skin, len(self.elements.points))
        self.shell = ShellTerm(skin, self.elements)
        self.pulls = ShellPulls(body, solid, skin, self.elements)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Muscles, and the shell if there is one."""
        return (self.pulls,) if self.shell is None else (self.pulls, self.shell)

    def _hold(self) -> None:
        """Find the rows that bones carry; a pair's rotation is held where both of its nodes are."""
        solid, skin = self.solid, self.skin
        weight = solid.bone_weight
        if skin is not None:
            turn = np.where(
                (solid.held[skin.layer.outer] & solid.held[skin.layer.inner])[:, None], weight[skin.layer.inner], 0.0
            )
            weight = np.concatenate([weight[skin.used], turn])
        self.weight = weight
        self.held = weight.sum(axis=1) > 0.5
        self.free = np.repeat(~self.held[:, None], 3, axis=1)
        self._main_bone = int(np.argmax(weight[self.held].sum(axis=0)))
        self._nodes = len(solid.mesh.points) if skin is None else len(skin.used)

    def _matrices(self) -> None:
        """Compute mass (lumped) and damping in the elements' pattern; rotations get the inertia of half their arm."""
        mass = self.node_mass.copy()
        if self.skin is not None:
            length = np.einsum("mi,mi->m", self.skin.arm, self.skin.arm)
            mass[self._nodes :] = 0.25 * length * self.solid.node_mass[self.skin.layer.outer]
        every = np.arange(len(mass), dtype=np.int32)
        at = self.elements.entries(every, every)
        values = np.zeros(len(self.elements.indices))
        for i in range(3):
            values[at[:, i, i]] = mass
        self.mass = self.elements.matrix(values)
        drag = self.solid.damping * values
        if self.solid.stiffness_damping:
            rest = self.elements.points
            stiff = self.elements.tangent_values(rest, np.zeros_like(values))
            if self.shell is not None:
                self.shell.add_tangent(rest, stiff)
            drag += self.solid.stiffness_damping * stiff
        self.drag = self.elements.matrix(drag)

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the surface points (n, 3) [mm] into `out`."""
        out[:] = self.matrix @ self.nodes(state)

    def nodes(self, state: State) -> Floats:
        """Return where all nodes of the body's solid are, (n, 3) [mm]."""
        return state.q if self.skin is None else self.skin.full(state.q)

    def _placed(self, pose: Floats, x: Floats) -> Floats:
        out = x.copy()
        held = np.flatnonzero(self.held)
        nodes, turns = held[held < self._nodes], held[held >= self._nodes]
        out[nodes] = carry(self.elements.points[nodes], self.weight[nodes], pose)
        if len(turns):
            out[turns] = Skin.turned(self.weight[turns], pose)
        return out

    def _carried_rest(self, pose: Floats) -> Floats:
        turn = pose[self._main_bone]
        out = np.asarray(self.elements.points @ turn[:3, :3].T + turn[:3, 3])
        if self.skin is not None:
            out[self._nodes :] = Skin.turned(np.ones((1, 1)), turn[None])
        return out

    def _first_step(self, control: Control, guess: State | None) -> float:
        """Return the share of the load in which bones go at most `options.step`, and muscles pull a little."""
        start = self._start(control, guess)
        way = self._placed(control.bone_pose, start)[: self._nodes] - start[: self._nodes]
        longest = float(np.linalg.norm(way, axis=1).max(initial=0.0))
        if self.model.law == "linear":
            return 1.0
        pulled = float(control.activation.max(initial=0.0)) if guess is None else 0.0
        return min(1.0, self.options.step / max(longest, 1e-9), FIRST_PULL / max(pulled, FIRST_PULL))

    def _note_doubts(self, report: Report) -> None:
        super()._note_doubts(report)
        if self.last_static is None:
            return
        stretch = largest_stretch(self.solid.mesh, self.nodes(self.last_static))
        self.stretch_beyond = beyond_limit(stretch, self.solid.region, self.materials)
        if self.model.law == "mooney_rivlin":
            for tissue, share in self.stretch_beyond.items():
                if share > 0:
                    self.notices.once(
                        f"{share:.0%} of {tissue} is stretched beyond the stability limit of its Mooney-Rivlin constants; "
                        "take law 'tension'"
                    )
