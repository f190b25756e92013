"""The page of a comparison: whole, safe whatever names hold, and in order."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from comparisons import failed_row, made_comparison, made_row
from PIL import Image

from faceanim.bench.comparison.page import HEADS, page
from faceanim.bench.comparison.rows import Comparison, front
from faceanim.ground.errors import UserError

VOID = {"meta", "img", "input", "br", "path", "line", "rect"}
NASTY = '</td></tr><script>alert("x")</script><img src=x onerror=\'a()\'> "&amp; ${x} \u6c34'


class Page(HTMLParser):
    """A page taken apart: tags with their attributes, text, cells; complains about tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.rows: list[list[dict[str, str | None]]] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names)), f"<{tag}> has an attribute twice"
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append(dict(attrs))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        """Return the attributes of all tags of that name."""
        return [attrs for name, attrs in self.tags if name == tag]


@pytest.fixture
def chart(tmp_path: Path) -> Path:
    path = tmp_path / "chart.png"
    Image.fromarray(np.full((20, 30, 3), 90, np.uint8)).save(path)
    return path


def made_page(comparison: Comparison, chart: Path) -> tuple[Page, str]:
    text = page(comparison, chart, chart.parent)
    return Page(text), text


def test_the_page_is_whole_and_loads_nothing(chart: Path) -> None:
    """Tags match, ids are unique, every link leads to one of them, and nothing comes from elsewhere."""
    found, text = made_page(made_comparison(), chart)
    assert text.startswith("<!DOCTYPE html>")
    assert "http://" not in text and "https://" not in text and "@import" not in text and "url(" not in text
    for tag, attrs in found.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        assert (attrs.get("src") or "data:").startswith("data:") and not (tag == "script" and "src" in attrs)
    ids = [attrs["id"] for _, attrs in found.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    assert all((attrs["href"] or "")[1:] in ids for attrs in found.named("a"))


def test_every_row_is_in_the_table_and_on_the_scatter(chart: Path) -> None:
    """Each label appears; each row that counts has a mark; rows of the front are told apart; failures give reasons."""
    comparison = made_comparison()
    found, _ = made_page(comparison, chart)
    text = "".join(found.text)
    assert all(row.label in text for row in comparison.rows)
    assert all(row.reason in text for row in comparison.rows)
    assert len(found.named("a")) == sum(row.counts for row in comparison.rows)
    kinds = [attrs.get("class") for attrs in found.named("tr")]
    assert kinds.count("front") == len(front(comparison.rows)) and kinds.count("failed") == 5
    assert kinds[-5:] == ["failed"] * 5


def test_values_to_sort_by_are_numbers_in_their_columns(chart: Path) -> None:
    """Every row fills all columns; costs are numeric and ascending, as the heading says."""
    found, _ = made_page(made_comparison(), chart)
    head, *rows = found.rows
    place = HEADS.index("cost [ms/frame]")
    assert len(head) == len(HEADS) and head[place]["aria-sort"] == "ascending"
    assert sum(cell["aria-sort"] == "none" for cell in head) == len(HEADS) - 1
    for cells in rows:
        assert sum(int(cell.get("colspan") or 1) for cell in cells) == len(HEADS)
        assert all(np.isfinite(float(cell["data-value"] or "")) for cell in cells if "data-value" in cell)
    costs = [float(cells[place]["data-value"] or "") for cells in rows[:-5]]
    assert costs == sorted(costs) and len(costs) == 43


def test_nasty_names_stay_text(chart: Path) -> None:
    """Names, reasons and settings that look like tags make no tags and no attributes."""
    names = {"label": NASTY, "backend": NASTY, "scheme": NASTY, "density": NASTY, "settings": {NASTY: NASTY}}
    rows = [made_row(**names), failed_row(NASTY, NASTY, **names)]
    comparison = made_comparison(rows=rows, title=NASTY, scene=NASTY, reference=NASTY, machine=NASTY)
    found, text = made_page(comparison, chart)
    assert len(found.named("script")) == 1 and len(found.named("img")) == 1
    assert "<script>alert" not in text
    assert not any(name.startswith("on") for _, attrs in found.tags for name in attrs)
    assert sum(NASTY in part for part in found.text) >= 6


def test_pictures_are_embedded_small_and_only_from_their_folder(chart: Path) -> None:
    """A picture is shown; missing, broken and outside ones are left out."""
    folder = chart.parent / "table"
    folder.mkdir()
    Image.fromarray(np.full((900, 1200, 3), 60, np.uint8)).save(folder / "good.png")
    (folder / "broken.png").write_bytes(b"no picture")
    names = ["good.png", "missing.png", "broken.png", "../chart.png", str(chart), "nul\0.png", "", None]
    rows = [made_row(key=str(k), picture=name) for k, name in enumerate(names)]
    found = Page(page(made_comparison(rows=rows), chart, folder))
    images = [attrs["src"] or "" for attrs in found.named("img")]
    assert len(images) == 2 and images[1].startswith("data:image/jpeg;base64,") and len(images[1]) < 20000


@pytest.mark.parametrize("rows", [[], [made_row()], [failed_row()], [made_row(along=None)]])
def test_any_number_of_rows_makes_a_page(rows: list, chart: Path) -> None:
    """None, one, or none that counts."""
    found, _ = made_page(made_comparison(rows=rows), chart)
    assert len(found.rows) == 1 + len(rows)


def test_a_missing_chart_is_named(tmp_path: Path) -> None:
    """Without its chart there is no page."""
    with pytest.raises(UserError, match=r"no\.png cannot be read"):
        page(made_comparison(), tmp_path / "no.png", tmp_path)
