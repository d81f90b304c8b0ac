"""The Hub's own libraries read a dataset's folder, offline: datasets, huggingface_hub, pandas."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from datagen.dataset.pages import COLUMNS, configurations, licence_names, size_category
from datagen.dataset.records import ClipRow
from tron.io.images import decode_exr
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import MEMBERS, clip_members

READ = Path(__file__).with_name("read_by_datasets.py")


@pytest.fixture(scope="module")
def read(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What `datasets` says of the folder, in a process of its own that may not reach the network."""
    home = tmp_path_factory.mktemp("hub")
    shards = [str(small_dataset / entry.name) for entry in Manifest.load(small_dataset).of_split("train")]
    command = [sys.executable, str(READ), str(small_dataset), ",".join(shards), str(home / "cache")]
    done = subprocess.run(
        command,
        env={"HF_HUB_OFFLINE": "1", "HF_HOME": str(home), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_datasets_reads_every_clip_of_every_split(read: dict, small_dataset: Path):
    manifest = Manifest.load(small_dataset)
    keys = {split: [key for e in manifest.of_split(split) for key in e.keys] for split in manifest.splits()}
    assert read["plain"] == read["streamed"] == keys["train"]
    assert read["default"] == {split: keys[split] for split in ("train", "train_b")}
    for columns, reference in zip(read["columns"], (False, True)):
        files = {
            f"f{frame:02d}.{name}.{MEMBERS[name].extension}"
            for frame in range(3)
            for name in clip_members(reference)
        }
        assert set(columns) == {*files, "meta.json", "__key__", "__url__"}


def test_what_datasets_gives_are_the_frames_and_the_whole_metadata(read: dict, small_dataset: Path):
    clip = next(read_clips(small_dataset, "train"))
    np.testing.assert_array_equal(decode_exr(bytes.fromhex(read["exr"])), clip.frames["rgb"][1])
    assert read["meta"] == json.loads(clip.meta.model_dump_json())
    # a family's own numbers are all there, although the next clip's light has other ones
    families = [json.loads(text) for text in read["lights"]]
    assert [light["family"] for light in families] == ["sun", "overcast"] * 2
    assert all(len(light) > 3 for light in families)


def test_pandas_reads_a_row_a_clip(small_dataset: Path):
    table = pd.read_parquet(small_dataset / "metadata.parquet")
    assert list(table.columns) == COLUMNS.names == list(ClipRow.model_fields)
    manifest = Manifest.load(small_dataset)
    assert sorted(table["key"]) == sorted(key for entry in manifest.shards for key in entry.keys)
    for split in manifest.splits():
        for clip in read_clips(small_dataset, split, ["mask"]):
            row = table[table["key"] == clip.meta.key].iloc[0]
            assert row["exposure"] == clip.meta.exposure
            assert (row["frames"], row["width"], row["height"]) == (3, 32, 24)
            assert (row["scene"], row["light_family"]) == (clip.meta.scene, clip.meta.light_family)
            assert row["contrast"] == clip.meta.extra["contrast"]
            assert 0 < row["contrast_share"] <= 1
            assert (small_dataset / row["thumbnail"]).is_file()
            assert clip.meta.key in next(e.keys for e in manifest.shards if e.name == row["shard"])


def test_the_front_matter_of_the_card(small_dataset: Path):
    data = yaml.safe_load((small_dataset / "README.md").read_text().split("---\n")[1])
    assert data["license"] == "unknown", "nobody's files are in it, and its maker has not said"
    assert data["size_categories"] == ["n<1K"]
    assert data["task_categories"] == ["image-to-image"]
    assert [each["config_name"] for each in data["configs"]] == ["default", "test"]


def test_splits_of_other_frames_are_another_configuration(small_settings, tmp_path: Path):
    settings = small_settings(tmp_path, "train_b.frames=2")
    found = configurations(settings, {"train": 4, "train_b": 1, "test": 2})
    assert [each["config_name"] for each in found] == ["default", "train_b", "test"]
    assert configurations(settings, {"test": 2})[0]["config_name"] == "default"


def test_licences_have_the_names_of_the_hub():
    assert licence_names(["CC BY 4.0", "cc-by-4.0"]) == "cc-by-4.0"
    assert licence_names(["CC0-1.0", "public domain", None]) == ["cc0-1.0", "other"]
    assert licence_names(["CC0", "cc0-1.0"]) == "cc0-1.0"
    assert licence_names([]) == "unknown"


def test_sizes_have_the_words_of_the_hub():
    assert [size_category(n) for n in (0, 999, 1000, 999_999, 10**9)] == [
        *("n<1K", "n<1K", "1K<n<10K", "100K<n<1M", "n>1B")
    ]
