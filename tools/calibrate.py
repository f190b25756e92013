"""Fit the muscles of the default face to the movements of its action units.

    python tools/calibrate.py                          # every unit: say what would change
    python tools/calibrate.py --units 12 15 --write    # these units, and write assets/muscles.toml, action_units.toml

Each unit is solved to its equilibrium on the true nonlinear model. Its own muscles may move their insertion on the skin
and their `via` in the tissue, change the size of their zone and their force; muscles lent by other units change their
gain. Origins stay on the bone. The search is Powell's, from the values in the files, without chance: the same files
give the same answer. At the end the forces are scaled on the default density until the movement is met.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.optimize import minimize

from faceanim.backends import make_solver
from faceanim.bench.faithfulness import ARTIST_UNITS, artist_fields, match_field, mouth_width, moving_region
from faceanim.bench.metrics import SkinCheck, principal_strain
from faceanim.body.control import Control
from faceanim.expression.action_units import load_action_units
from faceanim.face.attach import LID, LIP, SKIN
from faceanim.face.face import Face
from faceanim.face.library import asset_folder, load_face
from faceanim.face.muscles import AnyMuscle, LinearMuscle, build_muscles
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import DivergenceError

WANDER = 4.0
"""How far an insertion or a via may go from where the file has it, along each axis [mm]."""
STRETCH = 1.4
"""Largest factor on the size of a zone."""
SURGE = 2.5
"""Largest factor on a force."""
CREASE = 0.3
"""Compression of the skin above which a crease begins to show [-]."""


@dataclass(frozen=True)
class Goal:
    """What an action unit should do, and the muscles that it owns.

    target : largest movement [mm], or that of the mouth `corner`   width : change of the mouth's width [%], 0 = any
    """

    unit: str
    muscles: tuple[str, ...]
    target: float
    corner: bool = False
    width: float = 0.0


GOALS = (
    Goal("1", ("frontalis_inner",), 5.5),
    Goal("2", ("frontalis_outer",), 6.0),
    Goal("4", ("corrugator", "depressor_supercilii", "procerus"), 6.6),
    Goal("10", ("levator_labii_superioris", "zygomaticus_minor"), 5.6),
    Goal("9", ("levator_labii_superioris_alaeque_nasi",), 6.2),
    Goal("15", ("depressor_anguli_oris",), 5.3, corner=True),
    Goal("16", ("depressor_labii_inferioris",), 4.5),
    Goal("17", ("mentalis",), 5.6),
    Goal("20", ("risorius", "platysma"), 7.6),
    Goal("12", ("zygomaticus_major", "levator_anguli_oris"), 13.0, corner=True, width=23.0),
)
"""In this order: a unit that borrows a muscle comes after the one that owns it."""

PLAUSIBLE = {
    "frontalis_inner": (1500, 6700), "frontalis_outer": (1500, 5400), "corrugator": (2000, 4300),
    "depressor_supercilii": (500, 2500), "procerus": (800, 2500), "levator_labii_superioris_alaeque_nasi": (1000, 3000),
    "levator_labii_superioris": (1500, 5000), "zygomaticus_minor": (500, 2000), "zygomaticus_major": (1400, 4000),
    "levator_anguli_oris": (1500, 4000), "buccinator": (3000, 10700), "risorius": (300, 1500),
    "depressor_anguli_oris": (1500, 4000), "depressor_labii_inferioris": (1500, 4000), "mentalis": (2000, 5400),
    "platysma": (1000, 4300),
}  # fmt: skip
"""Forces [mN] that the cross-section of a muscle allows, at 27 N/cm^2; orders of magnitude for most."""

Muscles = dict[str, AnyMuscle]
Gains = dict[str, float]


@dataclass
class Bench:
    """A face on which any table of muscles can be tried."""

    face: Face
    guess: dict[str, Any] = field(default_factory=dict)
    """Unit -> its last equilibrium, from which the next search starts."""

    def __post_init__(self) -> None:
        self.body = self.face.body()
        self.check = SkinCheck(self.body)
        self.artist = artist_fields(self.face.density)
        self.outer = np.isin(self.face.region, (SKIN, LIP, LID))

    def displacement(self, goal: Goal, table: Muscles, gains: Gains) -> tuple[Floats, float]:
        """Return the equilibrium displacement (n, 3) [mm] under `gains`, and how unsound the skin is [-]."""
        muscles = build_muscles(table, self.face.terrain)
        solver = make_solver("mass_spring", replace(self.body, muscles=muscles), None)
        control = Control.rest(solver.body)
        for k, name in enumerate(muscles.names):
            control.activation[k] = gains.get(name.removesuffix("_left").removesuffix("_right"), 0.0)
        state = solver.solve_static(control, self.guess.get(goal.unit))
        self.guess[goal.unit] = state
        points = np.empty_like(self.body.surface.points)
        solver.surface(state, points)
        return points - self.body.surface.points, self.faults(points, control)

    def faults(self, points: Floats, control: Control) -> float:
        """Return 0 for sound skin: more for inverted triangles, lips and lids that cross, skin squeezed into creases."""
        sound = self.check.at(points, control)
        squeezed = np.maximum(-principal_strain(self.face.mesh, points) - CREASE, 0.0) * self.outer
        crease = float((squeezed**2 * self.face.mesh.vertex_areas).sum()) / 10.0
        return 0.1 * sound.inverted_triangles + max(0.0, max(sound.depth_crossed.values()) - 0.05) + crease

    def movement(self, goal: Goal, u: Floats) -> float:
        """Return the movement [mm] that `goal` speaks of."""
        if goal.corner:
            return float(np.linalg.norm(u[self.face.landmarks["cheilion_left"]]))
        return float(np.linalg.norm(u[self.outer], axis=1).max())

    def misfit(self, goal: Goal, u: Floats) -> float:
        """Return how far a displacement is from the artist's shape, scaled to its own size, and from the target [-]."""
        art = self.artist[ARTIST_UNITS[goal.unit]]
        match = match_field(self.face, goal.unit, "", u, art)
        where = moving_region(self.face, art)
        area, a, b = self.face.mesh.vertex_areas[where, None], art[where], u[where]
        scale = float((area * a * b).sum() / (area * a * a).sum())
        shape = float((area * (b - scale * a) ** 2).sum() / max((area * b * b).sum(), 1e-9))
        size = np.log(max(self.movement(goal, u), 1e-3) / goal.target) ** 2
        size += max(0.0, abs(np.log(match.peak / match.artist_peak)) - 0.2) ** 2
        if goal.width:
            mesh = self.face.mesh
            change = 100.0 * (mouth_width(self.face, mesh.points + u) / mouth_width(self.face, mesh.points) - 1.0)
            size += 0.5 * (change / goal.width - 1.0) ** 2
        return 2.0 * (1.0 - match.mean_cosine) + 0.5 * shape + 2.0 * float(size)

    def on_skin(self, point: Floats) -> Floats:
        """Return `point` put on the tangent plane of the nearest outer skin vertex."""
        mesh = self.face.mesh
        free = np.flatnonzero(self.outer)
        i = free[np.argmin(np.linalg.norm(mesh.points[free] - point, axis=1))]
        n = mesh.vertex_normals[i]
        return np.asarray(point - n * (n @ (point - mesh.points[i])))

    def outside_tissue(self, point: Floats) -> float:
        """Return how far `point` lies inside a bone or above the skin [mm], 0 if it lies in the soft tissue."""
        skull = self.face.skull
        clear = min(float(g.sample(point[None])[0]) for g in (skull.cranium_grid, skull.jaw_grid))
        skin = self.on_skin(point)
        i = np.argmin(np.linalg.norm(self.face.mesh.points - skin, axis=1))
        return max(0.0, -clear, float((point - skin) @ self.face.mesh.vertex_normals[i]))


