"""Samples as the network sees them: augmented in linear light, then display-encoded in [-1, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from train.examples.framing import Sample, random_start
from train.settings import DataSettings
from tron.color import luminance
from tron.errors import TronError
from tron.shards.schema import MEMBERS, TARGET, encoded

START = "lit"
"""Buffer that the network corrects into the picture."""


def augmented(
    sample: Sample, random: np.random.Generator, crop: int | None, settings: DataSettings
) -> Sample:
    """Crop, mirror, rotate, recolour and expose a sample, all its buffers alike.

    Colours are changed in linear light, where permuting and scaling the light's channels gives exactly the
    permuted and scaled buffers: transport is linear and channels are independent. A tint keeps the
    luminance of white, so that the exposure rule still holds; a random exposure, a gain on all channels,
    breaks that rule on purpose. Samples with display members keep their colours. A rotated picture is that
    of a rolled camera: no buffer holds a direction that would have to rotate too. Reflectance has its
    channels permuted but not scaled; non-colour buffers stay. Last, `mended` corrects some samples' ``lit``.
    """
    height, width = sample.buffers[TARGET].shape[-2:]
    rows, columns = slice(None), slice(None)
    if crop is not None:
        if crop > min(height, width):
            raise TronError(
                f"crop of {crop} pixels from frames of {width} x {height}", mend="make it smaller"
            )
        top, left = (random_start(random, side, crop) for side in (height, width))
        rows, columns = slice(top, top + crop), slice(left, left + crop)
    mirrored = random.random() < settings.flip
    order = random.permutation(3) if random.random() < settings.permute_colors else np.arange(3)
    tint = np.exp(settings.tint * random.standard_normal(3))
    # Options added later draw only if they are set, so that older runs keep their random numbers.
    stops = settings.exposure * random.standard_normal() if settings.exposure else 0.0
    gains = torch.tensor(tint / luminance(tint) * 2.0**stops, dtype=torch.float32).view(3, 1, 1, 1)
    turns = _quarter_turns(random, settings.rotate, (height, width) if crop is None else (crop, crop))
    buffers = {}
    for name, video in sample.buffers.items():
        video = video[..., rows, columns]
        video = video.flip(-1) if mirrored else video
        video = torch.rot90(video, turns, (-2, -1)) if turns else video
        space = None if sample.display else MEMBERS[name].color_space
        video = video if space is None else video[order.tolist()]
        buffers[name] = video * gains if space == "linear" else video
    return mended(Sample(buffers, sample.display), random, settings.mend)


def mended(sample: Sample, random: np.random.Generator, share: float) -> Sample:
    """Replace ``lit`` by w truth + (1 - w) lit, linear, in a given share of the samples.

    w is 1 in half of these, else uniform in [0, 1]. The truth's noise is mixed in on purpose: such a sample
    teaches the network to change nothing. Samples without lit, and photographs, stay.
    """
    if not share or random.random() >= share:
        return sample
    weight, names = min(1.0, 2 * random.random()), {START, TARGET}
    if names & sample.display or not names <= sample.buffers.keys():
        return sample
    lit, truth = (sample.buffers[name] for name in (START, TARGET))
    return replace(sample, buffers=sample.buffers | {START: torch.lerp(lit, truth, weight)})


def _quarter_turns(random: np.random.Generator, probability: float, size: tuple[int, int]) -> int:
    if not probability or random.random() >= probability:
        return 0
    return int(random.integers(1, 4)) if size[0] == size[1] else 2


def display_encoded(samples: Sequence[Sample], name: str) -> Tensor:
    """One buffer of a batch as the network sees it: encoded, then in [-1, 1], (B, 3, K, h, w)."""
    batch = torch.stack([sample.buffers[name] for sample in samples])
    space = MEMBERS[name].color_space
    plain = torch.tensor([name not in sample.display for sample in samples])
    if plain.all():
        batch = encoded(batch, space, axis=1)
    elif plain.any():
        batch[plain] = encoded(batch[plain], space, axis=1)
    return batch * 2 - 1
