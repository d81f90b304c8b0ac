"""Batches for training: which clips, frames and crops make a batch depends on seed, stage and step alone.

A split that fits the memory budget is decoded once and kept (on two cores decoding would dominate); a
larger one is streamed. Resuming at step s gives the batches that an uninterrupted run would have seen from
s on.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from train.augmentation import augmented, display_encoded
from train.curriculum import Stage, require_splits
from train.processes import Processes
from train.settings import DataSettings, ValidationSettings
from train.sources import (
    CachedSplit,
    Draw,
    Source,
    StreamedSplit,
    channels_first,
    first_meta,
    spread_clips,
)
from tron import seeds
from tron.errors import TronError
from tron.shards.manifest import Manifest
from tron.shards.schema import GUIDANCE, TARGET, Clip

log = logging.getLogger(__name__)

STAND_IN = "train_b"  # the second distribution that tron-datagen makes, for want of photographs
SEGMENT = 500  # batches after which a stream starts anew, so that resuming skips fewer than this


class Batches(IterableDataset):
    """Endless batches {member: (B, 3, K, h, w)} of one stage, from step `first_step` on.

    Batch s is a function of (seed, stage, s), so that a resumed run has the same ones. Ranks share it:
    together the batches of R ranks are the batch of R times the size that one process would have. A streamed
    split also depends on the number of loader processes, which must then stay the same.
    """

    def __init__(
        self,
        stage: Stage,
        cached: Mapping[str, CachedSplit],
        folder: Path,
        members: Sequence[str],
        settings: DataSettings,
        seed: int,
        first_step: int = 0,
        rank: int = 0,
        ranks: int = 1,
    ):
        super().__init__()
        self.stage, self.cached, self.folder = stage, cached, folder
        self.members, self.settings = members, settings
        self.seed, self.first_step, self.rank, self.ranks = seed, first_step, rank, ranks
        self.places = stage.batch_size * ranks

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        number, workers = (worker.id, worker.num_workers) if worker else (0, 1)
        # torch takes batches from process 0, 1, ... in turn, wherever the run resumes: so process n starts
        # with the n-th batch to come, and the stream it reads is named after what its steps have in common.
        step = self.first_step + number
        segment, source = step // SEGMENT, self._sources(step // SEGMENT, step, workers)
        while True:
            if step // SEGMENT != segment:
                segment = step // SEGMENT
                source = self._sources(segment, step, workers)
            yield self._batch(step, source)
            step += workers

    def _sources(self, segment: int, step: int, workers: int) -> Callable[[str, int], Source]:
        """(split, place in the batch) -> its source: memory, or a stream of this segment, wound to `step`.

        Each place has a stream of its own, so that ranks read what they use.
        """
        streams: dict[tuple[str, int], Source] = {}
        earlier = range(segment * SEGMENT + (step - segment * SEGMENT) % workers, step, workers)
        drawn = Counter(
            (split, sample % self.places) for past in earlier for split, _, sample in self._plan(past)
        )
        buffer = -(-self.settings.shuffle_buffer // self.places)

        def source(split: str, place: int) -> Source:
            if split in self.cached:
                return self.cached[split]
            if (split, place) not in streams:
                path = ("stream", self.stage.name, split, place, step % workers, segment)
                streams[split, place] = StreamedSplit(
                    self.folder,
                    split,
                    self.members,
                    self.stage.frames,
                    seeds.integer(self.seed, "train", *path),
                    shuffle_buffer=buffer,
                    per_clip=self.settings.samples_per_clip,
                    skip=drawn[split, place],
                )
            return streams[split, place]

        return source

    def _plan(self, step: int) -> list[tuple[str, int, int]]:
        """(split, number within that split's samples, number within all samples) of a batch's samples.

        Rehearsal is spread evenly: of any n samples in a row, ratio * n come from the rehearsal split.
        """
        stage = self.stage
        ratio = stage.rehearsal_ratio if stage.rehearsal_split else 0.0
        plan = []
        for place in range(stage.batch_size):
            sample = step * self.places + self.rank * stage.batch_size + place
            rehearsed = math.floor(sample * ratio)
            if stage.rehearsal_split and math.floor((sample + 1) * ratio) > rehearsed:
                plan.append((stage.rehearsal_split, rehearsed, sample))
            else:
                plan.append((stage.split, sample - rehearsed, sample))
        return plan

    def _batch(self, step: int, source: Callable[[str, int], Source]) -> dict[str, Tensor]:
        samples = []
        for split, number, sample in self._plan(step):
            random = seeds.generator(self.seed, "train", "sample", self.stage.name, sample)
            draw = Draw(number, random, self.stage.frames_of(step))
            drawn = source(split, sample % self.places).sample(draw)
            samples.append(augmented(drawn, random, self.stage.crop, self.settings))
        shapes = {tuple(sample.buffers[TARGET].shape) for sample in samples}
        if len(shapes) > 1:
            raise TronError(f"stage {self.stage.name} meets frames of several sizes", mend="give it a crop")
        return {name: display_encoded(samples, name) for name in self.members}


class TrainingData(lightning.LightningDataModule):
    """The dataset folder's splits, in memory where they fit, and batches for one stage at a time."""

    def __init__(
        self,
        folder: str | Path,
        settings: DataSettings,
        seed: int,
        validation: ValidationSettings,
        processes: Processes | None = None,
    ):
        super().__init__()
        self.processes = processes or Processes()
        self.folder, self.settings, self.seed, self.validation = Path(folder), settings, seed, validation
        self.manifest = Manifest.load(folder)
        self.members = (*GUIDANCE, TARGET)
        self.cached: dict[str, CachedSplit] = {}
        self.stage: Stage | None = None
        self.first_step = 0
        self._held_out: list[Clip] | None = None
        self.validation_split = validation.split
        if validation.split == ValidationSettings.DEFAULT and validation.split not in self.manifest.splits():
            log.info("No validation: this dataset has no split '%s'", validation.split)
            self.validation_split = None
        elif validation.split is not None:
            self.manifest.of_split(validation.split)  # a wrong name ends the run now, not after hours

    def open(self, stages: Sequence[Stage], guidance: Sequence[str] = GUIDANCE) -> None:
        """Check that every stage finds its splits, frames and sizes; decode the splits that fit in memory.

        guidance: members that the network is conditioned on.
        """
        require_splits(stages, self.manifest.splits())
        self.members = (*guidance, TARGET)
        budget = self.settings.cache_gb * 1e9
        for stage in stages:
            for split in stage.splits():
                first = first_meta(self.folder, self.manifest, split)
                if first.frames < stage.frames:
                    raise TronError(
                        f"stage {stage.name} needs clips of {stage.frames} frames, split '{split}' has "
                        f"{first.frames}",
                        mend="make longer clips, or shorten the stage's frames",
                    )
                if stage.crop and stage.crop > min(first.width, first.height):
                    raise TronError(
                        f"stage {stage.name} crops {stage.crop} pixels of {first.width} x {first.height}"
                    )
                if split in self.cached:
                    continue
                clips = sum(entry.samples for entry in self.manifest.of_split(split))
                size = clips * first.frames * first.height * first.width * len(self.members) * 3 * 4
                if size <= budget:
                    self.cached[split] = CachedSplit(self.folder, split, self.members, self.seed)
                    budget -= size
                    log.info("Split %s: in memory, %d clips, %.2f GB", split, clips, size / 1e9)
                else:
                    log.info("Split %s: streamed, %.1f GB would not fit data.cache_gb", split, size / 1e9)

    def stands_in(self, split: str) -> bool:
        """Whether a split holds path-traced pictures where the curriculum would have photographs."""
        first = first_meta(self.folder, self.manifest, split)
        return split == STAND_IN and first.color_space.get(TARGET) != "display"

    def calibration(self, stages: Sequence[Stage], temporal_factor: int, clips: int = 64) -> Iterator[Tensor]:
        """Training videos (1, 3, K, H, W), all buffers, of the longest stage's K, to calibrate a codec on."""
        longest = max(stages, key=lambda stage: stage.frames)
        for split in dict.fromkeys(split for stage in stages for split in stage.splits()):
            frames = min(longest.frames, first_meta(self.folder, self.manifest, split).frames)
            frames -= (frames - 1) % temporal_factor
            for clip in spread_clips(self.folder, self.manifest, split, clips, self.members):
                for name in self.members:
                    yield network_input(clip, name)[None, :, :frames]

    def begin(self, stage: Stage, first_step: int) -> None:
        """Choose the stage, and the step to go on from, of the loaders made next."""
        self.stage, self.first_step = stage, first_step

    def train_dataloader(self) -> DataLoader:
        """Endless batches of the stage that `begin` chose."""
        if self.stage is None:
            raise RuntimeError("begin() chooses the stage first")
        batches = Batches(
            self.stage,
            self.cached,
            self.folder,
            self.members,
            self.settings,
            self.seed,
            self.first_step,
            self.processes.rank,
            self.processes.count,
        )
        in_memory = all(split in self.cached for split in self.stage.splits())
        return DataLoader(batches, batch_size=None, num_workers=0 if in_memory else self.settings.workers)

    def val_dataloader(self) -> DataLoader | list[Any]:
        """This process's share of the held-out clips as `windows_of` the stage's K frames, one a batch."""
        if self.stage is None or self.validation_split is None:
            return []
        if self._held_out is None:
            members = (*self.members, "foreground")
            chosen = (self.validation_split, self.validation.clips, members)
            share = slice(self.processes.rank, None, self.processes.count)
            self._held_out = list(spread_clips(self.folder, self.manifest, *chosen, share))
        return DataLoader(HeldOut(self._held_out, self.stage.frames), batch_size=None)


class HeldOut(IterableDataset):
    """Windows of clips that have any; without a length, for even a process without clips must validate."""

    def __init__(self, clips: Sequence[Clip], frames: int):
        super().__init__()
        self.clips, self.frames = clips, frames

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        windows = (windows_of(clip, self.frames) for clip in self.clips)
        return (window for window in windows if len(window[TARGET]))


def windows_of(clip: Clip, frames: int) -> dict[str, Tensor]:
    """A clip as windows: its buffers (B, 3, K, H, W) in [-1, 1], mask (B, 1, K, H, W) in {0, 1}."""
    count = clip.meta.frames // frames
    videos = {name: network_input(clip, name) for name in clip.frames if name != "foreground"}
    videos["mask"] = torch.from_numpy(channels_first(clip.frames["foreground"] > 0.5))
    return {
        name: video[:, : count * frames].unflatten(1, (count, frames)).movedim(1, 0).contiguous()
        for name, video in videos.items()
    }


def network_input(clip: Clip, name: str) -> Tensor:
    """A clip's buffer as the network sees it: display-encoded in [-1, 1], (3, K, H, W) float32."""
    return torch.from_numpy(channels_first(clip.displayed(name))) * 2 - 1
