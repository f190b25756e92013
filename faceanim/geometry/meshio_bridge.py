"""Tetrahedral meshes from and to files, through meshio: any format it reads, with a report of what was repaired.

Files are untrusted: their size is checked before anything is read, and whatever meshio does about a broken one (it may
even end the program) becomes a `UserError` that names the file.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import RunError, UserError

LARGEST_FILE = 512 * 2**20
"""Files above this many bytes are not read."""
MOST_ELEMENTS = 5_000_000
READABLE = (".msh", ".vtu", ".vtk", ".mesh", ".inp", ".avs", ".bdf")
WRITABLE = (".vtu", ".msh", ".vtk", ".mesh")
REGION_NAMES = ("region", "gmsh:physical", "medit:ref", "cell_tags")
"""Names of element data that are taken for the region, the first that is found."""

_CORNERS = {"tetra": 4, "tetra10": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8, "hexahedron20": 8, "hexahedron27": 8}
_CORNERS |= {"wedge15": 6, "wedge18": 6, "pyramid13": 5, "pyramid14": 5}
# Faces with four corners, in meshio's numbering (that of VTK), and the corners of each cell to which fans are drawn.
_SQUARES = {
    5: ((0, 1, 2, 3),),
    6: ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    8: ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}
_TRIANGLES: dict[int, tuple[tuple[int, int, int], ...]] = {
    5: ((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    6: ((0, 1, 2), (3, 4, 5)),
    8: (),
}
_FLAT = 1e-9


@dataclass(frozen=True)
class VolumeReport:
    """What was found in a file and what was done about it.

    cells : kind of cell -> how many the file holds   region : (e,) region of each element, None if the file has none
    flipped : elements turned to positive volume   loose : points left out because no element uses them
    split : cells of other kinds that were split into elements   parts : how many pieces do not hang together
    """

    path: str
    cells: dict[str, int]
    region: Ints | None
    flipped: int = 0
    loose: int = 0
    split: int = 0
    parts: int = 1
    notes: list[str] = field(default_factory=list)


def read_volume(path: str | Path, *, largest: int = LARGEST_FILE) -> tuple[TetMesh, VolumeReport]:
    """Return the tetrahedra of a mesh file [mm] with a report of what was repaired.

    Cells of second order keep their corners; hexahedra, wedges and pyramids are split; inverted elements are turned.
    largest : greatest size of the file [byte]
    Raises `UserError` for a file that is missing, too large, unreadable, without volume cells, or holds numbers that
    are not finite, indices out of range or flat elements.
    """
    path = Path(path)
    raw = _read(path, largest)
    points = np.asarray(raw.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UserError(f"{path}: points have shape {points.shape}; (n, 3) is needed, a volume is three-dimensional")
    cells: dict[str, int] = {}
    for block in raw.cells:
        cells[block.type] = cells.get(block.type, 0) + len(block.data)
    blocks = [k for k, block in enumerate(raw.cells) if block.type in _CORNERS and len(block.data)]
    if not blocks:
        held = ", ".join(f"{n} {kind}" for kind, n in cells.items() if n) or "no cells at all"
        only = "only triangles" if set(cells) == {"triangle"} else held
        raise UserError(f"{path} holds {only}: a volume needs tetrahedra; mesh its inside first (e.g. with Gmsh)")
    labels = _labels(path, raw, blocks)
    tets, region, turn, split = [], [], [], 0
    for k in blocks:
        block = raw.cells[k]
        data = _indices(path, block, len(points))
        parts, owner = _split(data)
        split += 0 if data.shape[1] == 4 else len(data)
        tets.append(parts)
        turn.append(np.full(len(parts), data.shape[1] > 4))
        region.append(None if labels is None else labels[k][owner])
    mesh, report = _sound(path, points, np.concatenate(tets), np.concatenate(turn))
    kept = None if labels is None else np.concatenate([r for r in region if r is not None]).astype(np.int32)
    return mesh, _described(path, mesh, cells, kept, split, report)


def write_volume(
    path: str | Path,
    mesh: TetMesh,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
) -> None:
    """Write tetrahedra as VTU, MSH, VTK or MESH, by the ending of `path`.

    point_data : name -> (n, ...)   cell_data : name -> (e, ...)
    Raises `UserError` for an unknown ending or data that do not fit, `RunError` if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITABLE:
        raise UserError(
            f"{path}: volumes are written as {', '.join(WRITABLE)}, not {path.suffix or 'without ending'!r}"
        )
    for what, data, size in (("point", point_data, len(mesh.points)), ("cell", cell_data, len(mesh.tets))):
        for name, values in (data or {}).items():
            if np.ndim(values) < 1 or len(values) != size:
                raise UserError(f"{path}: {what} data {name!r} has shape {np.shape(values)}; {size} rows are needed")
    import meshio

    out = meshio.Mesh(
        mesh.points,
        [("tetra", mesh.tets)],
        point_data={name: np.asarray(v) for name, v in (point_data or {}).items()},
        cell_data={name: [np.asarray(v)] for name, v in (cell_data or {}).items()},
    )
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            out.write(path, **({"file_format": "gmsh", "binary": True} if path.suffix.lower() == ".msh" else {}))
    except OSError as error:
        raise RunError(f"{path} cannot be written: {error.strerror or error}") from error


