"""Make the pictures of README.md with the program itself: run `python tools/make_pictures.py` in the repository."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from faceanim import Session, load_expression, load_face
from faceanim.bench.accuracy import apex_frame
from faceanim.cli.drawing import Drawing, Picture
from faceanim.render.sequence import contact_sheet, write_png

DOCS = Path(__file__).resolve().parent.parent / "docs"
EXPRESSIONS = ("neutral", "happiness", "sadness", "surprise", "fear", "anger", "disgust", "contempt")
UNITS = tuple("1 2 4 5 6 7 9 10 12 14 15 16 17 18 20 22 24 27 45 L46".split())
SIZE = 300


def apex(face: object, body: object, name: str) -> tuple[Session, np.ndarray]:
    """Return a session and its positions at the held apex."""
    session = Session(face, load_expression(name), body=body)
    for frame in session.frames(copy=False):
        if frame.index == apex_frame(session):
            return session, frame.points.copy()
    raise AssertionError


def picture(face: object, body: object, name: str, **options: object) -> np.ndarray:
    """Return the picture of an expression at its apex, framed like the face at rest with the jaw open."""
    session, points = apex(face, body, name)
    drawing = Drawing(session, Picture(size=(SIZE, SIZE), **options), [points])
    return drawing.draw(points, 1.0).copy()


def labelled(pictures: list[np.ndarray], names: list[str], columns: int) -> np.ndarray:
    """Return pictures in rows of `columns`, each under its name."""
    rows = [
        contact_sheet([pictures[k : k + columns]], column_labels=names[k : k + columns])
        for k in range(0, len(pictures), columns)
    ]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 8), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate(padded)


def main() -> None:
    """Write docs/expressions.png, docs/action_units.png and docs/inside.png."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--density", default="default")
    args = parser.parse_args()
    face = load_face(density=args.density)
    body = face.body()
    DOCS.mkdir(exist_ok=True)
    shown = [picture(face, body, name) for name in EXPRESSIONS]
    write_png(DOCS / "expressions.png", labelled(shown, list(EXPRESSIONS), 4))
    shown = [picture(face, body, name) for name in UNITS]
    write_png(DOCS / "action_units.png", labelled(shown, [f"AU {name}" for name in UNITS], 5))
    kinds = {
        "displacement": {"colour": "displacement"},
        "strain": {"colour": "strain"},
        "node sets": {"colour": "sets"},
        "skull": {"show_skull": True, "views": ("three_quarter",)},
    }
    shown = [picture(face, body, "happiness", **options) for options in kinds.values()]
    write_png(DOCS / "inside.png", labelled(shown, list(kinds), 4))


if __name__ == "__main__":
    main()
