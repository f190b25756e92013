"""The three blocks of You, Zhang & Comninos (2000): their columns, our own, and the converged truth side by side.

A block L x 1 x 1 of E = 100 and nu = 0.49, clamped at x = 0, is pulled, stretched or sheared at x = L. Point 5 r + c + 1
of a table sits at row r and column c of a 5 x 5 grid over a cross-section; in the sheared block rows run along the shear.

The published columns of the finite elements can be had again (`finite_elements`); those of the weighted residual method
cannot, since its collocation points on the sides are not told, so we declare a layout of our own (`collocation`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from faceanim.backends.weighted_residual.boundary import Boundary
from faceanim.backends.weighted_residual.method import WeightedResidual
from faceanim.backends.weighted_residual.options import Options
from faceanim.bench.bricks import Bricks, graded
from faceanim.ground.arrays import Bools, Floats

YOUNG, POISSON = 100.0, 0.49


@dataclass(frozen=True)
class Block:
    """One case: what the far end gets, and where its table looks.

    load : "tension" a traction, "stretch" a normal displacement, "shear" a transverse one, of size `amount`
    terms : k of the paper   section : x of the table   component : of the displacement in the table
    factor : by which the published numbers exceed those of the block as described
    clamped : whether the far end keeps its other components still (not in the paper)
    """

    name: str
    length: float
    load: str
    amount: float
    terms: int
    section: float
    component: int = 0
    factor: float = 1.0
    clamped: bool = False

    @property
    def points(self) -> Floats:
        """The 25 points of the table, (25, 3)."""
        t = np.linspace(0.0, 1.0, 5)
        return np.array([[self.section, r, c] for r in t for c in t])

    def conditions(self, x: Floats) -> tuple[Bools, Floats]:
        """Return what is prescribed at `x` (n, 3) on the end faces or nodes, and the values, 2 x (n, 3)."""
        given, value = np.zeros((len(x), 3), dtype=bool), np.zeros((len(x), 3))
        given[x[:, 0] < 1e-9] = True
        far = x[:, 0] > self.length - 1e-9
        value[far, self.component] = self.amount
        if self.load != "tension":
            given[far, self.component] = True
            if self.clamped:
                given[far] = True
        return given, value


TENSION = Block("tension", 20.0, "tension", 2.0, 7, 20.0, factor=10.0)
STRETCH = Block("stretch", 5.0, "stretch", 0.5, 5, 4.375)
SHEAR = Block("shear", 5.0, "shear", 0.6, 9, 4.375, component=1)
CASES = (TENSION, STRETCH, SHEAR)
"""Cases 1, 2 and 3. The published numbers of case 1 are ten times those of the block as described."""


class Column(NamedTuple):
    """Displacements at the 25 points, the number of unknowns, and the force on the far end (None = not computed)."""

    values: Floats
    unknowns: int
    force: float | None = None


def faces(block: Block, along: Floats, across: Floats, w_along: Floats, w_across: Floats, ends: Floats,
           w_ends: Floats) -> Boundary:  # fmt: skip
    """Return the six faces with the tensor grids `along` x `across` on the sides and `ends` x `ends` on the ends."""
    parts = []
    for axis in range(3):
        grids = [(ends, w_ends)] * 2 if axis == 0 else [(along, w_along), (across, w_across)]
        a, b = (k for k in range(3) if k != axis)
        u, v = (g.ravel() for g in np.meshgrid(grids[0][0], grids[1][0], indexing="ij"))
        weight = np.outer(grids[0][1], grids[1][1]).ravel()
        for side in (0.0, 1.0):
            x, normal = np.zeros((len(u), 3)), np.zeros((len(u), 3))
            x[:, a], x[:, b], x[:, axis] = u, v, side * (block.length if axis == 0 else 1.0)
            normal[:, axis] = 2.0 * side - 1.0
            given, value = block.conditions(x) if axis == 0 else (np.zeros_like(x, dtype=bool), np.zeros_like(x))
            parts.append(Boundary(x, normal, weight, given, value))
    return Boundary.joined(parts)


def gauss_boundary(block: Block, along: int = 40, across: int = 13) -> Boundary:
    """Return the block's boundary with Gauss points, `along` x `across` on each side."""
    t, w = np.polynomial.legendre.leggauss(across)
    s, v = np.polynomial.legendre.leggauss(along)
    t, s = 0.5 * (t + 1.0), 0.5 * block.length * (s + 1.0)
    return faces(block, s, t, 0.5 * block.length * v, 0.5 * w, t, 0.5 * w)


