"""Parts of a dataset: disjoint, complete, and each a folder that knows which one it is."""

from pathlib import Path

import pytest
import yaml

from datagen.run.account import ACCOUNT
from datagen.run.dataset import make
from datagen.run.plan import adopt, config_sha256, plan
from datagen.settings.command import part_of
from tron.errors import TronError


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_parts_are_disjoint_and_together_the_plan(small_settings, tmp_path, count):
    items = plan(small_settings(tmp_path))
    parts = [part_of(items, f"{number}/{count}") for number in range(1, count + 1)]
    assert sorted((item for part in parts for item in part), key=items.index) == items
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("shard", ["0/3", "4/3", "1", "1/0", "a/b", "-1/3", "1/3/5", " 1/3", "1/3\n"])
def test_a_part_that_there_is_not_is_refused(small_settings, tmp_path, shard):
    with pytest.raises(TronError, match="shard"):
        small_settings(tmp_path, f"shard='{shard}'")


def test_more_parts_than_scenes_are_refused_before_anything_is_written(small_settings, tmp_path):
    with pytest.raises(TronError, match="more parts than there are scenes, 4"):
        make(small_settings(tmp_path / "out", "shard=1/5"))
    assert not (tmp_path / "out").exists()


def test_the_folder_of_a_part_says_so_and_takes_no_other(small_settings, tmp_path):
    adopt(small_settings(tmp_path, "shard=2/4"))
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["shard"] == "2/4"
    adopt(small_settings(tmp_path, "shard=2/4"))
    for other in (["shard=1/4"], [], ["shard=2/4", "train.scenes=3"]):
        with pytest.raises(TronError, match="output_dir holds part 2/4"):
            adopt(small_settings(tmp_path, *other))


def test_parts_have_the_hash_of_the_whole(small_settings, tmp_path):
    whole, part = small_settings(tmp_path), small_settings(tmp_path, "shard=1/2", "store=s3://a/b")
    assert config_sha256(whole) == config_sha256(part)


def test_files_of_the_whole_are_all_known_to_merges_and_stores(small_dataset: Path):
    """One that is not would be in two parts, and would never reach a store."""
    own = {path.name for path in small_dataset.iterdir() if path.is_file() and path.name[0] != "."}
    assert {name for name in own if not name.endswith((".tar", ".idx"))} <= set(ACCOUNT)
