"""Flesh that slides along bone and teeth, or sticks where it meets them, and sheets of skin that touch each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from faceanim.backends.mixed_fem.flesh import Flesh
from faceanim.backends.mixed_fem.skin import Skin
from faceanim.body.body import Body
from faceanim.body.solid import Solid
from faceanim.elements.contact import FACTOR, BonePenalty, Frozen, Touch, follow, near_bones, pose_between, steps_needed
from faceanim.elements.newton import Newton, Report, Term
from faceanim.elements.sheet_contact import SheetPenalty, coupled
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.bone_field import BoneField, bone_field
from faceanim.geometry.embedding import Embedding
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import DivergenceError, UserError

SPACING = 1.0
"""Of the lattice in which the depth in a bone is known [mm]."""
REACH = 30.0
"""Free nodes this near to a bone at rest may ever meet it [mm]."""
PAIR_REACH = 2.5
"""Skin this near to the other side at rest has room for its coupling in the tangent [mm]."""
ERROR = 0.1
"""A node deeper than this in a bone counts as an error [mm]."""
STILL = 0.01
"""Sheets have settled when looking at them anew moves nothing by more than this [mm]."""
ROUNDS, EVEN, NEARLY = 12, 3, 0.1
"""How often they are looked at anew at most, from which time on half-way between the last two places, and the change
that is then still accepted [mm]: contacts over an edge may go on to change between two triangles."""


class ContactReport(NamedTuple):
    """How flesh and bones touch: bones, nodes that may touch them, that do, that are `ERROR` deep or buried.

    ratio : of the errors over the nodes that may touch [-]   deepest : [mm] beyond what is so at rest
    through : the deepest that a lip or lid is in the other [mm]   setup_seconds : for the bones' distance fields
    """

    bones: int
    nodes: int
    touching: int
    errors: int
    ratio: float
    deepest: float
    through: float
    setup_seconds: float


def fields_of(body: Body, step: float) -> tuple[list[int], list[BoneField]]:
    """Return the bones of `body` that have a surface, and the depth in each; `step` as `bone_field` takes it.

    Raises `UserError` if there is none.
    """
    marked = [k for k, bone in enumerate(body.bones) if bone.surface is not None and len(bone.surface.triangles)]
    if not marked:
        raise UserError(
            "mixed_fem: contact needs the surface of a bone to touch, and no bone of this body has one; give its "
            "`Bone` a closed `surface`, or take contact = film"
        )
    return marked, [bone_field(s, spacing=SPACING, step=step) for k in marked if (s := body.bones[k].surface)]


class BoneSlide:
    """The penalty on depth in bones whose poses are read from their marks among the positions: a `newton.Term`."""

    def __init__(self, penalty: BonePenalty, flesh: Flesh) -> None:
        self.penalty, self.flesh = penalty, flesh

    def _at(self, x: Floats) -> BonePenalty:
        self.penalty.move(self.flesh.poses(x))
        return self.penalty

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ]; infinite where a node is buried."""
        return self._at(x).energy(x)

    def forces(self, x: Floats) -> Floats:
        """Return the forces of the bones on the flesh, (n, 3) [mN]."""
        return self._at(x).forces(x)

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add the Hessian without the curvature of the bones."""
        self._at(x).add_tangent(x, values)

    def report(self, x: Floats) -> Touch:
        """Return how the flesh touches the bones at `x`."""
        return self._at(x).report(x)

    def depths(self, x: Floats) -> Floats:
        """Return how much deeper than at rest each node that may touch is, (k,) [mm]."""
        return self._at(x).depths(x)[0]


class SkinSheets(SheetPenalty):
    """Lips and lids of a body whose skin is a shell: the shell's outer side touches, its inner nodes are pushed.

    The arms between the two are turned along when contacts are frozen, and kept until the next time.
    """

    def __init__(self, elements: Elements, body: Body, solid: Solid, skin: Skin, stiffness: float) -> None:
        self.outer, self.solid_skin = skin, solid.skin
        self.shift: Floats = np.zeros(3)
        inner = skin.inner(solid.skin)
        rest = elements.points
        self.shift = solid.skin.apply(solid.mesh.points) - inner.apply(rest)
        super().__init__(elements, body.surface, inner, body.pairs, stiffness)

    def place(self, x: Floats) -> Floats:
        """Return where the surface is, (n, 3) [mm], the shell's arms as they were found last."""
        return super().place(x) + self.shift

    def freeze(self, x: Floats, reach: float = 2.0) -> None:
        """Find what touches at `x`, and keep it and the arms."""
        self.turn(x)
        super().freeze(x, reach)

    def turn(self, x: Floats) -> None:
        """Turn the arms as they are at `x`."""
        self.shift = self.solid_skin.apply(self.outer.full(x)) - super().place(x)


class Settling(Newton):
    """Newton's method among sheets that touch: what is nearest is found anew until nothing moves.

    unsettled : the largest change that was accepted although it was not yet `STILL` [mm]
    """

    sheets: Sequence[Frozen] = ()
    unsettled = 0.0

    def minimise(self, x: Floats, force: Floats, report: Report) -> bool:
        """Move the free freedoms of `x` (n, 3) to the minimum, in place; return whether it was found."""
        if not self.sheets:
            return super().minimise(x, force, report)
        seen, moved = x.copy(), np.inf
        for k in range(ROUNDS):
            before = x.copy()
            for sheet in self.sheets:
                sheet.freeze(seen)
            if not super().minimise(x, force, report):
                return False
            moved = float(np.abs(x - before).max())
            if moved <= STILL:
                return True
            seen = x.copy() if k < EVEN else 0.5 * (seen + x)
        if moved > NEARLY:
            return False
        self.unsettled = max(self.unsettled, moved)
        return True


