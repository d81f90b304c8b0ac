"""Benchmark `demo`: make a small data set, train on it, evaluate. One command from nothing to a report."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

from pydantic import Field, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark
from eval.demo.large_frames import large_frames
from eval.demo.refinement import refinement
from eval.relighting.benchmark import Relighting
from eval.report.outcome import Outcome
from eval.report.stage_table import stage_section
from eval.results import Row, Target
from eval.stages import ONE_THREAD, Child, Stages, script_path
from tron.cli.installation import require_own_packages
from tron.shards.manifest import Manifest

WORDS = {
    "datagen": "path-trace scenes, make surfels, render pbr, irradiance and lit",
    "train": "train the neural renderer and, at the same time, one of two buffers and the pixel MLP",
    "large": "larger frames of three held-out scenes",
    "eval": "fit the baselines, score every held-out frame",
}
UNET = [
    "renderer=unet",
    "renderer.config.skip_blur=0.6",
    "renderer.config.skip_kernel=5",
    "loss.l2=0",
    "loss.psnr=1",
]
"""Network and loss of the shipped checkpoints: it begins as a Gaussian of ``lit``."""
TRAININGS = {
    "unet": UNET,
    "unet_of_two": [*UNET, "renderer.config.guidance=[pbr,irradiance]"],
    "pixel_mlp": ["renderer=pixel_mlp"],
}
"""Networks that train side by side: own arguments of tron-train."""


class Demo(Benchmark):
    """Settings: the recipe of each stage; the evaluation's own settings lie under ``relighting``."""

    name: ClassVar[str] = "demo"

    relighting: Relighting = Field(description="settings of the evaluation; its inputs are filled in")
    datagen: list[str] = Field(default=["experiment=demo"], description="arguments of tron-datagen")
    large: list[str] = Field(
        default_factory=list, description="arguments of tron-datagen for larger frames; none: no pictures"
    )
    train: list[str] = Field(
        default=["experiment=demo"], description="arguments of tron-train, for all networks"
    )
    max_seconds: PositiveFloat | None = Field(
        default=None, description="wall time of each training; null leaves it to the training recipe"
    )
    pixel_mlp_seconds: PositiveFloat | None = Field(
        default=None,
        description="wall time of the per-pixel network's, if it needs less; null: as the others",
    )
    train_threads: PositiveInt = Field(default=1, description="threads of each of the three trainings")

    def bounds(self) -> list[Target]:
        """The evaluation's targets, then the demo's own."""
        return [*self.relighting.targets, *self.targets]

    def check(self) -> None:
        """Find the commands that the stages call."""
        require_own_packages("datagen", "train")
        for name in ("tron-datagen", "tron-train"):
            script_path(name)

    def run(self, output_dir: Path) -> Outcome:
        """Run the stages that are not finished, evaluate, and add the ``demo.*`` rows.

        Raises:
            StageFailed: a command failed; what was finished before it is kept and is not redone.
        """
        folder = output_dir.absolute()
        stages, dataset = Stages(folder), folder / "dataset"
        stages.run("datagen", [Child("datagen", "tron-datagen", [*self.datagen, f"output_dir={dataset}"])])
        stages.run("train", [self._training(name, dataset, folder / "train" / name) for name in TRAININGS])
        if self.large:
            arguments = [*self.large, f"output_dir={folder / 'large'}"]
            stages.run("large", [Child("large", "tron-datagen", arguments)])
        weights = {name: folder / "train" / name / "renderer.safetensors" for name in TRAININGS}
        evaluation = self.relighting.model_copy(
            update={
                "dataset": dataset,
                "renderer": (weights["unet"], weights["unet_of_two"]),
                "pixel_mlp": weights["pixel_mlp"],
            }
        )
        stages.restart("eval")  # never stale: it costs a minute and shows the code as it is now
        with stages.timed("eval", [["tron-eval", "benchmark=demo", f"output_dir={output_dir}"]]):
            outcome = evaluation.run(output_dir)
            larger = large_frames(folder / "large") if self.large else []
        rows, sections = refinement(dataset, self.relighting.seed)
        seconds = {f"{name}_seconds": record.seconds for name, record in stages.records.items()}
        rows += [
            _seconds_per_scene(dataset, seconds["datagen_seconds"]),
            *(
                Row(metric=f"demo.{name}", value=value, unit="s", n=1)
                for name, value in {"seconds": sum(seconds.values()), **seconds}.items()
            ),
        ]
        return dataclasses.replace(
            outcome,
            rows=[*outcome.rows, *rows],
            title="Demo: from path-traced scenes to an evaluated neural renderer",
            sections=[*outcome.sections, *larger, *sections, *stage_section(stages.records, WORDS)],
            headline={**outcome.headline, "demo.seconds": "The whole demo, after set-up"},
            reproduce=[
                "make demo",
                f"# or, once installed: tron-eval benchmark=demo output_dir={output_dir}",
            ],
        )

    def _training(self, name: str, dataset: Path, folder: Path) -> Child:
        arguments = [*self.train, *TRAININGS[name], f"dataset={dataset}", f"output_dir={folder}"]
        seconds = (self.pixel_mlp_seconds if name == "pixel_mlp" else None) or self.max_seconds
        if seconds is not None:
            arguments.append(f"max_seconds={seconds:g}")
        threads = {variable: str(self.train_threads) for variable in ONE_THREAD}
        return Child(name, "tron-train", arguments, threads)


def _seconds_per_scene(dataset: Path, seconds: float) -> Row:
    """Wall time of the data engine over the scenes it made; its workers make several at a time."""
    keys = (key for entry in Manifest.load(dataset).shards for key in entry.keys)
    scenes = len({key.rsplit("-", 1)[0] for key in keys})
    return Row(metric="datagen.seconds_per_scene.demo", value=seconds / scenes, unit="s", n=scenes)
