"""Batches for training: which clips, frames and crops make a batch depends on seed, stage and step alone.

A split that fits the memory budget is decoded once and kept (on two cores decoding would dominate); a
larger one is streamed. Resuming at step s gives the batches that an uninterrupted run would have seen from
s on.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from train.curriculum import Stage
from train.settings import DataSettings, ValidationSettings
from train.sources import (
    BUFFERS,
    CachedSplit,
    Draw,
    Sample,
    Source,
    StreamedSplit,
    decoded_bytes,
    display_video,
    first_meta,
    spread_clips,
)
from tron import seeds
from tron.color import luminance, to_display
from tron.errors import TronError
from tron.neural.windows import TIME
from tron.shards.manifest import Manifest
from tron.shards.schema import Clip

log = logging.getLogger(__name__)

SEGMENT = 500  # batches after which a stream starts anew, so that resuming skips fewer than this


class Batches(IterableDataset):
    """Endless batches {"pbr", "irr", "rgb": (B, 3, K, h, w)} of one stage, from step `first_step` on.

    Batch s of rank r is a function of (seed, stage, r, s), so a resumed run sees what it would have seen. A
    streamed split also depends on the number of loader processes, which must then stay the same.
    """

    def __init__(
        self,
        stage: Stage,
        cached: Mapping[str, CachedSplit],
        folder: Path,
        settings: DataSettings,
        seed: int,
        first_step: int = 0,
        rank: int = 0,
        ranks: int = 1,
    ):
        super().__init__()
        self.stage, self.cached, self.folder, self.settings = stage, cached, folder, settings
        self.seed, self.first_step, self.rank, self.ranks = seed, first_step, rank, ranks

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        number, workers = (worker.id, worker.num_workers) if worker else (0, 1)
        # torch takes batches from process 0, 1, ... in turn, wherever the run resumes: so process n starts
        # with the n-th batch to come, and the stream it reads is named after what its steps have in common.
        step = self.first_step + number
        segment, sources = -1, {}
        while True:
            if step // SEGMENT != segment:
                segment = step // SEGMENT
                sources = self._sources(segment, step, workers)
            yield self._batch(step, sources)
            step += workers

    def _sources(self, segment: int, step: int, workers: int) -> dict[str, Source]:
        """The stage's splits: from memory, or as streams of this segment wound forward to `step`."""
        sources: dict[str, Source] = {}
        earlier = range(segment * SEGMENT + (step - segment * SEGMENT) % workers, step, workers)
        for split in self.stage.splits():
            if split in self.cached:
                sources[split] = self.cached[split]
                continue
            drawn = sum(name == split for past in earlier for name, _, _ in self._plan(past))
            path = ("stream", self.stage.name, split, self.rank, step % workers, segment)
            seed = seeds.integer(self.seed, "train", *path)
            sources[split] = StreamedSplit(self.folder, split, self.stage.frames, self.settings, seed, drawn)
        return sources

    def _plan(self, step: int) -> list[tuple[str, int, int]]:
        """(split, number within that split's samples, number within all samples) of a batch's samples.

        Rehearsal is spread evenly: of any n samples in a row, ratio * n come from the rehearsal split.
        """
        stage = self.stage
        ratio = stage.rehearsal_ratio if stage.rehearsal_split else 0.0
        plan = []
        for place in range(stage.batch_size):
            sample = (step * self.ranks + self.rank) * stage.batch_size + place
            rehearsed = math.floor(sample * ratio)
            if stage.rehearsal_split and math.floor((sample + 1) * ratio) > rehearsed:
                plan.append((stage.rehearsal_split, rehearsed, sample))
            else:
                plan.append((stage.split, sample - rehearsed, sample))
        return plan

    def _batch(self, step: int, sources: Mapping[str, Source]) -> dict[str, Tensor]:
        samples = []
        for split, number, sample in self._plan(step):
            random = seeds.generator(self.seed, "train", "sample", self.stage.name, sample)
            drawn = sources[split].sample(Draw(number, random, self.stage.frames_of(step)))
            samples.append(varied(drawn, random, self.stage.crop, self.settings))
        shapes = {tuple(sample.buffers["rgb"].shape) for sample in samples}
        if len(shapes) > 1:
            raise TronError(f"stage {self.stage.name} meets frames of several sizes", mend="give it a crop")
        return {name: developed(samples, name) for name in BUFFERS}


def developed(samples: Sequence[Sample], name: str) -> Tensor:
    """One buffer of a batch as the network sees it: AgX where it is linear, then [-1, 1], (B, 3, K, h, w)."""
    batch = torch.stack([sample.buffers[name] for sample in samples])
    linear = torch.tensor([name not in sample.display for sample in samples])
    if linear.all():
        batch = to_display(batch, 1.0, axis=1)
    elif linear.any():
        batch[linear] = to_display(batch[linear], 1.0, axis=1)
    return batch * 2 - 1


