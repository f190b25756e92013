"""Make the pictures and tables that README.md shows, with the program itself, and put the tables into README.md.

Run `python tools/make_docs.py` in the repository after the constants or the face have changed (a few minutes).
"""

from __future__ import annotations

import argparse
import re
import runpy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from faceanim import Session, load_expression, load_face
from faceanim.backends import backend_class
from faceanim.bench.accuracy import apex_frame
from faceanim.bench.faithfulness import Poser, artist_matches, movements
from faceanim.bench.muscle_images import round_trips
from faceanim.cli.drawing import Drawing, Picture
from faceanim.cli.main import main as faceanim
from faceanim.face.face import Face
from faceanim.face.muscle_image import map_picture
from faceanim.ground.folders import user_cache
from faceanim.render.muscle_picture import muscle_image, muscle_views
from faceanim.render.sequence import contact_sheet, write_png
from faceanim.render.tissue_picture import draw_cut

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
EXPRESSIONS = ("neutral", "happiness", "sadness", "surprise", "fear", "anger", "disgust", "contempt")
UNITS = tuple("1 2 4 5 6 7 9 10 12 14 15 16 17 18 20 22 24 27 45 L46".split())
SIZE = 420
CROP = slice(58, 408), slice(70, 350)
"""The face in a picture of SIZE pixels: rows and columns."""


class Apex:
    """The held apex of expressions on one face, each simulated once."""

    def __init__(self, density: str) -> None:
        self.face = load_face(density=density)
        self.body = self.face.body()
        self._known: dict[str, tuple[Session, np.ndarray]] = {}

    def of(self, name: str) -> tuple[Session, np.ndarray]:
        """Return a session and its positions (n, 3) [mm] at the end of the apex."""
        if name not in self._known:
            options = backend_class("mass_spring").Options(adaptive=True)
            session = Session(self.face, load_expression(name), body=self.body, options=options)
            for frame in session.frames(copy=False):
                if frame.index == apex_frame(session):
                    self._known[name] = session, frame.points.copy()
                    break
        return self._known[name]

    def picture(self, name: str, **options: Any) -> np.ndarray:
        """Return the picture of an expression at its apex."""
        session, points = self.of(name)
        drawing = Drawing(session, Picture(size=(SIZE, SIZE), **options), [points])
        return drawing.draw(points, 1.0)[CROP].copy()


def labelled(pictures: list[np.ndarray], names: list[str], columns: int) -> np.ndarray:
    """Return pictures in rows of `columns`, each under its name."""
    rows = [
        contact_sheet([pictures[k : k + columns]], column_labels=names[k : k + columns])
        for k in range(0, len(pictures), columns)
    ]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 8), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate(padded)


def pictures(apex: Apex) -> None:
    """Write docs/expressions.png, docs/action_units.png and docs/inside.png."""
    shown = [apex.picture(name) for name in EXPRESSIONS]
    write_png(DOCS / "expressions.png", labelled(shown, list(EXPRESSIONS), 4))
    shown = [apex.picture(name) for name in UNITS]
    small = [cv2.resize(one, None, fx=0.65, fy=0.65, interpolation=cv2.INTER_AREA) for one in shown]
    write_png(DOCS / "action_units.png", labelled(small, [f"AU {name}" for name in UNITS], 5))
    kinds: dict[str, dict[str, Any]] = {
        "displacement": {"colour": "displacement"},
        "strain": {"colour": "strain"},
        "node sets": {"colour": "sets"},
        "skull": {"show_skull": True, "views": ("three_quarter",)},
    }
    shown = [apex.picture("happiness", **options) for options in kinds.values()]
    write_png(DOCS / "inside.png", labelled(shown, list(kinds), 4))


def muscle_images(face: Face) -> str:
    """Write the muscle images of `assets/` and docs/muscle*.png; return a Markdown table of how well they are read."""
    images = {}
    for kind in ("front", "cylinder"):
        images[kind], _ = muscle_image(face, face.muscle_table, kind)
        write_png(ROOT / "assets" / f"muscle_image_{kind}.png", images[kind])
    write_png(DOCS / "muscle_images.png", labelled(list(images.values()), ["front", "cylinder"], 2))
    found = map_picture(images["front"], face)
    views = muscle_views(face, found.table, 420)
    write_png(DOCS / "muscles.png", np.concatenate([row[8:-36] for row in np.split(views, 2)]))
    lines = [
        "| picture | treatment | muscles and rings named right | faults | median [mm] | largest [mm] | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in round_trips(face):
        numbers = f"{r.right} of {r.drawn} | {r.faults} | {r.median:.2f} | {r.max:.2f} | {r.seconds:.2f}"
        lines.append(f"| {r.kind} | {r.treatment} | {numbers} |")
    return "\n".join(lines) + "\n"


def faithfulness(face: Face) -> str:
    """Return two Markdown tables: movements beside published ranges, and fields beside the artist's."""
    poser = Poser(face)
    lines = ["| AU | movement at full activation | measured | wanted |", "|---|---|---|---|"]
    for m in movements(poser):
        wanted = f"{m.low:g} to {m.high:g}" if m.low > -1.0 or m.high < 0.0 else f"below {m.high:g}"
        lines.append(f"| {m.action_unit} | {m.what} [{m.unit}] | {m.value:.2f} | {wanted} |")
    lines += [
        "",
        "| AU | artist's unit | mean cosine | peak [mm] | artist's peak [mm] | ratio |",
        "|---|---|---|---|---|---|",
    ]
    for f in artist_matches(poser):
        numbers = f"{f.mean_cosine:.2f} | {f.peak:.1f} | {f.artist_peak:.1f} | {f.peak_ratio:.2f}"
        lines.append(f"| {f.action_unit} | {f.artist_unit} | {numbers} |")
    return "\n".join(lines) + "\n"


def gallery(face: Face) -> None:
    """Run the scripts of docs/examples and write their pictures and the table of backends into docs/."""
    with TemporaryDirectory() as scratch:
        for name in ("bar_bending", "octree_block", "muscle_blocks", "face_backends"):
            print(f"{name}: {main_of(name)(scratch):.3g}")
        for what in ("bar", "face"):
            print(f"twist_and_drag {what}: {main_of('twist_and_drag')(scratch, what):.3g}")
            (Path(scratch) / "twist_and_drag.png").replace(DOCS / f"twisted_{what}.png")
        for made in (*Path(scratch).glob("*.png"), *Path(scratch).glob("*.md")):
            (DOCS / made.name).write_bytes(made.read_bytes())
    draw_cut(face, DOCS / "tissue_cut.png", place=6.0)


def operations() -> None:
    """Draw two of the built-in operations: bones, skin before and after, and how far it has moved."""
    with TemporaryDirectory() as folder:
        for plan in ("mandible_advance", "midface_advance"):
            out = Path(folder) / plan
            faceanim(["surgery", plan, "--out", str(out), "--size", "360"])
            rows = [cv2.imread(str(out / f"{name}.png"))[:, :, ::-1] for name in ("before", "after", "map")]
            width = max(row.shape[1] for row in rows)
            padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=247) for row in rows]
            write_png(DOCS / f"surgery_{plan}.png", np.ascontiguousarray(np.concatenate(padded)))
            (DOCS / f"bones_{plan}.png").write_bytes((out / "bones.png").read_bytes())


