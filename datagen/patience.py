"""Time that a scene may take before its maker counts as hung."""

from __future__ import annotations

from collections import defaultdict
from statistics import median

TIMES = 20.0
"""Times the median of a split's scenes: they differ in their objects, not in their sizes and samples."""
LEAST = 600.0
"""Seconds that every scene may take: compiling kernels on a busy machine is no hang."""
KNOWN = 3
"""Scenes of a split whose times are enough for a median."""
UNKNOWN = 86_400.0
"""Seconds that a scene may take while nobody knows how long those of its split take."""


class Patience:
    """Longest time of a scene: the one that was ``given`` in seconds, else one learnt from those made."""

    def __init__(self, given: float | None) -> None:
        self._given = given
        self._seconds: defaultdict[str, list[float]] = defaultdict(list)

    def saw(self, split: str, seconds: float) -> None:
        """Learn from a scene that was made; one that failed would teach too little."""
        self._seconds[split].append(seconds)

    def limit(self, split: str) -> float:
        """Seconds that a scene of the split may take."""
        if self._given is not None:
            return self._given
        seconds = self._seconds[split]
        return UNKNOWN if len(seconds) < KNOWN else max(TIMES * median(seconds), LEAST)
