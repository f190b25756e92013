"""The small bodies of the stability maps: skin on bone, a bar between two bones, a slender bar, a block.

What holds and pulls them is chosen by place, so that a body can be made again of a permuted or spoilt mesh. `stiffness`
multiplies every stiffness and every muscle, which keeps the shape of the answer; `light` divides the mass of one half.
`scale` is another unit of length: the same body in numbers that are so many times as large.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from faceanim.body.body import PULL_ALONG, PULL_TO_POINT, Attachment, Body, Bone, Muscles
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets, sheet
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats
from faceanim.tissue.material import Material
from faceanim.tissue.spring_law import SpringLaw

WIDTH = 40.0
"""Of the sheet, and length of the bar [mm]."""
SLENDER = (60.0, 6.0, 6.0)
"""[mm]"""
SKIN_DRAG = 200.0
"""[1/s]"""
YOUNG, DENSITY, POISSON = 15.0, 1.04e-6, 0.4
"""Of flesh: [kPa], [kg/mm^3], [-]."""


@dataclass(frozen=True)
class Tune:
    """What is changed of a body, see the module's text."""

    stiffness: float = 1.0
    light: float = 1.0
    scale: float = 1.0
    poisson: float = POISSON
    force: float = 1.0


PLAIN = Tune()


def skin_mesh(cells: int = 8) -> TriMesh:
    """Return a bulging sheet of `cells` x `cells` squares."""
    return sheet(cells, cells, WIDTH, WIDTH, bulge=6.0)


def _half(count: int) -> Bools:
    """Return every second of `count` things in a fixed random order."""
    return np.asarray(np.random.default_rng(5).permutation(count) % 2 == 0)


def _muscles(rows: list[tuple[int, Floats, int, tuple[float, float, float]]], points: Floats, force: float, scale: float
             ) -> Muscles:  # fmt: skip
    """Return one muscle per row (bone, weight of every vertex, kind, goal); their weights are brought to the sum 1."""
    node = [np.flatnonzero(weight > 0).astype(np.int32) for _, weight, _, _ in rows]
    size = [len(n) for n in node]
    kinds = np.array([kind for _, _, kind, _ in rows])
    goals = np.array([goal for *_, goal in rows]) * np.where(kinds == PULL_TO_POINT, scale, 1.0)[:, None]
    every = np.repeat(np.arange(len(rows)), size).astype(np.int32)
    weight = np.concatenate([w[n] / w[n].sum() for (_, w, _, _), n in zip(rows, node)])
    return Muscles(
        tuple(f"muscle {k + 1}" for k in range(len(rows))), np.full(len(rows), force), every, np.concatenate(node),
        weight, kinds[every].astype(np.int32), np.ascontiguousarray(goals[every]),
        np.array([bone for bone, *_ in rows], dtype=np.int32)[every], np.full(len(every), scale),
    )  # fmt: skip


def skin(mesh: TriMesh | None = None, tune: Tune = PLAIN) -> Body:
    """Return a sheet of skin fastened to cranium and jaw, pinned along its edge, with three muscles."""
    mesh = skin_mesh() if mesh is None else mesh
    x, n, t, k = mesh.points, len(mesh.points), len(mesh.triangles), tune.stiffness
    pinned = np.abs(x[:, :2]).max(axis=1) > 0.4975 * WIDTH
    jaw = 1.0 / (1.0 + np.exp((x[:, 1] + 6.0) / 4.0))

    def zone(at: tuple[float, float]) -> Floats:
        away = np.hypot(x[:, 0] - at[0], x[:, 1] - at[1]) / 8.0
        return np.where(pinned, 0.0, np.maximum(1.0 - away**2, 0.0) ** 2)

    pulls = _muscles([(0, zone((9.0, -4.0)), PULL_TO_POINT, (22.0, 12.0, 2.0)),
                      (0, zone((-9.0, -4.0)), PULL_TO_POINT, (-22.0, 12.0, 2.0)),
                      (0, zone((0.0, 9.0)), PULL_ALONG, (0.0, 0.8, -0.6))],
                     x, 300.0 * k * tune.force * tune.scale, tune.scale)  # fmt: skip
    area, surface = mesh.vertex_areas, TriMesh(tune.scale * x, mesh.triangles)
    mass = area * 4.0 * DENSITY
    return Body(
        surface=surface, mass=np.where(_half(n), mass / tune.light, mass), membrane_modulus=np.full(t, 40.0 * k),
        law=SpringLaw(s0=tune.scale), damping=SKIN_DRAG, pinned=pinned,
        attachment=Attachment(
            np.stack([1.0 - jaw, jaw], axis=1), area * 0.3 * k, s0=5.0 * tune.scale, shear=np.full(t, 3.0 * k),
            shear_limit=np.full(t, 0.4),
        ),
        muscles=pulls, bones=(Bone("cranium"), Bone("jaw")),
    )  # fmt: skip


