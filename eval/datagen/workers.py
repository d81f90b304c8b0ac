"""Two workers beside one: the same scenes in turns, and whether they are the same bytes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.datagen.runs import differences, make, tree
from eval.results import Row
from tron.report.page import Section, Table


@dataclass(frozen=True)
class Workers:
    """Wall seconds of whole commands, start and end of the workers included.

    Attributes:
        seconds: number of workers -> of each round; round k of both stands at index k.
        different: files that the two runs of a round did not agree on, over all rounds.
        scenes: of one run.
    """

    seconds: dict[int, list[float]]
    different: list[str]
    scenes: int

    @property
    def speedup(self) -> float:
        """Median seconds of one worker over those of two."""
        one, two = (float(np.median(self.seconds[count])) for count in (1, 2))
        return one / two

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Speedup, whether bytes agreed, and the seconds."""
        rounds = len(self.seconds[1])
        yield Row(metric="workers.speedup_2", value=self.speedup, unit="x", n=rounds)
        yield Row(metric="workers.identical", value=float(not self.different), unit="fraction", n=rounds)
        for count, seconds in self.seconds.items():
            value = float(np.median(seconds))
            yield Row(metric=f"workers.seconds_of_{count}", value=value, unit="s", n=rounds)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """The rounds in a table."""
        rows = [
            [f"{count} worker{'s' if count > 1 else ''}", *(f"{value:.1f} s" for value in seconds)]
            for count, seconds in self.seconds.items()
        ]
        rounds = [f"round {k + 1}" for k in range(len(self.seconds[1]))]
        said = "were the same bytes" if not self.different else f"differed in {', '.join(self.different[:3])}"
        caption = (
            f"Wall time of the whole command for the same {self.scenes} scenes, in turns, start and end of "
            f"its workers included. What one worker and two wrote {said}."
        )
        return [Section("workers", "One worker and two", [Table(caption, ["", *rounds], rows)])]


def measure_workers(recipe: Sequence[str], rounds: int, folder: Path) -> Workers:
    """Make the same scenes with one worker and with two, in turns, after a run that warms up the caches.

    Args:
        recipe: arguments of tron-datagen. rounds: how often. folder: for the datasets, which are removed.

    Raises:
        StageFailed: a run failed.
    """
    seconds: dict[int, list[float]] = {1: [], 2: []}
    different: list[str] = []
    scenes = 0
    output = folder / "warm"
    shutil.rmtree(output, ignore_errors=True)
    make([*recipe, "train.scenes=2", "workers=1"], output)
    shutil.rmtree(output)
    for turn in range(rounds):
        trees = []
        for count in seconds if turn % 2 == 0 else reversed(seconds):
            output = folder / f"workers_{count}"
            shutil.rmtree(output, ignore_errors=True)
            seconds[count].append(make([*recipe, f"workers={count}"], output))
            trees.append(tree(output))
            scenes = len(list(output.glob("scenes/*/record.json")))
            shutil.rmtree(output)
        different += differences(*trees)
    return Workers(seconds, different, scenes)
