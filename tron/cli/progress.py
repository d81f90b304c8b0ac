"""Progress of long work on stderr: a bar with an estimate on a terminal, sparse lines in a log."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sized
from types import TracebackType
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

Item = TypeVar("Item")

log = logging.getLogger(__name__)

LINES = 10
"""Lines about the whole work where there is no terminal."""
LINE_SECONDS = 20.0
"""Seconds without a line after which there is one between those."""


class Progress:
    """Bar of a long work; a context manager.

    Args:
        label: names the work.
        total: its size in any unit; None where nobody knows.
        start: how much was done before.
        unit: of the size, such as "clips".
    """

    def __init__(self, label: str, total: float | None, start: float = 0, unit: str = "") -> None:
        self._label, self._total, self._unit = label, total, f" {unit}" if unit else ""
        self._start = self._done = start
        self._began = self._last_line = time.monotonic()
        self._lines = self._tenths(start)
        self._bar: Bar | None = None
        console = Console(stderr=True)
        if console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"))
            times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
            self._bar = Bar(*columns, *times, console=console, refresh_per_second=2)
            self._task = self._bar.add_task(label, total=total, completed=int(start), said=self._count())
            self._bar.start()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def advance(self, amount: float = 1, text: str = "") -> None:
        """Count a piece of the work; see :meth:`update`."""
        self.update(self._done + amount, text)

    def update(self, done: float, text: str = "") -> None:
        """Show that so much is done, what was done before included, and a few words, such as "31.2 dB"."""
        self._done = done
        said = f"{self._count()}, {text}" if text else self._count()
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._task, completed=done, said=said)
        elif self._tenths(done) > self._lines or now - self._last_line > LINE_SECONDS:
            self._lines, self._last_line = self._tenths(done), now
            log.info("%s: %s%s", self._label, said, self._left(now))

    def close(self) -> None:
        """Leave the bar as it is and give the terminal back."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _tenths(self, done: float) -> int:
        return int(done * LINES / self._total) if self._total else 0

    def _count(self) -> str:
        whole = f"{self._done:,.0f}"
        return (whole if self._total is None else f"{whole} of {self._total:,.0f}") + self._unit

    def _left(self, now: float) -> str:
        if self._total is None or self._done <= self._start:
            return ""
        left = (now - self._began) * (self._total - self._done) / (self._done - self._start)
        minutes, seconds = divmod(round(left), 60)
        return f", {minutes}:{seconds:02d} left"


def track(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items, showing how far the work on them has come.

    Args:
        items: what is worked on.
        label: names the work.
        total: the number of items, where they do not know it themselves.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with Progress(label, total) as progress:
        for item in items:
            yield item
            progress.advance()
