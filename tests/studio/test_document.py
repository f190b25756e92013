"""The muscle document: nothing is lost, everything can be undone, and the file is always the document."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faceanim.face.library import asset_text
from faceanim.face.muscles import AnyMuscle, LinearMuscle, mirrored, one_sided, parse_muscles
from faceanim.ground.errors import AssetError, RunError, UserError
from faceanim.studio import document as rooms
from faceanim.studio.document import FILE, JOURNAL, MOST_STATES, MuscleDocument

START = one_sided(parse_muscles(asset_text("muscles.toml"), "muscles.toml"))
FEW = {name: START[name] for name in ("zygomaticus_major_left", "procerus", "orbicularis_oculi_orbital_right")}
COORDINATE = st.floats(-150.0, 150.0, allow_nan=False).map(lambda v: round(v, 3))
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)
NAMES = st.sampled_from(["a_left", "a_right", "b", "zygomaticus_major_left", "muscle_1_right"])


def read(folder: Path) -> dict[str, AnyMuscle]:
    """Return what is in the folder's file."""
    return parse_muscles((folder / FILE).read_text(), FILE)


@st.composite
def edits(draw: st.DrawFn) -> Callable[[MuscleDocument], None]:
    """Return one edit, sensible or not."""
    name, other = draw(NAMES), draw(NAMES)
    row = LinearMuscle(draw(POINT), draw(POINT), 800.0, 12.0, paired=False)
    place = draw(POINT)
    return draw(
        st.sampled_from(
            [
                lambda d: d.place({name: row}),
                lambda d: d.move(name, insertion=place),
                lambda d: d.mirror(name),
                lambda d: d.delete(name),
                lambda d: d.rename(name, other),
                lambda d: d.undo(),
                lambda d: d.redo(),
            ]
        )
    )


def apply(document: MuscleDocument, change: Callable[[MuscleDocument], None]) -> None:
    """Edit; an edit that cannot be is refused and changes nothing."""
    before = document.table
    try:
        change(document)
    except UserError:
        assert document.table == before


@settings(max_examples=40, deadline=None)
@given(st.lists(edits(), max_size=12))
def test_undoing_everything_gives_back_the_start_and_redoing_the_end(
    changes: list[Callable[[MuscleDocument], None]],
) -> None:
    """However many edits, undo leads through exactly the former states, order included; redo leads back."""
    with tempfile.TemporaryDirectory() as folder:
        document = MuscleDocument(Path(folder), FEW)
        for change in changes:
            apply(document, change)
        end = document.table
        states = [end]
        while document.undoable:
            document.undo()
            states.append(document.table)
        assert list(document.table.items()) == list(FEW.items())
        for state in reversed(states[:-1]):
            document.redo()
            assert list(document.table.items()) == list(state.items())
        assert document.table == end


@settings(max_examples=40, deadline=None)
@given(st.lists(edits(), max_size=8))
def test_the_file_is_the_document_and_a_restart_loses_nothing(changes: list[Callable[[MuscleDocument], None]]) -> None:
    """After every edit the file reads back as the document; a new start finds muscles and history."""
    with tempfile.TemporaryDirectory() as folder:
        document = MuscleDocument(Path(folder), FEW)
        for change in changes:
            apply(document, change)
            assert read(Path(folder)) == document.table
        again = MuscleDocument(Path(folder), {})
        assert list(again.table.items()) == list(document.table.items())
        assert (again.undoable, again.redoable) == (document.undoable, document.redoable)
        while document.undoable:
            assert document.undo() == again.undo()
            assert again.table == document.table


@given(POINT, POINT)
def test_mirroring_twice_is_the_identity(origin: tuple[float, float, float], end: tuple[float, float, float]) -> None:
    """The twin of the twin is the muscle itself."""
    if origin == end:
        return
    with tempfile.TemporaryDirectory() as folder:
        document = MuscleDocument(Path(folder), {"a_left": LinearMuscle(origin, end, 800.0, 12.0, paired=False)})
        before = document.table
        assert document.mirror("a_left") == "a_right"
        assert document.muscle("a_right") == mirrored(before["a_left"])
        assert document.mirror("a_right") == "a_left"
        assert document.muscle("a_left") == before["a_left"]


