"""How far a long run is and when it will end: a bar on a terminal, one line a scene anywhere else."""

from __future__ import annotations

import logging
import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

log = logging.getLogger(__name__)


class Progress:
    """Context manager that counts finished scenes; the estimate weighs scenes by their clips.

    Args:
        scenes, clips: how many there are in all.
        unit: what clips are called, where it is not clips that scenes give.
    """

    def __init__(self, scenes: int, clips: int, unit: str = "clips"):
        self._scenes, self._clips = scenes, clips
        self._seen = self._seen_clips = 0
        self._start = time.monotonic()
        self._bar: Bar | None = None
        if sys.stderr.isatty():
            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn(unit),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task("scenes", total=self._clips)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def done(self, name: str, clips: int) -> None:
        """Count a scene that was made."""
        self._advance(clips)
        if self._bar is not None:
            self._bar.update(self._task, advance=clips, description=name)
        else:
            log.info("%d/%d %s, %s left", self._seen, self._scenes, name, self._left())

    def failed(self, name: str, reason: str, clips: int) -> None:
        """Count a scene that was not made, and say why."""
        self._advance(clips)
        if self._bar is not None:
            self._bar.update(self._task, advance=clips)
        log.error("%d/%d %s failed: %s", self._seen, self._scenes, name, reason)

    def _advance(self, clips: int) -> None:
        self._seen += 1
        self._seen_clips += clips

    def _left(self) -> str:
        spent = time.monotonic() - self._start
        seconds = round(spent * (self._clips - self._seen_clips) / max(self._seen_clips, 1))
        return f"{seconds // 60}:{seconds % 60:02d}"
