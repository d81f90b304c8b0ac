"""Settings of the benchmark, and the data sets and baselines that it makes by other commands, each once."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, DirectoryPath, Field, NonNegativeInt, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting.networks import find_weights
from eval.stages import ONE_THREAD, Child, Stages
from tron.errors import TronError
from tron.shards.manifest import Manifest

log = logging.getLogger("tron.eval")

WEIGHTS = "renderer.safetensors"
TEST, TEST_RELIT = "test", "test_relit"
FIT, FIT_RELIT = "train", "train_relit"
BASELINE_BUFFERS = {
    "pixel_mlp": ("pbr", "irradiance"),
    "pixel_mlp_lit": ("pbr", "irradiance", "lit"),
}
"""Per-pixel baseline -> what it sees."""


Recipe = list[str]
"""Arguments of tron-datagen or tron-train, but for what it reads and where it writes."""
Sizes = Annotated[dict[PositiveInt, Recipe], Field(min_length=1)]
Part = Literal["synthetic", "models", "captures", "clips", "shadows", "validation"]
Quality = Literal["preview", "final"]


class CaptureRecipes(BaseModel):
    """Settings: captures with hidden truth, and their reconstructions under other lights."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    views: Recipe = Field(description="arguments of tron-datagen that make photographs and relit truth")
    pairs: Recipe = Field(
        description="arguments of tron-datagen that reconstruct the photographs and relight the result"
    )


class RendererSettings(Benchmark):
    """Settings: checkpoints, recipes and sizes of the parts; recipes are arguments of other commands."""

    name: ClassVar[str] = "renderer"

    parts: list[Part] = Field(description="parts to measure", min_length=1)
    seed: int = Field(default=0, description="seed of the fits and of the confidence intervals")
    threads: PositiveInt = Field(default=1, description="CPU threads of the networks")
    renderer: Path | list[Path] | None = Field(
        default=None,
        description="checkpoint to judge: a file or a shipped name; [a,b]: one with lit, one of the paper's "
        "two buffers; null: both shipped checkpoints",
    )
    data: dict[str, Path] = Field(
        default={},
        description="existing data sets, under the names of this benchmark's own: "
        "synthetic_128, models_128_preview, models_512_few_final, captures, shadows",
    )
    synthetic: Sizes = Field(description="width of a frame -> recipe of held-out scenes and lights")
    real_data: DirectoryPath | None = Field(
        default=None, description="folder with assets and hdri; null: no models"
    )
    models: Sizes = Field(description="width of a frame -> recipe of scenes of the models")
    qualities: dict[Quality, Recipe] = Field(
        description="quality of tron-relight -> further arguments for the recipes of models; path_spp "
        "differs in each, so that the truth is rendered twice",
        min_length=1,
    )
    few_surfels: Recipe | None = Field(
        default=None,
        description="further arguments to make the largest frames again with as few surfels as small "
        "frames have; null: not made",
    )
    captures: CaptureRecipes = Field(description="recipes of held-out captures")
    shadows: Recipe = Field(description="recipe of clips with a moving occluder")
    validation: Sizes = Field(
        description="width of a frame -> recipe of validation scenes for checkpoint=auto of tron-relight"
    )
    pixel_mlp: Recipe | None = Field(
        default=None,
        description="arguments of tron-train for per-pixel baselines on the training split of each test "
        "distribution that has one; null: no such baselines",
    )
    pictures: NonNegativeInt = Field(default=3, description="number of scenes per distribution on the page")

    def weights(self) -> list[Path]:
        """Return the files of the checkpoints."""
        given = [self.renderer] if isinstance(self.renderer, Path) else self.renderer
        return [find_weights(each) for each in given or ("paper", "surfaces")]


