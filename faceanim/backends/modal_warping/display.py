"""Many vertices a frame in float32: each warped by itself, or carried by warped nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faceanim.backends.nodal import carried
from faceanim.geometry.embedding import Embedding
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError
from faceanim.kernels import warp

if TYPE_CHECKING:
    from faceanim.backends.modal_warping.solver import SolverModalWarping, StateModalWarping

Singles = NDArray[np.float32]


def blocked(basis: Floats) -> Singles:
    """Return `basis` (n, 6, columns) as blocks (blocks, columns, 6, LANES) of float32, the last one filled with zeros."""
    n, _, columns = basis.shape
    blocks = -(-n // warp.LANES)
    padded = np.zeros((blocks * warp.LANES, 6, columns), np.float32)
    padded[:n] = basis
    return np.ascontiguousarray(padded.reshape(blocks, warp.LANES, 6, columns).transpose(0, 3, 2, 1))


class BlockWarp:
    """Points (n, 3) with modal vectors of their own, warped in blocks of float32.

    rest : (n, 3) [mm]   basis : (n, 6, columns), displacement and rotation per unit amplitude   threads : 1 or more
    compact : keep the basis in whole numbers of 16 bits, half the memory to read, with errors of about 2e-5 of the
    displacement instead of 1e-6
    """

    def __init__(self, rest: Floats, basis: Floats, *, threads: int = 1, compact: bool = False) -> None:
        if threads < 1:
            raise UserError(f"threads = {threads} must be at least 1")
        self.rest = np.ascontiguousarray(rest, dtype=np.float32)
        self.columns = basis.shape[2]
        self.scale, self.turn = np.ones(self.columns), np.float32(1.0)
        self.table: NDArray[Any] = self._compacted(basis) if compact else blocked(basis)
        self.scratch = np.zeros((threads, 6, warp.LANES), np.float32)
        self.out = self.rest.copy()

    def _compacted(self, basis: Floats) -> NDArray[np.int16]:
        """Return the blocks of `basis` in 16 bits; each column has its scale, rotations are first made as large as moves."""
        move, turn = (np.abs(part).max(initial=0.0) for part in (basis[:, :3], basis[:, 3:]))
        self.turn = np.float32(turn / move if turn > 0.0 and move > 0.0 else 1.0)
        even = np.concatenate([basis[:, :3], basis[:, 3:] / float(self.turn)], axis=1)
        self.scale = np.maximum(np.abs(even).max(axis=(0, 1)), 1e-300) / 32767.0
        return np.rint(blocked(even / self.scale)).astype(np.int16)

    def points(self, amplitudes: Floats) -> Singles:
        """Return the warped points (n, 3) at `amplitudes` (columns,) or the first of them; overwritten by the next call."""
        if amplitudes.ndim != 1 or len(amplitudes) > self.columns:
            raise UserError(f"amplitudes has shape {amplitudes.shape}; at most ({self.columns},) is known")
        z = (amplitudes * self.scale[: len(amplitudes)]).astype(np.float32)
        run = warp.warp_blocks if len(self.scratch) == 1 else warp.warp_blocks_parallel
        run(self.rest, self.table, z, len(z), self.turn, self.scratch, self.out)
        return self.out


def vertex_warp(solver: SolverModalWarping, skin: Embedding, *, threads: int = 1) -> BlockWarp:
    """Return the direct warp of vertices whose modal displacement and rotation are `skin`'s means of the nodes'."""
    rest = skin.apply(solver.solid.mesh.points)
    return BlockWarp(rest, skin.apply(solver.modes.basis), threads=threads)


def amplitudes(state: StateModalWarping) -> Floats:
    """Return all amplitudes of `state`, those of the modes and those of the bones' fields that move, (k,)."""
    twist = state.twist.ravel()
    moving = np.flatnonzero(twist)
    return np.concatenate([state.q, twist[: moving[-1] + 1]]) if len(moving) else state.q


class SkinWarp:
    """Vertices as means of warped nodes, most of them of up to four: the cheapest way to many of them.

    skin : which nodes carry them (default: the body's own)   threads : 1 or more
    """

    def __init__(self, solver: SolverModalWarping, skin: Embedding | None = None, *, threads: int = 1) -> None:
        self.solid = solver.solid
        skin = self.solid.skin if skin is None else skin
        basis = solver.modes.basis
        if not solver.shape.warped:
            basis = basis.copy()
            basis[:, 3:] = 0.0
        self.nodes = BlockWarp(self.solid.mesh.points, basis, threads=threads)
        order = np.argsort(-np.abs(skin.weight), axis=1, kind="stable")[:, :4]
        width = order.shape[1]
        self.node = np.zeros((len(skin.node), 4), np.int32)
        self.weight = np.zeros((len(skin.node), 4), np.float32)
        self.node[:, :width] = np.take_along_axis(skin.node, order, axis=1)
        self.weight[:, :width] = np.take_along_axis(skin.weight, order, axis=1)
        self.wide = np.flatnonzero((skin.weight != 0.0).sum(axis=1) > 4)
        self._wide = skin.matrix(len(basis))[self.wide]
        self.held = np.flatnonzero(self.solid.held)

    def points(self, state: StateModalWarping, out: Any) -> None:
        """Write the vertices (k, 3) [mm] into `out` (float32 or float64); held nodes are where the bones carry them."""
        x = self.nodes.points(amplitudes(state))
        if state.twist.any():
            x[self.held] = carried(self.solid, state.pose)
        self.spread(x, out)

    def spread(self, x: Singles, out: Any) -> None:
        """Write the vertices (k, 3) carried by nodes at `x` (n, 3) into `out`."""
        threads = len(self.nodes.scratch)
        if threads == 1:
            warp.interpolate(self.node, self.weight, x, 0, len(self.node), out)
        else:
            warp.interpolate_parallel(self.node, self.weight, x, threads, out)
        if len(self.wide):
            out[self.wide] = self._wide @ x
