"""Sources of samples: a split decoded into memory, or streamed from its tar files by webdataset.

Exposure is applied when a clip is loaded, AgX after augmentation (train.augmentation).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from webdataset.filters import detshuffle
from webdataset.pipeline import DataPipeline
from webdataset.shardlists import ResampledShards

from tron import seeds
from tron.errors import TronError
from tron.shards.manifest import Manifest
from tron.shards.reader import decode_clip, decode_meta, group_clips, read_clips, tar_files
from tron.shards.schema import META_SUFFIX, TARGET, Clip, ClipMeta


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


class CachedSplit:
    """A split decoded into memory; sample number n is clip n of an endless series of shuffled passes."""

    def __init__(self, folder: Path, split: str, members: Sequence[str], seed: int):
        self.seed, self.split = seed, split
        self.clips = [Sample.of(clip) for clip in read_clips(folder, split, members)]
        self._pass = -1
        self._order = np.zeros(0, np.int64)

    def sample(self, draw: Draw) -> Sample:
        """Clip `draw.number` of the shuffled passes, at a random start."""
        which, place = divmod(draw.number, len(self.clips))
        if which != self._pass:
            order = seeds.generator(self.seed, "train", "pass", self.split, which)
            self._pass, self._order = which, order.permutation(len(self.clips))
        clip = self.clips[int(self._order[place])]
        count = clip.buffers[TARGET].shape[1]
        if count < draw.frames:
            raise TronError(
                f"split '{self.split}' has a clip of {count} frames", mend=f"{draw.frames} are needed"
            )
        start = int(draw.random.integers(count - draw.frames + 1))
        frames = {name: video[:, start : start + draw.frames] for name, video in clip.buffers.items()}
        return Sample(frames, clip.display)


class StreamedSplit:
    """A split read from its tar files as it goes: webdataset resamples shards and shuffles clips in a buffer.

    Only the members and frames that a sample needs are decoded, by the reader's table of decoders. The
    stream is a function of (seed, stream name); `skip` samples at its start are not decoded.
    """

    def __init__(
        self,
        folder: Path,
        split: str,
        members: Sequence[str],
        frames: int,
        seed: int,
        *,
        shuffle_buffer: int,
        per_clip: int = 1,
        skip: int = 0,
    ):
        self.members, self.frames, self.seed = members, frames, seed
        self.per_clip, self.skip = per_clip, skip
        names = [str(folder / e.name) for e in Manifest.load(folder).of_split(split) if e.samples]
        self._pipeline: Any = DataPipeline(
            ResampledShards(
                names, seed=seeds.integer(seed, "shards", bits=31), worker_seed=_zero, deterministic=True
            ),
            self._undecoded,
            detshuffle(shuffle_buffer, shuffle_buffer, seed=seeds.integer(seed, "shuffle", bits=31)),
        )
        self._samples: Iterator[dict[str, bytes]] | None = None

    def _undecoded(self, shards: Iterator[dict[str, str]]) -> Iterator[dict[str, Any]]:
        """Bytes of the windows drawn from each clip of each shard, the first stages of a sample."""
        for number, shard in enumerate(shards):
            for key, files in group_clips(tar_files(shard["url"], self.members)):
                random = seeds.generator(self.seed, "window", number, key)
                count = decode_meta(files[META_SUFFIX]).frames if META_SUFFIX in files else 0
                if count < self.frames:
                    raise TronError(
                        f"clip {key} has {count} frames, the stage needs {self.frames}", shard["url"]
                    )
                for _ in range(self.per_clip):
                    start = int(random.integers(count - self.frames + 1))
                    wanted = {f"f{i:02d}" for i in range(start, start + self.frames)}
                    kept = {n: data for n, data in files.items() if n[: n.index(".")] in {*wanted, "meta"}}
                    yield {"files": kept, "start": start}

    def sample(self, draw: Draw) -> Sample:
        """The stream's next sample; its number is the order of calls."""
        if self._samples is None:
            self._samples = iter(self._pipeline)
            for _ in range(self.skip):
                next(self._samples)
        drawn: Any = next(self._samples)
        indices = range(drawn["start"], drawn["start"] + draw.frames)
        return Sample.of(decode_clip(drawn["files"], self.members, indices))


def _zero() -> int:
    return 0  # the seed already names rank and worker; webdataset's own would differ between launchers


def first_meta(folder: Path, manifest: Manifest, split: str) -> ClipMeta:
    """Metadata of a split's first clip; TronError where the split or its first shard is empty or missing."""
    entry = next(entry for entry in manifest.of_split(split) if entry.samples)
    for _, name, data in tar_files(folder / entry.name, ()):
        if name == META_SUFFIX:
            return decode_meta(data)
    raise TronError("shard holds no clip", str(folder / entry.name), "make it again with tron-datagen")


def spread_clips(
    folder: Path,
    manifest: Manifest,
    split: str,
    count: int,
    members: Sequence[str],
    share: slice = slice(None),
) -> Iterator[Clip]:
    """A share of up to `count` clips spread evenly over a split; the others are skipped without decoding."""
    entries = manifest.of_split(split)
    total = sum(entry.samples for entry in entries)
    spread = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
    chosen = set(spread.tolist()[share])
    number = 0
    for entry in entries:
        if chosen.isdisjoint(range(number, number + entry.samples)):
            number += entry.samples
            continue
        for _, files in group_clips(tar_files(folder / entry.name, members)):
            if number in chosen:
                yield decode_clip(files, members)
            number += 1