class Datasets:
    """Data sets by name, made on first use; finished ones are reused.

    Args:
        settings: settings of the benchmark.
        folder: absolute folder of all data sets.

    Every method raises StageFailed if a command fails, and TronError if the folder was begun with other
    settings.
    """

    def __init__(self, settings: RendererSettings, folder: Path):
        self.settings, self.folder, self.stages = settings, folder, Stages(folder)

    def synthetic(self, size: int) -> Path:
        """Return the data set of held-out scenes and lights."""
        return self._made(f"synthetic_{size}", self.settings.synthetic[size])

    def models(self, size: int, quality: Quality, few: bool = False) -> Path | None:
        """Return scenes of the user's models; None without models. ``few``: with few surfels."""
        name, data = models_name(size, quality, few), self.settings.real_data
        if name in self.settings.data:
            return self.settings.data[name]
        if data is None or not all((data / kind).is_dir() for kind in ("assets", "hdri")):
            log.warning("no models: give benchmark.real_data=FOLDER with assets and hdri")
            return None
        recipe = [*self.settings.models[size], *self.settings.qualities[quality]]
        recipe += (self.settings.few_surfels or ()) if few else ()
        return self._made(name, [*recipe, *model_arguments(data)])

    def captures(self) -> Path:
        """Return held-out captures, reconstructed and relit."""
        if "captures" in self.settings.data:
            return self.settings.data["captures"]
        recipes = self.settings.captures
        views = self._made("captures_views", recipes.views)
        given = [f"captures={views / 'captures'}", *(f"captured.{n}={views / n}" for n in ("relit", "truth"))]
        return self._made("captures", [*recipes.pairs, *given])

    def shadows(self) -> Path:
        """Return clips with a moving occluder."""
        return self._made("shadows", self.settings.shadows)

    def validation(self, size: int) -> Path:
        """Return the validation scenes, on which nothing is judged."""
        return self._made(f"validation_{size}", self.settings.validation[size])

    def pixel_mlps(self, dataset: Path, split: str) -> list[Path]:
        """Return weights of per-pixel baselines trained on a split; none if the recipe is null."""
        recipe = self.settings.pixel_mlp
        if recipe is None or split not in Manifest.load(dataset).splits():
            return []
        # The recipe's stages name FIT, which may be there beside the split and hold other pictures.
        place = [] if split == FIT else [f'splits={{{FIT}: "{dataset}#{split}"}}']
        children = []
        for name, buffers in BASELINE_BUFFERS.items():
            label = f"{dataset.name}_{name}"
            arguments = ["renderer=pixel_mlp", f"renderer.config.guidance=[{','.join(buffers)}]", *recipe]
            arguments += [f"dataset={dataset}", *place, f"output_dir={self.folder / label}"]
            children.append(Child(label, "tron-train", arguments, ONE_THREAD))
        labels = [child.label for child in children]
        self.stages.run(f"per-pixel baselines: {' '.join(labels)}", children)
        return [self.folder / label / WEIGHTS for label in labels]

    def _made(self, name: str, recipe: Sequence[str]) -> Path:
        if name in self.settings.data:
            return self.settings.data[name]
        output = self.folder / name
        self.stages.run(name, [Child(name, "tron-datagen", [*recipe, f"output_dir={output}"])])
        return output


def models_name(size: int, quality: Quality, few: bool) -> str:
    """Return the name of a data set of models."""
    return f"models_{size}{'_few' if few else ''}_{quality}"


def require_data(settings: RendererSettings) -> None:
    """Raise TronError unless every given folder has a data set, under a name of this benchmark."""
    known = [f"synthetic_{size}" for size in settings.synthetic]
    known += [
        models_name(size, quality, few)
        for size in settings.models
        for few in (False, True)
        for quality in settings.qualities
    ]
    known += [f"validation_{size}" for size in settings.validation]
    known += ["captures", "shadows"]
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


MODEL_FILES = (".gltf", ".glb", ".obj")
MAP_FILES = (".hdr", ".exr")
PLAIN = re.compile(r"[A-Za-z][\w./-]*")
"""Names that need no quotation marks on a command line."""


def model_names(data: Path) -> list[str]:
    """Return the names of a folder's models, sorted."""
    return _names(data / "assets", MODEL_FILES)


def model_arguments(data: Path) -> list[str]:
    """Return arguments with models and maps, of any licence: the data sets are not published."""
    data = data.absolute()
    names = [*model_names(data), *_names(data / "hdri", MAP_FILES)]
    return [
        f"assets={data / 'assets'}",
        f"environments={data / 'hdri'}",
        f"allow_unlicensed={typed_list(names)}",
    ]


def typed_list(names: Sequence[str]) -> str:
    """Format names as a typed list; names with spaces, or that look like numbers, are quoted."""
    return f"[{','.join(name if PLAIN.fullmatch(name) else _quoted(name) for name in names)}]"


def _quoted(name: str) -> str:
    escaped = name.replace("'", "\\'")
    return f"'{escaped}'"


def _names(folder: Path, suffixes: Sequence[str]) -> list[str]:
    """Return the names of a folder's files for tron-datagen, subfolders included, suffixes in any case.

    The name is the stem, or the path without the suffix if several files share the stem.
    """
    paths = [path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in suffixes]
    stems = Counter(path.stem for path in paths)
    return sorted(path.stem if stems[path.stem] == 1 else path.with_suffix("").as_posix() for path in paths)
