"""Progress on standard error: a moving bar on a terminal, a line now and then elsewhere, nothing when quiet."""

from __future__ import annotations

import sys
from time import perf_counter
from types import TracebackType
from typing import Any

_SILENCE = 5.0


class Progress:
    """Tell how far a job is; use it as a context and call `stage` and `advance`."""

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._bar: Any = None
        self._task: Any = None
        self._text, self._total, self._done = "", 0, 0
        self._spoke = self._began = perf_counter()

    def __enter__(self) -> Progress:
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            columns = (
                TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                TimeRemainingColumn(),
            )  # fmt: skip
            self._bar = RichProgress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def note(self, text: str) -> None:
        """Say something worth a line of its own, even when quiet."""
        if self._bar is not None:
            self._bar.console.print(f"faceanim: {text}", markup=False, highlight=False, soft_wrap=True)
        else:
            print(f"faceanim: {text}", file=sys.stderr, flush=True)

    def stage(self, text: str, total: int = 0) -> None:
        """Begin a stage of `total` units of work (0 = unknown)."""
        self._text, self._total, self._done = text, total, 0
        self._began = perf_counter()
        if self._bar is not None:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._task = self._bar.add_task(text, total=total or None)
        elif not self._quiet:
            self.note(f"{text} ...")
            self._spoke = perf_counter()

    def advance(self) -> None:
        """One more unit of the stage is done."""
        self._done += 1
        if self._bar is not None:
            self._bar.advance(self._task)
        elif not self._quiet and perf_counter() - self._spoke > _SILENCE:
            self.note(f"{self._text}: {self._done}/{self._total}{self._left()}")
            self._spoke = perf_counter()

    def _left(self) -> str:
        """Return in words how long the rest of the stage will take if it goes on as so far, once that is a while."""
        share = self._done / self._total if self._total else 0.0
        seconds = (perf_counter() - self._began) * (1.0 / share - 1.0) if share > 0.0 else 0.0
        if seconds < 10.0:
            return ""
        return f", about {seconds:.0f} s left" if seconds < 100.0 else f", about {seconds / 60.0:.0f} min left"

    def hear(self, what: str, done: int, total: int) -> None:
        """Show what a long computation tells (`ground.notes`) as a stage of its own."""
        if (what, total) != (self._text, self._total):
            self.stage(what, total)
        while self._done < done:
            self.advance()

    def detail(self, text: str) -> None:
        """Name the unit of work that is being done."""
        if self._bar is not None:
            self._bar.update(self._task, description=f"{self._text}: {text}")
        elif not self._quiet:
            place = f" ({self._done}/{self._total}{self._left()})" if self._done and self._total else ""
            self.note(f"{self._text}: {text}{place}")
            self._spoke = perf_counter()
