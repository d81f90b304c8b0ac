"""Progress of long work on stderr: a bar with an estimate on a terminal, sparse lines in a log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Iterator, Sized
from types import TracebackType
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

Item = TypeVar("Item")

log = logging.getLogger(__name__)

LINES = 10
"""Lines about the whole work where there is no terminal."""
LINE_SECONDS = 1.0
"""Seconds between two lines at least."""
SILENT_SECONDS = 5.0
"""Seconds without a line after which there is one, however long a piece takes."""
SILENT_SHARE = 0.02
"""The same as a share of what the work has taken so far: long work is not heard of as often."""
MEASURED = 0.25
"""Pieces after the first are timed for this share of the first one's time before a time left is told: the
first waits for kernels to be compiled, and several workers begin at once.
"""


class Progress:
    """Bar of a long work; a context manager. Where there is no terminal its name is a line at once.

    Args:
        label: names the work.
        total: its size in any unit; None where nobody knows, or where it is one piece.
        start: how much was done before.
        unit: of the size, such as "clips".
    """

    def __init__(self, label: str, total: float | None, start: float = 0, unit: str = "") -> None:
        self._label, self._total, self._unit = label, total, f" {unit}" if unit else ""
        self._done = start
        self._began = self._last_line = time.monotonic()
        self._first: tuple[float, float] | None = None  # when the first piece was done, and how much was then
        self._lines = self._tenths(start)
        self._bar: Bar | None = None
        self._closed = threading.Event()
        self._within: list[Progress] = _open.__dict__.setdefault("works", [])
        self._within.append(self)
        console = Console(stderr=True)
        if console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"))
            times = (TimeElapsedColumn(), TextColumn("{task.fields[left]}"))
            self._bar = Bar(*columns, *times, console=console, refresh_per_second=2)
            self._task = self._bar.add_task(
                label, total=total, completed=int(start), said=self._count(), left=""
            )
            self._bar.start()
        else:
            log.info("%s%s", label, f": {self._count()}" if total else "")
            threading.Thread(target=self._break_silence, daemon=True).start()

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
        left = self._left(now)
        if self._first is None:
            self._first = now, done
        if self._bar is not None:
            self._bar.update(self._task, completed=done, said=said, left=left)
        elif (self._tenths(done) > self._lines and now - self._last_line >= LINE_SECONDS) or self._is_silent(
            now
        ):
            self._lines = self._tenths(done)
            self._say(now, f"{said}, {left}" if left else said)

    def close(self) -> None:
        """Leave the bar as it is and give the terminal back."""
        self._closed.set()
        if self in self._within:
            self._within.remove(self)
            for outer in self._within[-1:]:  # which was heard of by this one
                outer._last_line = max(outer._last_line, self._last_line)
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _say(self, now: float, said: str) -> None:
        self._last_line = now
        log.info("%s: %s", self._label, said)

    def _break_silence(self) -> None:
        """Say that a piece takes long, unless another work within this one speaks."""
        while not self._closed.wait(0.5):
            now = time.monotonic()
            if self._within[-1:] == [self] and self._is_silent(now):
                so_far = f"{_minutes(now - self._began)} so far"
                counted = self._total is not None or self._done
                self._say(now, f"{self._count()}, {so_far}" if counted else so_far)

    def _is_silent(self, now: float) -> bool:
        return now - self._last_line >= max(SILENT_SECONDS, SILENT_SHARE * (now - self._began)) - 0.5

    def _tenths(self, done: float) -> int:
        return int(done * LINES / self._total) if self._total else 0

    def _count(self) -> str:
        whole = f"{self._done:,.0f}"
        return (whole if self._total is None else f"{whole} of {self._total:,.0f}") + self._unit

    def _left(self, now: float) -> str:
        """The time left in words; none before it is measured, or where nothing is left."""
        if self._total is None or self._first is None or self._done >= self._total:
            return ""
        at, done = self._first
        if self._done <= done or now - at < max(2.0, MEASURED * (at - self._began)):
            return ""
        return f"{_minutes((now - at) * (self._total - self._done) / (self._done - done))} left"


_open = threading.local()
"""Works that are under way in each thread, the innermost last."""


def _minutes(seconds: float) -> str:
    return "{}:{:02d}".format(*divmod(round(seconds), 60))


def working(label: str) -> Progress:
    """Progress of work that is one piece, such as reading a file: a context manager that names it."""
    return Progress(label, None)


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
