"""Import floors: every arrow points down, there is no circle, and sibling backends do not know each other."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "faceanim"
FLOORS = {
    "ground": 0,
    "kernels": 1,
    "geometry": 2,
    "tissue": 2,
    "body": 3,
    "elements": 3,
    "backends": 4,
    "face": 4,
    "expression": 4,
    "session": 5,
    "render": 5,
    "export": 5,
    "bench": 6,
    "surgery": 6,
    "cli": 7,
    "studio": 7,
    "__main__": 8,
}
NEIGHBOURS = {("expression", "face"), ("bench", "surgery"), ("cli", "studio")}
"""Rooms of one floor that may be seen from another: face, then expression; benches measure operations; the command line
opens the studio."""


def _modules() -> dict[str, Path]:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = _modules()


def _imports(path: Path, *, top_level_only: bool) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found: set[str] = set()
    nodes = _run_at_import(tree.body) if top_level_only else list(ast.walk(tree))
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            found |= {f"{module}.{a.name}" if f"{module}.{a.name}" in MODULES else module for a in node.names}
    return {name for name in found if name.split(".")[0] == "faceanim"}


def _run_at_import(body: list[ast.stmt]) -> list[ast.stmt]:
    out: list[ast.stmt] = []
    for node in body:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        out.append(node)
    return out


def _room(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("module", sorted(m for m in MODULES if _room(m)))
def test_imports_point_down(module: str) -> None:
    """A module sees its own room, the rooms below it, and no other, inside functions too."""
    room = _room(module)
    assert room in FLOORS, f"room {room} has no floor"
    for imported in _imports(MODULES[module], top_level_only=False):
        other = _room(imported)
        if other in ("", room):
            continue
        allowed = FLOORS[other] < FLOORS[room] or (room, other) in NEIGHBOURS
        assert allowed, f"{module} (floor {FLOORS[room]}) imports {imported} (floor {FLOORS[other]})"


def test_there_is_no_circle() -> None:
    """What runs at import time can be put in an order."""
    graph = {m: {i for i in _imports(p, top_level_only=True) if i in MODULES and i != m} for m, p in MODULES.items()}
    tuple(TopologicalSorter(graph).static_order())


def test_sibling_backends_do_not_know_each_other() -> None:
    """A backend imports the solver protocol and what all share, never another backend's folder."""
    folders = {p.name for p in (PACKAGE / "backends").iterdir() if p.is_dir() and p.name != "__pycache__"}
    for module, path in MODULES.items():
        parts = module.split(".")
        if parts[1:2] != ["backends"] or len(parts) < 3 or parts[2] not in folders:
            continue
        others = {i.split(".")[2] for i in _imports(path, top_level_only=False) if i.startswith("faceanim.backends.")}
        assert not (others & folders) - {parts[2]}, f"{module} imports {others}"


@pytest.mark.parametrize("module", sorted(m for m in MODULES if _room(m) == "kernels"))
def test_kernels_see_only_the_ground_and_lower_kernels(module: str) -> None:
    """Kernels import the decorator, NumPy, Numba, math and each other."""
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        for name in names:
            root = name.split(".")[0]
            assert root in {"faceanim", "numpy", "numba", "llvmlite", "math", "typing", "__future__", "collections"}, (
                name
            )


@pytest.mark.parametrize(
    ("statement", "heavy"),
    [
        ("import faceanim", {"numpy", "numba", "scipy", "cv2", "matplotlib", "rich", "msgspec", "viser"}),
        ("import faceanim.cli.main", {"numpy", "numba", "scipy", "cv2", "matplotlib", "rich", "msgspec", "viser"}),
        ("import faceanim.expression.library", {"numba", "scipy", "cv2", "matplotlib", "rich"}),
        ("import faceanim.face.muscle_check, faceanim.face.face", {"numba", "matplotlib", "rich"}),
    ],
)
def test_light_imports_stay_light(statement: str, heavy: set[str]) -> None:
    """Names and words load before anything that is compiled, drawn or plotted."""
    code = f"{statement}; import sys; print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not heavy & set(out.stdout.split())