Change = Callable[[Muscles, Gains, float], None]
"""Changes a table of muscles, or the gains, in place by a number in [-1, 1]; 0 is as in the files."""


def _shift(name: str, point: str, axis: int, bench: Bench) -> Change:
    def change(table: Muscles, gains: Gains, p: float) -> None:
        moved = np.array(getattr(table[name], point))
        moved[axis] += WANDER * p
        place = bench.on_skin(moved) if point == "insertion" else moved
        table[name] = msgspec.structs.replace(table[name], **{point: tuple(place.tolist())})

    return change


def _scale(name: str, quantity: str, most: float) -> Change:
    def change(table: Muscles, gains: Gains, p: float) -> None:
        value = getattr(table[name], quantity) * most**p
        table[name] = msgspec.structs.replace(table[name], **{quantity: value})

    return change


def _lend(name: str) -> Change:
    def change(table: Muscles, gains: Gains, p: float) -> None:
        gains[name] = float(np.clip(gains[name] + 0.5 * p, 0.02, 1.0))

    return change


def changes(goal: Goal, table: Muscles, gains: Gains, bench: Bench) -> list[Change]:
    """Return everything that may change to reach `goal`."""
    out: list[Change] = []
    for name in goal.muscles:
        m: Any = table[name]
        out.append(_scale(name, "force", SURGE))
        sizes = ("radius", "angle") if isinstance(m, LinearMuscle) else ("half_width", "length")
        out += [_scale(name, size, STRETCH) for size in sizes]
        # An unpaired muscle stays in the midline.
        out += [_shift(name, "insertion", axis, bench) for axis in (0, 1) if m.paired or axis]
        if m.via is not None:
            out += [_shift(name, "via", axis, bench) for axis in range(3) if m.paired or axis]
    return out + [_lend(name) for name in gains if name not in goal.muscles]


