"""Times of several ways to do one thing, taken in turns so that a noisy machine disturbs them alike."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from tron.errors import TronError

SLOW_SECONDS = 1.0


@dataclass(frozen=True)
class Times:
    """Seconds of each repetition, in the order in which they were taken; round k of all stands at index k."""

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median, s."""
        return float(np.median(self.seconds))

    @property
    def spread(self) -> float:
        """Largest minus smallest over the median."""
        return (max(self.seconds) - min(self.seconds)) / self.median

    def over(self, other: Times) -> float:
        """How many times as long this takes as ``other``: ratio of medians over the rounds of both."""
        rounds = min(len(self.seconds), len(other.seconds))
        return float(np.median(self.seconds[:rounds]) / np.median(other.seconds[:rounds]))

    def range_over(self, other: Times) -> tuple[float, float]:
        """Smallest and largest ratio among the rounds in which both ran."""
        ratios = [a / b for a, b in zip(self.seconds, other.seconds, strict=False)]
        return min(ratios), max(ratios)


def seconds_of(work: Callable[[], Any]) -> float:
    """Time of one call until the device has finished; what it returns is evaluated within."""
    dr.sync_thread()
    begin = time.perf_counter()
    dr.eval(work())
    dr.sync_thread()
    return time.perf_counter() - begin


def interleaved(
    contestants: Mapping[str, Callable[[], Any]], repetitions: int = 5, slow_repetitions: int = 3
) -> dict[str, Times]:
    """Time the contestants in turns: A B C, A B C, ...

    Each is called once before, which compiles its kernels. One that takes over a second sits out once it has
    ``slow_repetitions``; garbage is collected between rounds, never within.

    Raises:
        TronError: a number of repetitions below one.
    """
    if bool(min(repetitions, slow_repetitions) < 1):
        raise TronError(f"{min(repetitions, slow_repetitions)} repetitions", mend="give one or more")
    for work in contestants.values():
        seconds_of(work)
    taken: dict[str, list[float]] = {name: [] for name in contestants}
    enabled = gc.isenabled()
    for _ in range(max(repetitions, slow_repetitions)):
        gc.collect()
        gc.disable()
        for name, work in contestants.items():
            so_far = taken[name]
            limit = slow_repetitions if so_far and np.median(so_far) > SLOW_SECONDS else repetitions
            if len(so_far) < limit:
                so_far.append(seconds_of(work))
        if enabled:
            gc.enable()
    return {name: Times(tuple(values)) for name, values in taken.items()}
