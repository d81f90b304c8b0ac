"""Sources of samples: a split decoded into memory, or read frame by frame from its store.

Exposure is applied when a clip is loaded, AgX after augmentation (train.examples.augmentation).
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from train.examples.framing import Sample
from tron import seeds
from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.schema import TARGET
from tron.shards.streaming import StreamedClips

log = logging.getLogger(__name__)

MOST_TRIES = 64
"""Most damaged clips in a row; more end the run."""


@dataclass(frozen=True)
class Draw:
    """Request for one sample.

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
    """Endless passes over the clips of a split, each clip once per pass, newly shuffled in each.

    A pass's order depends on seed, split and pass number alone, so that any process knows the n-th clip.
    Streamed shards are read from beginning to end: shards are shuffled, and clips within a block, but the
    blocks of a shard keep their order.

    Args:
        clips: number of clips.
        shards: clip numbers of each block of each streamed shard; empty: clips are shuffled freely.
    """

    def __init__(self, seed: int, split: str, clips: int, shards: Sequence[Sequence[range]] = ()):
        self.seed, self.split, self.clips, self.shards = seed, split, clips, shards
        self._pass = -1
        self._order = np.zeros(0, np.int64)

    def clip(self, number: int) -> int:
        """Clip of the n-th sample."""
        which, place = divmod(number, self.clips)
        if which != self._pass:
            self._pass, self._order = which, self._ordered(which)
        return int(self._order[place])

    def _ordered(self, which: int) -> np.ndarray:
        order = seeds.generator(self.seed, "train", "pass", self.split, which)
        if not self.shards:
            return order.permutation(self.clips)
        shards = [self.shards[place] for place in order.permutation(len(self.shards))]
        return np.concatenate([order.permutation(block) for shard in shards for block in shard])


class ShortClip(TronError):
    """A clip has fewer frames than a sample: a mistake in the dataset's recipe, not damage."""


def _window(draw: Draw, count: int, split: str) -> slice:
    """Frames of the sample out of a clip of `count`, at a random start."""
    if count < draw.frames:
        raise ShortClip(f"split '{split}' has a clip of {count} frames", mend=f"{draw.frames} are needed")
    start = int(draw.random.integers(count - draw.frames + 1))
    return slice(start, start + draw.frames)


class IndexedSplit:
    """A split on a disk, in a store or in a stream; each sample reads only its own frames.

    Sample n comes from clip n of the split's passes. If that clip's frames are damaged, clip n + 1, n + 2,
    ... takes its place, so that the samples follow from the data alone; the log names each damaged clip
    once.

    Args:
        clips: of the split. split: its name in this run. members: that samples have. seed: of the run.
        mix_lights: share of the samples that show their scene under a mixture of two of its lights
        (:class:`OtherLights`).
    """

    def __init__(
        self, clips: ClipStore, split: str, members: Sequence[str], seed: int, mix_lights: float = 0.0
    ):
        self.clips, self.split, self.members = clips, split, tuple(members)
        shards = clips.blocks() if isinstance(clips, StreamedClips) else ()
        self._passes = Passes(seed, split, len(clips), shards)
        self._lights = OtherLights(clips, mix_lights, self.read) if mix_lights > 0 else None
        self._named: set[int] = set()

    def sample(self, draw: Draw) -> Sample:
        """Frames of clip `draw.number` of the passes, from a random start.

        Raises:
            TronError: a clip is too short; or the next 64 clips, or all of a pass, are damaged.
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
    """A split decoded into memory, with exactly IndexedSplit's samples. Damaged clips are not decoded.

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
        except TronError:  # perhaps one frame is damaged: samples of the others are whole
            return None


class OtherLights:
    """Clips of the same scene and cameras under other lights, found by the clips' keys.

    Keys are SCENE-LIGHT, or SCENE-LIGHT-cNUMBER where a scene has several clips under each light.

    Args:
        clips: of the split.
        ratio: share of the samples that are mixed.
        read: frames of a clip by its number; TronError where they are damaged.
    """

    def __init__(self, clips: ClipStore, ratio: float, read: Callable[[int, slice], Sample]):
        self.clips, self.ratio, self.read = clips, ratio, read
        self._places: dict[tuple[str, str], list[int]] = defaultdict(list)
        for number in range(len(clips)):
            self._places[self._place(number)].append(number)

    def mixed(self, sample: Sample, number: int, window: slice, random: np.random.Generator) -> Sample:
        """Return a clip's frames; with probability `ratio`, blend in the frames under another light.

        Every buffer becomes w times this light's plus 1 - w times the other's, w uniform in [0, 1], each with
        its own exposure. Exposure gives an unoccluded upward-facing white plane the same radiance under each
        light (conventions.md, 5), and so under the mixture. Samples with display members, clips without
        another light, and clips whose frames have other cameras stay as they are.
        """
        if sample.display or random.random() >= self.ratio:
            return sample
        others = [each for each in self._places[self._place(number)] if each != number]
        if not others:
            return sample
        other, weight = others[int(random.integers(len(others)))], float(random.random())
        one, two = self.clips.meta(number), self.clips.meta(other)
        if (one.scene, one.cameras[window]) != (two.scene, two.cameras[window]):
            return sample
        added = self.read(other, window)
        if added.display:
            return sample
        buffers = {
            name: weight * video + (1 - weight) * added.buffers[name]
            for name, video in sample.buffers.items()
        }
        return Sample(buffers)

    def _place(self, number: int) -> tuple[str, str]:
        """A clip's split and its key without the light; only clips of one split share cameras."""
        key = re.sub(r"-[^-]+(-c\d+)?$", r"\1", self.clips.key(number))
        return self.clips.split_of(number), key
