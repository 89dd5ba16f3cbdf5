"""Progress on stderr: a bar on a terminal, or a line every 20 seconds elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

INTERVAL = 20.0  # seconds between lines if stderr is not a terminal


class Progress:
    """Shows the progress of `total` steps. `log` prints a line above the bar."""

    def __init__(self, title: str, total: int) -> None:
        self._title, self._total, self._done = title, total, 0
        self._console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Bar(*columns, console=self._console, disable=not self._console.is_terminal)
        self._task = self._bar.add_task(title, total=total)
        self._started = self._last = time.monotonic()

    def __enter__(self) -> Self:
        if self._console.is_terminal:  # otherwise rich 13.7 ends a disabled bar with an empty line
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._console.is_terminal:
            self._bar.stop()

    def advance(self, count: int = 1, note: str = "") -> None:
        self._done += count
        self._bar.update(self._task, advance=count, description=f"{self._title} {note}".rstrip())
        now = time.monotonic()
        if not self._console.is_terminal and (now - self._last > INTERVAL):
            self._last = now
            left = (now - self._started) / self._done * (self._total - self._done) if self._done else 0.0
            print(f"{self._title}: {self._done}/{self._total} {note} {left:.0f} s left", file=sys.stderr, flush=True)

    def log(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
