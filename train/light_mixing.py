"""Scenes under two lights at once: light transport is linear, so that their pictures add up."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable

import numpy as np

from train.samples import Sample
from tron.shards.clip_store import ClipStore


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
        """A clip's frames, in `ratio` of all cases with those under another of its lights in a random share.

        Every buffer becomes w of this light's and 1 - w of the other's, w uniform in [0, 1], both under their
        own exposure: under either, an upward-facing white plane without anything in the way has one radiance
        (docs/conventions.md, 5), and so it has under their mixture. Samples with display members, clips
        without another light, and those whose frames have other cameras stay as they are.
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
        """A clip's split, whose clips alone are seen from the same places, and its key without its light."""
        key = re.sub(r"-[^-]+(-c\d+)?$", r"\1", self.clips.key(number))
        return self.clips.split_of(number), key