def _read(path: Path, largest: int) -> Any:
    """Return what meshio makes of a file, whatever goes wrong turned into `UserError`."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise UserError(f"mesh file {path} cannot be read: {error.strerror or error}") from error
    if not path.is_file():
        raise UserError(f"mesh file {path} is no file; name a mesh file such as head.vtu")
    if size > largest:
        raise UserError(f"mesh file {path} has {size / 2**20:.0f} MB; at most {largest / 2**20:.0f} MB are read")
    if path.suffix.lower() not in READABLE:
        raise UserError(f"mesh file {path} ends in {path.suffix or 'nothing'!r}; known: {', '.join(READABLE)}")
    import meshio

    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path)
    except (Exception, SystemExit) as error:  # a broken file raises whatever its damage provokes, or ends the program
        lines = [line.strip() for line in (str(error) or said.getvalue()).splitlines() if line.strip()]
        why = lines[0] if lines and not isinstance(error, SystemExit) else type(error).__name__
        if isinstance(error, SystemExit):
            why = "meshio finds no such mesh in it"
        raise UserError(
            f"mesh file {path} cannot be read as {path.suffix.lower()} ({why}); export it again, or in another format"
        ) from error


def _labels(path: Path, raw: Any, blocks: list[int]) -> dict[int, Ints] | None:
    """Return the region of the cells of each of the `blocks`, None if the file names none."""
    for name in REGION_NAMES:
        if name not in raw.cell_data:
            continue
        data = raw.cell_data[name]
        out = {}
        for k in blocks:
            values = np.asarray(data[k]) if k < len(data) and data[k] is not None else np.zeros(0)
            if values.shape != (len(raw.cells[k].data),):
                raise UserError(f"{path}: cell data {name!r} has shape {values.shape}; one number per cell is needed")
            if not np.isfinite(values).all() or (values != np.round(values)).any() or np.abs(values).max() > 2**31 - 1:
                raise UserError(f"{path}: cell data {name!r} must hold whole numbers; each names a region")
            out[k] = values.astype(np.int32)
        return out
    return None


def _indices(path: Path, block: Any, n: int) -> np.ndarray:
    """Return the corners of the cells of a block, checked to be points."""
    data = np.asarray(block.data)
    if data.ndim != 2 or data.shape[1] < _CORNERS[block.type] or not np.issubdtype(data.dtype, np.integer):
        raise UserError(f"{path}: cells {block.type} have shape {data.shape} of {data.dtype}; export the mesh again")
    if len(data) > MOST_ELEMENTS:
        raise UserError(f"{path} holds {len(data)} cells; at most {MOST_ELEMENTS} are read, use a coarser mesh")
    data = data[:, : _CORNERS[block.type]]
    if data.min() < 0 or data.max() >= n:
        bad = int(np.argmax(((data < 0) | (data >= n)).any(axis=1)))
        raise UserError(f"{path}: cell {bad} ({block.type}) has corners {data[bad].tolist()} outside 0..{n - 1}")
    return data.astype(np.int64)


def _split(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tetrahedra (e, 4) that fill the cells (c, 4..8), and the cell of each, (e,).

    Every square face is cut through its corner with the smallest number, so that neighbours fit; a cell is then a fan
    of its outer triangles around its own smallest corner (Dompierre et al., 8th Int. Meshing Roundtable, 1999).
    """
    width = cells.shape[1]
    if width == 4:
        return cells, np.arange(len(cells))
    apex = cells.min(axis=1)
    tets, owner = [], []
    for square in _SQUARES[width]:
        face = cells[:, square]
        first = face.argmin(axis=1)
        turned = np.take_along_axis(face, (first[:, None] + np.arange(4)) % 4, axis=1)
        for triangle in ((0, 1, 2), (0, 2, 3)):
            tets.append(np.concatenate([apex[:, None], turned[:, triangle]], axis=1))
            owner.append(np.arange(len(cells)))
    for corner in _TRIANGLES[width]:
        tets.append(np.concatenate([apex[:, None], cells[:, corner]], axis=1))
        owner.append(np.arange(len(cells)))
    every, cell = np.concatenate(tets), np.concatenate(owner)
    away = (every[:, 1:] != every[:, :1]).all(axis=1)
    order = np.argsort(cell[away], kind="stable")
    return every[away][order], cell[away][order]


