"""Compute what scenes are measured against and put it into `assets/references/`.

    python tools/make_references.py [SCENE ...]

Without names all built-in scenes and those of `tools/check_plans.py`; an hour or two, less with the extra `bench`. Scenes
whose reference is still that of their definition are skipped. The result does not depend on the machine beyond rounding.
"""

from __future__ import annotations

import sys
from time import perf_counter

import numpy as np

from faceanim.bench.comparison.reference import file_of, key_of, packed, reference
from faceanim.bench.comparison.scenes import SCENES, scene_named
from faceanim.cli.progress import Progress
from faceanim.face.library import asset_folder
from faceanim.ground.notes import listening

UNSEEN = (
    "face-anger", "face-sadness", "face-disgust", "face-contempt", "face-fear@0.5", "face-happiness@0.5",
    "face-blink@0.5", "face-anger@0.5", "face-sadness@0.5", "face-disgust@0.6",
)  # fmt: skip
"""Scenes on which plans are checked, and which none is made from."""


def main(names: list[str]) -> None:
    """Write the references of the scenes called `names`."""
    (asset_folder() / "references").mkdir(exist_ok=True)
    with Progress() as progress, listening(progress.hear):
        for name in names or [*SCENES, *UNSEEN]:
            scene, start = scene_named(name), perf_counter()
            found = reference(scene)
            np.savez_compressed(asset_folder() / file_of(scene), **packed(found, key_of(scene)))
            progress.note(f"{name}: known to {found.uncertainty:.2g} mm, {perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main(sys.argv[1:])
