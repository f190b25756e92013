"""The finite element backend behind the `Solver` protocol."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from faceanim.backends.finite_elements.options import Options
from faceanim.backends.newton_solver import SolverNewton
from faceanim.backends.nodal import carried, solid_of
from faceanim.backends.pulls import Pulls, carried_by, coupled
from faceanim.backends.solver import State
from faceanim.body.body import Body
from faceanim.elements.tetrahedra import Elements
from faceanim.ground.arrays import Floats


class SolverFiniteElements(SolverNewton):
    """Nonlinear statics and implicit dynamics of the body's volume; no contact.

    State: positions and velocities of all nodes, (n, 3); for quadratic elements the mid-edge nodes follow the corners.
    """

    name = "finite_elements"
    Options: ClassVar[type] = Options
    elements: Elements

    def __init__(self, body: Body, options: Any = None) -> None:
        super().__init__(body)
        self.options: Options = Options() if options is None else options
        self.solid = solid_of(body, "finite_elements")
        skin = self.solid.skin
        self.elements = Elements(
            self.solid.mesh, self.solid.materials, self.solid.region,
            order=self.options.order, law=self.options.law, coupled=coupled(body, skin),
        )  # fmt: skip
        self._hold()
        self.pulls = Pulls(body, self.elements, carried_by(self.elements, skin), mass=self.elements.gravity_mass)
        self._matrices()

    def _hold(self) -> None:
        """Find the nodes that bones carry; a mid-edge node is held if both of its corners are."""
        solid, edges = self.solid, self.elements.edges
        self.held = np.concatenate([solid.held, solid.held[edges].all(axis=1)])
        self.free = np.repeat(~self.held[:, None], 3, axis=1)
        weight = np.concatenate([solid.bone_weight, solid.bone_weight[edges].mean(axis=1)])
        self._main_bone = int(np.argmax(weight[self.held].sum(axis=0)))
        self._corners = np.flatnonzero(solid.held)
        self._held_edges = np.flatnonzero(solid.held[edges].all(axis=1))

    def _matrices(self) -> None:
        """Compute mass and damping in the elements' pattern, all that a time step adds to the stiffness."""
        mass = self.elements.mass
        if self.options.mass == "lumped":
            values = np.zeros(len(mass.data))
            every = np.arange(len(self.elements.points), dtype=np.int32)
            at = self.elements.entries(every, every)
            for i in range(3):
                values[at[:, i, i]] = self.elements.lumped_mass
            mass = self.elements.matrix(values)
        self.mass = mass
        drag = self.solid.damping * mass.data
        if self.solid.stiffness_damping:
            drag = drag + self.solid.stiffness_damping * self.elements.tangent(self.elements.points).data
        self.drag = self.elements.matrix(drag)

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the surface points (n, 3) [mm] into `out`."""
        out[:] = self.pulls.matrix @ state.q

    def _placed(self, pose: Floats, x: Floats) -> Floats:
        """Return `x` with the held nodes where the bones at `pose` carry them."""
        out = x.copy()
        out[self._corners] = carried(self.solid, pose)
        if len(self._held_edges):
            n = len(self.solid.mesh.points)
            out[n + self._held_edges] = out[self.elements.edges[self._held_edges]].mean(axis=1)
        return out

    def _carried_rest(self, pose: Floats) -> Floats:
        """Return the rest shape moved rigidly with the bone that holds most of it."""
        turn = pose[self._main_bone]
        return np.asarray(self.elements.points @ turn[:3, :3].T + turn[:3, 3])
