"""What long work tells while it goes on: whoever listens shows it, nobody need listen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[str, int, int], None]
"""(what is being done, how many of its parts are done, how many there are; 0 = unknown)."""

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def tell(what: str, done: int = 0, total: int = 0) -> None:
    """Say how far a long computation is."""
    listener = _listener.get()
    if listener is not None:
        listener(what, done, total)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Let `listener` hear what is told inside this context."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
