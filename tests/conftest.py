"""Fixtures shared by all rooms; this folder is importable, so that tests can `from toys import ...`."""

from __future__ import annotations

import os

# Many small products: threads that wait for each other would make them several times slower. Read when NumPy starts.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from faceanim.backends import BACKENDS


@pytest.fixture
def toy_backend(monkeypatch: pytest.MonkeyPatch) -> str:
    """Register a solver without physics, fast enough to test what surrounds solvers; return its name."""
    monkeypatch.setitem(BACKENDS, "toy", "toys:ToySolver")
    return "toy"
