"""Many cells into one: the masses and the 28 springs of a coarse cell from the leaves it replaces.

Section 4.3 of Ganovelli, Cignoni & Scopigno, always from the leaves. Every leaf owns its share of what it has in common
with its neighbours (an edge's stiffness / 4, a face diagonal's / 2, mass / 8), so that nothing is counted twice.
A leaf is an isotropic lattice of relative stiffness KE : KF : KB on its edges, face and body diagonals; central forces
make Poisson's ratio 1/4 whatever the material says. Springs of a cell: 12 edges (axis, then the place along the other
two axes), 12 face diagonals (normal axis, side, rising and falling), 4 body diagonals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError

KE, KF, KB = 1.0, 1.0 / 3.0, 0.25
"""k_edge = k_face + 8/3 k_body makes the lattice isotropic."""
YOUNG = 2.5 * (KF + 4.0 / 3.0 * KB)
"""Young's modulus of a lattice of stiffness 1, times the side of a cell: E = 5/2 C44, C44 = (kf + 4/3 kb) / h."""
RULES = ("energy", "series", "literal", "harmonic")
CHAINS = ("small_strain", "equal_energy")


def _pairs() -> Ints:
    """Return the corners that each of the 28 springs of a cell joins, (28, 2)."""
    weight = (4, 2, 1)
    out = []
    for axis in range(3):
        b, c = (d for d in range(3) if d != axis)
        for p in range(2):
            for q in range(2):
                first = p * weight[b] + q * weight[c]
                out.append((first, first + weight[axis]))
    for axis in range(3):
        b, c = (weight[d] for d in range(3) if d != axis)
        for side in range(2):
            base = side * weight[axis]
            out += [(base, base + b + c), (base + b, base + c)]
    out += [(0, 7), (1, 6), (2, 5), (3, 4)]
    return np.array(out, dtype=np.int32)


PAIRS = _pairs()


class Chain(NamedTuple):
    """A row of springs as one (4.3.2): stiffness, rest length and the lengths between which it holds."""

    stiffness: float
    rest: float
    low: float
    high: float


class Curve(NamedTuple):
    """How a row of springs answers as one after another reaches its stop: stiffness K_j, force F_j, travel d_j."""

    stiffness: Floats
    force: Floats
    travel: Floats


def chain_curve(stiffness: Floats, travel: Floats) -> Curve:
    """Return the response of springs in series, (u,) each; `travel` is what each can move before it blocks."""
    order = np.argsort(stiffness * travel, kind="stable")
    k, force = stiffness[order], (stiffness * travel)[order]
    slope = 1.0 / np.cumsum((1.0 / k)[::-1])[::-1]
    return Curve(slope, force, np.cumsum(np.diff(force, prepend=0.0) / slope))


def curve_area(curve: Curve) -> float:
    """Return the work done until the last spring blocks."""
    force, travel = np.r_[0.0, curve.force], np.r_[0.0, curve.travel]
    return float((0.5 * (force[1:] + force[:-1]) * np.diff(travel)).sum())


def chain_stiffness(stiffness: Floats, travel: Floats, mode: str = "small_strain") -> Floats:
    """Return the stiffness of springs in series along the last axis, (...,).

    mode : "small_strain" 1 / sum 1/k, exact while no spring blocks; "equal_energy" the straight line with the same work
        up to full travel, sum k D^2 / (sum D)^2, as in the paper: never softer, and three times too stiff for k = 1, 10
    """
    if mode == "small_strain":
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / (1.0 / stiffness).sum(axis=-1))
    return np.asarray((stiffness * travel**2).sum(axis=-1) / travel.sum(axis=-1) ** 2)


def chain(
    stiffness: Floats, rest: Floats, low: Floats, high: Floats, *, mode: str = "small_strain", fracture: bool = False
) -> Chain:
    """Return a row of springs (u,) each as one spring: the mean of its stiffness in contraction and in elongation.

    With `fracture` the row breaks when its weakest spring does, instead of stretching until all have.
    """
    if not ((low < rest).all() and (rest < high).all() and (stiffness > 0).all()):
        raise UserError("chain: every spring needs a positive stiffness and low < rest < high")
    shorter = float(chain_stiffness(stiffness, rest - low, mode))
    longer = float(chain_stiffness(stiffness, high - rest, mode))
    most = float(high.sum())
    if fracture:
        longer = float(chain_stiffness(stiffness, high - rest, "small_strain"))
        most = float(rest.sum() + (stiffness * (high - rest)).min() / longer)
    return Chain(0.5 * (shorter + longer), float(rest.sum()), float(low.sum()), most)


def merge(stiffness: Floats, length: Floats) -> tuple[Floats, Floats]:
    """Return the four edges of a fragment from its parallel chains `stiffness` (v + 1, w + 1), with their lengths.

    Stiffness adds, with bilinear weights; a length is the mean with the same weights, normalised.
    """
    first, second = (_ramp(n - 1) for n in stiffness.shape)
    total = np.einsum("jk,yj,zk->yz", stiffness, first, second)
    mean = np.einsum("jk,yj,zk->yz", length, first, second) / np.outer(first.sum(1), second.sum(1))
    return total, mean


