"""Linear elasticity of a solid as sparse matrices over its nodes: three rows a node, x, y, z."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from faceanim.body.solid import Solid
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats


def stiffness_matrix(solid: Solid) -> sparse.csr_matrix:
    """Return the stiffness of small displacements, (3n, 3n) [mN/mm], symmetric; linear tetrahedra."""
    mesh = solid.mesh
    lame, shear = solid.lame()
    g, volume = mesh.gradients, mesh.volumes
    dots = np.einsum("eai,ebi->eab", g, g)
    blocks = np.einsum("e,eai,ebj->eaibj", volume * lame, g, g)
    blocks += np.einsum("e,eaj,ebi->eaibj", volume * shear, g, g)
    blocks += np.einsum("e,eab,ij->eaibj", volume * shear, dots, np.eye(3))
    return _assembled(mesh, blocks.reshape(-1, 12, 12))


def mass_matrix(solid: Solid, *, lumped: bool = True) -> sparse.csr_matrix:
    """Return the mass, (3n, 3n) [kg]: diagonal if `lumped`, else consistent, rho V / 20 (1 + delta_ab) per element."""
    if lumped:
        return sparse.diags(np.repeat(solid.node_mass, 3)).tocsr()
    share = np.einsum("e,ab->eab", solid.density * solid.mesh.volumes / 20.0, np.ones((4, 4)) + np.eye(4))
    return _assembled(solid.mesh, np.einsum("eab,ij->eaibj", share, np.eye(3)).reshape(-1, 12, 12))


def _assembled(mesh: TetMesh, blocks: Floats) -> sparse.csr_matrix:
    """Return the sum of element matrices `blocks` (e, 12, 12)."""
    rows = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    i = np.repeat(rows, 12, axis=1).ravel()
    j = np.tile(rows, (1, 12)).ravel()
    size = 3 * len(mesh.points)
    return sparse.coo_matrix((blocks.ravel(), (i, j)), shape=(size, size)).tocsr()