def flesh(tune: Tune = PLAIN, young: float = YOUNG) -> Material:
    """Return flesh in the units of `tune`: kPa are kg / (mm s^2)."""
    return Material("flesh", DENSITY / tune.scale**3, young * tune.stiffness / tune.scale, tune.poisson)


def bar_mesh(cells: tuple[int, int, int] = (8, 2, 2)) -> TetMesh:
    """Return a bar 40 x 12 x 12 mm."""
    return box_tets(cells, (WIDTH, 12.0, 12.0))


def bar(mesh: TetMesh | None = None, tune: Tune = PLAIN, *, drag: float = 250.0) -> Body:
    """Return a bar of flesh between cranium (x = 0) and jaw (x = 40 mm), with two muscles on its back.

    drag : [1/s] at stiffness 1; it grows with the square root of the stiffness, so that vibrations die as fast in cycles
    """
    mesh = bar_mesh() if mesh is None else mesh
    x = mesh.points
    held = (x[:, 0] < 1e-6) | (x[:, 0] > WIDTH - 1e-6)
    light = _half(len(mesh.tets)) if tune.light != 1.0 else np.zeros(len(mesh.tets), dtype=bool)
    tissue = flesh(tune)
    two = (tissue, replace(tissue, name="light flesh", density=tissue.density / tune.light))
    body = solid_body(
        TetMesh(tune.scale * x, mesh.tets), two, held, region=light.astype(np.int32), bone=(x[:, 0] > 20.0).astype(int),
        bones=("cranium", "jaw"), damping=drag * np.sqrt(tune.stiffness),
    )  # fmt: skip
    p = body.surface.points / tune.scale
    top = ((p[:, 1] > 11.9) & (np.abs(p[:, 0] - 20.0) < 11.0)).astype(np.float64)
    if not top.any():
        top = (p[:, 1] > 11.9).astype(np.float64) * ~body.pinned
    pulls = _muscles([(0, top, PULL_TO_POINT, (10.0, 40.0, 15.0)), (0, top, PULL_ALONG, (0.0, 0.6, 0.8))],
                     p, 80.0 * tune.stiffness * tune.force * tune.scale, tune.scale)  # fmt: skip
    return replace(body, muscles=pulls)


def slender(cells: tuple[int, int, int] = (12, 2, 2)) -> Body:
    """Return a bar 60 x 6 x 6 mm between cranium (x = 0) and jaw (x = 60 mm), its axis through the origin, for turns."""
    mesh = box_tets(cells, SLENDER)
    x = mesh.points - [0.0, 3.0, 3.0]
    held = (x[:, 0] < 1e-6) | (x[:, 0] > SLENDER[0] - 1e-6)
    return solid_body(TetMesh(x, mesh.tets), flesh(), held, bone=(x[:, 0] > 30.0).astype(int),
                      bones=("cranium", "jaw"), damping=80.0)  # fmt: skip


def cantilever(cells: tuple[int, int, int], poisson: float) -> Body:
    """Return a bar 40 x 10 x 10 mm held at x = 0."""
    mesh = box_tets(cells, (WIDTH, 10.0, 10.0))
    return solid_body(mesh, Material("flesh", DENSITY, YOUNG, poisson), mesh.points[:, 0] < 1e-9, damping=60.0)


def block(cells: int = 4) -> Body:
    """Return a block 20 x 20 x 20 mm held at y = 0."""
    mesh = box_tets((cells, cells, cells), (20.0, 20.0, 20.0))
    return solid_body(mesh, Material("flesh", DENSITY, YOUNG, 0.25), mesh.points[:, 1] < 1e-9, damping=100.0)


def pull(body: Body, activation: float) -> Control:
    """Return the control with every muscle at `activation`."""
    control = Control.rest(body)
    control.activation[:] = activation
    return control
