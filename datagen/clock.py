"""Seconds per stage of making a scene; files with promised bytes do not contain them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

REST = "rest"
"""What is in no stage."""


class Clock:
    """Wall time of one piece of work; time in an inner stage does not count for the outer one.

    Attributes:
        seconds: of each stage so far, and REST.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._stage, self._since = REST, time.perf_counter()

    def enter(self, stage: str) -> str:
        """Switch to a stage; return the previous one."""
        now = time.perf_counter()
        self.seconds[self._stage] += now - self._since
        before, self._stage, self._since = self._stage, stage, now
        return before


_running: ContextVar[Clock | None] = ContextVar("clock", default=None)


@contextmanager
def clocked() -> Iterator[dict[str, float]]:
    """Yield stage -> seconds of the block, filled in when the block ends, in any way."""
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
    """Time a block or function as a stage of the clocked work; without a clock, do nothing."""
    clock = _running.get()
    if clock is None:
        yield
        return
    before = clock.enter(name)
    try:
        yield
    finally:
        clock.enter(before)
