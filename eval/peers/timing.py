"""Times of several ways to do one thing, taken in turns so that a noisy machine disturbs them alike."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import drjit as dr
import numpy as np

from eval.results import Row
from tron.storage import write_atomic

SLOW_SECONDS = 1.0


class Rounds(NamedTuple):
    """Rounds of timing.

    Attributes:
        usual: of a contestant that takes up to ``SLOW_SECONDS``.
        slow: of one that takes longer.
    """

    usual: int = 5
    slow: int = 3


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

    def range_over(self, other: Times) -> tuple[float, float]:
        """Smallest and largest ratio among the rounds in which both ran."""
        ratios = [a / b for a, b in zip(self.seconds, other.seconds, strict=False)]
        return min(ratios), max(ratios)


@dataclass(frozen=True)
class Timed:
    """Times of all contestants on one case.

    Attributes:
        count: surfels.
        size: width and height of the view, pixels.
        times: contestant -> times.
    """

    kind: ClassVar[str]
    """Name of the measurement in times.json."""

    count: int
    size: int
    times: Mapping[str, Times]

    @property
    def case(self) -> str:
        """Name of the case in metrics, such as 50k_512."""
        return f"{format_count(self.count)}_{self.size}"

    @property
    def label(self) -> str:
        """Name in times.json."""
        return f"{self.kind} {self.case}"

    def row(self, metric: str, value: float, unit: str, *contestants: str) -> Row:
        """Row of this case; ``n`` is the fewest rounds of the contestants, of all if none is named."""
        rounds = min(len(self.times[name].seconds) for name in contestants or self.times)
        return Row(metric=f"{metric}.{self.case}", value=value, unit=unit, n=rounds)


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


def interleaved(contestants: Mapping[str, Callable[[], Any]], rounds: Rounds) -> dict[str, Times]:
    """Time the contestants in turns: A B C, A B C, ...

    Each is called once before, which compiles its kernels. One that takes over ``SLOW_SECONDS`` sits out once
    it has ``rounds.slow``; garbage is collected between rounds, never within.
    """
    for work in contestants.values():
        seconds_of(work)
    taken: dict[str, list[float]] = {name: [] for name in contestants}
    enabled = gc.isenabled()
    for _ in range(max(rounds)):
        gc.collect()
        gc.disable()
        for name, work in contestants.items():
            so_far = taken[name]
            limit = rounds.slow if so_far and np.median(so_far) > SLOW_SECONDS else rounds.usual
            if len(so_far) < limit:
                so_far.append(seconds_of(work))
        if enabled:
            gc.enable()
    return {name: Times(tuple(values)) for name, values in taken.items()}


def fastest(times: Mapping[str, Times]) -> str:
    """Contestant with the least median."""
    return min(times, key=lambda name: times[name].median)


def write_times(path: Path, cases: Iterable[Timed]) -> None:
    """Write times.json: label of a case -> contestant -> seconds of its rounds."""
    seconds = {
        found.label: {name: [round(s, 6) for s in times.seconds] for name, times in found.times.items()}
        for found in cases
    }
    write_atomic(path, json.dumps(seconds, indent=1) + "\n")
