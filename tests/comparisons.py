"""Comparisons of backends made up for tests of their presentation."""

from __future__ import annotations

from typing import Any

import numpy as np

from faceanim.bench.comparison.rows import Comparison, Errors, Row

# backend: schemes, cost of a step per 1000 unknowns [ms], error of the model, error of the time stepping at 1 ms [mm]
CANDIDATES: dict[str, tuple[tuple[str, ...], float, float, float]] = {
    "mass_spring": (("conjugate_gradient", "explicit"), 0.5, 0.9, 0.02),
    "modal_warping": (("modes_64",), 0.08, 1.4, 0.004),
    "weighted_residual": (("",), 0.9, 0.35, 0.03),
    "octree_mass_spring": (("",), 0.35, 1.1, 0.05),
    "mixed_fem": (("newton",), 9.0, 0.05, 0.008),
    "finite_elements": (("newton", "linear"), 14.0, 0.025, 0.008),
}
UNKNOWNS = {"coarse": 2400, "default": 9600, "fine": 31000}
FAILURES = (
    ("diverged", "positions are not finite at t = 0.117 s; shorten the step to 2 ms or less, or take scheme newton"),
    ("inverted", "212 of 4988 triangles are turned inside out in the last frame"),
    ("too slow", "stopped after 600 s at frame 3 of 48"),
    ("refused", "weighted_residual models muscles of a solid; this scene has none"),
    ("failed", "no balance beyond 43 % of the load"),
)


def errors(rms: float, movement: float = 8.0) -> Errors:
    """Return errors of a plausible shape around `rms` [mm]."""
    return Errors(rms, 2.1 * rms, 6.3 * rms, rms / movement)


def made_row(**changes: Any) -> Row:
    """Return one measured row, with `changes`."""
    fields: dict[str, Any] = {
        "scene": "bar", "key": "k0", "label": "mass spring", "backend": "mass_spring", "scheme": "", "density": "coarse",
        "settings": {}, "step": 1.0 / 60.0, "steps_per_frame": 2, "fps": 30.0, "outcome": "done", "unknowns": 2400,
        "frames": 48, "frame_ms": 5.0, "frame_low_ms": 4.7, "frame_high_ms": 5.6, "setup_s": 0.4, "compile_s": 3.0,
        "memory_mb": 12.0, "rest": errors(0.4), "along": errors(0.5),
    }  # fmt: skip
    return Row(**(fields | changes))


def failed_row(outcome: str = "diverged", reason: str = "not finite at t = 0.1 s", **changes: Any) -> Row:
    """Return one row without measurements."""
    blank = dict.fromkeys(("frame_ms", "frame_low_ms", "frame_high_ms", "rest", "along"))
    return made_row(outcome=outcome, reason=reason, **(blank | changes))


def made_rows(scene: str = "bar", seed: int = 1) -> list[Row]:
    """Return rows of six backends, eight schemes, three densities and two steps: some failed."""
    rng = np.random.default_rng(seed)
    out: list[Row] = []
    for backend, (schemes, cost, model, stepping) in CANDIDATES.items():
        for k, scheme in enumerate(schemes):
            for density in UNKNOWNS:
                for steps in (1, 4):
                    out.append(_made(rng, scene, len(out), backend, (scheme, k), density, steps, cost, model, stepping))
    return out


def _made(
    rng: np.random.Generator,
    scene: str,
    number: int,
    backend: str,
    scheme: tuple[str, int],
    density: str,
    steps: int,
    cost: float,
    model: float,
    stepping: float,
) -> Row:
    unknowns, step = UNKNOWNS[density], 1.0 / (30.0 * steps)
    name = " ".join(part.replace("_", " ") for part in (backend, scheme[0]) if part)
    base: dict[str, Any] = {
        "scene": scene, "key": f"{scene}-{number}", "label": f"{name}, {density}, {1e3 * step:.3g} ms", "backend": backend,
        "scheme": scheme[0], "density": density, "step": step, "steps_per_frame": steps, "unknowns": unknowns,
        "settings": {"iterations": 40} if scheme[1] else {},
    }  # fmt: skip
    if number % 9 == 4:
        return failed_row(*FAILURES[number // 9 % len(FAILURES)], **base)
    frame = cost * steps * (unknowns / 1000.0) ** 1.15 * (0.6 if scheme[1] else 1.0) * rng.uniform(0.9, 1.1)
    off = model * (2400 / unknowns) ** 0.45 * (1.8 if scheme[1] else 1.0) * rng.uniform(0.85, 1.15)
    late = stepping * 1e3 * step * (0.4 if steps > 1 else 0.5)
    along = float(np.hypot(off, late))
    spread = rng.uniform(0.02, 0.2)
    return made_row(
        frame_ms=frame, frame_low_ms=frame * (1.0 - 0.5 * spread), frame_high_ms=frame * (1.0 + spread),
        rest=errors(off), along=errors(along), scheme_error=errors(late) if backend != "octree_mass_spring" else None,
        inverted=0, memory_mb=unknowns / 200.0, picture=f"pictures/{number}.png", **base,
    )  # fmt: skip


def made_comparison(scene: str = "bar", seed: int = 1, **changes: Any) -> Comparison:
    """Return a comparison of `made_rows`, with `changes`."""
    fields: dict[str, Any] = {
        "scene": scene, "title": f"{scene}: a bar of flesh between two bones, pulled by two muscles and let go",
        "reference": "finite elements, quadratic, 94 000 unknowns, BDF2 at 0.5 ms", "uncertainty": 0.02, "movement": 8.0,
        "machine": "2 cores of a made-up processor", "rows": made_rows(scene, seed),
    }  # fmt: skip
    return Comparison(**(fields | changes))