def fit(goal: Goal, table: Muscles, gains: Gains, bench: Bench, most: int, tick: Callable[[float], None]) -> float:
    """Change `table` and `gains` in place for the best of `most` trials; return its cost."""
    moves = changes(goal, table, gains, bench)
    best: tuple[float, Muscles, Gains] = (np.inf, dict(table), dict(gains))

    def cost(p: Floats) -> float:
        nonlocal best
        t, g = dict(table), dict(gains)
        for move, amount in zip(moves, p):
            move(t, g, float(amount))
        total = 0.02 * float((p**2).mean())
        for name in goal.muscles:
            m: Any = t[name]
            total += 0.0 if m.via is None else bench.outside_tissue(np.array(m.via))
            low, high = PLAUSIBLE[name]
            total += 0.05 * float(np.log(m.force / np.clip(m.force, low, high)) ** 2)
        try:
            u, faults = bench.displacement(goal, t, g)
            total += bench.misfit(goal, u) + faults
        except DivergenceError:
            bench.guess.pop(goal.unit, None)
            total = 1e3
        if total < best[0]:
            best = (total, t, g)
        tick(best[0])
        return total

    start = np.zeros(len(moves))
    minimize(cost, start, method="Powell", bounds=[(-1.0, 1.0)] * len(moves), options={"maxfev": most, "xtol": 0.05})
    table.update(best[1])
    gains.update(best[2])
    bench.guess.clear()
    return best[0]


def rescale(goal: Goal, table: Muscles, gains: Gains, bench: Bench) -> Floats:
    """Scale the forces of the muscles of `goal` until `bench` meets its movement; return the displacement (n, 3)."""
    bench.guess.clear()
    for _ in range(4):
        u, _ = bench.displacement(goal, table, gains)
        reached = bench.movement(goal, u)
        if abs(reached / goal.target - 1.0) < 0.01:
            break
        factor = float(np.clip(goal.target / reached, 0.7, 1.4)) ** 1.3
        for name in goal.muscles:
            table[name] = msgspec.structs.replace(table[name], force=table[name].force * factor)
    return u


