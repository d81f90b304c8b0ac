"""Progress of long work: a bar with an estimate on a terminal, plain lines in a log."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Item = TypeVar("Item")

# Where there is no terminal, this many lines tell of the whole work.
_LINES = 10


def track(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items, showing on stderr how far the work on them has come.

    total: their number, where they do not know it themselves.
    """
    if total is None:
        total = len(items) if isinstance(items, Sized) else None
    console = Console(stderr=True)
    if not console.is_terminal:
        yield from _lines(items, label, total)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        yield from progress.track(items, total=total, description=label)


def _lines(items: Iterable[Item], label: str, total: int | None) -> Iterator[Item]:
    log = logging.getLogger(__name__)
    told = 0
    for done, item in enumerate(items, start=1):
        yield item
        if total and done * _LINES // total > told:
            told = done * _LINES // total
            log.info("%s: %d of %d", label, done, total)


class StepBar:
    """A bar for one stage of many steps, with what its last step said of itself.

    Args:
        label: of the stage. total: its steps. start: steps done before.
    """

    def __init__(self, label: str, total: int, start: int = 0) -> None:
        self._label, self._total, self._told = label, total, start * _LINES // max(total, 1)
        console = Console(stderr=True)
        self._bar: Progress | None = None
        if console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
            self._bar = Progress(
                *columns, TextColumn("{task.fields[said]}"), TimeRemainingColumn(), console=console
            )
            self._task = self._bar.add_task(label, total=total, completed=start, said="")
            self._bar.start()

    def update(self, done: int, said: str) -> None:
        """``done`` steps are behind us; ``said`` is a few words, such as "31.2 dB, 9,800 surfels"."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, said=said)
        elif done * _LINES // self._total > self._told:
            self._told = done * _LINES // self._total
            logging.getLogger(__name__).info("%s: %d of %d, %s", self._label, done, self._total, said)

    def close(self) -> None:
        """Leave the bar as it is and give the terminal back."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
