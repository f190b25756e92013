"""The mixed finite element backend, and the models that it is compared with, behind the `Solver` protocol."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from faceanim.backends.mixed_fem.flesh import Flesh
from faceanim.backends.mixed_fem.options import Options
from faceanim.backends.mixed_fem.skin import ShellPulls, ShellTerm, Skin, node_mass
from faceanim.backends.mixed_fem.tissues import beyond_limit, largest_stretch, limits_said, materials_of
from faceanim.backends.newton_solver import SolverNewton
from faceanim.backends.nodal import carry, push_out, solid_of
from faceanim.backends.pulls import Pulls, coupled
from faceanim.backends.solver import Energy, State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import ThinLayer
from faceanim.elements.mixed import MixedElements
from faceanim.elements.newton import Newton, Report, Term
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.embedding import Embedding
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import RunError, UserError

if TYPE_CHECKING:
    from faceanim.backends.mixed_fem.contact import Contact
    from faceanim.geometry.bone_field import BoneField

FILM = "gap"
"""Material of the film between flesh and teeth, which contact replaces."""
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
        self.contact: Contact | None = None
        self.fields: list[BoneField] = []
        self.setup_seconds = 0.0
        self.skin: Skin | None = None
        self.shell: ShellTerm | None = None
        if self.model.shell and self.solid.layer is None:
            self.notices.once("this body has no skin layer that a shell could replace: all of it is tetrahedra")
        if self.model.shell and self.solid.layer is not None:
            self._build_mixed(self.solid.layer)
        else:
            self._build_solid()
        self._touch()
        self.matrix = self.solid.skin.matrix(len(self.solid.mesh.points))
        self._hold()
        self._matrices()

    def _flesh(self, layer: int | None) -> Flesh:
        """Return the elements that are kept, without the region `layer`, and without the film where contact replaces it."""
        if self.options.contact == "film":
            return Flesh(self.solid, layer=layer)
        from faceanim.backends.mixed_fem.contact import fields_of

        started = perf_counter()
        marked, self.fields = fields_of(self.body, self.options.step)
        self.setup_seconds = perf_counter() - started
        names = [m.name for m in self.solid.materials]
        return Flesh(self.solid, layer=layer, gap=names.index(FILM) if FILM in names else None, marked=marked)

    def _elements(self, flesh: Flesh, surface: Embedding, *pairs: Ints, rotations: int = 0) -> Elements:
        kind = MixedElements if self.model.pressure else Elements
        together = [coupled(self.body, surface), *pairs]
        if self.fields:
            from faceanim.backends.mixed_fem.contact import room

            together.append(room(self.body, surface))
        made = kind(
            flesh.mesh, self.materials, flesh.region, law=self.model.law or self.options.law,
            coupled=np.concatenate(together).astype(np.int32), extra=flesh.extra + rotations,
        )  # fmt: skip
        if flesh.extra:
            made.points[len(flesh.mesh.points) : len(flesh.points)] = flesh.points[len(flesh.mesh.points) :]
        return made

    def _build_solid(self) -> None:
        self.flesh = flesh = self._flesh(None)
        skin = self.solid.skin
        surface = Embedding(np.ascontiguousarray(flesh.row[skin.node]), skin.weight.copy())
        self.elements = self._elements(flesh, surface)
        self.node_mass = flesh.mass(self.solid)
        self.pulls: Pulls = Pulls(self.body, self.elements, surface, mass=self.node_mass)

    def _build_mixed(self, layer: ThinLayer) -> None:
        solid, body = self.solid, self.body
        material = self.materials[layer.region]
        self.flesh = self._flesh(layer.region)
        self.skin = skin = Skin(self.flesh, solid, layer, material, self.model.law or self.options.law)
        self.elements = self._elements(self.flesh, skin.inner(solid.skin), skin.coupled, rotations=len(skin.arm))
        self.node_mass = node_mass(solid, skin)
        self.shell = ShellTerm(skin, self.elements)
        self.pulls = ShellPulls(body, solid, skin, self.elements)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Muscles, and the shell and contacts if there are any."""
        out = (self.pulls,) if self.shell is None else (self.pulls, self.shell)
        return out if self.contact is None or self.options.contact != "slide" else (*out, *self.contact.terms)

    def _touch(self) -> None:
        """Find what may touch, if contact is asked for."""
        if not self.fields:
            return
        from faceanim.backends.mixed_fem.contact import contact_of

        self.contact = contact_of(self.body, self.solid, self.flesh, self.skin, self.elements, self.fields)
        self.contact.setup_seconds = self.setup_seconds

    def solve_static(self, control: Control, guess: State | None = None) -> State:
        """Return the equilibrium as `SolverNewton` does; where flesh sticks to bones, these go step by step."""
        if self.contact is None or self.options.contact != "stick":
            return super().solve_static(control, guess)
        control.reject_unfit(self.body)
        self._apply(control)
        start = self._start(control, guess)
        x, report, failure = self.contact.stuck(
            self.elements, start, control.bone_pose, fixed=~self.free, terms=self.terms, force=self.pulls.dead,
            carried=self._placed, tolerance=self.options.tolerance, most=self.options.most,
            least_step=self.options.least_step,
        )  # fmt: skip
        self.static_report = report
        self.last_static = State(x, np.zeros_like(x), 0.0 if guess is None else guess.t)
        if failure is not None:
            raise RunError(f"{self.name}: no equilibrium beyond {report.fraction:.1%} of the bones' way: {failure}")
        self._note_doubts(report)
        return self.last_static.copy()

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s] as `SolverNewton` does; raises `UserError` where flesh is to stick to bones."""
        if self.options.contact == "stick":
            raise UserError("mixed_fem: contact = stick has equilibria only, no steps in time; take contact = slide")
        return super().step(state_in, state_out, control, dt)

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state` [uJ]; that of contacts counts as elastic."""
        if self.contact is not None:
            self.contact.look(state.q)
        return super().energy(state, control)

    def _newton(self, terms: tuple[Any, ...]) -> Newton:
        if self.contact is None:
            return super()._newton(terms)
        return self.contact.newton(
            self.elements, self.free, (*self.terms, *terms), tolerance=self.options.tolerance, most=self.options.most
        )

    def _hold(self) -> None:
        """Find the rows that bones carry; a pair's rotation is held where both of its nodes are."""
        solid, skin = self.solid, self.skin
        weight = self.flesh.weight
        if skin is not None:
            both = solid.held[skin.layer.outer] & solid.held[skin.layer.inner]
            weight = np.concatenate([weight, np.where(both[:, None], solid.bone_weight[skin.layer.inner], 0.0)])
        self.weight = weight
        self.held = weight.sum(axis=1) > 0.5
        self.free = np.repeat(~self.held[:, None], 3, axis=1)
        self._main_bone = int(np.argmax(solid.bone_weight.sum(axis=0)))
        self._nodes = len(self.flesh.points)

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
        """Write the surface points (n, 3) [mm] into `out`, moved out of the eyeballs, which the flesh does not feel."""
        out[:] = self.matrix @ self.nodes(state)
        push_out(out, self.body)

    def nodes(self, state: State) -> Floats:
        """Return where all nodes of the body's solid are, (n, 3) [mm]."""
        return self.flesh.full(state.q) if self.skin is None else self.skin.full(state.q)

    def contact_report(self, state: State) -> Any:
        """Return how flesh and bones touch in `state`, see `contact.ContactReport`; None without contact."""
        return None if self.contact is None else self.contact.report(state.q)

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
        nodes = len(self.flesh.used)
        way = self._placed(control.bone_pose, start)[:nodes] - start[:nodes]
        longest = float(np.linalg.norm(way, axis=1).max(initial=0.0))
        if self.model.law == "linear":
            return 1.0
        pulled = float(control.activation.max(initial=0.0)) if guess is None else 0.0
        return min(1.0, self.options.step / max(longest, 1e-9), FIRST_PULL / max(pulled, FIRST_PULL))

    def _largest_step(self, control: Control, start: Floats) -> float:
        return 1.0 if self.contact is None else self.contact.largest_step(start, control.bone_pose)

    def _note_doubts(self, report: Report) -> None:
        super()._note_doubts(report)
        if self.last_static is None:
            return
        unsettled = getattr(self._statics, "unsettled", 0.0)
        if unsettled:
            self.notices.once(
                f"contact between lips or lids still moved skin by {unsettled:.2f} mm when it was accepted"
            )
        stretch = largest_stretch(self.solid.mesh, self.nodes(self.last_static))
        present = self.flesh.present
        self.stretch_beyond = beyond_limit(stretch[present], self.solid.region[present], self.materials)
        if self.model.law == "mooney_rivlin":
            for tissue, share in self.stretch_beyond.items():
                if share > 0:
                    self.notices.once(
                        f"{share:.0%} of {tissue} is stretched beyond the stability limit of its Mooney-Rivlin constants; "
                        "take law 'tension'"
                    )
