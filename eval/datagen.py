"""Benchmark `datagen`: speed of the data engine, and time of path tracing to an error as low as lit's.

Kills, hostile files, full disks and merging are tested in tests/robustness and tests/datagen.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.stages import Child, Stages, script_path
from tron.cli.installation import require_own_packages
from tron.errors import TronError
from tron.io.images import read_image
from tron.report.page import Picture, Pictures
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

SCRIPT = "tron-datagen"
WORKERS = 2
EQUAL_ERROR = "guidance.ratio_to_path_tracing.equal_error"
FIGURES = {"error": "abs", "seconds": "s", "paths": "1"}
"""Figure of a way in equal_error.json -> unit of its row ``guidance.FIGURE.WAY``."""


class Datagen(Benchmark):
    """Settings: arguments of tron-datagen for each part."""

    name: ClassVar[str] = "datagen"

    parts: list[Literal["throughput", "equal_error"]] = Field(description="parts to measure", min_length=1)
    seed: int = Field(default=1000, description="seed of the confidence intervals")
    throughput: list[str] = Field(description="recipe of the throughput measurement")
    sizes: dict[PositiveInt, list[str]] = Field(description="width of a frame -> further arguments")
    equal_error: list[str] = Field(
        description="recipe of the scenes on which guidance and path tracer are compared; "
        "where models and maps are comes with it"
    )

    def check(self) -> None:
        """Find the command that the parts call."""
        require_own_packages("datagen")
        script_path(SCRIPT)

    def run(self, output_dir: Path) -> Outcome:
        """Measure part by part.

        Raises:
            StageFailed: tron-datagen failed.
            TronError: it wrote no such records.
        """
        self.check()
        folder = output_dir.absolute()
        stages, outcome = Stages(folder), Outcome(folder)
        if "throughput" in self.parts:
            for width, more in self.sizes.items():
                outcome.add(self._throughput(stages, folder / f"throughput_{width}", width, more))
        if "equal_error" in self.parts:
            dataset = folder / "models"
            outcome.add(self._equal_errors(stages, dataset))
            files = sorted(dataset.glob("equal_error/*.png"))
            shown = [Picture(read_image(path), path.stem, path.stem) for path in files]
            title = (
                "Left to right: lit with reflections, the path tracer in no more than our time, the path "
                "tracer converged"
            )
            if shown:
                outcome.show("equal-error", "equal-error", Pictures(title, shown, columns=1))
        return outcome

    def _throughput(self, stages: Stages, output: Path, width: int, more: list[str]) -> Iterator[Row]:
        """Make scenes and measure frames per hour and worker, and seconds per frame of each stage.

        The first scene of each worker, which compiles the kernels, does not count.
        """
        shutil.rmtree(output, ignore_errors=True)
        stages.restart(output.name)  # a figure of this run, never of one before
        square = [f"train.width={width}", f"train.height={width}"]
        arguments = [*self.throughput, *square, *more, f"workers={WORKERS}", f"output_dir={output}"]
        stages.run(output.name, [Child(output.name, SCRIPT, arguments)])
        frames: dict[str, int] = {}
        for split in Manifest.load(output).splits():
            for clip in read_clips(output, split, ("foreground",)):
                frames[clip.meta.scene] = frames.get(clip.meta.scene, 0) + clip.meta.frames
        counted = counted_scenes(_records(output / "logs" / "times.jsonl"))
        shutil.rmtree(output)
        count = sum(frames[each["scene"]] for each in counted)
        seconds: dict[str, float] = {}
        for each in counted:
            for stage, value in each["seconds"].items():
                seconds[stage] = seconds.get(stage, 0.0) + value
        rate = 3600 * WORKERS * count / sum(seconds.values())
        yield Row(metric=f"frames_per_hour.{width}", value=rate, unit="frames/h", n=len(counted))
        for stage, value in seconds.items():
            metric = f"seconds_per_frame.{stage}.{width}"
            yield Row(metric=metric, value=value / count, unit="s", n=len(counted))

    def _equal_errors(self, stages: Stages, dataset: Path) -> Iterator[Row]:
        """Yield rows of our frame time over the path tracer's at equal error; scenes are made once."""
        arguments = [*self.equal_error, f"output_dir={dataset}"]
        stages.run("models", [Child("models", SCRIPT, arguments)])
        stages.restart("equal_error")
        stages.run("equal_error", [Child("equal_error", SCRIPT, [*arguments, "mode=equal_error"])])
        path = dataset / "equal_error.json"
        try:
            cases = json.loads(path.read_text("utf-8"))["cases"]
        except (OSError, ValueError, KeyError) as error:
            raise TronError(f"not a record of equal errors: {error}", path) from error
        for number, way in enumerate(cases[0]["ways"]):
            tail = f".{way}" if number else ""  # the target holds the first
            metrics = {"ratio": (EQUAL_ERROR + tail, "x")}
            metrics |= {"ratio_with_bake": (f"{EQUAL_ERROR}.with_bake{tail}", "x")}
            metrics |= {name: (f"guidance.{name}.{way}", unit) for name, unit in FIGURES.items()}
            for name, (metric, unit) in metrics.items():
                yield mean_row(metric, unit, [(c["scene"], c["ways"][way][name]) for c in cases], self.seed)


def counted_scenes(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the finished scenes without the first of each worker, if others are left."""
    made = [each for each in records if each["made"]]
    first = {each["worker"]: each for each in reversed(made)}
    return [each for each in made if first[each["worker"]] is not each] or made


def _records(path: Path) -> list[dict[str, Any]]:
    """Read tron-datagen's times.jsonl: "scene", "worker", "made" and "seconds" by stage."""
    try:
        return [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise TronError(f"not the times of a dataset: {error}", path) from error
