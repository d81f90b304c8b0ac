"""What a user may say about a capture before it is loaded."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from tron.errors import TronError

Format = Literal["auto", "transforms", "colmap", "tensoir", "tron", "photos"]
Matching = Literal["auto", "exhaustive", "sequential"]


@dataclass(frozen=True)
class PosingSettings:
    """How photos without poses are posed by structure from motion.

    Attributes:
        workspace: folder that keeps the result, so that it is computed once; None is the folder
            ``structure_from_motion`` beside the photos.
        matching: ``exhaustive`` compares every pair of photos, ``sequential`` each with the ten after it in
            the order of their names (a video); ``auto`` is exhaustive up to 200 photos.
        max_side: features are sought in copies of the photos of at most this many pixels a side.
        threads: of feature extraction, matching and adjustment; 0 takes all cores. The same photos give the
            same poses bit by bit with one thread, nearly so with more.
        seed: of the random samples that poses are estimated from.
    """

    workspace: Path | None = None
    matching: Matching = "auto"
    max_side: int = 1600
    threads: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.matching not in get_args(Matching):
            raise TronError(
                f"photos cannot be matched by {self.matching!r}",
                mend=f"one of {', '.join(get_args(Matching))}",
            )
        if self.max_side < 64 or self.threads < 0:
            raise TronError("posing photos needs max_side of at least 64 and threads of 0 or more")


@dataclass(frozen=True)
class LoadSettings:
    """How a capture is read. Of path-traced views (``tron``) only ``up`` counts: they bring their own split.

    Attributes:
        format: what the folder holds; ``auto`` looks. ``tron`` is a folder of path-traced views.
        images: folder of the photos where it is not the one that the poses name, from the capture's folder or
            absolute.
        downscale: photos are made this many times smaller, at least 1: 8 makes 135 x 240 of 1080 x 1920.
        max_side: or so much smaller that no side is longer than this many pixels.
        test_every: every n-th view in the order of names is held out, the first one included, unless the
            files say themselves which are; 0 holds out none.
        up: (3,) up direction in the capture's world, instead of the one estimated from the cameras.
        light: which of TensoIR's lights the photos are taken under.
        cache_bytes: how much decoded image data is kept in memory.
        posing: for a folder of photos without poses.

    Raises:
        TronError: a value outside its range, or both downscale and max_side.
    """

    format: Format = "auto"
    images: str | Path | None = None
    downscale: float = 1.0
    max_side: int | None = None
    test_every: int = 8
    up: tuple[float, float, float] | None = None
    light: str = "sunset"
    cache_bytes: int = 1_000_000_000
    posing: PosingSettings = field(default_factory=PosingSettings)

    def __post_init__(self) -> None:
        if self.format not in get_args(Format):
            raise TronError(
                f"unknown capture format {self.format!r}", mend=f"one of {', '.join(get_args(Format))}"
            )
        if not (np.isfinite(self.downscale) and self.downscale >= 1):
            raise TronError(f"downscale is {self.downscale}", mend="give a number of at least 1")
        if self.max_side is not None and (self.max_side < 1 or self.downscale != 1):
            raise TronError(
                f"max_side is {self.max_side} and downscale {self.downscale:g}",
                mend="give one of them, and at least 1",
            )
        if self.test_every < 0:
            raise TronError(f"test_every is {self.test_every}", mend="give 0 or more")
        if self.cache_bytes < 0:
            raise TronError(f"cache_bytes is {self.cache_bytes}", mend="give 0 or more")
        if self.up is not None and not (
            len(self.up) == 3 and np.isfinite(self.up).all() and np.linalg.norm(self.up) > 1e-6
        ):
            raise TronError(f"up is {self.up}", mend="give a direction of three numbers")

    def size_of(self, width: int, height: int) -> tuple[int, int]:
        """Width and height that an image of this size is reduced to."""
        factor = self.downscale
        if self.max_side is not None:
            factor = max(1.0, max(width, height) / self.max_side)
        return max(1, round(width / factor)), max(1, round(height / factor))
