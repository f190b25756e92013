"""Compare the four soft-tissue models of the mixed-element paper's Fig. 8 on a synthetic truth, and draw the figures.

    python tools/bench_surgery.py [--moves midface_advance,...] [--models mixed,...] [--ablation MOVE] [--out docs]

The truth of each move takes minutes the first time and is then kept in the cache; the models take 5 to 60 s each.
Writes four_models.csv, four_models.md and four_models.png.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from faceanim.backends.mixed_fem.options import MODELS
from faceanim.bench.surgery_charts import chart, csv_text, markdown
from faceanim.bench.surgery_models import ABLATIONS, MOVES, Row, at_rest, reference, run


def main() -> None:
    """Run what is asked for, print every row as it is found, and write the three files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--moves", default=",".join(MOVES))
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--ablation", default="", help="a move on which to change one part of the model at a time")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    args = parser.parse_args()
    rest = at_rest()
    print(f"skins of the two densities before any move: mean {rest.mean:.3f}, 95 % {rest.p95:.3f} mm", flush=True)
    rows: list[Row] = []
    for move in filter(None, args.moves.split(",")):
        known = reference(move)
        print(f"{move}: truth {known.seconds:.0f} s, {known.iterations} Newton steps", flush=True)
        for model in args.models.split(","):
            rows += _shown(run(move, model, known))
    if args.ablation:
        known = reference(args.ablation)
        for changes in ABLATIONS:
            rows += _shown(run(args.ablation, "mixed", known, **changes))
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "four_models.csv").write_text(csv_text(rows), encoding="utf-8")
    (args.out / "four_models.md").write_text(markdown(rows, rest), encoding="utf-8")
    chart(rows, args.out / "four_models.png")


def _shown(rows: object) -> list[Row]:
    kept = list(rows)  # type: ignore[call-overload]
    for row in kept:
        if row.moved is None:
            print(f"  {row.model:40s} failed at {row.fraction:.0%}: {row.failure}", flush=True)
        else:
            noise = "none" if row.noise is None else f"seed {row.noise}"
            m = row.moved
            print(
                f"  {row.model:40s} noise {noise:7s} mean {m.mean:.3f} p95 {m.p95:.3f} max {m.max:.2f} mm, "
                f"{m.within_1_5:.1f} % < 1.5 mm (moved); {row.seconds:.1f} s",
                flush=True,
            )
    return kept


if __name__ == "__main__":
    sys.exit(main())
