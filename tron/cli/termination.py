"""SIGTERM in order: what a command started ends with it, and nothing is left half-written."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


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


@dataclass
class Termination:
    """Whether SIGTERM has come."""

    asked: bool = False


@contextmanager
def termination_noted() -> Iterator[Termination]:
    """Note SIGTERM while the block runs; if it came, the end of the block raises SystemExit.

    For a block that starts and polls processes: an exception out of a signal handler may land within
    `subprocess.Popen` between the taking of its lock and the ``try`` that releases it, and whoever waits for
    that process then waits for ever. The block must look at ``asked`` by itself.
    Only the main thread may set handlers; in others nothing is noted.
    """
    termination = Termination()

    def note(_signum: int, _frame: object) -> None:
        termination.asked = True

    if threading.current_thread() is not threading.main_thread():
        yield termination
        return
    before = signal.signal(signal.SIGTERM, note)
    try:
        yield termination
    finally:
        signal.signal(signal.SIGTERM, before)
    if termination.asked:
        raise SystemExit(128 + signal.SIGTERM)
