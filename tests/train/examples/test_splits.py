"""Splits that come from another dataset, through the command."""

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from pydantic import ValidationError
from safetensors.torch import load_file

from train.cli import main
from train.examples.splits import Splits, manifest_hash
from train.settings import Settings
from tron.errors import TronError
from tron.shards.manifest import Manifest


@pytest.fixture(scope="module")
def captures(make_dataset, tmp_path_factory) -> Path:
    """Photographs, larger and not square, under another name."""
    return make_dataset(
        tmp_path_factory.mktemp("captures"), {"photos": 3}, size=32, width=48, spaces={"rgb": "display"}
    )


def test_the_command_trains_on_two_datasets(
    make_settings, dataset, captures, tmp_path, caplog: pytest.LogCaptureFixture
):
    stages = [
        {"name": "one", "split": "train", "steps": 2, "batch_size": 2, "crop": 16},
        {"name": "two", "split": "train_b", "frames": 5, "steps": 2, "batch_size": 2, "size": [24, 16]},
    ]

    def train(**splits: str) -> None:
        changes = {"splits": splits, "stages": stages, "validation": {"split": None}}
        main(Settings.model_validate(make_settings(dataset, tmp_path / "run", **changes)))

    with caplog.at_level("INFO"):
        train(train_b=f"{captures}#photos")
    assert "split 'train_b' (photographs)" in caplog.text
    assert "stands in" not in caplog.text
    kept = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert kept["splits"] == {"train_b": f"{captures}#photos"}
    assert kept["splits_sha256"] == {"train_b": f"{manifest_hash(captures)}#photos"}
    assert kept["dataset_sha256"] == manifest_hash(dataset)
    with pytest.raises(TronError, match=r"a run made with another splits\.train_b \(sha256") as other:
        train()
    assert "\n" not in str(other.value)


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
    with pytest.raises(TronError, match=r"another splits\.train_b"):
        train()


def test_wrong_splits_are_found_before_anything_is_read(make_settings, dataset, tmp_path):
    places = ("#photos", "folder#", "folder#train+", "folder#train+train")
    wrong = [({"train_b": place}, "neither FOLDER nor FOLDER#SPLIT") for place in places]
    wrong += [({"train_b": f"folder#{name}"}, "kept for evaluation") for name in ("test", "train+test_relit")]
    for splits, message in [*wrong, ({"train_c": "folder"}, "which neither a stage nor validation reads")]:
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
