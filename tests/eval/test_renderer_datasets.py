"""Commands by which the renderer benchmark makes data and trainings: their settings, and what they read."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from datagen.files.assets import find_assets
from datagen.settings.command import Settings as DatagenSettings
from datagen.settings.surfels import SurfelBudget
from eval.cli import Settings as EvalSettings
from eval.renderer.benchmark import Renderer
from eval.renderer.datasets import Datasets, Quality, model_names
from eval.stages import Child
from train.examples.splits import Splits
from train.settings import Settings as TrainSettings
from tron.cli.instantiation import make
from tron.cli.recipes import check, compose_recipe

COMMANDS = {"tron-datagen": ("conf.datagen", DatagenSettings), "tron-train": ("conf.train", TrainSettings)}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Name of what is made -> settings of its command, which is not run."""
    found: dict[str, Any] = {}

    def note(children: Sequence[Child]) -> None:
        for child in children:
            module, model = COMMANDS[child.script]
            found[child.label] = check(compose_recipe(module, model, child.arguments), model)

    monkeypatch.setattr("eval.stages.run_together", note)
    return found


def datasets(folder: Path, *overrides: str) -> Datasets:
    recipe = compose_recipe("conf.eval", EvalSettings, ["benchmark=renderer", *overrides])
    benchmark = make(check(recipe, EvalSettings).benchmark, "benchmark")
    assert isinstance(benchmark, Renderer)
    return Datasets(benchmark, folder)


def test_the_commands_accept_every_recipe_and_no_data_share_a_seed(asked: dict[str, Any], tmp_path: Path):
    for kind in ("assets/a", "hdri"):
        (tmp_path / "real" / kind).mkdir(parents=True)
    (tmp_path / "real" / "assets" / "a" / "chess-board.glb").touch()
    (tmp_path / "real" / "hdri" / "night_1k.hdr").touch()
    made = datasets(tmp_path / "out", f"benchmark.real_data={tmp_path / 'real'}")
    for size in (128, 256):
        made.synthetic(size)
    for make_it in (made.captures, made.shadows):
        make_it()
    for size in (128, 256, 512):
        for quality in ("preview", "final"):
            made.models(size, quality)
    made.models(512, "final", few=True)
    assert asked["models_128_preview"].allow_unlicensed == ["chess-board", "night_1k"]
    assert asked["captures"].captures == tmp_path / "out" / "captures_views" / "captures"
    assert asked["captures"].captured.split_by_name
    seeds = [
        asked[name].seed for name in ("synthetic_128", "models_128_preview", "captures_views", "shadows")
    ]
    for learnt_from in ("renderer_train", "pseudo_captures"):
        typed = [f"experiment={learnt_from}", f"output_dir={tmp_path}"]
        composed = compose_recipe("conf.datagen", DatagenSettings, typed)
        seeds.append(check(composed, DatagenSettings).seed)
    assert len(set(seeds)) == len(seeds)


def test_qualities_and_surfels_show_the_same_scenes_and_path_trace_them_anew(
    asked: dict[str, Any], tmp_path: Path
):
    """All but guidance, surfels and paths is alike, so frames are; other numbers of paths are other noise."""
    for kind in ("assets", "hdri"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / ("cup.glb" if kind == "assets" else "night.hdr")).touch()
    made = datasets(tmp_path / "out", f"benchmark.real_data={tmp_path}")
    kinds: list[tuple[Quality, bool]] = [
        ("preview", False),
        ("final", False),
        ("preview", True),
        ("final", True),
    ]
    for quality, few in kinds:
        made.models(512, quality, few)
    names = [f"models_512{'_few' if few else ''}_{quality}" for quality, few in kinds]
    recipes = [asked[name].recipe() for name in names]
    budgets = [asked[name].surfel_budget("test").surfels for name in names]
    assert budgets == [100_000, 100_000, 20_000, 20_000]
    assert [each["test"].pop("path_spp") for each in recipes] == [64, 60, 36, 36]
    assert [each["test"].pop("guidance_spp") for each in recipes] == [quality for quality, _ in kinds]
    for each in recipes:
        for name in ("train", "test"):
            for of_surfels in SurfelBudget._fields:
                del each[name][of_surfels]
        for name in ("guidance_spp", "path_spp"):
            each["train"].pop(name, None)
    assert all(each == recipes[0] for each in recipes)


@pytest.mark.parametrize("size", [128, 256, 512])
def test_no_two_truths_share_the_paths_of_a_pass(size: int):
    """Passes of as many paths begin with one seed: their renders would be the same in part."""
    from datagen.truth.pathtrace import LANES, near_product

    recipes = compose_recipe("conf.eval", EvalSettings, ["benchmark=renderer"])["benchmark"]
    kinds = [*recipes["qualities"].values(), recipes["few_surfels"]]
    paths = [
        int(typed.split("=")[1]) for each in kinds for typed in each if typed.startswith("test.path_spp")
    ]
    passes = [-(-spp // max(LANES // size**2, 1)) for spp in paths]
    parts = [near_product(-(-spp // count)) for spp, count in zip(paths, passes)]
    assert len(set(parts)) == len(parts) == 3


def test_models_of_one_file_name_and_with_spaces_are_called_as_tron_datagen_calls_them(
    asked: dict[str, Any], tmp_path: Path
):
    """Many downloads hold a scene.gltf."""
    for name in (
        "assets/cup/scene.gltf",
        "assets/jar/scene.gltf",
        "assets/chess board.glb",
        "hdri/2024.hdr",
        "hdri/o'clock.exr",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    names = model_names(tmp_path)
    assert sorted(names) == ["chess board", "cup/scene", "jar/scene"]
    assert {each.id for each in find_assets(tmp_path / "assets", allow_unlicensed=names)} == set(names)
    datasets(tmp_path / "out", f"benchmark.real_data={tmp_path}").models(128, "final")
    assert asked["models_128_final"].allow_unlicensed == [*names, "2024", "o'clock"]


def test_threads_and_seed_of_the_command_are_those_of_the_benchmark(tmp_path: Path):
    settings = datasets(tmp_path, "threads=3", "seed=5").settings
    assert (settings.threads, settings.seed) == (3, 5)


def test_per_pixel_baselines_learn_from_the_split_that_fits_are_made_on(
    asked: dict[str, Any], dataset: Path, tmp_path: Path
):
    """A captures' `train` holds photographs; relit truth, which judges, is in `train_relit`."""
    for split in ("train", "train_b"):
        datasets(tmp_path / split).pixel_mlps(dataset, split)
        for name in ("pixel_mlp", "pixel_mlp_lit"):
            settings = asked[f"{dataset.name}_{name}"]
            splits = Splits(settings.dataset, settings.splits)
            (learnt,) = {split for stage in settings.stages for split in stage.splits()}
            clips = splits.clips(learnt)
            assert {clips.meta(number).split for number in range(len(clips))} == {split}
    assert datasets(tmp_path / "none").pixel_mlps(dataset, "train_relit") == []
