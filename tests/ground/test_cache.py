"""What long work keeps and tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from faceanim.ground import cache, notes


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Keep these arrays out of the user's cache."""
    monkeypatch.setattr(cache, "user_cache", lambda: tmp_path)


def test_a_key_tells_contents_apart() -> None:
    """Values, shapes, types and the version of the computation all count; equal contents have equal keys."""
    a = np.arange(6.0)
    key = cache.content_key("v", a, 1.0)
    assert key == cache.content_key("v", a.copy(), 1.0)
    others = [("w", a, 1.0), ("v", a + 1, 1.0), ("v", a.reshape(2, 3), 1.0), ("v", a.astype(np.float32), 1.0), ("v", a)]
    assert len({key, *(cache.content_key(*other) for other in others)}) == 6


def test_arrays_come_back_as_they_were() -> None:
    """What is kept under a key is found under it, to the byte, and nothing under another."""
    a = np.random.default_rng(1).standard_normal((3, 4))
    cache.save_arrays("things", "k", a=a, b=np.array([1, 2]))
    found = cache.load_arrays("things", "k")
    assert found is not None and found["a"].tobytes() == a.tobytes() and found["b"].tolist() == [1, 2]
    assert cache.load_arrays("things", "other") is None


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 half a file", b"\x93NUMPY"])
def test_a_damaged_file_is_as_good_as_none(tmp_path: Path, damage: bytes) -> None:
    """A file cut short, or holding something else, is not an error."""
    cache.save_arrays("things", "k", a=np.ones(3))
    (tmp_path / "things" / "k.npz").write_bytes(damage)
    assert cache.load_arrays("things", "k") is None


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    """A cached file that holds pickled objects is refused."""
    (tmp_path / "things").mkdir()
    np.savez(tmp_path / "things" / "k.npz", a=np.array([{}], dtype=object))
    assert cache.load_arrays("things", "k") is None


def test_only_who_listens_hears() -> None:
    """What is told inside the context reaches the listener; outside it reaches nobody."""
    heard: list[tuple[str, int, int]] = []
    notes.tell("before")
    with notes.listening(lambda *words: heard.append(words)):
        notes.tell("modes", 3, 40)
    notes.tell("after")
    assert heard == [("modes", 3, 40)]
