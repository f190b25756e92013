"""Time and judge how flesh is taken out of moved bones, beside Table 2 of the mixed-element paper.

    python tools/bench_contact.py [--spacing 1.0] [--vertices 3500] [--output contact.json]

Prints for the mandible (8 mm forward and 3 degrees) and the mid-face (12 mm forward) the time of all steps, without
making the field, which is done once, for several readings of the field; the first is the paper's. What is measured is
told in `faceanim/bench/bone_contact.py`; `faceanim claims mixed-table-2` draws it.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from faceanim.bench.bone_contact import SPACING, TABLE_2, VERTICES, contacts


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spacing", type=float, default=SPACING, help="of the field's lattice [mm]")
    parser.add_argument("--vertices", type=int, default=VERTICES)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    rows = []
    print("procedure  reading  sweeps steps   time/s  imposed errors ratio/%  worst/mm  buried against  field/s")
    for row in contacts(vertices=options.vertices, spacing=options.spacing):
        rows.append({**asdict(row), "ratio": row.ratio})
        print(
            f"{row.procedure:10} {row.reading:8} {row.sweeps:6d} {row.steps:5d} {row.seconds:8.4f} {row.imposed:8d} "
            f"{row.errors:6d} {row.ratio:7.2f} {row.worst:9.3f} {row.buried:7d} {row.against:7d} "
            f"{row.field_seconds:8.2f}"
        )
    for name, (seconds, count, errors, ratio) in TABLE_2.items():
        print(f"{name:10} {'(Table 2)':21} {seconds:8.4f} {count:8d} {errors:6d} {ratio:7.2f}")
    if options.output:
        options.output.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
