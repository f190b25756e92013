"""Triangulate the three densities, number them for memory locality and write the face files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse as sp
from assets_face import (
    EAR,
    LID,
    LIP,
    MIDLINE,
    MUCOSA,
    NECK,
    PAIRED,
    SCALP,
    SKIN,
    Control,
    Samples,
    select,
)  # fmt: skip
from assets_outline import HAIR, THROAT, inside_outline
from assets_subdivision import mixed_triangles, subdivide_corners
from scipy.sparse.csgraph import reverse_cuthill_mckee

SHARES = {"coarse": 0.0, "default": 0.29, "fine": 0.245}


def level_triangles(samples: Samples, control: Control, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles, texture triangles and texture points of one density, in the numbering of the samples."""
    uv, uv_faces, mirror_face = control.uv, control.uv_faces, control.mirror_face
    level = 1 if name == "fine" else 0
    if level:
        uv, uv_faces = subdivide_corners(uv, uv_faces)
        mirror_face = _mirror_faces(samples.levels[1].faces, samples.mirror)
    mesh = samples.levels[level]
    selected = np.zeros(len(mesh.faces), bool)
    if SHARES[name] > 0:
        selected = select(samples, level, SHARES[name])
        selected &= selected[mirror_face]
    uv_next, _ = subdivide_corners(uv, uv_faces)
    triangles, uv_triangles = mixed_triangles(mesh, selected, samples.points, mirror_face, (uv_faces, len(uv)))
    return triangles, uv_triangles, uv_next


def _mirror_faces(faces: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    table = {tuple(sorted(q)): i for i, q in enumerate(faces.tolist())}
    return np.array([table[tuple(sorted(q))] for q in mirror[faces].tolist()])


def locality_order(triangles: np.ndarray, n_points: int) -> np.ndarray:
    """Reverse Cuthill-McKee order of the vertices, (n_points,) old index at each new place."""
    rows, cols = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    graph = sp.csr_matrix((np.ones(len(rows)), (rows, cols)), shape=(n_points, n_points))
    return reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)


def regions(samples: Samples) -> np.ndarray:
    """Region label of every sample point, (n2,) uint8."""
    p = samples.points
    out = np.full(len(p), SKIN, np.uint8)
    out[inside_outline(p, HAIR) > 0] = SCALP
    out[inside_outline(p, THROAT) > 0] = NECK
    out[(np.hypot((p[:, 1] + 2.0) / 32.0, (p[:, 2] + 2.0) / 20.0) < 1.0) & (np.abs(p[:, 0]) > 60.0)] = EAR
    out[(samples.lip_ring >= -7.05) & (samples.lip_ring < 90)] = LIP
    out[(samples.lip_ring > 0.6) | (samples.cavity > 0.4)] = MUCOSA
    out[samples.lid_ring >= -0.25] = LID
    return out


def contact_lists(samples: Samples, used: np.ndarray) -> dict[str, np.ndarray]:
    """Vertices of the lip and lid surfaces that can touch, as sample indices."""
    p = samples.points
    lip = (samples.lip_ring > -5.6) & (samples.lip_ring < 2.4) & used
    out = {"lip_upper": np.flatnonzero(lip & (samples.side > 0)), "lip_lower": np.flatnonzero(lip & (samples.side < 0))}
    lid = (samples.lid_ring > -2.6) & used
    for side, sign in (("left", 1.0), ("right", -1.0)):
        mine = lid & (p[:, 0] * sign > 0)
        rim = p[mine & (np.abs(samples.lid_ring) < 0.3)]
        inner, outer = rim[np.argmin(np.abs(rim[:, 0]))], rim[np.argmax(np.abs(rim[:, 0]))]
        line = np.interp(np.abs(p[:, 0]), np.abs([inner[0], outer[0]]), [inner[1], outer[1]])
        out[f"lid_upper_{side}"] = np.flatnonzero(mine & (p[:, 1] >= line))
        out[f"lid_lower_{side}"] = np.flatnonzero(mine & (p[:, 1] < line))
    return out


def landmarks(control: Control) -> dict[str, int]:
    """Landmark name to control vertex (the same index in every density before renumbering)."""
    where = {int(b): i for i, b in enumerate(control.base_index)}
    out = {name: where[b] for name, b in MIDLINE.items()}
    for name, b in PAIRED.items():
        out[f"{name}_left"] = where[b]
        out[f"{name}_right"] = int(control.mirror[where[b]])
    return out


def write_face(samples: Samples, control: Control, name: str, path: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Assemble one density and write it; returns the arrays and the sample index of each vertex."""
    triangles, uv_triangles, uv = level_triangles(samples, control, name)
    used, inverse = np.unique(triangles, return_inverse=True)
    triangles = inverse.reshape(-1, 3)
    order = used[locality_order(triangles, len(used))]
    new = np.full(len(samples.points), -1)
    new[order] = np.arange(len(order))
    triangles = new[used][triangles]
    triangles, uv_triangles = _sorted_triangles(triangles, uv_triangles)
    uv_used, uv_inverse = np.unique(uv_triangles, return_inverse=True)
    mark = landmarks(control)
    mask = np.zeros(len(samples.points), bool)
    mask[used] = True
    zeros = np.zeros(len(order), np.float32)
    arrays: dict[str, np.ndarray] = {
        "points": samples.points[order],
        "triangles": triangles.astype(np.int32),
        "uv": uv[uv_used].astype(np.float32),
        "uv_triangles": uv_inverse.reshape(-1, 3).astype(np.int32),
        "mirror": new[samples.mirror[order]].astype(np.int32),
        "region": regions(samples)[order],
        "landmark_names": np.array(list(mark), dtype="<U32"),
        "landmark_index": new[np.array(list(mark.values()))].astype(np.int32),
        "depth": zeros, "depth_jaw": zeros, "depth_cranium": zeros,
    }  # fmt: skip
    for key, index in contact_lists(samples, mask).items():
        arrays[key] = np.sort(new[index]).astype(np.int32)
    if name != "fine":
        arrays["artist_names"] = np.array(list(samples.units), dtype="<U32")
        arrays["artist"] = np.stack([f[order] for f in samples.units.values()]).astype(np.float16)
    keep_depths(arrays, path)
    np.savez_compressed(path, **arrays)
    return arrays, order


def keep_depths(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Keep the tissue depths a skull build has written into `path`, as long as the vertices are the same."""
    if not path.exists():
        return
    with np.load(path, allow_pickle=False) as old:
        if old["points"].shape == arrays["points"].shape and np.allclose(old["points"], arrays["points"], atol=1e-9):
            for key in ("depth", "depth_jaw", "depth_cranium"):
                arrays[key] = old[key]


def _sorted_triangles(triangles: np.ndarray, uv_triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles rotated to start at their lowest vertex and sorted by it."""
    turn = np.argmin(triangles, axis=1)
    pick = (turn[:, None] + np.arange(3)) % 3
    row = np.arange(len(triangles))[:, None]
    triangles, uv_triangles = triangles[row, pick], uv_triangles[row, pick]
    order = np.lexsort((triangles[:, 2], triangles[:, 1], triangles[:, 0]))
    return triangles[order], uv_triangles[order]
