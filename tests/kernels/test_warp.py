"""The warp kernels against quadrature, exponentials and differences (sections 2 and 7 of the equations)."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from faceanim.backends.modal_warping.display import BlockWarp
from faceanim.backends.modal_warping.twist import mean_rotation, mean_rotation_slope, rotation, skew
from faceanim.kernels import warp

TOOLS = Path(__file__).resolve().parents[2] / "tools"
ANGLES = (0.0, 1e-9, 1e-3, 9.9e-3, 1.01e-2, 0.0999, 0.1001, 0.5, 2.0, np.pi, 5.0, 6.2)


def vectors(angle: float, seed: int = 0) -> np.ndarray:
    w = np.random.default_rng(seed).standard_normal((20, 3))
    return angle * w / np.linalg.norm(w, axis=1, keepdims=True)


def warped(w: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return Rt(w) u by the kernel."""
    moved, out = np.ascontiguousarray(np.concatenate([u, w], axis=1)), np.zeros_like(u)
    warp.warp(np.zeros_like(u), moved, True, out)
    return out


def projected(w: np.ndarray, u: np.ndarray, force: np.ndarray, kind: int) -> np.ndarray:
    """Return the generalised force of one node whose six modes are its own displacement and rotation."""
    basis = np.eye(6)[None].copy()
    out = np.zeros(6)
    warp.project(basis, np.concatenate([u, w])[None], force[None].copy(), kind, out)
    return out


@pytest.mark.parametrize("angle", ANGLES)
def test_mean_rotation_is_the_mean_of_the_rotation(angle: float) -> None:
    """Rt(w) is the integral of exp(t [w]x) over 0..1, by 40-point Gauss, to 1e-13, with no gap at small angles."""
    t, weight = np.polynomial.legendre.leggauss(40)
    for w in vectors(angle)[:5]:
        mean = sum(0.5 * g * expm(0.5 * (1.0 + s) * skew(w)) for s, g in zip(t, weight, strict=True))
        np.testing.assert_allclose(mean_rotation(w), mean, atol=1e-13)
        for axis, column in zip(np.eye(3), mean.T, strict=True):
            np.testing.assert_allclose(warped(w[None], axis[None])[0], column, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_mean_rotation_halves_the_angle_and_shortens(angle: float) -> None:
    """F1: across w it is sinc(th/2) times the rotation by th/2, along w the identity."""
    for w in vectors(angle, 1):
        across = np.cross(w + 1e-300, [0.3, -0.5, 0.8])
        np.testing.assert_allclose(
            warped(w[None], across[None])[0], np.sinc(angle / 2.0 / np.pi) * rotation(0.5 * w) @ across, atol=1e-13
        )
        np.testing.assert_allclose(warped(w[None], w[None])[0], w, atol=1e-13)


def test_mean_rotation_is_singular_at_a_full_turn() -> None:
    """F2: the determinant is (2 sin(th/2) / th)^2, zero at 2 pi."""
    for angle in (0.7, 3.0, 2.0 * np.pi):
        w = vectors(angle)[0]
        assert np.linalg.det(mean_rotation(w)) == pytest.approx((2.0 * np.sin(angle / 2.0) / angle) ** 2, abs=1e-12)


def test_along_a_ray_the_rate_is_the_end_rotation() -> None:
    """F3: d/ds Rt(s w) s u = R(s w) u."""
    w, u, h = vectors(1.3, 2), np.random.default_rng(3).standard_normal((20, 3)), 1e-5
    rate = (warped((1 + h) * w, (1 + h) * u) - warped((1 - h) * w, (1 - h) * u)) / (2 * h)
    np.testing.assert_allclose(rate, np.einsum("kij,kj->ki", rotation(w), u), atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from((1e-4, 0.05, 0.0999, 0.1001, 0.8, 2.5, 6.0)))
def test_consistent_force_is_the_derivative_of_its_work(seed: int, angle: float) -> None:
    """Section 7: J^T F is the gradient of F . Rt(w) u by central differences to 1e-9; along the ray as (R Phi)^T F."""
    random = np.random.default_rng(seed)
    w, u, force = vectors(angle, seed)[0], random.standard_normal(3), random.standard_normal(3)
    found = projected(w, u, force, warp.CONSISTENT)

    def work(p: np.ndarray) -> float:
        return float(force @ warped(p[None, 3:], p[None, :3])[0])

    p, h = np.concatenate([u, w]), 1e-3
    # differences of fourth order
    slope = [
        (8 * (work(p + h * e) - work(p - h * e)) - work(p + 2 * h * e) + work(p - 2 * h * e)) / (12 * h)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(found, slope, atol=1e-9)
    assert p @ found == pytest.approx(p @ projected(w, u, force, warp.PAPER), abs=1e-12)
    turned = np.einsum("kij->ij", mean_rotation_slope(w[None], u[None])).T @ force
    np.testing.assert_allclose(found[3:], turned, atol=1e-9)


def test_paper_force_turns_back() -> None:
    """Eq. 18: (R Phi)^T F uses the end rotation, and gives rotations nothing."""
    w, force = vectors(2.0)[0], np.array([1.0, -2.0, 0.5])
    found = projected(w, np.ones(3), force, warp.PAPER)
    np.testing.assert_allclose(found[:3], rotation(w).T @ force, atol=1e-14)
    assert (found[3:] == 0.0).all()


@pytest.mark.parametrize("scale", [0.0, 0.3, 2.0, 3.3, 9.0])
@pytest.mark.parametrize("n", [1, 127, 128, 300])
def test_blocks_agree_with_double_precision(n: int, scale: float) -> None:
    """float32 blocks agree with float64 to 1e-5, beyond a full turn too; two threads give the same bytes as one."""
    random = np.random.default_rng(n)
    basis, rest = random.standard_normal((n, 6, 9)) / 6.0, random.standard_normal((n, 3))
    z = scale * random.standard_normal(7)
    moved, exact = np.zeros((n, 6)), np.zeros((n, 3))
    warp.local(basis, z, 7, moved)
    warp.warp(rest, moved, True, exact)
    one = BlockWarp(rest, basis).points(z).copy()
    np.testing.assert_allclose(one, exact, atol=1e-5 * max(1.0, np.abs(exact).max()))
    assert one.tobytes() == BlockWarp(rest, basis, threads=2).points(z).tobytes()
    compact = BlockWarp(rest, basis, compact=True).points(z)
    np.testing.assert_allclose(compact, exact, atol=2e-4 * max(1.0, np.abs(exact).max()))
    if scale == 0.0:
        assert (one == rest.astype(np.float32)).all()


@pytest.mark.slow
def test_blocks_are_much_faster_than_numpy() -> None:
    """Section 8, 28,098 vertices, 31 modes: blocks take at most 1/3 of NumPy's warp in float64, nodes 1/8 of its product."""
    case = runpy.run_path(str(TOOLS / "bench_warp.py"))["Case"]()
    single, compact = case.errors()
    assert single < 1e-5 and compact < 1e-4
    least = {name: t.min() for name, t in case.times(100).items()}
    assert least["blocks"] < least["numpy"] / 3.0
    assert least["compact"] < least["blocks"]
    assert least["nodes"] < least["product"] / 8.0
