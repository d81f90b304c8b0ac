"""mode=plan renders and writes nothing of a dataset, and foretells what it takes."""

import shutil
from pathlib import Path

import pytest

from datagen.cli import cli, main
from datagen.run.clusters import worker_count
from datagen.run.cost import project, time_limit
from datagen.run.plan import plan
from datagen.settings.command import Settings
from datagen.sources import SOURCES
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError

SOURCE = SOURCES["synthetic"]


def cells(text: str, split: str) -> list[str]:
    line = next(line for line in text.splitlines() if line.startswith(f"{split} "))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def files_of_split(dataset: Path, split: str) -> list[Path]:
    patterns = (f"{split}-[0-9]*.tar", f"scenes/{split}-[0-9]*/*.*", f"previews/{split}-[0-9]*-l*")
    return [path for pattern in patterns for path in dataset.glob(pattern)]


def test_the_table_foretells_a_dataset_and_renders_nothing(
    small_settings, small_dataset: Path, tmp_path: Path, capsys, monkeypatch
):
    """Against the dataset of the same recipe: bytes; seconds are no test's to judge."""
    monkeypatch.setattr("mitsuba.render", None)
    assert main(small_settings(tmp_path / "not there", "mode=plan")) == 0
    text = capsys.readouterr().out
    assert not (tmp_path / "not there").exists()
    assert "4 of 4: train-000000, train-000001, train_b-000000, test-000000" in text
    for split, scenes, clips in (("train", 2, 4), ("train_b", 1, 1), ("test", 1, 2)):
        row = cells(text, split)
        assert row[1:6] == [str(scenes), str(scenes), str(clips), str(3 * clips), "32 x 24"]
        true = sum(path.stat().st_size for path in files_of_split(small_dataset, split))
        assert 0.5 < float(row[6]) * 1e9 / true < 2


@pytest.mark.parametrize(
    ("more", "at_least"),
    [
        ("train.path_spp=400", 10.0),
        ("train.frames=8", 0.1),
        ("refine_steps=1000", 5.0),
        ("train.width=320", 0.1),
    ],
)
def test_what_costs_more_is_said_to(small_settings, tmp_path: Path, more: str, at_least: float):
    larger = ("train.width=96", "train.height=96")
    settings = [small_settings(tmp_path, *larger, *each) for each in ([], [more])]
    few, many = (SOURCE.cost(plan(each)[0], each) for each in settings)
    assert many.seconds > few.seconds + at_least
    assert many.memory >= few.memory


def test_the_papers_scene_costs_what_was_projected_from_small_ones():
    """93 core hours and 12.2 GB, carried on from renders of 24 and 96 pixels (docs/paper/reproduction.md)."""
    recipe = compose_recipe("conf.datagen", Settings, ["experiment=paper", "output_dir=none"])
    settings = check(recipe, Settings)
    cost = SOURCE.cost(plan(settings)[0], settings)
    assert 0.5 < cost.seconds / 3600 / 93 < 2
    assert 0.5 < cost.bytes / 12.2e9 < 2
    assert 0.5 < cost.memory / 6.9e9 < 2


def test_a_finished_dataset_is_missing_nothing(small_settings, small_dataset: Path):
    text = project(small_settings(small_dataset))
    assert "scenes to make  0 of 4" in text
    assert "none: nothing is missing" in text


def test_what_is_in_the_store_is_not_missing(small_settings, small_dataset: Path, tmp_path: Path):
    there, store = tmp_path / "out", tmp_path / "store"
    shutil.copytree(small_dataset, there)
    store.mkdir()
    for path in there.glob("*.tar"):
        path.rename(store / path.name)
    assert "scenes to make  0 of 4" in project(small_settings(there, f"store=file://{store}"))


def test_a_plan_is_refused_where_the_dataset_would_be(small_settings, small_dataset: Path, tmp_path: Path):
    with pytest.raises(TronError, match=r"made with test\.path_spp=4, not 5"):
        project(small_settings(small_dataset, "test.path_spp=5"))
    with pytest.raises(TronError, match="no such scene"):
        project(small_settings(tmp_path, "only=[train-000099]"))


def test_a_dataset_that_cannot_be_drawn_beside_is_refused_by_the_plan_too(small_settings, tmp_path: Path):
    with pytest.raises(TronError, match="manifest"):
        project(small_settings(tmp_path / "new", f"variety_against={tmp_path}"))


def test_workers_are_those_of_the_cluster(small_settings, tmp_path: Path):
    assert worker_count(small_settings(tmp_path), 9) == (1, ", this process")
    assert worker_count(small_settings(tmp_path, "cluster=local", "workers=5"), 3) == (3, "")
    elsewhere = small_settings(tmp_path).model_copy(
        update={"cluster": {"_target_": "dask.distributed.Client"}}
    )
    assert worker_count(elsewhere, 9)[1].startswith("; the cluster has its own number")


def test_a_scene_may_take_twenty_times_its_cost(small_settings, tmp_path: Path):
    settings = small_settings(tmp_path)
    assert time_limit(plan(settings)[0], settings) == 600.0
    dear = small_settings(tmp_path, "train.path_spp=10000000")
    assert time_limit(plan(dear)[0], dear) == 20 * SOURCE.cost(plan(dear)[0], dear).seconds > 600
    assert time_limit(plan(dear)[0], small_settings(tmp_path, "scene_timeout=7")) == 7.0
    assert time_limit(plan(dear)[0], small_settings(tmp_path, "mode=captures")) == 86_400.0


def test_help_teaches_the_plan(capsys):
    with pytest.raises(SystemExit):
        cli(["--help", "all"])
    text = capsys.readouterr().out
    assert "mode=plan" in text
    assert "variety_against" in text
