"""The limit that a run meets first: space, memory, storage or processors."""

from __future__ import annotations

import os

SLOW_STORAGE = 100e6
"""Bytes a second of a slow shared disk, or of a gigabit network to an object store."""


def first_limit(
    *, needed: float, free: float, memory: float, workers: int, here: bool, seconds: float, written: float
) -> str:
    """The first limit that a plan runs into, in words.

    Args:
        needed, free: bytes that are asked of the disk, and that it has.
        memory: of a worker, bytes; 0 where it is not known.
        workers: how many there are.
        here: they share this machine's memory.
        seconds: of processor, of all scenes together.
        written: bytes of shards and the rest, of all scenes together.
    """
    if needed > free:
        return f"space: {(needed - free) / 1e9:.3g} GB are missing; store=URL sends shards away"
    if here and workers * memory > (there := machine_memory()):
        most = int(there // memory)
        return (
            f"memory: {workers} workers take {workers * memory / 1e9:.2g} GB of {there / 1e9:.2g}; {most} fit"
        )
    if not seconds:
        return "nothing: nothing is missing"
    rate = written / seconds
    keeps_up = int(SLOW_STORAGE // rate) if rate else workers
    if keeps_up < workers:
        return (
            f"storage, if it takes {SLOW_STORAGE / 1e6:.0f} MB/s: a worker writes {rate / 1e6:.2g} MB/s, so "
            f"that keeps up with {keeps_up}"
        )
    return (
        f"processors: a worker writes {rate / 1e6:.2g} MB/s; storage of {SLOW_STORAGE / 1e6:.0f} MB/s would "
        f"bind at {keeps_up:,} workers"
    )


def machine_memory() -> float:
    """Bytes of this machine's memory."""
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
