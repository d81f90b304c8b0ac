"""Sources of samples: a split decoded into memory, or read frame by frame where it lies.

Exposure is applied when a clip is loaded, AgX after augmentation (train.augmentation).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from train.light_mixing import OtherLights
from train.samples import Sample
from tron import seeds
from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.schema import TARGET

log = logging.getLogger(__name__)

MOST_TRIES = 64
"""Clips in a row that may be damaged before a run ends."""


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


class ShortClip(TronError):
    """Clip of fewer frames than a sample has: a mistake in the dataset's recipe, not damage."""


def _window(draw: Draw, count: int, split: str) -> slice:
    """Frames of the sample out of a clip of `count`, at a random start."""
    if count < draw.frames:
        raise ShortClip(f"split '{split}' has a clip of {count} frames", mend=f"{draw.frames} are needed")
    start = int(draw.random.integers(count - draw.frames + 1))
    return slice(start, start + draw.frames)


class IndexedSplit:
    """A split on a disk or in a store, of which each sample reads its own frames.

    Sample number n is of clip n of the split's passes. Where that clip's frames are damaged, those of clip
    n + 1, n + 2, ... stand in, so that which samples there are follows from the data alone; the log names
    each damaged clip once.

    Args:
        clips: of the split. split: its name in this run. members: that samples have. seed: of the run.
        mix_lights: share of the samples that show their scene under two of its lights (train.light_mixing).
    """

    def __init__(
        self, clips: ClipStore, split: str, members: Sequence[str], seed: int, mix_lights: float = 0.0
    ):
        self.clips, self.split, self.members = clips, split, tuple(members)
        self._passes = Passes(seed, split, len(clips))
        self._lights = OtherLights(clips, mix_lights, self.read) if mix_lights > 0 else None
        self._named: set[int] = set()

    def sample(self, draw: Draw) -> Sample:
        """Frames of clip `draw.number` of the passes, from a random start.

        Raises:
            TronError: a clip is too short; or no clip of the next 64, or of a whole pass, is whole.
        """
        failure: TronError | None = None
        for ahead in range(min(MOST_TRIES, len(self.clips))):
            number = self._passes.clip(draw.number + ahead)
            try:
                found = self._drawn(number, draw)
            except ShortClip:
                raise
            except TronError as error:
                failure = error
                self._name(number, error)
            else:
                return replace(found, stands_in=ahead > 0)
        assert failure is not None
        raise failure

    def frames(self, number: int) -> int:
        """Frames of a clip; TronError where its metadata are damaged."""
        return self.clips.meta(number).frames

    def read(self, number: int, window: slice) -> Sample:
        """Frames of a clip; TronError where they are damaged."""
        return Sample.of(self.clips.read_frames(number, range(window.start, window.stop), self.members))

    def _drawn(self, number: int, draw: Draw) -> Sample:
        window = _window(draw, self.frames(number), self.split)
        sample = self.read(number, window)
        return sample if self._lights is None else self._lights.mixed(sample, number, window, draw.random)

    def _name(self, number: int, error: TronError) -> None:
        if number not in self._named:
            self._named.add(number)
            key = self.clips.key(number)
            log.warning("Split %s: clip %s is damaged, others stand in: %s", self.split, key, error)


class CachedSplit(IndexedSplit):
    """A split decoded into memory: IndexedSplit's samples, bit by bit. Damaged clips are left where they lie.

    Args:
        clips, split, members, seed, mix_lights: as IndexedSplit's.
    """

    def __init__(
        self, clips: ClipStore, split: str, members: Sequence[str], seed: int, mix_lights: float = 0.0
    ):
        super().__init__(clips, split, members, seed, mix_lights)
        decoded = ((number, self._whole(number)) for number in range(len(clips)))
        self._decoded = {number: sample for number, sample in decoded if sample is not None}

    def frames(self, number: int) -> int:
        """Frames of a clip; TronError where its metadata are damaged."""
        clip = self._decoded.get(number)
        return super().frames(number) if clip is None else clip.buffers[TARGET].shape[1]

    def read(self, number: int, window: slice) -> Sample:
        """Frames of a clip; TronError where they are damaged."""
        clip = self._decoded.get(number)
        if clip is None:
            return super().read(number, window)
        return Sample({name: video[:, window] for name, video in clip.buffers.items()}, clip.display)

    def _whole(self, number: int) -> Sample | None:
        try:
            return Sample.of(self.clips.read_frames(number, members=self.members))
        except TronError:  # perhaps of one frame: the samples of the others are whole
            return None
