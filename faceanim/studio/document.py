"""The muscles being edited: every change can be undone and is on disk before the next one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec

from faceanim.face.muscles import (
    AnyMuscle,
    LinearMuscle,
    SheetMuscle,
    Vec,
    mirrored,
    muscles_text,
    one_sided,
    parse_muscles,
    side_of,
)
from faceanim.ground.errors import FaceanimError, UserError, unknown_name
from faceanim.ground.files import not_written, write_whole

FILE, JOURNAL = "muscles.toml", "history.jsonl"
MOST_STATES = 200
"""How many states can be gone back to."""
LONGEST_NAME = 60
_TWIN = {"left": "right", "right": "left"}
_HEAD = "Muscles placed in faceanim studio; saved after every change."


class _Line(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """A line of the journal: a new state with its label, or a move `to` one of the states."""

    label: str = ""
    table: dict[str, AnyMuscle] | None = None
    to: int | None = None


@dataclass(frozen=True)
class _State:
    label: str
    table: dict[str, AnyMuscle]


class MuscleDocument:
    """One-sided muscles by full name, with undo and redo, saved in `folder` after every change.

    folder : holds muscles.toml, the muscles as they are, and history.jsonl, the states to go back and forth to; both
    are read again at the start    start : the muscles if there are none in the folder
    notices : what was found wrong with the files in the folder
    """

    def __init__(self, folder: Path, start: Mapping[str, AnyMuscle]) -> None:
        self.folder = folder
        self.notices: list[str] = []
        self._states, self._at = self._read_journal()
        saved = self._read_file()
        if not self._states:
            self._states, self._at = [_State("start", one_sided(start) if saved is None else saved)], 0
            self._rewrite_journal()
            self._save()
        elif saved is not None and saved != self.table:
            self._put("changed outside the studio", saved)
        elif saved is None:
            self._save()

    # What there is

    @property
    def table(self) -> dict[str, AnyMuscle]:
        """The muscles, a copy."""
        return dict(self._states[self._at].table)

    @property
    def text(self) -> str:
        """The muscles as TOML."""
        return muscles_text(self.table, head=_HEAD)

    @property
    def undoable(self) -> str:
        """What `undo` takes back, empty if nothing."""
        return self._states[self._at].label if self._at else ""

    @property
    def redoable(self) -> str:
        """What `redo` does again, empty if nothing."""
        return self._states[self._at + 1].label if self._at + 1 < len(self._states) else ""

    def muscle(self, name: str) -> AnyMuscle:
        """Return a muscle; raise `UserError` if there is none of that name."""
        if name not in self._states[self._at].table:
            raise unknown_name("muscle", name, self.table)
        return self.table[name]

    # Changes

    def place(self, rows: Mapping[str, AnyMuscle], label: str = "") -> None:
        """Add muscles, or put them where muscles of their names are."""
        self._put(label or "place " + ", ".join(rows), {**self.table, **one_sided(rows)})

    def move(
        self, name: str, *, insertion: Vec | None = None, origin: Vec | None = None, bone: str | None = None
    ) -> None:
        """Put one or both ends of a muscle elsewhere; raise `UserError` for a ring, which has none."""
        muscle = self.muscle(name)
        if not isinstance(muscle, (LinearMuscle, SheetMuscle)):
            raise UserError(f"{name} is a ring; place its axis again instead")
        given = {"insertion": insertion, "origin": origin, "bone": bone}
        changed = msgspec.structs.replace(muscle, **{k: v for k, v in given.items() if v is not None})
        self._put(f"move {name}", {**self.table, name: changed})

    def mirror(self, name: str) -> str:
        """Give a muscle its mirror image as the twin on the other side and return that one's name.

        Raises `UserError` for a muscle in the middle.
        """
        muscle, side = self.muscle(name), side_of(name)
        if side not in _TWIN:
            raise UserError(f"{name} has no side; only muscles that end in _left or _right have a twin")
        twin = f"{name.removesuffix(side)}{_TWIN[side]}"
        self._put(f"mirror {name}", {**self.table, twin: mirrored(muscle)})
        return twin

    def delete(self, name: str) -> None:
        """Take a muscle away."""
        self.muscle(name)
        self._put(f"delete {name}", {k: v for k, v in self.table.items() if k != name})

    def rename(self, name: str, new: str) -> str:
        """Call a muscle `new`, which keeps the side of the old name if it names none; return its new name.

        Raises `UserError` for a name that is taken or is none.
        """
        self.muscle(name)
        new = re.sub(r"[\s-]+", "_", new.strip()).strip("_")
        if side_of(name) in _TWIN and side_of(new) not in _TWIN:
            new = f"{new}_{side_of(name)}"
        if not re.fullmatch(r"[A-Za-z0-9_]+", new) or not re.sub(r"(^|_)(left|right)$", "", new):
            raise UserError(f"{new!r} is no name for a muscle; use letters, digits and underscores")
        if len(new) > LONGEST_NAME:
            raise UserError(f"a name has at most {LONGEST_NAME} letters; {new!r} has {len(new)}")
        if new == name:
            return name
        if new in self.table:
            raise UserError(f"there is a muscle {new} already; delete it first or choose another name")
        self._put(f"rename {name}", {new if k == name else k: v for k, v in self.table.items()})
        return new

    def replace_all(self, table: Mapping[str, AnyMuscle], label: str) -> None:
        """Take other muscles in place of all there are."""
        self._put(label, one_sided(table))

    def undo(self) -> str:
        """Go back by one change and return which; raise `UserError` if there is none."""
        if not self.undoable:
            raise UserError("there is nothing to undo")
        label = self.undoable
        self._go(self._at - 1)
        return label

    def redo(self) -> str:
        """Do again what was undone last and return what; raise `UserError` if nothing was."""
        if not self.redoable:
            raise UserError("there is nothing to redo")
        self._go(self._at + 1)
        return self._states[self._at].label

    def _put(self, label: str, table: dict[str, AnyMuscle]) -> None:
        """Make `table` the newest state; raise `UserError` if it could not be read back."""
        parse_muscles(muscles_text(table), "this change")
        self._states = [*self._states[: self._at + 1], _State(label, table)]
        self._at += 1
        if len(self._states) > MOST_STATES:
            self._states = self._states[-MOST_STATES // 2 :]
            self._at = len(self._states) - 1
            self._rewrite_journal()
        else:
            self._append(_Line(label, table))
        self._save()

    def _go(self, at: int) -> None:
        self._at = at
        self._append(_Line(to=at))
        self._save()

    # Files

    def _save(self) -> None:
        write_whole(self.folder / FILE, self.text.encode(), lasting=True)

    def _append(self, line: _Line) -> None:
        path = self.folder / JOURNAL
        try:
            with path.open("ab") as file:
                file.write(msgspec.json.encode(line) + b"\n")
        except OSError as error:
            raise not_written(path, error) from error

    def _rewrite_journal(self) -> None:
        lines = [_Line(state.label, state.table) for state in self._states]
        lines += [_Line(to=self._at)]
        write_whole(self.folder / JOURNAL, b"".join(msgspec.json.encode(line) + b"\n" for line in lines))

    def _read_journal(self) -> tuple[list[_State], int]:
        """Return the states in the journal and which one was last; what follows a damaged line is left out."""
        states: list[_State] = []
        at = -1
        try:
            lines = (self.folder / JOURNAL).read_bytes().splitlines()
        except FileNotFoundError:
            return [], -1
        except OSError as error:
            raise UserError(
                f"{self.folder / JOURNAL} cannot be read ({error.strerror}); choose another --work"
            ) from error
        for text in lines:
            try:
                line = msgspec.json.decode(text, type=_Line)
                if line.table is not None:
                    parse_muscles(muscles_text(line.table), JOURNAL)
                    states, at = [*states[: at + 1], _State(line.label, line.table)], at + 1
                elif line.to is not None and 0 <= line.to < len(states):
                    at = line.to
            except (msgspec.MsgspecError, FaceanimError, UnicodeDecodeError):
                self.notices.append(f"{JOURNAL} is damaged; what came after the damage cannot be undone")
                break
        return states[-MOST_STATES:], at - max(0, len(states) - MOST_STATES)

    def _read_file(self) -> dict[str, AnyMuscle] | None:
        """Return the muscles in the folder's file, None if there is none; a broken file is put aside."""
        path = self.folder / FILE
        try:
            return one_sided(parse_muscles(path.read_text(encoding="utf-8"), FILE))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UserError(f"{path} cannot be read ({error.strerror}); choose another --work") from error
        except (FaceanimError, UnicodeDecodeError) as error:
            aside = path.with_name("muscles.broken.toml")
            path.replace(aside)
            self.notices.append(f"{FILE} could not be read and is now {aside.name}: {error}")
            return None