def test_paired_muscles_become_one_sided(tmp_path: Path) -> None:
    """A table with pairs is taken apart, so that each side can be edited by itself."""
    document = MuscleDocument(tmp_path, parse_muscles(asset_text("muscles.toml"), "muscles.toml"))
    assert document.table == START
    assert not any(muscle.paired for muscle in read(tmp_path).values())


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("big smiler", "big_smiler_left"), ("other_right", "other_right"), ("  my-muscle_left ", "my_muscle_left")],
)
def test_names_are_tidied(tmp_path: Path, name: str, wanted: str) -> None:
    """Spaces become underscores, and a name without a side keeps the old one's."""
    document = MuscleDocument(tmp_path, FEW)
    assert document.rename("zygomaticus_major_left", name) == wanted
    assert next(iter(document.table)) == wanted


@pytest.mark.parametrize("name", ["", "../../etc", "a.b", "ä", "_left", "x" * 80, "procerus\n[evil]"])
def test_bad_names_are_refused(tmp_path: Path, name: str) -> None:
    """A name that could not be a TOML key, or is far too long, changes nothing."""
    document = MuscleDocument(tmp_path, FEW)
    with pytest.raises(UserError):
        document.rename("procerus", name)
    assert document.table == FEW


def test_a_taken_name_is_refused(tmp_path: Path) -> None:
    """No muscle is overwritten by giving its name to another."""
    document = MuscleDocument(tmp_path, START)
    with pytest.raises(UserError, match="already"):
        document.rename("risorius_left", "zygomaticus_major_left")


def test_a_muscle_without_length_is_refused(tmp_path: Path) -> None:
    """Both ends in one place are no muscle; the document stays as it was."""
    document = MuscleDocument(tmp_path, FEW)
    with pytest.raises(AssetError):
        document.place({"x_left": LinearMuscle((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 1.0, 1.0)})
    assert document.table == FEW
    assert read(tmp_path) == FEW


def test_unknown_muscles_and_empty_history_are_named(tmp_path: Path) -> None:
    """Errors say what is missing."""
    document = MuscleDocument(tmp_path, FEW)
    with pytest.raises(UserError, match="unknown muscle"):
        document.delete("zygomaticus_minor_left")
    with pytest.raises(UserError, match="nothing to undo"):
        document.undo()
    with pytest.raises(UserError, match="nothing to redo"):
        document.redo()
    with pytest.raises(UserError, match="no side"):
        document.mirror("procerus")
    with pytest.raises(UserError, match="ring"):
        document.move("orbicularis_oculi_orbital_right", insertion=(0.0, 0.0, 0.0))


def test_the_file_counts_more_than_the_history(tmp_path: Path) -> None:
    """Who edits the file by hand finds that at the next start, and can undo it."""
    MuscleDocument(tmp_path, FEW).delete("procerus")
    (tmp_path / FILE).write_text(rooms.muscles_text(FEW))
    document = MuscleDocument(tmp_path, {})
    assert document.table == FEW
    document.undo()
    assert "procerus" not in document.table


def test_a_broken_file_is_put_aside(tmp_path: Path) -> None:
    """The history takes over, nothing is deleted, and the page can tell."""
    MuscleDocument(tmp_path, FEW).delete("procerus")
    (tmp_path / FILE).write_text("[broken")
    document = MuscleDocument(tmp_path, {})
    assert "procerus" not in document.table and len(document.table) == 2
    assert (tmp_path / "muscles.broken.toml").read_text() == "[broken"
    assert len(document.notices) == 1


def test_a_torn_journal_still_gives_the_last_state(tmp_path: Path) -> None:
    """A last line that was cut short costs its undo step, not the muscles."""
    document = MuscleDocument(tmp_path, FEW)
    document.delete("procerus")
    journal = tmp_path / JOURNAL
    journal.write_bytes(journal.read_bytes()[:-20])
    again = MuscleDocument(tmp_path, {})
    assert again.table == document.table
    assert again.notices


def test_history_is_kept_within_bounds(tmp_path: Path) -> None:
    """Old states are let go; the newest ones can be undone."""
    document = MuscleDocument(tmp_path, FEW)
    for k in range(MOST_STATES + 5):
        document.move("procerus", insertion=(0.0, 30.0, 100.0 + 0.01 * k))
    assert document.undoable
    assert len((tmp_path / JOURNAL).read_bytes().splitlines()) <= MOST_STATES + 5


def test_a_full_disk_is_reported_and_nothing_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The change stays in the page, the former file on disk."""
    document = MuscleDocument(tmp_path, FEW)

    def full(path: Path, data: bytes, *, lasting: bool = False) -> None:
        raise RunError(f"{path} could not be written (No space left on device)")

    monkeypatch.setattr(rooms, "write_whole", full)
    with pytest.raises(RunError, match="No space"):
        document.delete("procerus")
    assert "procerus" not in document.table
    assert read(tmp_path) == FEW
