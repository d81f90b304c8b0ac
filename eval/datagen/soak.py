"""Memory of the data engine over hundreds of scenes: the command, its scheduler and its workers together."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from eval.datagen.runs import TIMES, make, resident_mb
from eval.report.charts import line_chart
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Section, Text

WORKERS = 2
WARM = 10
"""Scenes of a worker's life before its growth is looked at, and the fewest over which it is."""
PARTS = 5
"""The scenes are cut in so many parts: the first warms up, the second is what the last is held against."""


@dataclass(frozen=True)
class Soak:
    """Resident memory while scenes are made.

    Attributes:
        samples: (scenes finished by then, MB of each process by its number) about once a second.
        scenes: of the run.
        seconds: wall time of the command.
    """

    samples: list[tuple[int, dict[int, float]]]
    scenes: int
    seconds: float

    def peak(self, part: int) -> float:
        """Largest resident memory while one of PARTS of the scenes was made, MB.

        A part holds whole lives of workers, so a saw-tooth has its teeth in each.

        Raises:
            TronError: too few scenes for a sample in each part.
        """
        low, high = (self.scenes * k / PARTS for k in (part, part + 1))
        inside = [sum(each.values()) for done, each in self.samples if low <= done < high]
        if not inside:
            raise TronError(
                f"{self.scenes} scenes are over before memory is sampled",
                "benchmark.soak_scenes",
                "make more of them",
            )
        return max(inside)

    def growth_per_scene(self) -> float:
        """Memory that a process gains with each scene that it makes, MB; its end gives it back.

        The largest slope of a process's memory against the scenes that it made (half of all: there are two
        workers), from the tenth scene of its life on.
        """
        lives: dict[int, list[tuple[float, float]]] = {}
        for done, each in self.samples:
            for process, mb in each.items():
                lives.setdefault(process, []).append((done / WORKERS, mb))
        slopes = []
        for life in lives.values():
            points = np.array([point for point in life if point[0] >= life[0][0] + WARM])
            if len(points) > 2 and np.ptp(points[:, 0]) >= WARM:
                slopes.append(float(np.polyfit(points[:, 0], points[:, 1], 1)[0]))
        return max(slopes, default=0.0)

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Growth and peak of the memory, growth within a worker's life, and seconds a scene."""
        growth = self.peak(PARTS - 1) - self.peak(1)
        yield Row(metric="soak.rss_growth_mb", value=growth, unit="MB", n=self.scenes)
        within = self.growth_per_scene()
        yield Row(metric="soak.worker_growth_mb_per_scene", value=within, unit="MB", n=self.scenes)
        peak = max(sum(each.values()) for _, each in self.samples)
        yield Row(metric="soak.rss_peak_mb", value=peak, unit="MB", n=self.scenes)
        each = self.seconds / self.scenes
        yield Row(metric="soak.seconds_per_scene", value=each, unit="s", n=self.scenes)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Memory over the scenes."""
        caption = (
            f"Resident memory of the command, its scheduler and two workers over {self.scenes} tiny scenes; "
            "workers are replaced as shipped."
        )
        points = [(float(done), sum(each.values())) for done, each in self.samples]
        chart = line_chart({"all processes": points}, "scenes made", "MB", caption)
        last, second = self.peak(PARTS - 1), self.peak(1)
        text = (
            f"The figure is the largest memory in the last fifth of the scenes less that in the second: "
            f"{last:.0f} MB less {second:.0f} MB. The first fifth warms up. The process that grows most "
            f"gains {self.growth_per_scene():.2f} MB a scene in its life. Pages that processes share are "
            "counted in each."
        )
        return [Section("soak", "Memory over many scenes", [Text(text), chart])]


def measure_soak(recipe: Sequence[str], scenes: int, folder: Path) -> Soak:
    """Make so many scenes of a recipe with two workers, and watch the memory.

    Raises:
        StageFailed: the run failed.
    """
    output = folder / "soak"
    shutil.rmtree(output, ignore_errors=True)
    samples: list[tuple[int, dict[int, float]]] = []

    def watch(process: psutil.Process) -> None:
        done = (output / TIMES).read_bytes().count(b"\n") if (output / TIMES).is_file() else 0
        samples.append((done, resident_mb(process)))

    seconds = make([*recipe, f"train.scenes={scenes}", f"workers={WORKERS}"], output, watch=watch)
    shutil.rmtree(output)
    return Soak(samples, scenes, seconds)
