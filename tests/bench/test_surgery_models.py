"""The benchmark of four models: its noise is what it says, its registration undoes rigid motion, its tables are whole."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest

from faceanim.backends.mixed_fem.options import MODELS
from faceanim.bench.surgery_charts import chart, csv_text, markdown, noisy_share
from faceanim.bench.surgery_models import MOVES, PAPER, Row, reference, registered, run
from faceanim.bench.synthetic_truth import LENGTH, SIGMA, noise, patches
from faceanim.face.skull import rotation
from faceanim.surgery.distance_map import statistics
from faceanim.surgery.plan import plan_names


def sheet(n: int = 60, step: float = 1.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    return np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)


def test_noise_has_its_size_and_length() -> None:
    """Along the normals only, with the declared deviation, and correlated by 1/e over the declared length."""
    points = sheet()
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    drawn = np.stack([noise(points, normals, seed)[:, 2] for seed in range(6)]).reshape(6, 60, 60)
    assert np.abs(noise(points, normals, 0)[:, :2]).max() == 0.0
    assert drawn.std() == pytest.approx(SIGMA, rel=0.1)
    lag = int(LENGTH)
    correlation = (drawn[:, :, lag:] * drawn[:, :, :-lag]).mean() / drawn.var()
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.1)
    np.testing.assert_array_equal(noise(points, normals, 3), noise(points, normals, 3))


def test_patches_stay_within_their_bounds_and_vary_slowly() -> None:
    """A field in [-1, 1] with both signs, that changes little over a tenth of its width."""
    points = sheet(40, 3.0)
    field = patches(points, 30.0, 1)
    assert -1.0 <= field.min() < -0.4 and 0.4 < field.max() <= 1.0
    assert np.abs(np.diff(field.reshape(40, 40), axis=1)).max() < 0.4


def test_registration_undoes_a_rigid_motion() -> None:
    """Points turned and shifted come back where they were, by the chosen ones alone."""
    random = np.random.default_rng(2)
    points = random.normal(size=(50, 3)) * 30.0
    moved = points @ rotation(np.array([0.2, 1.0, 0.1]), 0.1).T + [2.0, -1.0, 3.0]
    chosen = np.arange(50) < 20
    np.testing.assert_allclose(registered(moved, points, chosen), points, atol=1e-9)


def rows() -> list[Row]:
    random = np.random.default_rng(0)
    out = []
    for move in MOVES[:2]:
        for k, model in enumerate(MODELS):
            for seed in (None, 1, 2):
                figures = statistics((0.2 + 0.1 * k) * random.normal(size=500), np.ones(500))
                out.append(Row(move, model, seed, 1.0, 3.0 + k, figures, figures))
    out.append(Row(MOVES[2], "linear", None, 0.4, 9.0, None, None, "no balance"))
    return out


def test_tables_hold_every_row_and_failures(tmp_path: Path) -> None:
    """The CSV has all rows, the Markdown those without noise; a failure is a row with its reason."""
    table = list(csv.DictReader(io.StringIO(csv_text(rows()))))
    assert len(table) == len(rows()) and table[-1]["failure"] == "no balance" and table[-1]["moved_mean"] == ""
    text = markdown(rows(), statistics(np.zeros(5), np.ones(5)))
    assert text.count("\n| mid") == 9 and "no balance beyond 40%" in text and "95 %" in text
    assert noisy_share(rows(), rows()[-1]) is None
    chart(rows(), tmp_path / "four.png")
    assert (tmp_path / "four.png").stat().st_size > 10_000


def test_the_moves_are_built_in_and_the_models_are_the_papers() -> None:
    """Every move is a plan that comes with the project, every published figure has its model."""
    assert set(MOVES) <= set(plan_names())
    assert set(PAPER) == set(MODELS)


@pytest.mark.slow
def test_the_mixed_model_meets_the_truth() -> None:
    """On a mandibular advancement, without noise: mean below 0.5 mm and 95 % below 1.5 mm in the moved region."""
    first = next(iter(run("mandible_advance", "mixed", reference("mandible_advance"))))
    assert first.moved is not None
    assert first.moved.mean < 0.5 and first.moved.p95 < 1.5
    worse = next(iter(run("mandible_advance", "linear", reference("mandible_advance"))))
    assert worse.moved is not None and worse.moved.mean > first.moved.mean
