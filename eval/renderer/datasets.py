"""Data sets, checkpoints and baselines that the benchmark makes by the other commands, each once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from eval.real_models import has_models, model_arguments
from eval.renderer.settings import CaptureRecipes, Kind, RendererSettings
from eval.stages import ONE_THREAD, Child, Stages
from tron.errors import TronError
from tron.shards.manifest import Manifest

WEIGHTS = "renderer.safetensors"
TEST, TEST_RELIT = "test", "test_relit"
FIT, FIT_RELIT = "train", "train_relit"
BASELINE_BUFFERS = {
    "pixel_mlp": ("pbr", "irradiance"),
    "pixel_mlp_lit": ("pbr", "irradiance", "lit"),
}
"""Per-pixel baseline -> what it sees."""


class Datasets:
    """Data sets by name, made on first use; what is finished is not made again.

    Args:
        settings: of the benchmark.
        folder: for all of them, absolute.

    Every method raises StageFailed where a command fails, and TronError where the folder was begun with
    other settings.
    """

    def __init__(self, settings: RendererSettings, folder: Path):
        self.settings, self.folder, self.stages = settings, folder, Stages(folder)

    def synthetic(self, size: int) -> Path:
        """Held-out scenes and lights."""
        return self._made(f"synthetic_{size}", self.settings.synthetic[size])

    def models(self, size: int) -> Path | None:
        """Scenes of the user's models; None where there are none."""
        name, data = f"models_{size}", self.settings.real_data
        if name in self.settings.data:
            return self.settings.data[name]
        if data is None or not has_models(data):
            return None
        return self._made(name, [*self.settings.models[size], *model_arguments(data)])

    def captures(self) -> Path:
        """Held-out captures, reconstructed and relit."""
        return self._captured("captures", self.settings.captures)

    def shadows(self) -> Path:
        """Clips in which an occluder moves."""
        return self._made("shadows", self.settings.shadows)

    def seeds(self) -> Path:
        """Data of short trainings: the checkpoints' own training data where they are at hand."""
        if self.settings.train or "training" in self.settings.data:
            return self._made("training", self.settings.training_recipes.data)
        return self._made("seed_training", self.settings.seeds.data)

    def kills(self) -> Path:
        """The tiny data set of trainings that are killed."""
        return self._made("kills", self.settings.kills.data)

    def trained(self) -> dict[Kind, Path]:
        """Train both checkpoints, side by side; folder of each one's training."""
        recipes = self.settings.training_recipes
        data = self._made("training", recipes.data)
        others = {
            "captures": self._captured("training_captures", recipes.captures),
            "clips": self._made("training_clips", recipes.clips),
        }
        placed = {name: place.split("#") for name, place in recipes.splits.items()}
        splits = ",".join(f'{name}: "{others[kind]}#{split}"' for name, (kind, split) in placed.items())
        common = [*recipes.recipe, f"dataset={data}"]
        common += [f"splits={{{splits}}}"] if splits else []
        limit = [] if self.settings.max_seconds is None else [f"max_seconds={self.settings.max_seconds:g}"]
        arguments = {f"trained_{kind}": [*common, *own, *limit] for kind, own in recipes.own.items()}
        made = self.train("training", arguments, len(arguments))
        return {kind: made[f"trained_{kind}"] for kind in recipes.own}

    def train(self, stage: str, runs: Mapping[str, Sequence[str]], side_by_side: int) -> dict[str, Path]:
        """Run trainings, folder -> arguments; their folders by the same names."""
        names = list(runs)
        for first in range(0, len(names), side_by_side):
            children = [
                Child(name, "tron-train", [*runs[name], f"output_dir={self.folder / name}"], ONE_THREAD)
                for name in names[first : first + side_by_side]
            ]
            self.stages.run(f"{stage}: {' '.join(child.label for child in children)}", children)
        return {name: self.folder / name for name in names}

    def pixel_mlps(self, dataset: Path, split: str) -> dict[str, Path]:
        """Per-pixel baselines trained on a split: name -> weights; none where they are not asked for."""
        recipe = self.settings.pixel_mlp
        if recipe is None or split not in Manifest.load(dataset).splits():
            return {}
        # The recipe's stages name FIT, which may be there beside the split and hold other pictures.
        place = [] if split == FIT else [f'splits={{{FIT}: "{dataset}#{split}"}}']
        runs = {
            f"{dataset.name}_{name}": [
                *("renderer=pixel_mlp", f"renderer.config.guidance=[{','.join(buffers)}]"),
                *(*recipe, f"dataset={dataset}", *place),
            ]
            for name, buffers in BASELINE_BUFFERS.items()
        }
        made = self.train("per-pixel baselines", runs, len(runs))
        return {name: made[f"{dataset.name}_{name}"] / WEIGHTS for name in BASELINE_BUFFERS}

    def _captured(self, name: str, recipes: CaptureRecipes) -> Path:
        if name in self.settings.data:
            return self.settings.data[name]
        views = self._made(f"{name}_views", recipes.views)
        given = [
            f"captures={views / 'captures'}",
            *(f"captured.{name}={views / name}" for name in ("relit", "truth")),
        ]
        return self._made(name, [*recipes.pairs, *given])

    def _made(self, name: str, recipe: Sequence[str]) -> Path:
        if name in self.settings.data:
            return self.settings.data[name]
        output = self.folder / name
        self.stages.run(name, [Child(name, "tron-datagen", [*recipe, f"output_dir={output}"])])
        return output


def require_data(settings: RendererSettings) -> None:
    """TronError unless every folder that was given holds a data set, and is given for one that is made."""
    known = [f"synthetic_{size}" for size in settings.synthetic]
    known += [f"models_{size}" for size in settings.models]
    known += [
        "captures",
        "shadows",
        "training",
        "training_captures",
        "training_clips",
        "seed_training",
        "kills",
    ]
    for name, folder in settings.data.items():
        if name not in known:
            raise TronError(
                f"no data set is called '{name}'", "benchmark.data", f"names are {', '.join(known)}"
            )
        if not folder.is_dir():
            raise TronError(
                f"no data set {name}", folder, f"leave out benchmark.data.{name}: it is made then"
            )
        Manifest.load(folder)
