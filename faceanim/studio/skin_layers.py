"""The colours of a face as thin coloured layers over a plain skin, for a viewer that gives each mesh one colour.

Hair and brows, lips and lid margins, and the lining of the mouth are cut out of the skin along lines of equal tint of
its texture, in nested steps from faint to full, each lifted a little off the one beneath. Every point of a layer is a
fixed mean of skin vertices, so that the layers follow the skin by one sparse product.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from faceanim.face.attach import LIP, MUCOSA
from faceanim.ground.arrays import Floats, Ints

BASE = (204.0, 153.0, 131.0)
HAIR = (58.0, 44.0, 36.0)
RED = (186.0, 92.0, 86.0)
LINING = (112.0, 44.0, 42.0)
"""sRGB colours of skin, hair, lips, and of the mouth's lining."""
LIFT = 0.12
"""Height of each layer over the one beneath [mm]."""
_HAIR_STEPS = ((0.40, 0.62), (0.56, 1.0))
_RED_STEPS = ((0.34, 0.28), (0.50, 0.55), (0.66, 0.80))
"""Share of the tint from which a step covers the skin, and the share it is drawn with."""
_SPLIT = 4
_BLUR = 5.0
_SLIVER = 0.06
"""No cut is nearer to a corner than this share of the edge: slivers have no normal to shade them by."""


@dataclass(frozen=True, eq=False)
class Layer:
    """A coloured layer of skin.

    weights : (m, n) sparse, rows sum to 1: its points as means of skin vertices   lift : (m, 3) [mm] added to them
    triangles : (t, 3)   colour : sRGB bytes   moves : False over skin that never does
    """

    name: str
    weights: Any
    lift: Floats
    triangles: Ints
    colour: tuple[int, int, int]
    moves: bool = True

    def points(self, skin: Floats) -> np.ndarray:
        """Return where the layer is over the skin points (n, 3), (m, 3) [mm]."""
        return np.asarray(self.weights @ skin + self.lift, dtype=np.float32)


def skin_colour() -> tuple[int, int, int]:
    """Return the colour of the plain skin, sRGB bytes."""
    return _bytes(np.array(BASE))


def skin_layers(face: Any) -> list[Layer]:
    """Return the layers of `face` from the lowest to the highest; none if it has no texture coordinates."""
    if not len(face.uv):
        return []
    points, triangles = face.mesh.points, face.mesh.triangles
    n = len(points)
    inside = (face.region[triangles] == MUCOSA).all(axis=1)
    layers = [_layer("lining", sparse.identity(n, format="csr"), triangles[inside], face, 1, np.array(LINING))]
    tint = _tint(_texture_at(face, face.uv))
    at_vertex = _vertex_mean(face, tint, n)
    fine, pieces, hair = _split(face, np.flatnonzero(~inside).astype(np.int32))
    plain = sparse.identity(n, format="csr")
    layers += _steps(face, "red", _RED_STEPS, RED, (plain, triangles[~inside], at_vertex[:, 1]), 1)
    layers += _steps(face, "hair", _HAIR_STEPS, HAIR, (fine, pieces, hair), 1 + len(_RED_STEPS))
    still = face.pinned & (face.bone_weight[:, 0] == 1.0)
    layers = [part for layer in layers for part in _parted(layer, still)]
    return [layer for layer in layers if len(layer.triangles)]


def _steps(face: Any, name: str, steps: Any, full: Any, surface: tuple[Any, Ints, Floats], height: int) -> list[Layer]:
    """Return the nested layers of one tint; what the next one covers is left out."""
    weights, triangles, share = surface
    layers = []
    for k, (level, mix) in enumerate(steps):
        above = steps[k + 1][0] if k + 1 < len(steps) else np.inf
        seen = triangles[share[triangles].min(axis=1) <= above]
        rows, cut = region_above(weights, seen, share, level)
        layers.append(_layer(f"{name}_{k + 1}", rows, cut, face, height + k, _mixed(full, mix)))
    return layers


def _parted(layer: Layer, still: np.ndarray) -> list[Layer]:
    """Return the moving part of `layer` and the part over skin that never moves, `still` (n,)."""
    fixed = np.asarray(layer.weights @ (~still).astype(np.float64)) == 0.0
    rigid = fixed[layer.triangles].all(axis=1)
    parts = []
    for triangles, moves in ((layer.triangles[~rigid], True), (layer.triangles[rigid], False)):
        used, local = np.unique(triangles, return_inverse=True)
        name = layer.name if moves else f"{layer.name}_still"
        parts.append(
            Layer(
                name, layer.weights[used], layer.lift[used], local.reshape(-1, 3).astype(np.int32), layer.colour, moves
            )
        )
    return parts


def _layer(name: str, weights: Any, triangles: Ints, face: Any, height: int, colour: Floats) -> Layer:
    used, local = np.unique(triangles, return_inverse=True)
    rows = weights[used]
    lift = height * LIFT * np.asarray(rows @ face.mesh.vertex_normals)
    return Layer(name, rows, lift, local.reshape(-1, 3).astype(np.int32), _bytes(colour))


def _mixed(colour: tuple[float, float, float], share: float) -> Floats:
    return (1.0 - share) * np.array(BASE) + share * np.array(colour)


def _bytes(colour: Floats) -> tuple[int, int, int]:
    r, g, b = (int(v) for v in np.clip(np.round(colour), 0, 255))
    return r, g, b