def _sound(path: Path, points: Floats, tets: np.ndarray, split: np.ndarray) -> tuple[TetMesh, dict[str, int]]:
    """Return a mesh without loose points and with positive volumes, and what was changed.

    split : (e,) elements made by splitting, whose orientation is not the file's
    """
    used, index = np.unique(tets, return_inverse=True)
    tets = index.reshape(-1, 4).astype(np.int32)
    loose = len(points) - len(used)
    points = points[used]
    if not np.isfinite(points).all():
        bad = int(used[np.argmin(np.isfinite(points).all(axis=1))])
        raise UserError(f"{path}: point {bad} holds a number that is not finite; export the mesh again")
    flip = TetMesh(points, tets).volumes < 0
    tets[flip] = tets[flip][:, [0, 2, 1, 3]]
    mesh = TetMesh(points, tets)
    flat = np.flatnonzero(mesh.quality < _FLAT)
    if flat.size:
        raise UserError(
            f"{path}: {flat.size} of {len(tets)} elements are flat, the first is {int(flat[0])} with points "
            f"{used[tets[flat[0]]].tolist()}; weld double points or mesh it again"
        )
    return mesh, {"flipped": int((flip & ~split).sum()), "loose": loose}


def _described(
    path: Path, mesh: TetMesh, cells: dict[str, int], region: Ints | None, split: int, change: dict[str, int]
) -> VolumeReport:
    """Return the report with its notes in words."""
    parts = int(mesh.parts.max()) + 1
    notes = []
    other = {kind: n for kind, n in cells.items() if kind not in _CORNERS and n}
    if other:
        notes.append("left out: " + ", ".join(f"{n} {kind}" for kind, n in other.items()))
    if split:
        notes.append(f"{split} cells that are no tetrahedra were split")
    if change["flipped"]:
        notes.append(f"{change['flipped']} inverted elements were turned")
    if change["loose"]:
        notes.append(f"{change['loose']} points that no element uses were left out")
    if parts > 1:
        notes.append(f"the volume falls into {parts} parts that do not hang together")
    return VolumeReport(str(path), cells, region, split=split, parts=parts, notes=notes, **change)
