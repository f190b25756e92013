"""Laws of cuts through flesh."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from faceanim.face.library import load_face
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import RunError, UserError
from faceanim.render.tissue_picture import draw_cut, sections


def _area(polygon: np.ndarray) -> float:
    x = polygon - polygon[0]
    return float(np.linalg.norm(sum(np.cross(x[i], x[i + 1]) for i in range(1, len(x) - 1))) / 2.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_sections_fill_the_cut(axis: int) -> None:
    """The polygons of a box lie in the plane and together have the area of its cross-section."""
    size = (2.0, 3.0, 4.0)
    box = box_tets((2, 2, 2), size)
    polygons, element = sections(box.points, box.tets, axis, 0.7)
    assert len(polygons) == len(element) and all(np.allclose(p[:, axis], 0.7) for p in polygons)
    assert sum(map(_area, polygons)) == pytest.approx(np.prod(size) / size[axis])
    assert sections(box.points, box.tets, axis, 9.0)[0] == []


def test_a_cut_is_drawn(tmp_path: Path) -> None:
    """Skin, muscle and bone have their colours in the picture; a plane beside the head and a bad axis are refused."""
    face = load_face("default", "coarse")
    picture = cv2.imread(str(draw_cut(face, tmp_path / "cut.png", place=8.0, dpi=80)))
    assert picture is not None
    for red, green, blue in ((0xE3, 0xB0, 0x92), (0xB5, 0x48, 0x3F), (0xB9, 0xB4, 0xA6)):
        assert (np.abs(picture.astype(int) - [blue, green, red]).max(axis=2) < 12).sum() > 50
    with pytest.raises(UserError, match="meets no flesh; it spans"):
        draw_cut(face, tmp_path / "no.png", place=300.0)
    with pytest.raises(UserError, match="axis 'w' must be"):
        draw_cut(face, tmp_path / "no.png", axis="w")
    with pytest.raises(RunError, match="could not be written"):
        draw_cut(face, tmp_path / "none" / "cut.png")
