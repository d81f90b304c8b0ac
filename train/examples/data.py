"""Batches for training: a batch's clips, frames and crops depend on seed, stage and step alone.

A split that fits the memory budget is decoded once and kept (on two cores decoding would dominate); from a
larger split each sample reads the frames it needs. Both give the same batches. A run resumed at step s gets
the same batches from s on as an uninterrupted run, without reading earlier ones.
"""

from __future__ import annotations

import logging
import math
import signal
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from train.curriculum import CAPTURES, Stage, require_splits
from train.examples.augmentation import augmented, display_encoded
from train.examples.framing import centred, sized
from train.examples.held_out import HeldOutClips, Windows, first_windows, network_input, spread
from train.examples.requirements import (
    first_whole,
    firsts_whole,
    require_clips,
    require_fit,
    require_members,
    require_size,
)
from train.examples.sources import CachedSplit, Draw, IndexedSplit, Source
from train.examples.splits import Splits
from train.processes import Processes
from train.settings import DataSettings, ValidationSettings
from tron import seeds
from tron.errors import TronError
from tron.shards.dataset_folder import Place
from tron.shards.schema import GUIDANCE, TARGET, ClipMeta
from tron.shards.streaming import StreamedClips

log = logging.getLogger(__name__)

DAMAGED = "damaged"
"""Key of a batch: the number of its samples that replace damaged ones."""


class Batches(IterableDataset):
    """Endless batches {member: (B, 3, K, h, w), damaged: count} of one stage, from step `first_step` on.

    Batch s is a function of (seed, stage, s), so that a resumed run has the same batches with any number of
    loader processes. The batches of R ranks together are the batch that one process would draw at R times
    the size.
    """

    def __init__(
        self,
        stage: Stage,
        sources: Mapping[str, Source],
        members: Sequence[str],
        settings: DataSettings,
        seed: int,
        first_step: int = 0,
        rank: int = 0,
        ranks: int = 1,
    ):
        super().__init__()
        self.stage, self.sources = stage, sources
        self.members, self.settings = members, settings
        self.seed, self.first_step, self.rank, self.ranks = seed, first_step, rank, ranks
        self.places = stage.batch_size * ranks

    def __iter__(self) -> Iterator[dict[str, Tensor] | TronError]:
        worker = get_worker_info()
        number, workers = (worker.id, worker.num_workers) if worker else (0, 1)
        step = self.first_step + number  # torch takes batches from process 0, 1, ... in turn
        while True:
            try:
                yield self._batch(step)
            except TronError as error:
                if worker is None:
                    raise
                yield error  # `Loader` raises it: torch would turn it into a traceback of many lines
                return
            step += workers

    def _plan(self, step: int) -> list[tuple[str, int, int]]:
        """For each sample of a batch: its split, its number in that split, its number in all samples.

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

    def _batch(self, step: int) -> dict[str, Tensor]:
        stage, settings, samples, damaged = self.stage, self.settings, [], 0
        for split, number, sample in self._plan(step):
            random = seeds.generator(self.seed, "train", "sample", stage.name, sample)
            drawn = self.sources[split].sample(Draw(number, random, stage.frames_of(step)))
            damaged += drawn.stands_in
            drawn = sized(drawn, stage.size, random)
            samples.append(augmented(drawn, random, stage.crop, settings))
        shapes = {tuple(sample.buffers[TARGET].shape) for sample in samples}
        if len(shapes) > 1:
            raise TronError(f"stage {stage.name} meets frames of several sizes", mend="give it a size")
        videos = {name: display_encoded(samples, name) for name in self.members}
        return videos | {DAMAGED: torch.tensor(damaged)}


class Loader(DataLoader):
    """A DataLoader whose processes' TronErrors arrive as they were raised."""

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        for batch in super().__iter__():
            if isinstance(batch, TronError):
                raise batch
            yield batch


