"""The calibrated muscles of the default face against the artist's shapes and against published movements."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.bench.faithfulness import ARTIST_UNITS, Poser, artist_fields, artist_matches, match_field, movements
from faceanim.face.library import load_face


@pytest.fixture(scope="module")
def poser() -> Poser:
    """The default face, each action unit solved once."""
    return Poser(load_face())


def test_a_field_matches_itself() -> None:
    """An artist's field compared with itself has cosine 1 and the same peak; turned round, cosine -1."""
    face = load_face("default", "coarse")
    for unit, name in ARTIST_UNITS.items():
        field = artist_fields("coarse")[name]
        same = match_field(face, unit, name, field, field)
        assert same.mean_cosine == pytest.approx(1.0)
        assert same.peak_ratio == pytest.approx(1.0)
        assert match_field(face, unit, name, -field, field).mean_cosine == pytest.approx(-1.0)


@pytest.mark.slow
def test_action_units_move_as_the_artist_shapes_do(poser: Poser) -> None:
    """Mean cosine at least 0.80 over the moving region, peak within 30 %."""
    for match in artist_matches(poser):
        assert match.mean_cosine >= 0.80, match
        assert 0.70 <= match.peak_ratio <= 1.30, match


@pytest.mark.slow
def test_movements_lie_in_the_published_ranges(poser: Poser) -> None:
    """Smile, brow, nose, lids, jaw, pucker and funnel reach what people reach."""
    for movement in movements(poser):
        assert movement.inside, movement


@pytest.mark.slow
def test_the_smile_does_not_depend_on_the_density(poser: Poser) -> None:
    """The mouth corner moves equally far on 3,774, 7,285 and 26,712 vertices, within 5 %."""
    corner = poser.face.landmarks["cheilion_left"]
    wanted = np.linalg.norm(poser.displacement("12")[corner])
    for density in ("coarse", "fine"):
        other = Poser(load_face(density=density))
        moved = np.linalg.norm(other.displacement("12")[other.face.landmarks["cheilion_left"]])
        assert moved == pytest.approx(wanted, rel=0.05)
