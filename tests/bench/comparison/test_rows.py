"""Laws of the rows of a comparison: who stands on the front, and that files give back what was written."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from itertools import pairwise

import pytest
from comparisons import errors, failed_row, made_comparison, made_row
from hypothesis import given
from hypothesis import strategies as st

from faceanim.bench.comparison.rows import (
    CLOSE,
    COLUMNS,
    Errors,
    Row,
    as_csv,
    as_json,
    excess,
    front,
    grade,
    load,
    worst,
)
from faceanim.ground.errors import UserError

# Half of the costs are close together, so that chains of them occur.
COSTS = st.one_of(st.floats(0.05, 500.0), st.integers(0, 9).map(lambda k: 1.1**k))
PAIRS = st.lists(st.tuples(COSTS, st.floats(0.001, 10.0)), max_size=25)


def row(cost: float, error: float, label: str = "", **changes: object) -> Row:
    """Return a row of that cost [ms] and error [mm]."""
    fields = {"frame_ms": cost, "rest": None, "along": errors(error), "label": label, "key": label} | changes
    return made_row(**fields)


def rows_of(pairs: list[tuple[float, float]]) -> list[Row]:
    return [row(cost, error, str(k)) for k, (cost, error) in enumerate(pairs)]


def labels(rows: list[Row]) -> list[str]:
    return [r.label for r in rows]


def cost(r: Row) -> float:
    assert r.frame_ms is not None
    return r.frame_ms


@given(PAIRS)
def test_no_row_of_the_front_is_beaten(pairs: list[tuple[float, float]]) -> None:
    """No other row is at least as good in both and better in one; one of the best grade is always there."""
    rows = rows_of(pairs)
    best = front(rows)
    for kept in best:
        for other in rows:
            better = cost(other) < cost(kept) or worst(other) < worst(kept)
            assert not (better and cost(other) <= cost(kept) and worst(other) <= worst(kept))
        assert excess(kept, rows) == 1.0
    if rows:
        assert min(map(grade, rows)) == grade(best[-1])


@given(PAIRS)
def test_the_front_is_a_sparse_staircase_that_covers_every_row(pairs: list[tuple[float, float]]) -> None:
    """Costs rise by more than the noise while errors fall; every row has an equal on the front, but for noise."""
    rows = rows_of(pairs)
    best = front(rows)
    for a, b in pairwise(best):
        assert cost(b) > CLOSE * cost(a) and worst(b) < worst(a)
    for r in rows:
        assert any(grade(f) <= grade(r) and cost(f) <= CLOSE * cost(r) for f in best)


@given(PAIRS.filter(bool), st.data())
def test_a_dominated_row_changes_nothing(pairs: list[tuple[float, float]], data: st.DataObject) -> None:
    """A row that is dearer and worse than another neither joins the front nor takes anybody off it."""
    rows = rows_of(pairs)
    model = data.draw(st.sampled_from(rows))
    factors = data.draw(st.tuples(st.floats(1.0, 3.0), st.floats(1.001, 3.0)))
    late = row(cost(model) * factors[0], worst(model) * factors[1], "late")
    assert labels(front([late, *rows])) == labels(front(rows))


@given(PAIRS, st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(pairs: list[tuple[float, float]], random: object) -> None:
    """The front is the same however rows are shuffled."""
    rows = rows_of(pairs)
    mixed = list(rows)
    random.shuffle(mixed)  # type: ignore[attr-defined]
    assert labels(front(mixed)) == labels(front(rows))


BANDED = st.lists(
    st.tuples(st.integers(0, 12), st.floats(1.0, 1.05), st.floats(1 / 1.03, 1.03)), min_size=1, max_size=20
)


@given(BANDED, st.permutations(range(20)))
def test_noise_within_bands_changes_nothing(bands: list[tuple[int, float, float]], ranks: list[int]) -> None:
    """Rows in bands of 5 %, the bands 40 % apart: 3 % of noise in every cost leaves the front as it is."""
    quiet = [row(1.4**k * within, 0.1 + ranks[n], str(n)) for n, (k, within, _) in enumerate(bands)]
    noisy = [replace(r, frame_ms=cost(r) * noise) for r, (_, _, noise) in zip(quiet, bands)]
    assert set(labels(front(noisy))) == set(labels(front(quiet)))


@given(PAIRS.filter(bool), st.lists(st.floats(1 / 1.03, 1.03), min_size=25, max_size=25))
def test_noise_moves_the_front_by_little(pairs: list[tuple[float, float]], noise: list[float]) -> None:
    """Whatever noise does to membership, the staircase moves by the noise and one band at most."""
    quiet = rows_of(pairs)
    noisy = [replace(r, frame_ms=cost(r) * factor) for r, factor in zip(quiet, noise)]
    for a, b in ((quiet, noisy), (noisy, quiet)):
        for r in front(a):
            cheapest = min(cost(f) for f in front(b) if grade(f) <= grade(r))
            assert cheapest <= CLOSE * 1.03 * cost(r) * (1.0 + 1e-12)


def test_a_chain_of_close_rows_keeps_its_cheap_end() -> None:
    """Twenty rows, each 10 % dearer and a little better than the last: the front spans them all, a band apart."""
    chain = rows_of([(1.1**k, 1.0 - 0.04 * k) for k in range(20)])
    best = front(chain)
    assert cost(best[0]) <= CLOSE and grade(best[-1]) == grade(chain[-1])
    assert len(best) == 10


def test_a_gain_of_less_than_a_band_is_none() -> None:
    """Twice the cost for half a per cent of accuracy does not stand on the front; for half of the error it does."""
    rows = rows_of([(1.0, 1.015), (2.0, 1.005), (4.0, 0.5)])
    assert [cost(r) for r in front(rows)] == [1.0, 4.0]


def test_only_finished_and_finite_rows_count() -> None:
    """Failed rows, rows without cost, and rows with an error that is no number stand on no front."""
    nan = Errors(float("nan"), 1.0, 1.0, 1.0)
    off = [failed_row(), row(1.0, 1.0, outcome="inverted"), row(1.0, 1.0, frame_ms=None), row(1.0, 1.0, along=nan)]
    off += [row(1.0, 1.0, rest=nan), row(1.0, 1.0, frame_ms=0.0), row(1.0, float("inf"))]
    assert front(off) == [] and front([]) == []


def test_equal_errors_leave_the_cheaper_one() -> None:
    """Of two rows of the same error only the cheaper stays."""
    assert labels(front([row(5.0, 1.0, "dear"), row(1.0, 1.0, "cheap")])) == ["cheap"]


def test_written_comparisons_are_read_back() -> None:
    """What was saved is loaded again, all rows and settings."""
    comparison = made_comparison()
    assert load(as_json(comparison), "x.json") == comparison


def test_errors_that_are_no_numbers_do_not_spoil_the_file() -> None:
    """A row whose error is not finite is written without it, and the file can be read."""
    broken = made_row(along=Errors(float("nan"), 1.0, 1.0, 1.0), outcome="failed", reason="no number")
    back = load(as_json(made_comparison(rows=[broken])), "x.json")
    assert back.rows[0].along is None and back.rows[0].reason == "no number"


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"scene": 3}', b"\xff\xfe"])
def test_other_files_are_refused_by_name(data: bytes) -> None:
    """What is no comparison raises an error that names the file."""
    with pytest.raises(UserError, match=r"old\.json is not a comparison"):
        load(data, "old.json")


def test_csv_has_every_row_and_marks_the_front() -> None:
    """The table has all columns, one line a row whatever its label, and as many marks as the front has rows."""
    nasty = made_row(label='a "quoted", label\nof two lines', frame_ms=0.01, settings={"k": 1.5, "of": "x"})
    twin = row(1e4, 50.0, "twin", key="k0")
    comparison = made_comparison(rows=[*made_comparison().rows, replace(nasty, key="k0"), twin])
    table = list(csv.DictReader(io.StringIO(as_csv(comparison))))
    assert len(table) == len(comparison.rows) and tuple(table[0]) == COLUMNS
    assert table[-2]["label"] == nasty.label and table[-2]["settings"] == "k=1.5 of=x"
    assert sum(line["on_front"] == "True" for line in table) == len(front(comparison.rows))
    assert table[-1]["on_front"] == "False"  # the same key as one on the front
    assert float(table[-2]["step_ms"]) == pytest.approx(1e3 / 60.0, rel=1e-5)
    assert json.loads(as_json(comparison))["rows"][-2]["label"] == nasty.label