def even_boundary(block: Block) -> Boundary:
    """Return the declared layout of collocation points: 9 x 9 on either end and on each side, edges included, the
    stations along the sides evenly between the ends."""
    t = np.linspace(0.0, 1.0, 9)
    s = np.linspace(0.0, block.length, 11)[1:-1]
    one = np.ones(9)
    return faces(block, s, t, one, one, t, one)


def collocation(block: Block, *, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> WeightedResidual:
    """Return the paper's method at the declared layout: its fields and k, plain sum of squares in metres and pascals."""
    options = Options(basis="paper", terms=block.terms, method="collocation", displacement_weight=1.0 / YOUNG)
    return WeightedResidual(even_boundary(block), YOUNG, POISSON, options, origin=origin, size=1.0)


def nitsche(block: Block, options: Options | None = None, *, poisson_ratio: float = POISSON, along: int = 40,
            across: int = 13) -> WeightedResidual:  # fmt: skip
    """Return the energy-consistent method; by default the paper's fields and k together with the 12 linear fields."""
    chosen = Options(basis="paper_linear", terms=block.terms) if options is None else options
    boundary = gauss_boundary(block, along, across)
    origin = None if chosen.basis == "navier" else (0.0, 0.0, 0.0)
    return WeightedResidual(boundary, YOUNG, poisson_ratio, chosen, origin=origin, size=1.0)


def table(block: Block, method: WeightedResidual) -> Column:
    """Return a column of the block's table by `method`."""
    c = method.solve()
    force = None
    if method.options.method == "nitsche" and block.load != "tension":
        force = float(method.reaction(c, method.boundary.points[:, 0] > block.length - 1e-9)[block.component])
    values = method.displacement(block.points, c)[:, block.component]
    return Column(block.factor * values, method.fields.count, force)


def _by_bricks(block: Block, bricks: Bricks, given: Bools, value: Floats, where: Floats, times: float) -> Column:
    tension = block.load == "tension"
    pull = np.eye(3)[block.component] * block.amount
    load = bricks.end_traction(pull) if tension else None
    u, reaction = bricks.solve(given, value, load)
    far = bricks.points[:, 0] > block.length - 1e-9
    force = None if tension else float(times * reaction[far, block.component].sum())
    values = bricks.at(where, u)[:, block.component]
    return Column(block.factor * values, bricks.points.size, force)


def finite_elements(block: Block, cells: int = 8, *, average_dilatation: bool = False) -> Column:
    """Return the table by cells^3 trilinear bricks: with 8 and full integration the paper's column (case 2: to 0.3 %)."""
    t = np.linspace(0.0, 1.0, cells + 1)
    bricks = Bricks((block.length * t, t, t), YOUNG, POISSON, average_dilatation=average_dilatation)
    given, value = block.conditions(bricks.points)
    return _by_bricks(block, bricks, given, value, block.points, 1.0)


@lru_cache(maxsize=16)
def truth(block: Block, poisson_ratio: float = POISSON, order: int = 3) -> Column:
    """Return the converged table (error about 2e-5): a quarter of the block, elements graded to its edges."""
    axis = graded(block.length, 12, 2.0, both=block.load != "tension")
    side = graded(0.5, 4, 2.5)
    bricks = Bricks((axis, side, side), YOUNG, poisson_ratio, order=order)
    x = bricks.points
    given, value = block.conditions(x)
    middle_y, middle_z = x[:, 1] > 0.5 - 1e-9, x[:, 2] > 0.5 - 1e-9
    given[middle_z, 2] = True
    for component in (0, 2) if block.load == "shear" else (1,):  # shear along y is odd in y
        given[middle_y, component] = True
    # whatever the planes fix is zero there, but for what the far end already prescribes
    where = block.points.copy()
    where[:, 1:] = np.minimum(where[:, 1:], 1.0 - where[:, 1:])
    return _by_bricks(block, bricks, given, value, where, 4.0)


def error(values: Floats, reference: Floats) -> float:
    """Return the largest relative difference [-]."""
    return float(np.abs(values / reference - 1.0).max())


@lru_cache(maxsize=1)
def columns() -> dict[str, dict[str, Column]]:
    """Return every column of Tables 1 to 3: case -> what -> column."""
    out: dict[str, dict[str, Column]] = {}
    for block in CASES:
        out[block.name] = {
            "paper FEM": Column(PAPER_FEM[block.name], 2187),
            "bricks 8^3": finite_elements(block),
            "paper WRM": Column(PAPER_WRM[block.name], 36 * block.terms),
            "collocation": table(block, collocation(block)),
            "nitsche": table(block, nitsche(block)),
            "truth": truth(block),
        }
    return out


def as_text(results: dict[str, dict[str, Column]]) -> str:
    """Return Tables 1 to 4 as text: every point, its error towards the truth [%], and the numbers of unknowns."""
    lines = []
    for number, (case, table_) in enumerate(results.items(), 1):
        names = [name for name in table_ if name != "truth"]
        exact = table_["truth"].values
        lines += [f"Table {number}: {case}, displacement and error towards the truth [%]"]
        lines += ["NOP  truth    " + "  ".join(f"{name:>16}" for name in names)]
        for p in range(25):
            row = [f"{table_[n].values[p]:9.5f} {100 * abs(table_[n].values[p] / exact[p] - 1):6.2f}" for n in names]
            lines.append(f"{p + 1:3d}  {exact[p]:.5f}  " + "  ".join(row))
        worst = [f"{'max':>9} {100 * error(table_[n].values, exact):6.2f}" for n in names]
        lines += [" " * 14 + "  ".join(worst)]
        forces = [f"{n} {column.force:.5g}" for n, column in table_.items() if column.force is not None]
        lines += ["force on the far end: " + (", ".join(forces) or "prescribed"), ""]
    lines += ["Table 4: number of unknowns (finite elements with those of the clamped nodes, as printed)"]
    for name in next(iter(results.values())):
        lines.append(f"{name:>12}  " + "  ".join(str(table_[name].unknowns) for table_ in results.values()))
    return "\n".join(lines)


def _symmetric(quarter: list[list[float]]) -> Floats:
    index = [0, 1, 2, 1, 0]
    return np.array(quarter)[np.ix_(index, index)].ravel()


# Tables 1 to 3 of the paper, columns FEM and WRM.
PAPER_FEM: dict[str, Floats] = {
    "tension": np.full(25, 3.43757),
    "stretch": _symmetric([[0.42718, 0.42686, 0.42666], [0.42686, 0.42653, 0.42633], [0.42666, 0.42633, 0.42614]]),
    "shear": _symmetric([[0.47576, 0.47677, 0.47710], [0.47490, 0.47601, 0.47636], [0.47459, 0.47573, 0.47609]]),
}
PAPER_WRM: dict[str, Floats] = {
    "tension": np.array([
        3.38108, 3.38107, 3.38097, 3.38078, 3.38052, 3.40540, 3.40545, 3.40540, 3.40524, 3.40499, 3.43025, 3.43036,
        3.43035, 3.43022, 3.42999, 3.45550, 3.45566, 3.45568, 3.45558, 3.45537, 3.48105, 3.48123, 3.48127, 3.48119,
        3.48102,
    ]),
    "stretch": np.array([
        0.37919, 0.37905, 0.38237, 0.38914, 0.40026, 0.39106, 0.38860, 0.38925, 0.39317, 0.40012, 0.40082, 0.39659,
        0.39455, 0.39530, 0.39790, 0.40795, 0.40240, 0.39819, 0.39613, 0.39478, 0.41323, 0.40664, 0.40094, 0.39669,
        0.39185,
    ]),
    "shear": np.array([
        0.48055, 0.48956, 0.49650, 0.50354, 0.51210, 0.47955, 0.48854, 0.49497, 0.50103, 0.50822, 0.48200, 0.48890,
        0.49411, 0.49934, 0.50575, 0.48599, 0.48922, 0.49290, 0.49765, 0.50348, 0.48830, 0.48727, 0.48993, 0.49576,
        0.50234,
    ]),
}  # fmt: skip
