"""One test distribution judged: every baseline, fitted on that very distribution, and every checkpoint.

Where the data set has a training split the fits are made on it. Otherwise they are made on the other scenes
of the test split: the scenes are divided into groups, and each group is judged by fits on the others, so that
no baseline has seen the scene that it is judged by.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.relighting.baselines import fit_baselines, predictions
from eval.relighting.benchmark import choose_clips
from eval.relighting.buffers import MEMBERS
from eval.relighting.fits import Show
from eval.relighting.gallery import Example, middle_frame
from eval.relighting.measured import Judged
from eval.relighting.scores import Scores
from eval.renderer.networks import METHODS, Network
from eval.renderer.settings import Kind
from tron.errors import TronError
from tron.seeds import generator
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

log = logging.getLogger("tron.eval")

Fits = Mapping[str, Mapping[str, Show]]
"""Scene -> baseline -> the method as fitted for it."""


@dataclass(frozen=True)
class Judging:
    """A data set and the way in which it is judged.

    Attributes:
        dataset: its folder.
        split: that judges.
        fit_split: on which baselines are fitted, where the data set has it.
        networks: checkpoints.
        trained: further methods, such as per-pixel baselines.
        window: frames a pass of the checkpoints.
        folds: groups of scenes where there is no ``fit_split``.
        pictures: scenes that are shown.
        seed: of the fits and the groups.
    """

    dataset: Path
    split: str
    fit_split: str
    networks: Mapping[Kind, Network]
    trained: Mapping[str, Show]
    window: int
    folds: int
    pictures: int
    seed: int

    def judged(self) -> Judged:
        """Score every frame, and keep some for pictures; a second pass makes those.

        Raises:
            TronError: the data set lacks the split, or has neither a training split nor two scenes.
        """
        fits, scores, clips = self._fits(), Scores(), []
        for clip in read_clips(self.dataset, self.split, MEMBERS):
            scores.add(clip, predictions(clip, self._methods(fits, clip.meta.scene)), clip.displayed("rgb"))
            clips.append(clip.meta)
            log.info("scored clip %s (%s, %s)", clip.meta.key, clip.meta.light, clip.meta.light_family)
        return Judged(scores, clips, self._examples(fits, scores))

    def _methods(self, fits: Fits, scene: str) -> dict[str, Show]:
        shown = {METHODS[kind]: network.show(self.window) for kind, network in self.networks.items()}
        return {**fits[scene], **self.trained, **shown}

    def _examples(self, fits: Fits, scores: Scores) -> list[Example]:
        """Middle frames of clips that are spread evenly over the ranking by gain, a scene once."""
        keys = choose_clips(scores, self.pictures)
        found: dict[str, Example] = {}
        for clip in read_clips(self.dataset, self.split, MEMBERS) if keys else ():
            if clip.meta.key in keys:
                shown = predictions(clip, self._methods(fits, clip.meta.scene))["frame"]
                found[clip.meta.key] = middle_frame(clip, shown, clip.displayed("rgb"))
        return [found[key] for key in keys]

    def _fits(self) -> Fits:
        manifest = Manifest.load(self.dataset)
        manifest.of_split(self.split)
        scenes = sorted({clip.meta.scene for clip in read_clips(self.dataset, self.split, ())})
        if self.fit_split in manifest.splits():
            fitted = fit_baselines(read_clips(self.dataset, self.fit_split, MEMBERS), self.seed)
            methods = {name: each.show for name, each in fitted.items()}
            return {scene: methods for scene in scenes}  # noqa: C420
        if len(scenes) < 2:
            raise TronError(
                f"no split '{self.fit_split}' and one scene: nothing is left to fit baselines on",
                self.dataset,
                "make two scenes or more",
            )
        found: dict[str, Mapping[str, Show]] = {}
        for group in fold(scenes, self.folds, self.seed):
            others = (
                clip for clip in read_clips(self.dataset, self.split, MEMBERS) if clip.meta.scene not in group
            )
            fitted = fit_baselines(others, self.seed)
            methods = {name: each.show for name, each in fitted.items()}
            found |= {scene: methods for scene in group}  # noqa: C420
        return found


def fold(scenes: list[str], folds: int, seed: int) -> list[list[str]]:
    """Scenes in random groups of nearly one size, as many as asked for or as there are scenes."""
    order = generator(seed, "eval", "folds").permutation(len(scenes))
    count = min(folds, len(scenes))
    return [[scenes[k] for k in np.sort(order[start::count])] for start in range(count)]
