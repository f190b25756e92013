"""The exceptions that faceanim raises.

A `UserError` is a mistake in what was asked for (command line exit status 2); a `RunError` is a run that failed
although the request was sound (exit status 1). Messages name the thing, the value, the rule and the way out.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class FaceanimError(Exception):
    """Base of every exception that faceanim raises on purpose."""


class UserError(FaceanimError, ValueError):
    """The request itself is wrong: an unknown name, a value outside its range, a folder that cannot be written."""


class AssetError(UserError):
    """A file that describes a face, an expression or a material is missing, broken or inconsistent."""


class RunError(FaceanimError, RuntimeError):
    """A sound request that failed while it ran: a full disk, a diverged simulation."""


class DivergenceError(RunError):
    """The simulation left the finite numbers; the message carries frame, time, step and what to change."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """Return the error for an unknown `name`, suggesting the nearest of the `known` ones."""
    names = sorted(known)
    near = get_close_matches(name, names, n=3, cutoff=0.5)
    if near:
        hint = "did you mean " + " or ".join(repr(n) for n in near) + "?"
    elif len(names) <= 40:
        hint = "known: " + ", ".join(names)
    else:
        hint = "see `faceanim info`"
    return UserError(f"unknown {kind} {name!r}; {hint}")