def comparisons(work: Path) -> None:
    """Compare the backends on every scene, on a smile in full, and keep charts, fronts and one page's pictures in docs/."""
    faceanim(["compare", "face-smile", "--limit", "240", "--out", str(work / "face-smile-full")])
    faceanim(["compare", "all", "--quick", "--out", str(work)])
    copied(work / "face-smile-full", {"comparison.png": "comparison.png", "comparison.csv": "comparison.csv"})
    copied(work, {"overview.png": "fronts.png", "fronts.md": "fronts.md"})


def stability(work: Path) -> None:
    """Make the stability maps of skin and bar and keep the overview and some of the maps in docs/."""
    faceanim(["atlas", "sheet", "--out", str(work / "atlas-sheet")])
    faceanim(["atlas", "bar", "--quick", "--out", str(work / "atlas-bar")])
    copied(work / "atlas-sheet", {"atlas.png": "atlas.png"})
    copied(work / "atlas-bar", {"bar_twist.png": "atlas_twist.png"})


def claims(work: Path) -> None:
    """Measure the papers' claims and keep tables and pictures in docs/claims/ and the overview in docs/claims.md."""
    faceanim(["claims", "all", "--out", str(work / "claims")])
    (DOCS / "claims").mkdir(exist_ok=True)
    for made in sorted((work / "claims").iterdir()):
        (DOCS / "claims" / made.name).write_bytes(made.read_bytes())
    overview = (work / "claims" / "claims.md").read_text(encoding="utf-8")
    (DOCS / "claims.md").write_text(overview.replace("](", "](claims/"), encoding="utf-8")


def copied(folder: Path, names: dict[str, str]) -> None:
    """Copy files of `folder` into docs/ under other names."""
    for name, ours in names.items():
        (DOCS / ours).write_bytes((folder / name).read_bytes())


def main_of(example: str) -> Any:
    """Return the function `main` of a script in docs/examples."""
    return runpy.run_path(str(DOCS / "examples" / f"{example}.py"))["main"]


def insert_tables() -> None:
    """Put the tables of docs/ between their marks in README.md."""
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    for name in ("framerate", "faithfulness", "muscles", "face_backends", "four_models", "fronts", "claims"):
        if not (DOCS / f"{name}.md").exists():
            continue
        table = (DOCS / f"{name}.md").read_text(encoding="utf-8").replace("](claims/", "](docs/claims/")
        marks = f"<!-- table: {name} -->", f"<!-- end of table: {name} -->"
        pattern = re.escape(marks[0]) + ".*?" + re.escape(marks[1])
        text = re.sub(pattern, lambda _: f"{marks[0]}\n{table}{marks[1]}", text, flags=re.DOTALL)  # noqa: B023
    readme.write_text(text, encoding="utf-8")


PARTS = ("pictures", "muscles", "gallery", "surgery", "framerate", "faithfulness", "insert")
LONG_PARTS = ("comparisons", "stability", "claims")
"""Made only when asked for: an hour together. They go on where they stopped, in the user's cache."""


def main() -> None:
    """Make everything, or what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=(*PARTS, *LONG_PARTS))
    only = parser.parse_args().only
    DOCS.mkdir(exist_ok=True)
    apex = Apex("default")
    if only in (None, "pictures"):
        pictures(apex)
    if only in (None, "muscles"):
        (DOCS / "muscles.md").write_text(muscle_images(apex.face), encoding="utf-8")
    if only in (None, "gallery"):
        gallery(apex.face)
    if only in (None, "surgery"):
        operations()
    if only in (None, "faithfulness"):
        (DOCS / "faithfulness.md").write_text(faithfulness(apex.face), encoding="utf-8")
    if only in (None, "framerate"):
        faceanim(["framerate", "--out", str(DOCS)])
    work = user_cache() / "docs"
    for name, make in zip(LONG_PARTS, (comparisons, stability, claims), strict=True):
        if only == name:
            make(work)
    insert_tables()


if __name__ == "__main__":
    main()