def _ramp(s: int) -> Floats:
    """Return the weights of s + 1 layers for the first and for the last of them, (2, s + 1)."""
    last = np.arange(s + 1) / s
    return np.stack([1.0 - last, last])


def _padded_sum(values: Floats, axes: tuple[int, ...]) -> Floats:
    """Return at every line or point between the cells `values` the sum over the cells around it along `axes`."""
    for axis in axes:
        width = [(0, 0)] * values.ndim
        width[axis] = (1, 1)
        wide = np.pad(values, width)
        values = np.take(wide, range(wide.shape[axis] - 1), axis) + np.take(wide, range(1, wide.shape[axis]), axis)
    return values


def simplify_mass(mass: Floats) -> Floats:
    """Return the corner masses (c, 8) of cells from the masses (c, s, s, s) of their leaves; sum and centroid stay."""
    s = mass.shape[1]
    node = _padded_sum(mass / 8.0, (1, 2, 3))
    w = _ramp(s)
    return np.asarray(np.einsum("cijk,xi,yj,zk->cxyz", node, w, w, w).reshape(-1, 8))


def simplify_springs(leaf: Floats, rule: str, mode: str) -> Floats:
    """Return the stiffness of the 28 springs (c, 28) of cells from that of their leaves `leaf` (c, s, s, s).

    rule : how diagonals are joined, see `Options`   mode : how edges in a row are, see `chain_stiffness`
    """
    out = np.empty((len(leaf), 28))
    for axis in range(3):
        along = np.moveaxis(leaf, 1 + axis, 1)
        out[:, 4 * axis : 4 * axis + 4] = _edges(along, mode)
        out[:, 12 + 4 * axis : 16 + 4 * axis] = _faces(along, rule)
    out[:, 24:] = _bodies(leaf, rule)
    return out


def _edges(leaf: Floats, mode: str) -> Floats:
    """Return the four edges (c, 4) along the first axis of `leaf` (c, s, s, s)."""
    s = leaf.shape[1]
    line = np.moveaxis(_padded_sum(0.25 * KE * leaf, (2, 3)), 1, -1)
    present = line > 0
    count = present.sum(axis=-1)
    travel = present.astype(np.float64)
    filled = np.where(present, line, np.inf if mode == "small_strain" else 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        row = np.where(count > 0, chain_stiffness(filled, travel, mode) * (count / s) ** 2, 0.0)
    w = _ramp(s)
    return np.asarray(np.einsum("cjk,yj,zk->cyz", row, w, w).reshape(-1, 4))


def _faces(leaf: Floats, rule: str) -> Floats:
    """Return the diagonals (c, 4) of the two faces normal to the first axis of `leaf` (c, s, s, s)."""
    c, s = leaf.shape[:2]
    layer = _padded_sum(0.5 * KF * leaf, (1,))
    face = np.einsum("cikl,xi->cxkl", layer, _ramp(s)).reshape(-1, s, s)
    rising, falling = (_diagonals(f.reshape(-1, s * s), s, 2, rule) for f in (face, face[:, ::-1]))
    return np.stack([rising, falling], axis=1).reshape(c, 4)


def _bodies(leaf: Floats, rule: str) -> Floats:
    """Return the four body diagonals (c, 4), 0-7, 1-6, 2-5 and 3-4."""
    c, s = leaf.shape[:2]
    views = (np.flip(leaf, flip).reshape(c, -1) for flip in ((), (3,), (2,), (2, 3)))
    return KB * np.stack([_diagonals(view, s, 3, rule) for view in views], axis=1)


def _diagonals(k: Floats, s: int, dimension: int, rule: str) -> Floats:
    """Return one diagonal of s^dimension cells from their parallel diagonals `k` (c, s^dimension), row by row.

    "energy" keeps the energy of a homogeneous strain, sum k l^2 cos^4 / L^2; "literal" projects every spring on the
    main diagonal with weight 1 - distance / farthest and joins the intervals in series; "series" also counts that a
    piece of a spring is stiffer than the whole.
    """
    if s == 1:
        return np.asarray(k[:, 0])
    if rule in ("energy", "harmonic"):
        return np.asarray(k.sum(axis=1) / s**2)
    place = np.stack(np.meshgrid(*[np.arange(s)] * dimension, indexing="ij"), -1).reshape(-1, dimension)
    off = np.linalg.norm(place - place.mean(axis=1, keepdims=True), axis=1)
    alpha = 1.0 - off / (s * np.sqrt(1.0 - 1.0 / dimension))
    first = place.sum(axis=1)  # in units of L / (s dimension), of which every spring covers `dimension`
    at = np.arange(s * dimension)
    piece = ((at >= first[:, None]) & (at < first[:, None] + dimension)) * alpha[:, None]
    interval = k @ piece * (dimension if rule == "series" else 1.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (1.0 / interval).sum(axis=1))
