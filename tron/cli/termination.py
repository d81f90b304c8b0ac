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
    """The signal that asked for the end, if one did."""

    signum: int | None = None

    @property
    def asked(self) -> bool:
        """Whether one has come."""
        return self.signum is not None


@contextmanager
def termination_noted() -> Iterator[Termination]:
    """Note SIGTERM and SIGINT while the block runs; if one came its end raises SystemExit, KeyboardInterrupt.

    For a block that starts and polls processes: an exception out of a signal handler may land within
    `subprocess.Popen` between the taking of its lock and the ``try`` that releases it, and whoever waits for
    that process then waits for ever. The block must look at ``asked`` by itself. What it raises gives way.
    Signals that are ignored stay so. Only the main thread may set handlers; in others nothing is noted.
    """
    termination = Termination()

    def note(signum: int, _frame: object) -> None:
        termination.signum = signum

    if threading.current_thread() is not threading.main_thread():
        yield termination
        return
    noted = [each for each in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(each) != signal.SIG_IGN]
    before = {each: signal.signal(each, note) for each in noted}
    try:
        yield termination
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
        if termination.signum == signal.SIGINT:
            raise KeyboardInterrupt
        if termination.signum is not None:
            raise SystemExit(128 + termination.signum)
