"""How far the warp's assumptions are off in a given state: its ghost force and the error of Eq. 13."""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.backends.modal_warping.twist import rotation
from faceanim.ground.arrays import Floats


def ghost_force(stiffness: Any, local: Floats, turned: Floats) -> tuple[float, Floats]:
    """Return the share |sum f| / sum |f| and the sum (3,) [mN] of the warped elastic forces f = -R K uL.

    On a free body they should sum to zero; a node-wise rotation does not see to it (section IV-C of Choi & Ko).
    stiffness : (3n, 3n)   local : (n, 3) uL [mm]   turned : (n, 3) rotation vectors [rad]
    """
    force = -np.einsum("nij,nj->ni", rotation(turned), (stiffness @ local.ravel()).reshape(-1, 3))
    net = force.sum(axis=0)
    total = float(np.linalg.norm(force, axis=1).sum())
    return (float(np.linalg.norm(net)) / total if total > 0.0 else 0.0), net


def commutation_error(mass: Any, turned: Floats) -> float:
    """Return the Frobenius norm of R^T M - M R^T relative to the total mass (Eq. 13, App. I); zero for a lumped mass.

    mass : (3n, 3n)   turned : (n, 3) rotation vectors [rad]
    """
    nodal = mass[::3][:, ::3].tocoo()
    r = rotation(turned)
    apart = ((r[nodal.row] - r[nodal.col]) ** 2).sum(axis=(1, 2))
    return float(np.sqrt(nodal.data**2 @ apart) / nodal.data.sum())