def _texture_at(face: Any, uv: np.ndarray) -> Floats:
    """Return the texture's colour at `uv` (k, 2), a little blurred, (k, 3) sRGB bytes."""
    import cv2

    picture = cv2.GaussianBlur(face.texture, (0, 0), _BLUR * face.texture.shape[0] / 2048.0 + 1e-3)
    height, width = picture.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1.0 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return np.asarray(picture[row, column], dtype=np.float64)


def _tint(colour: Floats) -> Floats:
    """Return how much hair and how much red is in `colour` (k, 3), (k, 2) in [0, 1]: least squares of a mixture."""
    basis = np.stack([np.array(HAIR) - BASE, np.array(RED) - BASE], axis=1)
    share = (colour - np.array(BASE)) @ np.linalg.pinv(basis).T
    return np.clip(share, 0.0, 1.0)


def _vertex_mean(face: Any, values: Floats, n: int) -> Floats:
    """Return the mean over its texture corners for each of the `n` vertices, (n, k)."""
    total, count = np.zeros((n, values.shape[1])), np.zeros(n)
    np.add.at(total, face.mesh.triangles.ravel(), values[face.uv_triangles.ravel()])
    np.add.at(count, face.mesh.triangles.ravel(), 1.0)
    return np.asarray(total / np.maximum(count, 1.0)[:, None])


def _split(face: Any, chosen: Ints) -> tuple[Any, Ints, Floats]:
    """Return the triangles `chosen` in pieces fine enough for brows: weights (m, n), pieces (t, 3), hair share (m,)."""
    grid = [(i, j) for i in range(_SPLIT + 1) for j in range(_SPLIT + 1 - i)]
    place = {ij: k for k, ij in enumerate(grid)}
    corner = np.array([(_SPLIT - i - j, i, j) for i, j in grid]) / _SPLIT
    piece = [(place[i, j], place[i + 1, j], place[i, j + 1]) for i, j in grid if i + j < _SPLIT]
    piece += [(place[i + 1, j], place[i + 1, j + 1], place[i, j + 1]) for i, j in grid if i + j < _SPLIT - 1]
    uv = np.einsum("pc,tcd->tpd", corner, face.uv[face.uv_triangles[chosen]])
    hair = _tint(_texture_at(face, uv.reshape(-1, 2)))[:, 0].reshape(len(chosen), -1)
    lips = (face.region[face.mesh.triangles[chosen]] == LIP).any(axis=1)
    some = (hair.max(axis=1) > _HAIR_STEPS[0][0]) & ~lips
    whole = some & (hair.min(axis=1) > _HAIR_STEPS[-1][0])
    some &= ~whole
    dark, kept, hair = face.mesh.triangles[chosen[whole]], chosen[some], hair[some]
    count, width = len(kept), len(grid)
    rows = np.repeat(np.arange(count * width), 3)
    columns = np.repeat(face.mesh.triangles[kept], width, axis=0).reshape(-1)
    weights = sparse.csr_matrix(
        (np.tile(corner, (count, 1)).reshape(-1), (rows, columns)), shape=(count * width, len(face.mesh.points))
    )
    pieces = (np.array(piece)[None] + width * np.arange(count)[:, None, None]).reshape(-1, 3)
    n = len(face.mesh.points)
    weights = sparse.vstack([sparse.identity(n, format="csr"), weights], format="csr")
    return weights, np.concatenate([dark, n + pieces]).astype(np.int32), np.concatenate([np.ones(n), hair.reshape(-1)])


def region_above(weights: Any, triangles: Ints, values: Floats, level: float) -> tuple[Any, Ints]:
    """Return the part of a surface on which `values` (k,), linear over its triangles, exceed `level`.

    weights : (k, n) sparse, the surface's points as means of others
    Returns the weights of old and new points, (k + c, n), and the triangles of the part.
    """
    above = values > level
    count = above[triangles].sum(axis=1)
    whole = triangles[count == 3]
    cut = np.concatenate(
        [_odd_first(triangles[count == 1], above, True), _odd_first(triangles[count == 2], above, False)]
    )
    if not len(cut):
        return weights, whole
    ends = np.concatenate([cut[:, [0, 1]], cut[:, [0, 2]]])
    pairs, which = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    share = (level - values[pairs[:, 0]]) / (values[pairs[:, 1]] - values[pairs[:, 0]])
    share = np.clip(share, _SLIVER, 1.0 - _SLIVER)
    new = sparse.diags(1.0 - share) @ weights[pairs[:, 0]] + sparse.diags(share) @ weights[pairs[:, 1]]
    crossing = (len(values) + which.reshape(2, -1)).T
    lone = count[count == 1].size
    a, b, c = cut.T
    ab, ac = crossing.T
    parts = [
        whole,
        np.stack([a, ab, ac], axis=1)[:lone],
        np.stack([ab, b, c], axis=1)[lone:],
        np.stack([ab, c, ac], axis=1)[lone:],
    ]
    return sparse.vstack([weights, new], format="csr"), np.concatenate(parts).astype(np.int32)


def _odd_first(triangles: Ints, above: np.ndarray, odd: bool) -> Ints:
    """Return `triangles` turned so that the corner of which `above` is `odd` comes first."""
    first = np.argmax(above[triangles] == odd, axis=1) if len(triangles) else np.zeros(0, dtype=int)
    return np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
