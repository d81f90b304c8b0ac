"""Frames an hour on this machine at several sizes, and what their time goes to."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.datagen.runs import SceneTime, make, scene_times
from eval.report.charts import bar_chart
from eval.results import Row
from tron.report.page import Section, Table, Text
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

WORKERS = 2
STAGES = {
    "build": "draw and build",
    "surfels": "surfels",
    "refine": "refine",
    "path_trace": "path trace",
    "guidance": "guidance",
    "reference": "reference",
    "write": "write",
    "rest": "rest",
}
"""Stage of a scene's times -> its words, in the order of the chart."""


@dataclass(frozen=True)
class Size:
    """Throughput at one size.

    Attributes:
        frames: of the scenes that count.
        scenes: that count: all but the first of each worker, which compiles the kernels.
        seconds: stage -> seconds of those scenes together.
        first: mean seconds of the workers' first scenes.
    """

    frames: int
    scenes: int
    seconds: Mapping[str, float]
    first: float

    @property
    def total(self) -> float:
        """Seconds of one worker for all of them."""
        return sum(self.seconds.values())

    @property
    def frames_per_hour(self) -> float:
        """Frames that WORKERS make in an hour, once they are running."""
        return 3600 * WORKERS * self.frames / self.total


@dataclass(frozen=True)
class Throughput:
    """Width of the square frames -> what was measured."""

    sizes: Mapping[int, Size]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Frames an hour, and seconds a frame by stage."""
        for width, size in self.sizes.items():
            metric, value = f"frames_per_hour.{width}", size.frames_per_hour
            yield Row(metric=metric, value=value, unit="frames/h", n=size.scenes)
            for stage, seconds in size.seconds.items():
                metric, value = f"seconds_per_frame.{stage}.{width}", seconds / size.frames
                yield Row(metric=metric, value=value, unit="s", n=size.scenes)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Time by stage as a chart and a table."""
        stages = [stage for stage in STAGES if any(stage in size.seconds for size in self.sizes.values())]
        bars = {
            f"{width}²": {STAGES[stage]: 100 * size.seconds.get(stage, 0.0) / size.total for stage in stages}
            for width, size in self.sizes.items()
        }
        chart = bar_chart(bars, "share of the time, %", "Where the time of a frame goes, by its size.")
        rows = [
            [
                f"{width}²",
                f"{size.frames_per_hour:,.0f}",
                *(f"{size.seconds.get(stage, 0.0) / size.frames:.2f}" for stage in stages),
                f"{size.first - size.total / size.scenes:+.0f}",
            ]
            for width, size in self.sizes.items()
        ]
        headings = ["Frame", "Frames an hour", *(STAGES[stage] for stage in stages), "First scene"]
        groups = [("", 2), ("Seconds a frame", len(stages)), ("Seconds more", 1)]
        caption = (
            f"Frames an hour of {WORKERS} workers that are running, and seconds of one of them for a frame."
        )
        text = Text(
            "The first scene of each worker, which compiles the kernels, is left out; the last column says "
            "how much longer it takes. What is done once for a scene (build, surfels, refine) or a light is "
            "shared by its frames."
        )
        table = Table(caption, headings, rows, groups=groups)
        return [Section("throughput", "Frames an hour", [text, chart, table])]


def measure_throughput(recipe: Sequence[str], sizes: Mapping[int, Sequence[str]], folder: Path) -> Throughput:
    """Make scenes of a recipe at several sizes.

    Args:
        recipe: arguments of tron-datagen for all. sizes: width -> further arguments. folder: for datasets.

    Raises:
        StageFailed: a run failed.
    """
    found = {}
    for width, more in sizes.items():
        output = folder / f"throughput_{width}"
        shutil.rmtree(output, ignore_errors=True)
        square = [f"train.width={width}", f"train.height={width}"]
        make([*recipe, *square, *more, f"workers={WORKERS}"], output)
        found[width] = _size(scene_times(output), _frames(output))
        shutil.rmtree(output)
    return Throughput(found)


def _size(times: Sequence[SceneTime], frames: Mapping[str, int]) -> Size:
    first = {each.worker: each for each in reversed(times)}
    counted = [each for each in times if first[each.worker] is not each] or list(times)
    seconds: dict[str, float] = {}
    for each in counted:
        for stage, value in each.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + value
    compiling = [each.total for each in first.values()]
    return Size(
        sum(frames[each.scene] for each in counted), len(counted), seconds, sum(compiling) / len(compiling)
    )


def _frames(dataset: Path) -> dict[str, int]:
    """Scene -> frames of all its clips."""
    frames: dict[str, int] = {}
    for split in Manifest.load(dataset).splits():
        for clip in read_clips(dataset, split, ("foreground",)):
            frames[clip.meta.scene] = frames.get(clip.meta.scene, 0) + clip.meta.frames
    return frames
