"""SIGTERM and Ctrl-C in order: work in hand is finished, nothing is left half-written or running."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

TERMINATED = 128 + signal.SIGTERM
"""Exit code of a command that SIGTERM has ended."""
SAME_SECONDS = 5.0
"""Seconds in which further signals say nothing new: `timeout` and Slurm tell every process of a group, and
the command that started some of them tells these too.
"""
_AGAIN_SECONDS = 0.02


@contextmanager
def termination_unwinds() -> Iterator[None]:
    """Let SIGTERM end the block by SystemExit, so that the process does not leave its children running.

    An exception out of a signal handler that lands in a destructor or in a callback of the importer is
    dropped by Python; while the block runs, its signal comes again. Only the main thread may set handlers; in
    others the block runs as it is.
    """

    came = False

    def end(signum: int, _frame: object) -> None:
        nonlocal came
        came = True
        raise SystemExit(128 + signum)

    def again(dropped: sys.UnraisableHookArgs) -> None:
        interrupted = issubclass(dropped.exc_type, KeyboardInterrupt)
        if interrupted or (came and issubclass(dropped.exc_type, SystemExit)):
            signum = signal.SIGINT if interrupted else signal.SIGTERM
            threading.Timer(_AGAIN_SECONDS, os.kill, (os.getpid(), signum)).start()
        else:
            hook(dropped)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before, hook = signal.signal(signal.SIGTERM, end), sys.unraisablehook
    sys.unraisablehook = again
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        sys.unraisablehook = hook


@dataclass
class Termination:
    """The signal that asked for the end, if one did."""

    signum: int | None = None

    @property
    def asked(self) -> bool:
        """Whether one has come."""
        return self.signum is not None


@contextmanager
def termination_noted(line: str | None = None) -> Iterator[Termination]:
    """Note SIGTERM and SIGINT while the block runs; if one came its end raises SystemExit, KeyboardInterrupt.

    For work that must be left between two steps, and for a block that starts and polls processes: an
    exception out of a signal handler may land within `subprocess.Popen` between the taking of its lock and
    the ``try`` that releases it, and whoever waits for that process then waits for ever. The block must look
    at ``asked`` by itself. What it raises gives way. Signals that are ignored stay so. Only the main thread
    may set handlers; in others nothing is noted.

    Args:
        line: said on stderr as soon as a signal comes, "" for nothing; a signal SAME_SECONDS after the first
            then ends the block at once. None: nothing is said, and the block ends by itself alone.
    """
    termination = Termination()
    asked_at = 0.0

    def note(signum: int, _frame: object) -> None:
        nonlocal asked_at
        now = time.monotonic()
        if termination.signum is None:
            termination.signum, asked_at = signum, now
            if line:
                os.write(2, f"\n{line}\n".encode())  # print() may be amid another line of this thread
        elif line is not None and now - asked_at >= SAME_SECONDS:
            raise _end_of(signum)

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
        if termination.signum is not None:
            raise _end_of(termination.signum)


def ending_behind(error: BaseException) -> BaseException | None:
    """The KeyboardInterrupt or SystemExit by SIGTERM that an exception was raised in place of, if any.

    Extensions that are interrupted amid their import raise ImportError for it, and what follows others.
    """
    seen: list[BaseException] = []
    each: BaseException | None = error
    while each is not None and each not in seen:
        if isinstance(each, KeyboardInterrupt) or (isinstance(each, SystemExit) and each.code == TERMINATED):
            return each
        seen.append(each)
        each = each.__cause__ or each.__context__
    return None


def _end_of(signum: int) -> KeyboardInterrupt | SystemExit:
    return KeyboardInterrupt() if signum == signal.SIGINT else SystemExit(128 + signum)
