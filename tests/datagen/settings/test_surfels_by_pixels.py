"""Surfels by pixels: the law grows with frames, numbers overrule it, recipes and costs hold what it says."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from datagen.run import plan as planning
from datagen.run.plan import adopt, plan
from datagen.settings import command
from datagen.settings.command import Settings
from datagen.settings.surfels import SurfelBudget, surfels_by_pixels
from datagen.sources import SOURCES
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError

SOURCE = SOURCES["synthetic"]


def composed(*words: str) -> Settings:
    return check(compose_recipe("conf.datagen", Settings, [*words, "output_dir=none"]), Settings)


def sized(side: int, *words: str) -> Settings:
    return composed(f"train.width={side}", f"train.height={side}", *words)


def test_frames_of_128_have_as_many_as_the_shipped_renderers_learnt_from():
    """Surfels, views and steps of the recipes that they were trained on, until 2026-11-26; larger views."""
    assert surfels_by_pixels(128 * 128) == (20_000, 32, 192, 192, 100)
    assert surfels_by_pixels(8 * 8) == surfels_by_pixels(128 * 128)


def test_larger_frames_have_no_fewer_of_anything():
    budgets = [surfels_by_pixels(side * side) for side in range(8, 4096, 40)]
    for smaller, larger in pairwise(budgets):
        assert all(few <= many for few, many in zip(smaller, larger))
    assert budgets[-1].surfels <= 200_000
    assert surfels_by_pixels(512 * 512).surfels >= 60_000


def test_pixels_count_not_the_shape_of_frames():
    wide = composed("train.width=1024", "train.height=256").surfel_budget("train")
    assert wide == sized(512).surfel_budget("train")
    assert wide.view_width == wide.view_height


def test_numbers_overrule_the_law_one_by_one():
    budget = sized(512, "surfels=700", "refine_steps=0").surfel_budget("train")
    assert budget == sized(512).surfel_budget("train")._replace(surfels=700, refine_steps=0)
    for wrong in ("surfels=some", "surfels=99", "view_width=7", "views=0", "refine_steps=-1"):
        with pytest.raises(TronError, match=wrong.partition("=")[0]):
            composed(wrong)


def test_the_recipe_holds_numbers_split_by_split():
    recipe = composed("train.width=512", "train.height=512", "test.width=128", "test.height=128").recipe()
    for split, pixels in (("train", 512 * 512), ("train_b", 256 * 256), ("test", 128 * 128)):
        held = {name: recipe[split][name] for name in SurfelBudget._fields}
        assert held == surfels_by_pixels(pixels)._asdict()
    assert not set(SurfelBudget._fields) & set(recipe)


def test_numbers_that_the_law_gives_are_the_same_recipe():
    budget = surfels_by_pixels(128 * 128)
    words = [f"{split}.{side}=128" for split in command.SPLITS for side in ("width", "height")]
    typed = composed(*words, *(f"{name}={value}" for name, value in budget._asdict().items()))
    assert typed.recipe() == composed(*words).recipe()


def test_a_dataset_of_another_law_is_refused(tmp_path, small_settings, monkeypatch):
    words = ["surfels=auto", "train_b.scenes=0", "test.scenes=0"]
    adopt(small_settings(tmp_path, *words))
    adopt(small_settings(tmp_path, *words))
    monkeypatch.setattr(command, "surfels_by_pixels", lambda pixels: surfels_by_pixels(16 * 128 * 128))
    now = surfels_by_pixels(16 * 128 * 128).surfels
    with pytest.raises(TronError, match=rf"train\.surfels=20000, not {now}"):
        adopt(small_settings(tmp_path, *words))


def test_a_dataset_of_other_surfels_or_another_fit_is_refused_by_name(tmp_path, small_settings):
    adopt(small_settings(tmp_path))
    with pytest.raises(TronError, match=r"train\.surfels=1500, not 1600"):
        adopt(small_settings(tmp_path, "surfels=1600"))
    config = tmp_path / planning.CONFIG_NAME
    held = yaml.safe_load(config.read_text())
    del held["recipe"]["fit"]
    config.write_text(yaml.safe_dump(held))
    with pytest.raises(TronError, match=r"made with fit=None, not"):
        adopt(small_settings(tmp_path))


@pytest.mark.parametrize("side", [128, 512, 1024])
def test_what_is_foretold_is_of_the_numbers_that_the_law_gives(side: int):
    law = surfels_by_pixels(side * side)._asdict()
    auto, typed = sized(side), sized(side, *(f"{name}={value}" for name, value in law.items()))
    item = plan(auto)[0]
    assert SOURCE.cost(item, auto) == SOURCE.cost(item, typed)
    assert SOURCE.scratch_bytes(item, auto) == SOURCE.scratch_bytes(item, typed)
    assert SOURCE.kept_bytes(auto, [item]) == SOURCE.kept_bytes(typed, [item])
    assert SOURCE.surfels(item, auto) == law["surfels"]


def test_the_setting_and_the_guide_say_the_numbers_of_the_law():
    guide = Path("docs/guides/worlds.md").read_text("utf-8")
    for says in (Settings.model_fields["surfels"].description, guide):
        for side in (128, 512):
            count, _, width, height, steps = surfels_by_pixels(side * side)
            assert re.search(rf"{count:,} from (32 views of )?{width} x {height} in {steps}\b", says or "")
