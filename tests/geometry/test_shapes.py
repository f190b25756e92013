"""Shapes that tests and demonstrations stand on."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.geometry.shapes import sheet, sphere
from faceanim.ground.errors import UserError


def test_a_sheet_is_its_own_mirror_image() -> None:
    """Mirroring x gives the same points and, up to orientation, the same triangles."""
    mesh = sheet(6, 4, 12.0, 8.0, bulge=2.0)
    mirrored = mesh.points * [-1.0, 1.0, 1.0]
    twin = np.array([np.flatnonzero((mesh.points == p).all(axis=1))[0] for p in mirrored])
    sets = {tuple(sorted(t)) for t in mesh.triangles.tolist()}
    assert {tuple(sorted(t)) for t in twin[mesh.triangles].tolist()} == sets


def test_a_flat_sheet_has_its_area_and_faces_forward() -> None:
    """The triangles tile width times height, all normals along +z."""
    mesh = sheet(6, 4, 12.0, 8.0)
    assert mesh.areas.sum() == pytest.approx(96.0)
    assert (mesh.normals_by_area[:, 2] > 0).all()


def test_a_sphere_is_round_and_faces_outwards() -> None:
    """Vertices lie at the radius; the area comes near that of the sphere; normals point away from the centre."""
    mesh = sphere(10.0, 3)
    np.testing.assert_allclose(np.linalg.norm(mesh.points, axis=1), 10.0)
    assert mesh.areas.sum() == pytest.approx(400.0 * np.pi, rel=0.01)
    assert ((mesh.normals_by_area * mesh.points[mesh.triangles].mean(axis=1)).sum(axis=1) > 0).all()


def test_impossible_shapes_are_rejected() -> None:
    """An odd number of columns cannot be mirrored; a radius must be positive."""
    with pytest.raises(UserError, match="even"):
        sheet(3, 2, 1.0, 1.0)
    with pytest.raises(UserError, match="radius"):
        sphere(0.0)
