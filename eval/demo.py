"""Benchmark `demo`: make a small data set, train on it, evaluate. One command from nothing to a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

from pydantic import Field, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting.baselines import predictions
from eval.relighting.benchmark import Relighting
from eval.relighting.buffers import MEMBERS
from eval.relighting.gallery import Example, middle_frame
from eval.relighting.networks import load_networks
from eval.renderer.pictures import comparison
from eval.report.outcome import Outcome
from eval.results import Row, Target, mean_row
from eval.stages import ONE_THREAD, Child, Stages, script_path
from tron.cli.installation import require_own_packages
from tron.errors import TronError
from tron.neural.shipped import installed
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

DEMO = "experiment=demo"
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


REFINED = {"base_color_psnr": "dB", "normal_mae_deg": "deg", "silhouette_error": "fraction"}
"""Figure of a scene's record before and after refinement -> unit."""


class Demo(Benchmark):
    """Settings: a recipe for each stage; ``relighting`` has the settings of the evaluation."""

    name: ClassVar[str] = "demo"

    relighting: Relighting = Field(description="settings of benchmark=relighting; its inputs are filled in")
    datagen: list[str] = Field(default=[DEMO], description="arguments of tron-datagen")
    large: list[str] = Field(
        default_factory=list, description="arguments of tron-datagen for larger frames; none: no pictures"
    )
    train: list[str] = Field(default=[DEMO], description="arguments of tron-train, the same for all networks")
    max_seconds: PositiveFloat | None = Field(
        default=None, description="wall time of each training; null: as in the training recipe"
    )
    pixel_mlp_seconds: PositiveFloat | None = Field(
        default=None,
        description="wall time of the per-pixel network's training; null: same as the others",
    )
    train_threads: PositiveInt = Field(default=1, description="CPU threads of each of the three trainings")

    def bounds(self) -> list[Target]:
        """Return the targets of the demo's own recipe; none for other data or trainings."""
        own = all(getattr(self, name) == [DEMO] for name in ("datagen", "train"))
        return self.targets if own else []

    def check(self) -> None:
        """Find the commands that the stages call."""
        require_own_packages("datagen", "train")
        for name in ("tron-datagen", "tron-train"):
            script_path(name)

    def run(self, output_dir: Path) -> Outcome:
        """Run the unfinished stages, evaluate, and add the ``demo.*`` rows.

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
            if self.large:
                show_large_frames(folder / "large", outcome)
        outcome.rows += refinement(dataset, self.relighting.seed)
        seconds = {f"{name}_seconds": record.seconds for name, record in stages.records.items()}
        outcome.rows.append(_seconds_per_scene(dataset, seconds["datagen_seconds"]))
        outcome.rows += [
            Row(metric=f"demo.{name}", value=value, unit="s", n=1)
            for name, value in {"seconds": sum(seconds.values()), **seconds}.items()
        ]
        again = f"# or, once installed: tron-eval benchmark=demo output_dir={output_dir}"
        outcome.reproduce = ["make demo", again]
        return outcome

    def _training(self, name: str, dataset: Path, folder: Path) -> Child:
        arguments = [*self.train, *TRAININGS[name], f"dataset={dataset}", f"output_dir={folder}"]
        seconds = (self.pixel_mlp_seconds if name == "pixel_mlp" else None) or self.max_seconds
        if seconds is not None:
            arguments.append(f"max_seconds={seconds:g}")
        threads = {variable: str(self.train_threads) for variable in ONE_THREAD}
        return Child(name, "tron-train", arguments, threads)


def refinement(dataset: Path, seed: int) -> list[Row]:
    """Return rows ``refinement.*``: surfels before and after the fit to G-buffers, by tron-datagen's records.

    Means are over all scenes at held-out cameras; there are none if surfels were not fitted.
    ``seed`` draws the scenes of the intervals.

    Raises:
        TronError: a scene's record is not readable.
    """
    found = []
    for path in sorted(dataset.glob("scenes/*/record.json")):
        try:
            record = json.loads(path.read_text("utf-8")).get("refinement")
        except (OSError, ValueError, AttributeError) as error:
            raise TronError(f"not a scene's record: {error}", path) from error
        if record is not None:
            found.append((path.parent.name, record))
    if not found:
        return []
    return [
        mean_row(
            f"refinement.{name}.{when}", unit, [(scene, each[when][name]) for scene, each in found], seed
        )
        for name, unit in REFINED.items()
        for when in ("before", "after")
    ]


def show_large_frames(dataset: Path, outcome: Outcome) -> None:
    """Show one frame of each test scene by the shipped checkpoints, which never saw the demo's data.

    Each frame is under another light than the previous scene's. None if this installation has no
    checkpoints.

    Raises:
        TronError: the dataset has no test split or is damaged.
    """
    shows = {name: network.show for name, network in load_networks("neural", installed().values()).items()}
    examples: dict[str, list[Example]] = {}
    for clip in read_clips(dataset, "test", MEMBERS) if shows else ():
        shown = predictions(clip, shows)["frame"]
        examples.setdefault(clip.meta.scene, []).append(middle_frame(clip, shown, clip.displayed("rgb")))
    for number, lights in enumerate(examples.values()):
        example = lights[number % len(lights)]
        outcome.show("large", f"large-{example.meta.key}", comparison(example))


def _seconds_per_scene(dataset: Path, seconds: float) -> Row:
    """Divide the wall time of the data engine by its number of scenes; workers make several at a time."""
    keys = (key for entry in Manifest.load(dataset).shards for key in entry.keys)
    scenes = len({key.rsplit("-", 1)[0] for key in keys})
    return Row(metric="datagen.seconds_per_scene.demo", value=seconds / scenes, unit="s", n=scenes)
