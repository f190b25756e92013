"""One colour and one mark per backend in every chart, to be told apart in grey as well."""

from __future__ import annotations

COLOURS = {
    "mass_spring": "#d1495b",
    "modal_warping": "#00798c",
    "weighted_residual": "#d98e04",
    "octree_mass_spring": "#6a994e",
    "mixed_fem": "#7b2d8b",
    "finite_elements": "#30343f",
}
MARKS = {
    "mass_spring": "o",
    "modal_warping": "s",
    "weighted_residual": "^",
    "octree_mass_spring": "D",
    "mixed_fem": "P",
    "finite_elements": "X",
}
OTHER = ("#8a8a8a", "v")
"""Of a backend without an entry of its own."""

OUTCOME_COLOURS = {
    "converged": "#f2f0e6",
    "bounded but wrong": "#f4c95d",
    "inverted": "#dd6e42",
    "not finite": "#7d1d3f",
    "refused": "#b9c0c9",
}
"""Of a stability map, light to dark: read in grey as well."""


def colour(backend: str) -> str:
    """Return the colour of a backend."""
    return COLOURS.get(backend, OTHER[0])


def mark(backend: str) -> str:
    """Return the mark of a backend (Matplotlib's letters)."""
    return MARKS.get(backend, OTHER[1])
