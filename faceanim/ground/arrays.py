"""Arrays as the kernels want them: float64 or int32, C-contiguous, of a known shape and, when asked, read-only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faceanim.ground.errors import UserError

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Bools = NDArray[np.bool_]


def _checked(name: str, array: Any, shape: Sequence[int | None]) -> None:
    fits = array.ndim == len(shape) and all(w is None or w == g for w, g in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("n" if w is None else str(w) for w in shape)
        raise UserError(f"{name} has shape {array.shape}; ({wanted}) is needed")


def floats(name: str, value: Any, *shape: int | None) -> Floats:
    """Return `value` as finite float64 in C order with the given shape (None = any size); raise `UserError` else."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    _checked(name, array, shape)
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))[0]
        raise UserError(f"{name} holds a number that is not finite at index {tuple(int(b) for b in bad)}")
    return array


def ints(name: str, value: Any, *shape: int | None, below: int | None = None) -> Ints:
    """Return `value` as int32 indices in C order, checked to lie in [0, below); raise `UserError` else."""
    raw = np.asarray(value)
    if raw.size and not np.issubdtype(raw.dtype, np.integer):
        raise UserError(f"{name} must hold integers, not {raw.dtype}")
    if raw.size and below is not None and (raw.min() < 0 or raw.max() >= below):
        worst = int(raw.min()) if raw.min() < 0 else int(raw.max())
        raise UserError(f"{name} holds the index {worst}, outside 0..{below - 1}")
    array = np.ascontiguousarray(raw, dtype=np.int32)
    _checked(name, array, shape)
    return array


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return `array` marked read-only (in place)."""
    array.setflags(write=False)
    return array
