"""A folder for the Hub, read offline by the libraries that read there: datasets, mlcroissant, webdataset."""

import json
import os
import subprocess
import sys
from pathlib import Path

import mlcroissant
import numpy as np
import pandas as pd
import pytest
import webdataset
import yaml

from datagen.cli import main
from datagen.run.publish import CROISSANT_NAME
from datagen.settings.command import Settings
from tron.errors import TronError
from tron.io.images import decode_exr
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

READ = Path(__file__).parents[1] / "dataset" / "read_by_datasets.py"


@pytest.fixture(scope="module")
def hub(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("published") / "hub"
    asked = {"output_dir": small_dataset, "mode": "publish", "publish": folder}
    assert main(Settings(**asked, licence="cc-by-4.0")) == 0
    return folder


def test_only_what_others_need_is_there_and_shards_are_not_copied(hub: Path, small_dataset: Path):
    names = {path.name for path in hub.iterdir()}
    shards = {entry.name for entry in Manifest.load(small_dataset).shards}
    assert {"README.md", "metadata.parquet", "index.html", "manifest.json", CROISSANT_NAME} | shards <= names
    assert not names & {"scenes", "logs", "config.yaml", "work"}
    shard = sorted(shards)[0]
    assert (hub / shard).samefile(small_dataset / shard) or os.stat(hub).st_dev != os.stat(
        small_dataset
    ).st_dev
    described = yaml.safe_load((hub / "README.md").read_text().split("---\n")[1])
    assert described["license"] == "cc-by-4.0"
    table = pd.read_parquet(hub / "metadata.parquet")
    assert all((hub / name).is_file() for name in table["thumbnail"])


def test_mlcroissant_finds_no_fault_and_reads_a_record_a_clip(hub: Path):
    dataset = mlcroissant.Dataset(jsonld=hub / CROISSANT_NAME)
    issues = dataset.metadata.ctx.issues
    assert not issues.errors
    table = pd.read_parquet(hub / "metadata.parquet")
    records = list(dataset.records("clips"))
    assert len(records) == len(table)
    found = {record["clips/key"].decode(): record for record in records}
    for _, row in table.iterrows():
        assert found[row["key"]]["clips/exposure"] == pytest.approx(row["exposure"])
        assert found[row["key"]]["clips/frames"] == row["frames"]


def test_mlcroissant_reads_the_pictures_in_the_tars(hub: Path):
    dataset = mlcroissant.Dataset(jsonld=hub / CROISSANT_NAME)
    named = {record["rgb_frames/filename"].decode(): record["rgb_frames/content"]
             for record in dataset.records("rgb_frames")}  # fmt: skip
    splits = {entry.split for entry in Manifest.load(hub).shards}
    clips = [clip for split in sorted(splits) for clip in read_clips(hub, split)]
    assert len(named) == sum(clip.meta.frames for clip in clips) > 0
    for clip in clips:
        found = decode_exr(named[f"{clip.meta.key}.f00.rgb.exr"])
        np.testing.assert_array_equal(found, clip.frames["rgb"][0])


def test_hashes_of_croissant_are_those_of_the_files(hub: Path):
    content = json.loads((hub / CROISSANT_NAME).read_text())
    for entry in [each for each in content["distribution"] if each["@type"] == "cr:FileObject"]:
        said = subprocess.run(
            ["sha256sum", hub / entry["contentUrl"]], capture_output=True, text=True, check=True
        )
        assert said.stdout.split()[0] == entry["sha256"]


def test_datasets_reads_it(hub: Path, tmp_path: Path):
    manifest = Manifest.load(hub)
    shards = ",".join(str(hub / entry.name) for entry in manifest.of_split("train"))
    done = subprocess.run(
        [sys.executable, str(READ), str(hub), shards, str(tmp_path / "cache")],
        env={"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    keys = [key for entry in manifest.of_split("train") for key in entry.keys]
    assert json.loads(done.stdout)["plain"] == keys


def test_webdataset_reads_it(hub: Path):
    clip = next(read_clips(hub, "train"))
    shard = hub / Manifest.load(hub).of_split("train")[0].name
    sample = next(iter(webdataset.WebDataset(str(shard), shardshuffle=False)))
    assert sample["__key__"] == clip.meta.key
    np.testing.assert_array_equal(decode_exr(sample["f01.rgb.exr"]), clip.frames["rgb"][1])


@pytest.mark.parametrize("changes, words", [
    ({"licence": None}, "has no licence"),
    ({"publish": None}, "no folder to make"),
    ({"output_dir": "absent"}, "no manifest.json"),
])  # fmt: skip
def test_what_cannot_be_published_is_one_line_and_leaves_nothing(small_dataset, tmp_path, changes, words):
    asked = {"output_dir": small_dataset, "mode": "publish", "publish": tmp_path / "hub", "licence": "mit"}
    if "output_dir" in changes:
        changes = {"output_dir": tmp_path / "absent"}
    with pytest.raises(TronError, match=words):
        main(Settings(**(asked | changes)))
    assert not (tmp_path / "hub").exists()
