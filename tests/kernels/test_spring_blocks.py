"""Gradient and diagonal Hessian blocks of the springs."""

import numpy as np
import pytest
from spring_meshes import deformed, evaluate, hessian, sheet, springs_of

from faceanim.kernels.spring_blocks import elastic_gradient_blocks
from faceanim.kernels.springs import force_scratch
from faceanim.kernels.tables import Law, Springs

LAWS = [Law(0.0, 1.0, 2.0, 1), Law(1.0, 1.3, 2.0, 1), Law(0.6, 1.0, 3.0, 1), Law(2.0, 0.9, 1.4, 1)]


def gradient_and_blocks(x: np.ndarray, springs: Springs, law: Law) -> tuple[np.ndarray, np.ndarray]:
    out = np.full((len(x), 9), np.nan)
    elastic_gradient_blocks(x, springs, law, force_scratch(springs), out)
    rows = np.array([[3, 4, 5], [4, 6, 7], [5, 7, 8]])
    return out[:, :3], out[:, rows]


def diagonal_blocks(matrix: np.ndarray) -> np.ndarray:
    n = len(matrix) // 3
    return np.array([matrix[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(n)])


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
@pytest.mark.parametrize("reaction", [0, 1])
def test_gradient_is_minus_the_force(law: Law, reaction: int) -> None:
    """Both kernels give the same forces to round-off."""
    points, triangles = sheet(30, 12)
    springs = springs_of(points, triangles)
    x = deformed(points)
    law = law._replace(reaction=reaction)
    force = evaluate(x, springs, law)[:, :3]
    gradient, _ = gradient_and_blocks(x, springs, law)
    np.testing.assert_allclose(gradient, -force, atol=1e-14 * np.abs(force).max())


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
def test_blocks_are_exact_at_rest(law: Law) -> None:
    """Without forces the projection changes nothing: the blocks are those of the energy's Hessian."""
    points, triangles = sheet(6, 5)
    springs = springs_of(points, triangles)
    exact = diagonal_blocks(hessian(points, springs, law))
    _, blocks = gradient_and_blocks(points, springs, law)
    np.testing.assert_allclose(blocks, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
def test_blocks_are_exact_in_tension(law: Law) -> None:
    """Stretched structural springs need no projection; nor does, at its own corner, a stretched height."""
    points, triangles = sheet(6, 5)
    springs = springs_of(points, triangles)
    x = np.ascontiguousarray(1.3 * points)
    edges_only = springs._replace(height_stiffness=0.0 * springs.height, repulsion=0.0 * springs.height)
    exact = diagonal_blocks(hessian(x, edges_only, law))
    np.testing.assert_allclose(
        gradient_and_blocks(x, edges_only, law)[1], exact, atol=1e-6 * np.abs(exact).max()
    )  # fmt: skip
    one = springs_of(points, triangles[:1])
    off = np.array([[1.0], [0.0], [0.0]])
    one = one._replace(
        edge_stiffness=0.0 * one.height,
        height_stiffness=off * one.height_stiffness,
        repulsion=0.1 * off * one.repulsion,
    )
    corner = triangles[0, 0]
    exact = diagonal_blocks(hessian(x, one, law))[corner]
    block = gradient_and_blocks(x, one, law)[1][corner]
    np.testing.assert_allclose(block, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.alpha}-{law.beta}")
@pytest.mark.parametrize("stretch", [0.5, 1.0, 1.8])
def test_blocks_are_positive_semidefinite(law: Law, stretch: float) -> None:
    """Every block is positive semidefinite at any state; only a boundary vertex with a single triangle may be free."""
    points, triangles = sheet(15, 14)
    springs = springs_of(points, triangles)
    x = points * [stretch, 1.0, 1.0] + np.random.default_rng(4).normal(0.0, 0.4, points.shape)
    _, blocks = gradient_and_blocks(x, springs, law)
    least, _, largest = np.linalg.eigvalsh(blocks).T
    assert (least > -1e-12 * largest).all()
    inner = np.bincount(triangles.ravel()) > 1
    assert (least[inner] > 1e-6 * largest[inner]).all()


def test_descent_lowers_the_force() -> None:
    """Damped block-Jacobi steps from a crumpled state bring the net force down to a thousandth."""
    points, triangles = sheet(8, 8, 0.2)
    springs = springs_of(points, triangles)
    x = deformed(points, 0.1)
    start = None
    for _ in range(400):
        gradient, blocks = gradient_and_blocks(x, springs, LAWS[1])
        start = np.abs(gradient).max() if start is None else start
        x = x - 0.45 * np.linalg.solve(blocks + 1e-3 * np.eye(3), gradient[..., None])[..., 0]
    assert np.abs(gradient).max() < 1e-3 * start
