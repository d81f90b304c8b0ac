"""SIGTERM as an exception: what a command started ends with it, and nothing is left half-written."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def termination_unwinds() -> Iterator[None]:
    """Let SIGTERM end the block by SystemExit, so that the process does not leave its children running.

    Only the main thread may set handlers; in others the block runs as it is.
    """

    def end(signum: int, _frame: object) -> None:
        raise SystemExit(128 + signum)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
