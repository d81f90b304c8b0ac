"""Seconds that a scene takes, stage by stage; no file whose bytes are promised holds them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

REST = "rest"
"""What is in no stage."""


class Clock:
    """Wall time of one piece of work; what is in an inner stage does not count to the outer.

    Attributes:
        seconds: of each stage so far, and REST.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._stage, self._since = REST, time.perf_counter()

    def enter(self, stage: str) -> str:
        """Go over to a stage; returns the one that ran until now."""
        now = time.perf_counter()
        self.seconds[self._stage] += now - self._since
        before, self._stage, self._since = self._stage, stage, now
        return before


_running: ContextVar[Clock | None] = ContextVar("clock", default=None)


@contextmanager
def clocked() -> Iterator[dict[str, float]]:
    """Stage -> seconds of what the block does; filled in when the block ends, however it ends."""
    clock, seconds = Clock(), dict[str, float]()
    token = _running.set(clock)
    try:
        yield seconds
    finally:
        _running.reset(token)
        clock.enter(REST)
        seconds.update(clock.seconds)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """A stage of the work that is clocked, as a block or around a function; nothing where none is."""
    clock = _running.get()
    if clock is None:
        yield
        return
    before = clock.enter(name)
    try:
        yield
    finally:
        clock.enter(before)