def edited(text: str, section: str, key: str, value: Any) -> str:
    """Return a TOML text with `key = value` changed in one `[section]`, all else as it was."""
    shown = [round(v, 1) for v in value] if isinstance(value, tuple) else value
    pattern = rf"(?ms)(^\[{re.escape(section)}\]\n(?:(?!^\[).)*?^{key} = )[^\n#]*?(?=\s*(?:#|\n))"
    return re.sub(pattern, lambda m: f"{m[1]}{shown}", text)


def write(old: Muscles, table: Muscles, gains: dict[str, Gains]) -> None:
    """Write what changed into the asset files, comments kept."""
    path = Path(asset_folder() / "muscles.toml")
    text = path.read_text(encoding="utf-8")
    for name, m in table.items():
        for key in m.__struct_fields__:
            value = getattr(m, key)
            if value != getattr(old[name], key):
                text = edited(text, name, key, round(value, 1) if isinstance(value, float) else value)
    path.write_text(text, encoding="utf-8")
    path = Path(asset_folder() / "action_units.toml")
    text = path.read_text(encoding="utf-8")
    for unit, gain in gains.items():
        text = edited(
            text, f"unit.{unit}", "muscles", "{ " + ", ".join(f"{k} = {v:.2f}" for k, v in gain.items()) + " }"
        )
    path.write_text(text, encoding="utf-8")


def _forces(goal: Goal, table: Muscles) -> str:
    """Return the forces of the muscles of `goal` [N], each with its share of the largest plausible one."""
    force = {name: table[name].force for name in goal.muscles}
    return ", ".join(f"{n} {f / 1e3:.2f} ({f / PLAUSIBLE[n][1]:.2f})" for n, f in force.items())


def calibrate(goals: list[Goal], density: str, most: int, console: Console) -> tuple[Muscles, dict[str, Gains], Table]:
    """Fit every goal in turn; return muscles, gains by unit, and a table of what was reached."""
    bench, judge = Bench(load_face("default", density)), Bench(load_face("default", "default"))
    table, units = dict(judge.face.muscle_table), load_action_units()
    gains = {goal.unit: dict(units[int(goal.unit)].muscles) for goal in goals}
    report = Table("unit", "cost", "movement [mm]", "target", "cosine", "peak ratio", "forces [N] (share of plausible)")
    with Progress(console=console) as progress:
        for goal in goals:
            task = progress.add_task(f"unit {goal.unit}", total=most)

            def show(best: float, goal: Goal = goal, task: Any = task) -> None:
                progress.update(task, advance=1, description=f"unit {goal.unit}: {best:.3f}")

            best = fit(goal, table, gains[goal.unit], bench, most, show)
            u = rescale(goal, table, gains[goal.unit], judge)
            match = match_field(judge.face, goal.unit, "", u, judge.artist[ARTIST_UNITS[goal.unit]])
            row = (best, judge.movement(goal, u), goal.target, match.mean_cosine, match.peak_ratio)
            report.add_row(goal.unit, *(f"{v:.3f}" for v in row), _forces(goal, table))
    return table, gains, report


def main() -> None:
    """Read the options, fit, tell, and write if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--units", nargs="*", choices=[g.unit for g in GOALS], default=[g.unit for g in GOALS])
    parser.add_argument("--density", default="coarse", choices=("coarse", "default"), help="of the search")
    parser.add_argument("--iterations", type=int, default=250, help="trials per unit")
    parser.add_argument("--write", action="store_true", help="change the files in assets/")
    args = parser.parse_args()
    console = Console()
    old = dict(load_face("default", "coarse").muscle_table)
    table, gains, report = calibrate([g for g in GOALS if g.unit in args.units], args.density, args.iterations, console)
    console.print(report)
    for name, m in table.items():
        for key in m.__struct_fields__:
            if getattr(m, key) != getattr(old[name], key):
                console.print(f"{name}.{key}: {getattr(old[name], key)} -> {getattr(m, key)}")
    for unit, gain in gains.items():
        console.print(f"unit {unit}: {gain}")
    if args.write:
        write(old, table, gains)


if __name__ == "__main__":
    main()