def varied(sample: Sample, random: np.random.Generator, crop: int | None, settings: DataSettings) -> Sample:
    """Crop, mirror and recolour a sample, its buffers all alike.

    Colours are changed in linear light, where permuting and scaling channels of the light gives exactly the
    permuted and scaled buffers: transport is linear and no channel knows another. A tint keeps the
    luminance of white, so that the exposure rule still holds. Samples with display members keep their
    colours.
    """
    height, width = sample.buffers["rgb"].shape[-2:]
    rows, columns = slice(None), slice(None)
    if crop is not None:
        if crop > min(height, width):
            raise TronError(
                f"crop of {crop} pixels from frames of {width} x {height}", mend="make it smaller"
            )
        top, left = (
            int(random.integers((side - crop) // settings.crop_alignment + 1)) * settings.crop_alignment
            for side in (height, width)
        )
        rows, columns = slice(top, top + crop), slice(left, left + crop)
    mirrored = random.random() < settings.flip
    order = random.permutation(3) if random.random() < settings.permute_colors else np.arange(3)
    tint = np.exp(settings.tint * random.standard_normal(3))
    gains = torch.tensor(tint / luminance(tint), dtype=torch.float32).view(3, 1, 1, 1)
    buffers = {}
    for name, video in sample.buffers.items():
        video = video[..., rows, columns]
        video = video.flip(-1) if mirrored else video
        buffers[name] = video if sample.display else video[order.tolist()] * gains
    return Sample(buffers, sample.display)


class TrainingData(lightning.LightningDataModule):
    """The dataset folder's splits, in memory where they fit, and batches for one stage at a time."""

    def __init__(self, folder: str | Path, settings: DataSettings, seed: int, validation: ValidationSettings):
        super().__init__()
        self.folder, self.settings, self.seed, self.validation = Path(folder), settings, seed, validation
        self.manifest = Manifest.load(folder)
        self.cached: dict[str, CachedSplit] = {}
        self.stage: Stage | None = None
        self.first_step = 0
        self._held_out: list[Clip] | None = None
        self.validation_split = validation.split
        if validation.split == ValidationSettings.DEFAULT and validation.split not in self.manifest.splits():
            log.info("No validation: this dataset has no split '%s'", validation.split)
            self.validation_split = None
        elif validation.split is not None:
            self.manifest.of_split(validation.split)  # a wrong name is told now, not after hours

    def open(self, stages: Sequence[Stage]) -> None:
        """Check that every stage finds its splits, frames and sizes; decode the splits that fit in memory."""
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
                size = decoded_bytes(first) * sum(entry.samples for entry in self.manifest.of_split(split))
                if size <= budget:
                    self.cached[split] = CachedSplit(self.folder, split, self.seed)
                    budget -= size
                    log.info("Split %s: in memory, %d clips, %.2f GB", split, *self._size(split, size))
                else:
                    log.info("Split %s: streamed, %.1f GB would not fit data.cache_gb", split, size / 1e9)

    def _size(self, split: str, size: float) -> tuple[int, float]:
        return len(self.cached[split].clips), size / 1e9

    def calibration(self, stages: Sequence[Stage], clips: int = 64) -> Iterator[Tensor]:
        """Training videos (1, 3, K, H, W), all buffers, of the longest stage's K, to fit the codec on."""
        longest = max(stages, key=lambda stage: stage.frames)
        for split in dict.fromkeys(split for stage in stages for split in stage.splits()):
            frames = min(longest.frames, first_meta(self.folder, self.manifest, split).frames)
            frames -= (frames - 1) % TIME
            for clip in spread_clips(self.folder, self.manifest, split, clips, BUFFERS):
                for name in BUFFERS:
                    yield torch.from_numpy(display_video(clip, name))[None, :, :frames]

    def begin(self, stage: Stage, first_step: int) -> None:
        """Choose the stage, and the step to go on from, of the loaders made next."""
        self.stage, self.first_step = stage, first_step

    def train_dataloader(self) -> DataLoader:
        """Endless batches of the stage that `begin` chose."""
        if self.stage is None:
            raise RuntimeError("begin() chooses the stage first")
        trainer = self.trainer
        batches = Batches(
            self.stage,
            self.cached,
            self.folder,
            self.settings,
            self.seed,
            self.first_step,
            trainer.global_rank if trainer else 0,
            trainer.world_size if trainer else 1,
        )
        in_memory = all(split in self.cached for split in self.stage.splits())
        return DataLoader(batches, batch_size=None, num_workers=0 if in_memory else self.settings.workers)

    def val_dataloader(self) -> DataLoader | list[Any]:
        """Held-out clips as `windows_of` the stage's K frames, one clip a batch."""
        if self.stage is None or self.validation_split is None:
            return []
        if self._held_out is None:
            split, count = self.validation_split, self.validation.clips
            members = (*BUFFERS, "foreground")
            self._held_out = list(spread_clips(self.folder, self.manifest, split, count, members))
        windows = [windows_of(clip, self.stage.frames) for clip in self._held_out]
        return DataLoader([w for w in windows if len(w["rgb"])], batch_size=None)  # type: ignore[arg-type]


def windows_of(clip: Clip, frames: int) -> dict[str, Tensor]:
    """A clip as windows: pbr, irr, rgb (B, 3, K, H, W) in [-1, 1], mask (B, 1, K, H, W) the foreground."""
    count = clip.meta.frames // frames
    result = {}
    for name in (*BUFFERS, "mask"):
        if name == "mask":
            video = np.moveaxis((clip.frames["foreground"] > 0.5).astype(np.float32), -1, 0)
        else:
            video = display_video(clip, name)
        video = video[:, : count * frames].reshape(len(video), count, frames, *video.shape[2:])
        result[name] = torch.from_numpy(np.ascontiguousarray(np.moveaxis(video, 1, 0)))
    return result
