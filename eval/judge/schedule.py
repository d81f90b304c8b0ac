"""Pairs of pictures to judge: as in the paper, five views per scene and light, three seeds, both orders."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tron.seeds import generator

CONTROL, SPOILED = "control-whole", "control-spoiled"
"""The two of a control pair: a picture, and the same in blocks. No method can have such a name."""
CONTROLS = 8
"""Control pairs; two scenes of five lights have as many and more."""


@dataclass(frozen=True)
class Question:
    """Two methods' pictures of one view; ``first`` is shown as A, ``second`` as B."""

    scene: str
    light: str
    view: int
    seed: int
    first: str
    second: str

    def swapped(self) -> Question:
        """The pair in the other order."""
        return Question(self.scene, self.light, self.view, self.seed, self.second, self.first)


def questions(
    scenes: Mapping[str, tuple[Sequence[str], int]],
    ours: str,
    rivals: Sequence[str],
    views: int,
    seeds: Sequence[int],
) -> list[Question]:
    """Return every pair in both orders, shuffled, so that an early end leaves a fair sample.

    A seed draws the views, the same for all rivals, and is sent to the judge, whose answer may depend on it.

    Args:
        scenes: name -> its lights, and its number of test views.
        ours: method to compare with the ``rivals``.
        rivals: other methods.
        views: number of views per scene and light; all views if there are fewer.
        seeds: the rounds.
    """
    found = []
    for seed in seeds:
        for scene, (lights, count) in scenes.items():
            for light in lights:
                drawn = generator(seed, "judge", scene, light).permutation(count)[:views]
                for view in sorted(drawn.tolist()):
                    pairs = [Question(scene, light, view, seed, ours, rival) for rival in rivals]
                    found += [each for pair in pairs for each in (pair, pair.swapped())]
    order = generator(seeds[0], "judge", "order").permutation(len(found))
    return [found[k] for k in order]


def controls(scenes: Mapping[str, tuple[Sequence[str], int]], seed: int) -> list[Question]:
    """Return at most CONTROLS pairs of a picture and its spoiled copy, in both orders, over all lights."""
    every = [
        Question(scene, light, view, seed, CONTROL, SPOILED)
        for scene, (lights, count) in scenes.items()
        for light in lights
        for view in range(count)
    ]
    order = generator(seed, "judge", "controls").permutation(len(every))[:CONTROLS]
    return [each for k in order for each in (every[k], every[k].swapped())]


def spoiled(picture: np.ndarray) -> np.ndarray:
    """Pixelate a picture (H, W, 3) in blocks of 1/16 of its shorter side: worse by the prompt's criteria."""
    height, width = picture.shape[:2]
    block = max(2, min(height, width) // 16)
    rows, columns = np.arange(0, height, block), np.arange(0, width, block)
    sums = np.add.reduceat(np.add.reduceat(picture, rows, 0), columns, 1)
    counts = np.multiply.outer(np.diff(np.append(rows, height)), np.diff(np.append(columns, width)))
    return np.kron(sums / counts[..., None], np.ones((block, block, 1)))[:height, :width]


def pairs(asked: Sequence[Question]) -> Iterator[tuple[Question, Question]]:
    """Yield both orders of each pair; the order that shows the first-named method first comes first.

    Raises:
        ValueError: a pair was asked in one order only.
    """
    there = set(asked)
    seen: set[Question] = set()
    for each in asked:
        other = each.swapped()
        if other not in there:
            raise ValueError(f"{each} was asked in one order alone")
        if other not in seen:
            seen.add(each)
            yield each, other
