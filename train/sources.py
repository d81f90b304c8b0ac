"""Sources of samples: a split decoded into memory, or read frame by frame where it lies.

Exposure is applied when a clip is loaded, AgX after augmentation (train.augmentation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from tron import seeds
from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.schema import TARGET, Clip


def channels_first(frames: np.ndarray) -> np.ndarray:
    """(K, H, W, C) -> (C, K, H, W) float32."""
    return np.ascontiguousarray(np.moveaxis(frames, -1, 0), np.float32)


@dataclass(frozen=True)
class Sample:
    """Frames of one clip.

    Attributes:
        buffers: (3, K, H, W) by name: linear under the clip's exposure, or in [0, 1] where display-encoded.
        display: names of the display-encoded ones.
    """

    buffers: dict[str, Tensor]
    display: frozenset[str] = frozenset()

    @classmethod
    def of(cls, clip: Clip) -> Sample:
        """All frames of a clip, in the members that it was read with."""
        buffers = {name: torch.from_numpy(channels_first(clip.exposed(name))) for name in clip.frames}
        return cls(buffers, frozenset(name for name in buffers if clip.is_display(name)))


@dataclass(frozen=True)
class Draw:
    """Order for one sample.

    Attributes:
        number: of the sample within its split, counted through the stage.
        random: its own stream of random numbers.
        frames: K.
    """

    number: int
    random: np.random.Generator
    frames: int


class Source(Protocol):
    """Clips of a split that samples are drawn from by number."""

    def sample(self, draw: Draw) -> Sample:
        """The drawn sample, K = draw.frames frames."""
        ...


class Passes:
    """Endless passes over the clips of a split, each clip once a pass, in an order of the pass's own.

    A pass is a function of seed, split and its number alone, so that any process can say which clip is the
    n-th.
    """

    def __init__(self, seed: int, split: str, clips: int):
        self.seed, self.split, self.clips = seed, split, clips
        self._pass = -1
        self._order = np.zeros(0, np.int64)

    def clip(self, number: int) -> int:
        """Clip of the n-th sample."""
        which, place = divmod(number, self.clips)
        if which != self._pass:
            order = seeds.generator(self.seed, "train", "pass", self.split, which)
            self._pass, self._order = which, order.permutation(self.clips)
        return int(self._order[place])


def _window(draw: Draw, count: int, split: str) -> slice:
    """Frames of the sample out of a clip of `count`, at a random start."""
    if count < draw.frames:
        raise TronError(f"split '{split}' has a clip of {count} frames", mend=f"{draw.frames} are needed")
    start = int(draw.random.integers(count - draw.frames + 1))
    return slice(start, start + draw.frames)


class CachedSplit:
    """A split decoded into memory; sample number n is of clip n of its passes.

    Args:
        clips: of the split. split: its name in this run. members: that samples have. seed: of the run.
    """

    def __init__(self, clips: ClipStore, split: str, members: Sequence[str], seed: int):
        self.split = split
        self.samples = [Sample.of(clips.read_frames(n, members=members)) for n in range(len(clips))]
        self._passes = Passes(seed, split, len(clips))

    def sample(self, draw: Draw) -> Sample:
        """Frames of clip `draw.number` of the passes, from a random start."""
        clip = self.samples[self._passes.clip(draw.number)]
        window = _window(draw, clip.buffers[TARGET].shape[1], self.split)
        return Sample({name: video[:, window] for name, video in clip.buffers.items()}, clip.display)


class IndexedSplit:
    """A split on a disk or in a store, of which each sample reads its own frames: CachedSplit's, bit by bit.

    Args:
        clips: of the split. split: its name in this run. members: that samples have. seed: of the run.
    """

    def __init__(self, clips: ClipStore, split: str, members: Sequence[str], seed: int):
        self.clips, self.split, self.members = clips, split, tuple(members)
        self._passes = Passes(seed, split, len(clips))

    def sample(self, draw: Draw) -> Sample:
        """Frames of clip `draw.number` of the passes, from a random start."""
        number = self._passes.clip(draw.number)
        window = _window(draw, self.clips.meta(number).frames, self.split)
        return Sample.of(self.clips.read_frames(number, range(window.start, window.stop), self.members))
