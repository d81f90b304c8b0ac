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
