"""Splits that come from another dataset, through the command."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from pydantic import ValidationError
from safetensors.torch import load_file

from train.cli import main
from train.settings import Settings
from train.splits import Splits, manifest_hash
from tron.errors import TronError
from tron.shards.manifest import Manifest


@pytest.fixture(scope="module")
def captures(make_dataset, tmp_path_factory) -> Path:
    """Photographs, larger and not square, under another name."""
    return make_dataset(
        tmp_path_factory.mktemp("captures"), {"photos": 3}, size=32, width=48, spaces={"rgb": "display"}
    )


def run(make_settings, folder: Path, *words: str, **changes) -> subprocess.CompletedProcess[str]:
    recipes = folder / "recipes" / "experiment"
    recipes.mkdir(parents=True, exist_ok=True)
    settings = make_settings(None, str(folder / "run"), **changes)
    del settings["dataset"]
    (recipes / "two.yaml").write_text("# @package _global_\n" + yaml.safe_dump(settings))
    command = [str(Path(sys.executable).with_name("tron-train")), "--config-dir", str(folder / "recipes")]
    return subprocess.run(
        [*command, "experiment=two", *words], capture_output=True, text=True, check=False, timeout=240
    )


def test_the_command_trains_on_two_datasets(make_settings, dataset, captures, tmp_path):
    stages = [
        {"name": "one", "split": "train", "steps": 2, "batch_size": 2, "crop": 16},
        {"name": "two", "split": "train_b", "frames": 5, "steps": 2, "batch_size": 2, "size": [24, 16]},
    ]
    words = (f"dataset={dataset}", f"splits={{train_b: '{captures}#photos'}}")
    done = run(make_settings, tmp_path, *words, stages=stages, validation={"split": None})
    assert done.returncode == 0, done.stderr
    assert "split 'train_b' (photographs)" in done.stderr
    assert "stands in" not in done.stderr
    kept = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert kept["splits"] == {"train_b": f"{captures}#photos"}
    assert kept["splits_sha256"] == {"train_b": f"{manifest_hash(captures)}#photos"}
    assert kept["dataset_sha256"] == manifest_hash(dataset)
    other = run(make_settings, tmp_path, f"dataset={dataset}", stages=stages, validation={"split": None})
    assert other.returncode == 2
    assert "a run made with splits_sha256" in other.stderr
    assert len(other.stderr.splitlines()) == 1


def test_a_dataset_in_two_folders_trains_what_it_does_in_one(make_settings, dataset, make_dataset, tmp_path):
    copy = make_dataset(tmp_path / "copy", {"train_b": 3})
    outputs = []
    for name, splits in (("one", {}), ("two", {"train_b": str(copy)})):
        settings = make_settings(dataset, tmp_path / name, splits=splits, validation={"split": None})
        main(Settings.model_validate(settings))
        outputs.append(load_file(tmp_path / name / "renderer.safetensors"))
    assert all(torch.equal(outputs[0][key], outputs[1][key]) for key in outputs[0])


def test_a_moved_dataset_is_the_same_by_its_hash(make_settings, dataset, make_dataset, tmp_path):
    copy = make_dataset(tmp_path / "copy", {"train_b": 3})

    def train() -> None:
        changes = {"splits": {"train_b": str(copy)}, "validation": {"split": None}}
        main(Settings.model_validate(make_settings(dataset, tmp_path / "run", **changes)))

    train()
    copy = copy.rename(tmp_path / "moved")
    train()
    make_dataset(copy, {"train_b": 2})
    with pytest.raises(TronError, match=r"splits_sha256\.train_b"):
        train()


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"train_b": "#photos"}, "neither FOLDER nor FOLDER#SPLIT"),
        ({"train_b": "folder#"}, "neither FOLDER nor FOLDER#SPLIT"),
        ({"train_b": "folder#test"}, "kept for evaluation"),
        ({"train_b": "folder#train+test_relit"}, "kept for evaluation"),
        ({"train_b": "folder#train+"}, "neither FOLDER nor FOLDER#SPLIT"),
        ({"train_b": "folder#train+train"}, "neither FOLDER nor FOLDER#SPLIT"),
        ({"train_c": "folder"}, "which neither a stage nor validation reads"),
    ],
)
def test_wrong_splits_are_found_before_anything_is_read(make_settings, dataset, tmp_path, splits, message):
    with pytest.raises(ValidationError, match=message):
        Settings.model_validate(make_settings(dataset, tmp_path, splits=splits))


def test_two_splits_of_a_folder_are_one_after_the_other(make_dataset, dataset, tmp_path):
    captures = make_dataset(tmp_path / "captures", {"photos": 3, "relit": 2})
    splits = Splits(dataset, {"train_b": f"{captures}#photos+relit", "relit": str(captures)})
    both, relit = splits.clips("train_b"), splits.clips("relit")
    assert len(both) == 5
    assert [both.key(k) for k in (3, 4)] == [relit.key(k) for k in (0, 1)]
    assert both.first_of_splits() == [0, 3]
    assert [both.split_of(k) for k in (2, 3)] == ["photos", "relit"]
    with pytest.raises(TronError, match=r"no split 'absent' .*it has: photos, relit"):
        Splits(dataset, {"train_b": f"{captures}#photos+absent"})


def test_every_joined_split_is_checked_before_the_first_step(make_settings, dataset, make_dataset, tmp_path):
    captures = make_dataset(tmp_path / "captures", {"long": 2}, frames=5)
    make_dataset(tmp_path / "more", {"short": 2}, frames=1)
    manifest = Manifest.load(captures)
    for path in (tmp_path / "more").glob("short-*"):
        shutil.copy(path, captures)
    shards = [*manifest.shards, *Manifest.load(tmp_path / "more").shards]
    (captures / "manifest.json").write_text(manifest.model_copy(update={"shards": shards}).model_dump_json())
    stage = {"name": "one", "split": "train_b", "frames": 5, "steps": 2, "batch_size": 2, "crop": 16}
    changes = {"stages": [stage], "validation": {"split": None}}
    joined = {"splits": {"train_b": f"{captures}#long+short"}}
    with pytest.raises(TronError, match="needs clips of 5 frames, split 'train_b' has 1"):
        main(Settings.model_validate(make_settings(dataset, tmp_path / "run", **changes, **joined)))


def test_names_of_stages_and_validation_are_not_joined(make_settings, dataset, tmp_path):
    settings = make_settings(dataset, tmp_path / "run", validation={"split": "train+test"})
    with pytest.raises(TronError, match=r"no split 'train\+test'"):
        main(Settings.model_validate(settings))


def test_folders_that_have_not_the_split_are_named(dataset, captures, tmp_path):
    with pytest.raises(TronError, match=rf"no split 'train_b' \({captures}\): it has: photos"):
        Splits(dataset, {"train_b": str(captures)})
    with pytest.raises(TronError, match="no dataset folder"):
        Splits(dataset, {"train_b": str(tmp_path / "nothing")})


def test_a_url_is_kept_as_it_was_typed(make_settings, tmp_path):
    settings = Settings.model_validate(make_settings("s3://bucket/data", tmp_path))
    assert settings.dataset == "s3://bucket/data"
    assert Settings.model_validate(make_settings("data", tmp_path)).dataset == Path("data")
