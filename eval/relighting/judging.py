"""Score every method on the test split of a data set, and make pictures of some clips."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.relighting.baselines import BASELINES, predictions
from eval.relighting.fits import Show
from eval.relighting.gallery import Example, middle_frame
from eval.relighting.scores import Scores, Where
from tron.shards.dataset_folder import Place
from tron.shards.reader import read_clips
from tron.shards.schema import TARGET, Clip

log = logging.getLogger("tron.eval")


class Judged(NamedTuple):
    """Scores of every method, and examples from the least gain to the greatest."""

    scores: Scores
    examples: list[Example]
    seconds: dict[str, list[float]]
    """Method name -> those of a frame, clip by clip."""


def judge(
    dataset: Place,
    split: str,
    methods: Callable[[str], Mapping[str, Show]],
    pictures: int,
    scores: Scores,
    members: Sequence[str] | None = None,
    look: Callable[[Clip], object] = lambda _: None,
    truth: Callable[[Clip], np.ndarray] = lambda clip: clip.displayed(TARGET),
) -> Judged:
    """Score every frame; a second pass makes the pictures.

    Args:
        methods: scene -> fitted baselines and networks by their names.
        pictures: number of clips to show.
        scores: scores to extend.
        members: members of the clips to read, all by default.
        look: callback for every clip.
        truth: function of a clip that returns its truth, (K, H, W, 3) display values.
    """
    seconds: dict[str, list[float]] = {}
    for clip in read_clips(dataset, split, members):
        scores.add(clip, predictions(clip, methods(clip.meta.scene), seconds), truth(clip))
        look(clip)
        log.info("scored clip %s (%s, %s)", clip.meta.key, clip.meta.light, clip.meta.light_family)
    keys, found = choose_clips(scores, pictures), {}
    for clip in read_clips(dataset, split, members) if keys else ():
        if clip.meta.key in keys:
            shown = predictions(clip, methods(clip.meta.scene))["frame"]
            found[clip.meta.key] = middle_frame(clip, shown, truth(clip))
    return Judged(scores, [found[key] for key in keys], seconds)


def choose_clips(scores: Scores, count: int) -> list[str]:
    """Choose clips evenly spaced in the ranking by gain, including the worst and the best.

    The gain is the network's foreground PSNR minus the PSNR of the best scored baseline; without a network,
    clips are ranked by the PSNR of lit.
    """
    baselines = [method.name for method in scores.methods if method in BASELINES]

    def rank(key: str) -> float:
        of_clip, network = Where(clip=key), scores.network
        gain = None if network is None else scores.gain(network.name, baselines, of_clip)
        found = (gain, scores.psnr("lit", of_clip), scores.psnr("pbr", of_clip))
        return next((figure for figure in found if figure is not None), -np.inf)

    ordered = sorted(scores.clips, key=rank)
    places = np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)
    return [ordered[place] for place in places]
