"""Times of several ways to do one thing, taken in turns so that a noisy machine disturbs them alike."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from eval.results import Row
from tron.storage import write_atomic

SLOW_SECONDS, SLOW_ROUNDS = 1.0, 3
"""What takes longer sits out after so many rounds."""


@dataclass(frozen=True)
class Times:
    """Seconds of each repetition, in the order in which they were taken; round k of all stands at index k."""

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median, s."""
        return float(np.median(self.seconds))

    def over(self, other: Times) -> float:
        """Ratio of the medians of this and ``other``, over the rounds of both."""
        rounds = min(len(self.seconds), len(other.seconds))
        return float(np.median(self.seconds[:rounds]) / np.median(other.seconds[:rounds]))


@dataclass(frozen=True)
class Timed:
    """Times of all contestants on one case.

    Attributes:
        kind: name of the measurement in times.json.
        case: in metrics, such as 50k_512: surfels, and the view's width in pixels.
        times: contestant -> times.
    """

    kind: str
    case: str
    times: Mapping[str, Times]

    def row(self, metric: str, value: float, unit: str, *contestants: str) -> Row:
        """Row of this case; ``n`` is the fewest rounds of the contestants, of all if none is named."""
        rounds = min(len(self.times[name].seconds) for name in contestants or self.times)
        return Row(metric=f"{metric}.{self.case}", value=value, unit=unit, n=rounds)

    def over(self, metric: str, slow: str, fast: str) -> Row:
        """Row of one contestant's time over another's."""
        return self.row(metric, self.times[slow].over(self.times[fast]), "x", slow, fast)


def format_count(count: int) -> str:
    """Number of surfels in a metric's name: 10000 -> '10k', 1000000 -> '1m', 300 -> '300'.

    >>> format_count(200_000), format_count(1_000_000), format_count(1500)
    ('200k', '1m', '1500')
    """
    for size, letter in ((1_000_000, "m"), (1_000, "k")):
        if count >= size and count % size == 0:
            return f"{count // size}{letter}"
    return str(count)


def seconds_of(work: Callable[[], Any]) -> float:
    """Time of one call until the device has finished; what it returns is evaluated within."""
    dr.sync_thread()
    begin = time.perf_counter()
    dr.eval(work())
    dr.sync_thread()
    return time.perf_counter() - begin


def interleaved(contestants: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, Times]:
    """Time the contestants in turns: A B C, A B C, ...

    Each is called once before, which compiles its kernels. One that takes over ``SLOW_SECONDS`` sits out once
    it has ``SLOW_ROUNDS``; garbage is collected between rounds, never within.
    """
    for work in contestants.values():
        seconds_of(work)
    taken: dict[str, list[float]] = {name: [] for name in contestants}
    enabled = gc.isenabled()
    for _ in range(rounds):
        gc.collect()
        gc.disable()
        for name, work in contestants.items():
            so_far = taken[name]
            if len(so_far) < SLOW_ROUNDS or np.median(so_far) <= SLOW_SECONDS:
                so_far.append(seconds_of(work))
        if enabled:
            gc.enable()
    return {name: Times(tuple(values)) for name, values in taken.items()}


def write_times(path: Path, cases: Iterable[Timed]) -> None:
    """Write times.json: kind and case -> contestant -> seconds of its rounds."""
    seconds = {
        f"{each.kind} {each.case}": {
            name: [round(s, 6) for s in times.seconds] for name, times in each.times.items()
        }
        for each in cases
    }
    write_atomic(path, json.dumps(seconds, indent=1) + "\n")