def _leave_signals(_worker: int) -> None:
    """Ignore signals sent to the whole process group: the training process still needs its batch."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL))


class TrainingData(lightning.LightningDataModule):
    """A run's splits, in memory if they fit, and batches for one stage at a time."""

    def __init__(
        self,
        dataset: Place,
        settings: DataSettings,
        seed: int,
        validation: ValidationSettings,
        processes: Processes | None = None,
        splits: Mapping[str, str] | None = None,
    ):
        super().__init__()
        self.processes = processes or Processes()
        self.settings, self.seed, self.validation = settings, seed, validation
        self.splits = Splits(dataset, splits)
        self.members = (*GUIDANCE, TARGET)
        self.sources: dict[str, Source] = {}
        self.stage: Stage | None = None
        self.first_step = 0
        self._budget = settings.cache_gb * 1e9
        self._held_out: HeldOutClips | None = None
        self.validation_split = validation.split
        default = ValidationSettings.DEFAULT
        if validation.split == default and default not in self.splits:
            log.info("No validation: this dataset has no split '%s'", default)
            self.validation_split = None
        elif validation.split is not None:
            self.splits.clips(validation.split)  # a wrong name fails now, not after hours

    def open(self, stages: Sequence[Stage], guidance: Sequence[str] = GUIDANCE) -> None:
        """Check that every stage finds its splits, frames and sizes; decode the splits that fit in memory.

        guidance: the members that condition the network.
        """
        require_splits(stages, self.splits.names())
        self.members = (*guidance, TARGET)
        used = list(dict.fromkeys(split for stage in stages for split in stage.splits()))
        for stage in stages:
            for split in stage.splits():
                for first in firsts_whole(self.splits.clips(split)):
                    require_fit(stage, split, first)
            if self.validation_split is not None:
                require_size(stage, self.validation_split, self.first_meta(self.validation_split))
        for split in used:
            require_clips(split, len(self.splits.clips(split)), self.processes.count)
        for split in (*used, *([self.validation_split] if self.validation_split else ())):
            require_members(self.splits.clips(split), split, self.members)
        for split in used:
            self.sources[split] = self._source(split)

    def _source(self, split: str) -> CachedSplit | IndexedSplit:
        first, clips = self.first_meta(split), self.splits.clips(split)
        size = len(clips) * first.frames * first.height * first.width * len(self.members) * 3 * 4
        if size <= self._budget:
            self._budget -= size
            log.info("Split %s: in memory, %d clips, %.2f GB", split, len(clips), size / 1e9)
            return CachedSplit(clips, split, self.members, self.seed, self.settings.mix_lights)
        log.info("Split %s: read as needed, %.1f GB would not fit data.cache_gb", split, size / 1e9)
        return IndexedSplit(clips, split, self.members, self.seed, self.settings.mix_lights)

    def first_meta(self, split: str) -> ClipMeta:
        """First readable metadata of a split's clips; TronError if there is no such split or clip."""
        return first_whole(self.splits.clips(split))

    def photographs(self, split: str) -> bool:
        """Whether all of a split's pictures are display-encoded, as photographs are."""
        firsts = firsts_whole(self.splits.clips(split))
        return all(first.color_space.get(TARGET) == "display" for first in firsts)

    def stands_in(self, split: str) -> bool:
        """Whether a split holds path-traced pictures where the curriculum would have photographs."""
        return split == CAPTURES and not self.photographs(split)

    def calibration(self, stages: Sequence[Stage], temporal_factor: int, clips: int = 64) -> Iterator[Tensor]:
        """Training videos (1, 3, K, H, W) of all buffers, to calibrate a codec: the longest stage's K."""
        longest = max(stage.frames for stage in stages)
        for split in dict.fromkeys(split for stage in stages for split in stage.splits()):
            store = self.splits.clips(split)
            size = next(stage.size for stage in reversed(stages) if split in stage.splits())
            frames = min(longest, self.first_meta(split).frames)
            frames -= (frames - 1) % temporal_factor
            early = isinstance(store, StreamedClips)  # the whole of it would have to come
            for number in range(min(clips, len(store))) if early else spread(len(store), clips):
                try:
                    whole = range(min(frames, store.meta(number).frames))
                    clip = centred(store.read_frames(number, whole, self.members), size)
                except TronError:  # damaged: its samples will be replaced too, counted and named
                    continue
                for name in self.members:
                    yield network_input(clip, name)[None]

    def begin(self, stage: Stage, first_step: int) -> None:
        """Choose the stage and the first step of the loaders made next."""
        self.stage, self.first_step = stage, first_step

    def train_dataloader(self) -> DataLoader:
        """Endless batches of the stage that `begin` chose."""
        if self.stage is None:
            raise RuntimeError("begin() chooses the stage first")
        sources = {split: self.sources[split] for split in self.stage.splits()}
        batches = Batches(
            self.stage,
            sources,
            self.members,
            self.settings,
            self.seed,
            self.first_step,
            self.processes.rank,
            self.processes.count,
        )
        in_memory = all(isinstance(source, CachedSplit) for source in sources.values())
        workers = 0 if in_memory else self.settings.workers
        return Loader(batches, batch_size=None, num_workers=workers, worker_init_fn=_leave_signals)

    def val_dataloader(self) -> DataLoader | list[Any]:
        """This process's share of the held-out clips as windows of the stage's K frames, in batches."""
        if self.stage is None or self.validation_split is None:
            return []
        windows = Windows(self._held_out_clips(), self.stage, self.validation.batch_pixels)
        return DataLoader(windows, batch_size=None)

    def pictured_windows(self, stage: Stage) -> Iterator[dict[str, Tensor]]:
        """First windows (1, 3, K, H, W) of a few undamaged held-out clips of this process."""
        if self.validation_split is not None and self.validation.pictures:
            yield from first_windows(self._held_out_clips(), stage, self.validation.pictures)

    def _held_out_clips(self) -> HeldOutClips:
        assert self.validation_split is not None
        if self._held_out is None:
            clips = self.splits.clips(self.validation_split)
            share = slice(self.processes.rank, None, self.processes.count)
            numbers = spread(len(clips), self.validation.clips)[share]
            self._held_out = HeldOutClips(clips, numbers, self.members, self._budget)
        return self._held_out
