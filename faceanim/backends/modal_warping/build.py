"""From a solid to its modes: frequencies, shapes, the rotations that they imply, and the fields that follow bones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from faceanim.backends.modal_warping.options import Options
from faceanim.backends.nodal import Pull
from faceanim.body.assembly import mass_matrix, stiffness_matrix
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import Solid
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.cache import content_key, load_arrays, save_arrays
from faceanim.ground.errors import UserError
from faceanim.ground.notes import tell

VERSION = "modal_warping 2"
NEGLIGIBLE = 1e-6
"""A static answer of which so small a share is left beside the modes adds nothing."""
DENSE = 400
"""Up to so many freedoms the eigenproblem is solved densely."""


@dataclass(frozen=True, eq=False)
class Modes:
    """The lowest m vibration modes of a solid and its static answers to moving bones.

    squared : (m,) squared angular frequencies Lambda [1/s^2], increasing   basis : (n, 6, m + 6 bones): displacement
    (Phi, Lift) and rotation (Psi, W Lift) of every node per unit of each column
    bone : (bones,) which bone each six lift columns belong to: rotation vector and translation of its pose's logarithm
    coupling : (m, 6 bones) Phi^T M Lift   lift_mass, lift_stiffness : (6 bones, 6 bones) Lift^T M Lift, Lift^T K Lift
    mass : (3n, 3n)
    """

    squared: Floats
    basis: Floats
    bone: Ints
    coupling: Floats
    lift_mass: Floats
    lift_stiffness: Floats
    mass: Any

    @property
    def count(self) -> int:
        """How many vibration modes there are."""
        return len(self.squared)

    @property
    def frequencies(self) -> Floats:
        """(m,) [Hz]."""
        return np.asarray(np.sqrt(self.squared) / (2.0 * np.pi))

    def shapes(self) -> Floats:
        """Return Phi, (3n, m), mass-normalised."""
        return self.basis[:, :3, : self.count].reshape(-1, self.count)

    def rotations(self) -> Floats:
        """Return Psi = W Phi, (3n, m)."""
        return self.basis[:, 3:, : self.count].reshape(-1, self.count)


def with_held(solid: Solid, nodes: tuple[int, ...]) -> Solid:
    """Return `solid` with `nodes` held by bone 0 as well; raise `UserError` for a node that it does not have."""
    if not nodes:
        return solid
    n = len(solid.mesh.points)
    if max(nodes) >= n:
        raise UserError(f"held: node {max(nodes)} is outside 0..{n - 1}")
    weight = solid.bone_weight.copy()
    extra = np.array(nodes)[~solid.held[list(nodes)]]
    weight[extra, 0] = 1.0
    return replace(solid, bone_weight=weight)


def rotation_matrix(mesh: TetMesh, average: str = "plain") -> sparse.csr_matrix:
    """Return W (3n, 3n): nodal displacements to nodal rotation vectors, half the curl averaged over a node's elements.

    Element a of tetrahedron e contributes (1/2) [g_a]x (Eq. 7); `average` "plain" or "volume"-weighted (footnote 1).
    """
    share = np.ones(len(mesh.tets)) if average == "plain" else mesh.volumes
    total = np.bincount(mesh.tets.ravel(), np.repeat(share, 4), len(mesh.points))
    weight = share[:, None] / total[mesh.tets]
    g = 0.5 * mesh.gradients
    skew = np.zeros((len(mesh.tets), 4, 3, 3))
    for (i, j), component, sign in (((2, 1), 0, 1), ((1, 2), 0, -1), ((0, 2), 1, 1), ((2, 0), 1, -1)):
        skew[:, :, i, j] = sign * g[:, :, component]
    skew[:, :, 1, 0], skew[:, :, 0, 1] = g[:, :, 2], -g[:, :, 2]
    blocks = np.einsum("eb,eaij->ebiaj", weight, skew).reshape(-1, 12, 12)
    rows = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    places = (np.repeat(rows, 12, axis=1).ravel(), np.tile(rows, (1, 12)).ravel())
    size = 3 * len(mesh.points)
    return sparse.coo_matrix((blocks.ravel(), places), shape=(size, size)).tocsr()


def factorised(matrix: Any) -> Any:
    """Return the factors of a symmetric positive definite sparse matrix."""
    options = {"SymmetricMode": True}
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def eigenmodes(stiffness: Any, mass: Any, count: int, factors: Any) -> tuple[Floats, Floats]:
    """Return the `count` lowest Lambda and the shapes, K Phi = M Phi Lambda, Phi^T M Phi = I to round-off.

    Signs are such that the largest entry of each shape is positive.
    """
    size = stiffness.shape[0]
    if size <= DENSE or count > size // 2:
        found = linalg.eigh(stiffness.toarray(), mass.toarray(), subset_by_index=(0, count - 1))
    else:
        inverse = LinearOperator((size, size), matvec=factors.solve, dtype=np.float64)
        start = np.random.default_rng(0).standard_normal(size)
        found = eigsh(stiffness, count, mass, sigma=0.0, OPinv=inverse, v0=start)
    shapes = found[1]
    upper = linalg.cholesky(shapes.T @ (mass @ shapes))
    shapes = linalg.solve_triangular(upper, shapes.T, trans="T").T
    small = shapes.T @ (stiffness @ shapes)
    squared, turn = linalg.eigh(0.5 * (small + small.T))
    shapes = shapes @ turn
    peak = shapes[np.abs(shapes).argmax(axis=0), np.arange(count)]
    return squared, np.ascontiguousarray(shapes * np.sign(peak))


def _lift_held(solid: Solid, bones: Ints) -> Floats:
    """Return the motion of the held nodes per unit twist of each bone, (3n, 6 bones)."""
    x = solid.mesh.points
    out = np.zeros((len(x), 3, 6 * len(bones)))
    for k, bone in enumerate(bones):
        weight = solid.bone_weight[:, bone, None]
        for axis, unit in enumerate(np.eye(3)):
            out[:, :, 6 * k + axis] = weight * np.cross(unit, x)
            out[:, :, 6 * k + 3 + axis] = weight * unit
    return out.reshape(3 * len(x), -1)


def _moving_bones(solid: Solid) -> Ints:
    """Return the bones that hold nodes, bone 0 last, since it seldom moves."""
    holds = np.flatnonzero((solid.bone_weight > 0.0).any(axis=0))
    return np.roll(holds, -1).astype(np.int32) if holds[0] == 0 else holds.astype(np.int32)


def augmented(squared: Floats, shapes: Floats, static: Floats, stiffness: Any, mass: Any) -> tuple[Floats, Floats]:
    """Return Lambda and shapes of the space that the modes `shapes` (f, m) and the `static` answers (f, k) span.

    The result is as normal as the modes are: Rayleigh and Ritz on the answers, without what the modes have of them.
    """
    rest = static.copy()
    for _ in range(2):
        rest -= shapes @ (shapes.T @ (mass @ rest))
    size = np.sqrt(np.maximum((rest * (mass @ rest)).sum(axis=0), 0.0))
    whole = np.sqrt((static * (mass @ static)).sum(axis=0))
    rest = rest[:, size > NEGLIGIBLE * whole] / size[size > NEGLIGIBLE * whole]
    share, turn = linalg.eigh(rest.T @ (mass @ rest))
    kept = share > NEGLIGIBLE**2
    rest = rest @ (turn[:, kept] / np.sqrt(share[kept]))
    both = np.concatenate([shapes, rest], axis=1)
    small = both.T @ (stiffness @ both)
    small[: len(squared), : len(squared)] = np.diag(squared)
    values, turn = linalg.eigh(0.5 * (small + small.T))
    return values, np.ascontiguousarray(both @ turn)


def muscle_forces(body: Body, solid: Solid) -> Floats:
    """Return the pull of every muscle on the nodes at rest and full activation, (3n, m) [mN]."""
    pull, control = Pull(body, solid), Control.rest(body)
    out = np.zeros((3 * len(solid.mesh.points), len(control.activation)))
    for k in range(out.shape[1]):
        control.activation[:] = 0.0
        control.activation[k] = 1.0
        out[:, k] = pull.at(control, body.surface.points).ravel()
    return out


def _solved(solid: Solid, options: Options, stiffness: Any, mass: Any, loads: Floats) -> tuple[Floats, ...]:
    """Return Lambda, Phi (3n, m) and Lift (3n, 6 bones); `loads` (3n, k) are answered statically as well."""
    free = np.flatnonzero(np.repeat(~solid.held, 3))
    if options.modes > len(free):
        raise UserError(f"modes = {options.modes}; this body has only {len(free)} freedoms: ask for fewer modes")
    inner, inner_mass = stiffness[free][:, free].tocsc(), mass[free][:, free].tocsc()
    tell("computing modes: factors of the stiffness")
    loose = UserError("the body can turn freely: the nodes that bones hold lie on one line; hold at least three apart")
    try:
        factors = factorised(inner)
        tell("computing modes: vibration modes")
        squared, shapes = eigenmodes(inner, inner_mass, options.modes, factors)
    except (RuntimeError, linalg.LinAlgError, ArpackError) as error:
        raise loose from error
    if not squared[0] > 1e-10 * inner.diagonal().sum() / inner_mass.diagonal().sum():
        raise loose
    if loads.shape[1]:
        tell("computing modes: answers to the muscles")
        squared, shapes = augmented(squared, shapes, factors.solve(loads[free]), inner, inner_mass)
    tell("computing modes: fields of the bones")
    lift = _lift_held(solid, _moving_bones(solid))
    lift[free] = factors.solve(-(stiffness @ lift)[free])
    phi = np.zeros((stiffness.shape[0], len(squared)))
    phi[free] = shapes
    return squared, phi, lift


def compute_modes(solid: Solid, options: Options, *, loads: Floats | None = None) -> Modes:
    """Compute the modes of `solid`, or read them from the cache on disk.

    loads : (3n, k) [mN] forces whose static answers join the modes
    Raises `UserError` if more modes are asked for than there are freedoms, or if the body is not held firmly.
    """
    loads = np.zeros((3 * len(solid.mesh.points), 0)) if loads is None else loads
    mesh = solid.mesh
    constants = np.stack([*solid.lame(), solid.density])
    key = content_key(
        VERSION, mesh.points, mesh.tets, constants, solid.bone_weight, options.modes, options.mass, loads
    )  # fmt: skip
    stiffness, mass = stiffness_matrix(solid), mass_matrix(solid, lumped=options.mass == "lumped")
    kept = load_arrays("modes", key) if options.cache else None
    if kept is None:
        squared, phi, lift = _solved(solid, options, stiffness, mass, loads)
        if options.cache:
            save_arrays("modes", key, squared=squared, phi=phi, lift=lift)
    else:
        squared, phi, lift = kept["squared"], kept["phi"], kept["lift"]
    columns = np.concatenate([phi, lift], axis=1)
    n = len(mesh.points)
    turning = rotation_matrix(mesh, options.rotation_average) @ columns
    basis = np.concatenate([columns.reshape(n, 3, -1), turning.reshape(n, 3, -1)], axis=1)
    heavy = mass @ lift
    return Modes(
        squared, np.ascontiguousarray(basis), _moving_bones(solid), phi.T @ heavy, lift.T @ heavy,
        lift.T @ (stiffness @ lift), mass,
    )  # fmt: skip
