"""Time several contestants in turns, so that noise of the machine affects all equally."""

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
    """Seconds of each repetition in order; index k is round k of all contestants."""

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median, s."""
        return float(np.median(self.seconds))

    def over(self, other: Times) -> float:
        """Return the median over the median of ``other``, over the rounds of both."""
        rounds = min(len(self.seconds), len(other.seconds))
        return float(np.median(self.seconds[:rounds]) / np.median(other.seconds[:rounds]))


@dataclass(frozen=True)
class Timed:
    """Times of all contestants in one case.

    Attributes:
        kind: name of the measurement in times.json.
        case: in metrics, such as 50k_512: surfels, and the view's width in pixels.
        times: contestant -> times.
    """

    kind: str
    case: str
    times: Mapping[str, Times]

    def row(self, metric: str, value: float, unit: str, *contestants: str) -> Row:
        """Return a row of this case; ``n`` is the fewest rounds of named contestants, by default of all."""
        rounds = min(len(self.times[name].seconds) for name in contestants or self.times)
        return Row(metric=f"{metric}.{self.case}", value=value, unit=unit, n=rounds)

    def over(self, metric: str, slow: str, fast: str) -> Row:
        """Return a row of one contestant's time over another's."""
        return self.row(metric, self.times[slow].over(self.times[fast]), "x", slow, fast)


def format_count(count: int) -> str:
    """Format a number of surfels for a metric's name: 10000 -> '10k', 1000000 -> '1m', 300 -> '300'.

    >>> format_count(200_000), format_count(1_000_000), format_count(1500)
    ('200k', '1m', '1500')
    """
    for size, letter in ((1_000_000, "m"), (1_000, "k")):
        if count >= size and count % size == 0:
            return f"{count // size}{letter}"
    return str(count)


def seconds_of(work: Callable[[], Any]) -> float:
    """Time one call until the device has finished, including evaluation of the result."""
    dr.sync_thread()
    begin = time.perf_counter()
    dr.eval(work())
    dr.sync_thread()
    return time.perf_counter() - begin


def interleaved(contestants: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, Times]:
    """Time the contestants in turns: A B C, A B C, ...

    Each is called once before, to compile its kernels. A contestant over ``SLOW_SECONDS`` stops after
    ``SLOW_ROUNDS`` rounds; garbage is collected between rounds, never within.
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
