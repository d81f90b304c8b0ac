"""PSNR of several networks frame by frame, where no baseline is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from eval.relighting.buffers import MEMBERS, Buffers, region_mask
from eval.relighting.fits import Show
from eval.results import Row, mean_row
from tron import metrics
from tron.shards.reader import read_clips

FramePsnr = Sequence[tuple[str, float]]
"""Scene and foreground PSNR in dB of each frame, in the order of the data set."""


def frame_psnr(dataset: Path, split: str, methods: Mapping[str, Show]) -> dict[str, FramePsnr]:
    """Method -> its frames; those without a foreground count for none.

    Raises:
        TronError: the data set lacks the split.
    """
    found: dict[str, list[tuple[str, float]]] = {name: [] for name in methods}
    for clip in read_clips(dataset, split, MEMBERS):
        buffers, truth, inside = Buffers.of(clip), clip.displayed("rgb"), region_mask(clip, "foreground")
        for name, show in methods.items():
            for image, target, mask in zip(show(buffers), truth, inside):
                if mask.any():
                    psnr = metrics.capped_psnr(image, target, mask)
                    found[name].append((clip.meta.scene, psnr))
    return dict(found)


def difference_row(metric: str, ours: FramePsnr, others: FramePsnr, seed: int) -> Row:
    """Mean of one method's PSNR minus another's on the same frames, in dB."""
    pairs = [(scene, mine - theirs) for (scene, mine), (_, theirs) in zip(ours, others, strict=True)]
    return mean_row(metric, "dB", pairs, seed)
