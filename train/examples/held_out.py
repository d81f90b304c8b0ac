"""Clips held out for validation, shown as windows of a stage's K frames in batches of bounded size."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from train.curriculum import Stage
from train.examples.framing import centred, channels_first
from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.schema import Clip, ClipMeta

log = logging.getLogger(__name__)

FOREGROUND = "foreground"


def spread(total: int, count: int) -> list[int]:
    """Up to `count` of the numbers below `total`, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int)).tolist()


class HeldOutClips:
    """Held-out clips of a split by number, decoded once if they fit in memory, else at each use.

    Args:
        clips: the split.
        numbers: numbers of its held-out clips.
        members: inputs and targets of the network; the foreground mask is read with them.
        budget: most bytes of the decoded clips.
    """

    def __init__(self, clips: ClipStore, numbers: Sequence[int], members: Sequence[str], budget: float):
        self.clips, self.members = clips, (*members, FOREGROUND)
        self._named: set[int] = set()
        metas = {number: meta for number in numbers if (meta := self._meta(number)) is not None}
        self.numbers = list(metas)
        pixels = sum(meta.frames * meta.width * meta.height for meta in metas.values())
        self.bytes = pixels * (3 * len(members) + 1) * 4
        self.in_memory = self.bytes <= budget
        self._decoded: dict[int, Clip] = {}

    def read(self, number: int, frames: range) -> Clip:
        """Frames of a clip; TronError where they cannot be read."""
        if not self.in_memory:
            return self.clips.read_frames(number, frames, self.members)
        if number not in self._decoded:
            try:
                self._decoded[number] = self.clips.read_frames(number, members=self.members)
            except TronError:  # perhaps of frames that are not asked for
                return self.clips.read_frames(number, frames, self.members)
        whole = self._decoded[number]
        part = slice(frames.start, frames.stop)
        return Clip(whole.meta, {name: images[part] for name, images in whole.frames.items()})

    def windows(self, number: int, stage: Stage, frames: range) -> Iterator[dict[str, Tensor]]:
        """A clip as one batch of n windows of a stage's K frames; damaged windows are left out."""
        try:
            yield windows_of(centred(self.read(number, frames), stage.size), stage.frames)
        except TronError as error:
            if len(frames) == stage.frames:
                self._name(number, error)
                return
            for start in frames[:: stage.frames]:
                yield from self.windows(number, stage, range(start, start + stage.frames))

    def _meta(self, number: int) -> ClipMeta | None:
        try:
            return self.clips.meta(number)
        except TronError as error:
            self._name(number, error)
            return None

    def _name(self, number: int, error: TronError) -> None:
        if number not in self._named:
            self._named.add(number)
            log.warning("Validation without frames of clip %s: %s", self.clips.key(number), error)


class Windows(IterableDataset):
    """Batches {member: (B, 3, K, H, W) in [-1, 1], mask: (B, 1, K, H, W) in {0, 1}} of a stage's K and size.

    A batch holds windows of one clip: at most `batch_pixels` pixels, but at least one window. It defines no
    length, because even a process without clips must validate.
    """

    def __init__(self, held_out: HeldOutClips, stage: Stage, batch_pixels: int):
        super().__init__()
        self.held_out, self.stage, self.batch_pixels = held_out, stage, batch_pixels

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        frames = self.stage.frames
        for number in self.held_out.numbers:
            meta = self.held_out.clips.meta(number)
            width, height = self.stage.size or (meta.width, meta.height)
            step = max(1, self.batch_pixels // (frames * width * height)) * frames
            end = meta.frames - meta.frames % frames
            for start in range(0, end, step):
                yield from self.held_out.windows(number, self.stage, range(start, min(start + step, end)))


def first_windows(held_out: HeldOutClips, stage: Stage, count: int) -> Iterator[dict[str, Tensor]]:
    """First window of each of `count` clips, spread evenly over the held-out clips."""
    for place in spread(len(held_out.numbers), count):
        number = held_out.numbers[place]
        if held_out.clips.meta(number).frames >= stage.frames:
            yield from held_out.windows(number, stage, range(stage.frames))


def windows_of(clip: Clip, frames: int) -> dict[str, Tensor]:
    """A clip of n K frames as n windows: (n, 3, K, H, W) in [-1, 1], mask (n, 1, K, H, W) in {0, 1}."""
    videos = {name: network_input(clip, name) for name in clip.frames if name != FOREGROUND}
    videos["mask"] = torch.from_numpy(channels_first(clip.frames[FOREGROUND] > 0.5))
    return {
        name: video.unflatten(1, (-1, frames)).movedim(1, 0).contiguous() for name, video in videos.items()
    }


def network_input(clip: Clip, name: str) -> Tensor:
    """A clip's buffer as the network sees it: display-encoded in [-1, 1], (3, K, H, W) float32."""
    return torch.from_numpy(channels_first(clip.displayed(name))) * 2 - 1