def room(body: Body, surface: Embedding) -> Ints:
    """Return the pairs of nodes that the sheets of `body`, carried by `surface`, need in the tangent, (k, 2)."""
    if not body.pairs:
        return np.zeros((0, 2), dtype=np.int32)
    return coupled(body.surface, body.pairs, surface, PAIR_REACH)


@dataclass
class Contact:
    """What a body's flesh may touch: its bones, and skin the skin opposite."""

    slide: BoneSlide
    sheets: tuple[SheetPenalty, ...]
    fields: list[BoneField]
    setup_seconds: float = 0.0

    @property
    def terms(self) -> tuple[Term, ...]:
        """What has energy where flesh slides."""
        return (self.slide, *self.sheets)

    def newton(self, *args: Any, **options: Any) -> Newton:
        """Return a search for balance with these contacts; arguments as `Newton` takes them."""
        out = Settling(*args, **options)
        out.sheets = self.sheets
        return out

    def largest_step(self, start: Floats, poses: Floats) -> float:
        """Return the share of the way from `start` to bones at `poses` in which no bone goes farther than it may."""
        flesh = self.slide.flesh
        return 1.0 / steps_needed(self.fields, flesh.poses(start), poses[list(flesh.marked)])

    def look(self, x: Floats) -> None:
        """Find anew at `x` which parts of the skin are opposite each other."""
        for sheet in self.sheets:
            sheet.freeze(x)

    def stuck(
        self, elements: Elements, start: Floats, poses: Floats, *, carried: Callable[[Floats, Floats], Floats],
        **options: Any,
    ) -> tuple[Floats, Report, str | None]:  # fmt: skip
        """Move all bones from where they are in `start` to `poses`; nodes that a bone meets are moved out of it and stick.

        carried : poses of all bones, positions -> positions with the held nodes where the bones carry them
        options : for `elements.contact.follow`. Returns the positions, the report, and why it ended early or None.
        """
        flesh, x, total = self.slide.flesh, start, Report()
        begin = np.tile(np.eye(4), (len(poses), 1, 1))
        marked = list(flesh.marked)
        begin[marked] = flesh.poses(start)
        unmarked = np.setdiff1d(np.arange(len(poses)), marked)
        begin[unmarked] = poses[unmarked]
        count = steps_needed(self.fields, begin[marked], poses[marked])
        for k in range(count):
            goal = pose_between(begin, poses, (k + 1) / count)
            self.slide.penalty.move(flesh.poses(x))

            def held(now: Floats, goal: Floats = goal, before: Floats = x) -> Floats:
                every = goal.copy()
                every[marked] = now
                return carried(every, before)

            try:
                done = follow(elements, self.slide.penalty, goal[marked], steps=1, start=x, impose=True,
                              sheets=self.sheets, carried=held, **options)  # fmt: skip
            except DivergenceError as error:
                return x, total, str(error)
            x = done.x
            total.iterations += sum(report.iterations for report in done.reports)
            total.fraction, total.load_steps = (k + 1) / count, k + 1
            final = done.reports[-1]
            total.residual, total.least_ratio, total.inverted = final.residual, final.least_ratio, final.inverted
            total.valid = final.valid
        total.converged = True
        return x, total, None

    def report(self, x: Floats) -> ContactReport:
        """Return how things touch at positions `x`."""
        depth = self.slide.depths(x)
        node = self.slide.penalty.touch.node
        count, errors = len(np.unique(node)), len(np.unique(node[depth > ERROR]))
        touch = self.slide.report(x)
        self.look(x)
        through = max((sheet.report(x).through for sheet in self.sheets), default=0.0)
        return ContactReport(
            len(self.fields), count, touch.active, errors, errors / max(count, 1), touch.deepest, through,
            self.setup_seconds,
        )  # fmt: skip


def contact_of(
    body: Body, solid: Solid, flesh: Flesh, skin: Skin | None, elements: Elements, fields: list[BoneField]
) -> Contact:
    """Return the contacts of the flesh with bones that have these `fields`, and of the sheets of `body`."""
    young = np.array([m.young_modulus for m in elements.materials])[flesh.region]
    held = flesh.weight[: len(flesh.mesh.points)].sum(axis=1) > 0.5
    touch = near_bones(
        flesh.mesh, held, fields, reach=REACH, young=young, among=_inner_side(solid, flesh, skin)
    )  # fmt: skip
    slide = BoneSlide(BonePenalty(elements, touch, fields), flesh)
    if not body.pairs:
        return Contact(slide, (), fields)
    corner = body.surface.points[body.surface.triangles[np.concatenate([pair.triangle for pair in body.pairs])]]
    edge = float(np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).mean())
    stiffness = FACTOR * max(m.young_modulus for m in elements.materials) / edge
    if skin is not None:
        return Contact(slide, (SkinSheets(elements, body, solid, skin, stiffness),), fields)
    carried = rows(flesh, solid.skin)
    return Contact(slide, (SheetPenalty(elements, body.surface, carried, body.pairs, stiffness),), fields)


def rows(flesh: Flesh, surface: Embedding) -> Embedding:
    """Return what carries `surface` as rows of `flesh`, all of whose nodes have one."""
    return Embedding(np.ascontiguousarray(flesh.row[surface.node]), surface.weight.copy())


def _inner_side(solid: Solid, flesh: Flesh, skin: Skin | None) -> Any:
    """Return the rows of the boundary that are not under or on the visible skin, None = all."""
    if solid.layer is None:
        return None
    outside = solid.layer.outer if skin is None else solid.layer.inner
    return np.setdiff1d(flesh.mesh.boundary_nodes, flesh.row[outside]).astype(np.int32)
