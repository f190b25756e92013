"""Explicit steps that stay safe: stiffer springs get shorter steps, inverted cells are stepped again or made larger."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from faceanim.backends.octree_mass_spring.build import Rig
from faceanim.backends.octree_mass_spring.cut import coarsened
from faceanim.backends.octree_mass_spring.options import Options
from faceanim.backends.octree_mass_spring.transfer import transfer
from faceanim.body.control import Control
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.kernels import lattice as kernels

CHUNK = 4
"""Steps between two looks at muscles, volumes and lengths."""
HALVINGS = 2
"""How often a step that inverts a cell is tried again with half the length."""
MARGIN = 0.05
"""Share of a spring's linear range, at its ends, within which steps are already as short as beyond it."""
AHEAD = 0.1
"""How far above its barrier a cell's smallest Jacobian counts as near it."""
SLOW = 0.1
"""Largest movement of a node in one step, in sides of the smallest cell, once nothing else helps."""


@dataclass(eq=False)
class Moment:
    """What drives one step: control, the held points (p, 3) before and after it, drag [1/s]."""

    control: Control
    held_before: Floats
    held_after: Floats
    drag: float


class Motion:
    """Steps a rig through time, changing it if the options allow."""

    def __init__(self, options: Options, notice: Callable[[str], None]) -> None:
        self.options, self.notice = options, notice

    def over(
        self, rig_of: Callable[[Ints], Rig], level: Ints, quiet: Ints, q: Floats, qd: Floats, moment: Moment, dt: float
    ) -> tuple[Rig, Floats, Floats, int]:
        """Return the rig, positions and velocities after `dt` [s], and how many steps it took; `quiet` (c,) is updated."""
        rig = rig_of(level)
        x, v = rig.room.x, rig.room.v
        x[:], v[:] = q, qd
        done, taken = 0.0, 0
        while done < 1.0 - 1e-12:
            if self.options.dynamic:
                rig, x, v = self._safer(rig_of, rig, x, v, quiet, moment, dt, done)
            count = max(1, int(np.ceil((1.0 - done) * dt / (self.options.safety * rig.dt_max) - 1e-9)))
            chunk = min(CHUNK, count)
            share = (1.0 - done) / count * chunk
            steps, inverted = self._chunk(rig, x, v, moment, dt, done, share, chunk)
            if inverted is not None and self.options.dynamic and self._can_grow(rig, inverted):
                x[:], v[:] = rig.room.x_before, rig.room.v_before
                rig, x, v = self._grow(rig_of, rig, x, v, inverted, quiet)
                continue
            done += share
            taken += steps
        return rig, x, v, taken

    def _safer(
        self, rig_of: Callable[[Ints], Rig], rig: Rig, x: Floats, v: Floats, quiet: Ints, moment: Moment, dt: float,
        done: float,
    ) -> tuple[Rig, Floats, Floats]:  # fmt: skip
        """Replace cells that the next step may invert by their parents, until none is left or they are the root."""
        for _ in range(len(rig.model.lattice.tree.levels)):
            unsafe = self._unsafe(rig, x, v, moment, dt, done)
            quiet[unsafe[rig.model.of_leaf]] = 0
            if not self._can_grow(rig, unsafe):
                break
            rig, x, v = self._grow(rig_of, rig, x, v, unsafe, quiet)
        return rig, x, v

    def _unsafe(self, rig: Rig, x: Floats, v: Floats, moment: Moment, dt: float, done: float) -> Bools:
        """Return the cells whose corners may go farther in a step than beta times their current margin (4.4)."""
        room, tables = rig.room, rig.model.tables
        h = min(dt, self.options.safety * rig.dt_max)
        load = rig.load(moment.control, x)
        held = moment.held_before + done * (moment.held_after - moment.held_before)
        kernels.all_forces(x, load, tables, rig.targets(held), room.force)
        kernels.corner_volumes(x, tables.cells, room.volume)
        kernels.reach(x, v, room.force, rig.inverse_mass, h, tables.cells, room.reach)
        return np.asarray(room.reach > self.options.beta * np.maximum(room.volume, 0.0))

    def _can_grow(self, rig: Rig, cells: Bools) -> bool:
        return bool((cells & (rig.model.cell_level < rig.model.lattice.top)).any())

    def _grow(
        self, rig_of: Callable[[Ints], Rig], rig: Rig, x: Floats, v: Floats, cells: Bools, quiet: Ints
    ) -> tuple[Rig, Floats, Floats]:
        self.notice("cells in danger of turning inside out were made larger")
        new = rig_of(coarsened(rig.model, cells))
        x, v = transfer(rig.model, new.model, x, v)
        quiet[new.model.level > rig.model.level] = 0
        new.room.x[:], new.room.v[:] = x, v
        return new, new.room.x, new.room.v

    def _chunk(
        self, rig: Rig, x: Floats, v: Floats, moment: Moment, dt: float, done: float, share: float, count: int
    ) -> tuple[int, Bools | None]:
        """Advance `x` and `v` in place by `share` of `dt` in `count` steps or more; return their number.

        Second result: the cells that are inverted although steps were halved (None = none that was not so before); the
        state before is then in `rig.room`.
        """
        room, tables = rig.room, rig.model.tables
        room.x_before[:], room.v_before[:] = x, v
        load = rig.load(moment.control, x)
        inverse_mass = rig.lag(moment.control, x, share * dt)
        kernels.watch(x, tables.cells, tables.barrier, AHEAD, room.volume)
        already = room.volume <= 0.0
        strained = tables.springs.ramp > 1.0 and kernels.outside(x, tables.springs, MARGIN) > 0
        finer = int(np.ceil(np.sqrt(tables.springs.ramp))) if strained else 1
        fresh = already
        for _ in range(HALVINGS):
            self._advance(rig, x, v, load, inverse_mass, moment, dt, done, share, count * finer, np.inf)
            kernels.corner_volumes(x, tables.cells, room.volume)
            fresh = ~(room.volume > 0.0) & ~already
            beyond = not strained and tables.springs.ramp > 1.0 and kernels.outside(x, tables.springs, 0.0) > 0
            if np.isfinite(x).all() and not fresh.any() and not beyond:
                return count * finer, None
            finer = finer * 2 if strained else max(2 * finer, int(np.ceil(np.sqrt(tables.springs.ramp))))
            strained = True
            x[:], v[:] = room.x_before, room.v_before
        self._advance(
            rig, x, v, load, inverse_mass, moment, dt, done, share, count * finer, SLOW * float(tables.cells.side.min())
        )
        if not self.options.dynamic:
            self.notice(
                "a load turned cells inside out; movements were limited: lower it, or use larger or dynamic cells"
            )
        kernels.corner_volumes(x, tables.cells, room.volume)
        fresh = ~(room.volume > 0.0) & ~already
        return count * finer, fresh if fresh.any() else None

    def _advance(
        self, rig: Rig, x: Floats, v: Floats, load: Floats, inverse_mass: Floats, moment: Moment, dt: float, done: float,
        share: float, count: int, limit: float,
    ) -> None:  # fmt: skip
        model = rig.model
        way = moment.held_after - moment.held_before
        goal = (moment.held_before + (done + share) * way)[model.carried_by]
        target = rig.targets(moment.held_before + done * way)
        kernels.advance(
            x, v, load, model.tables, inverse_mass, model.carried, (goal - x[model.carried]) / count, target,
            rig.targets(way) * (share / count), share * dt / count, moment.drag, limit, count, rig.room.force,
        )  # fmt: skip
