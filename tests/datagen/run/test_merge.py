"""Merged parts are the bytes of one run, without a copy, and nothing else can be merged."""

import os
import shutil
from pathlib import Path

import pytest

import datagen.run.merge
from datagen.dataset.records import WORK
from datagen.run.dataset import make
from datagen.run.merge import merge
from datagen.run.validate import validate
from tron.errors import TronError

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.long]


@pytest.fixture(scope="module")
def parts(variant, small_settings, tmp_path_factory) -> list[Path]:
    """Three parts of the small dataset."""
    folder = tmp_path_factory.mktemp("parts")
    for number in (1, 2, 3):
        assert make(small_settings(folder / str(number), f"shard={number}/3")) == 0
    return [folder / str(number) for number in (1, 2, 3)]


def merging(small_settings, output: Path, parts: list[Path], *more: str):
    named = ",".join(map(str, parts))
    return small_settings(output, "mode=merge", f"merge=[{named}]", *more)


def test_three_parts_are_the_bytes_of_one_run_and_share_their_disk_space(
    parts, small_settings, small_dataset, files_of, tmp_path
):
    output = tmp_path / "out"
    assert merge(merging(small_settings, output, parts)) == 0
    assert files_of(output) == files_of(small_dataset)
    assert validate(output) == 0
    shards = list(output.glob("*.tar"))
    assert shards
    assert all(path.stat().st_nlink >= 2 for path in (*shards, *output.glob("scenes/*/record.json")))


def test_what_an_unfinished_scene_goes_on_from_is_not_shared(
    parts, small_settings, small_dataset, files_of, tmp_path
):
    """Through a link a run that goes on in a part would write into the merged folder."""
    first = tmp_path / "first"
    shutil.copytree(parts[0], first)
    left = next(first.glob("scenes/*")) / WORK / "checkpoint.safetensors"
    left.parent.mkdir()
    left.write_bytes(b"half a reconstruction")
    assert merge(merging(small_settings, tmp_path / "out", [first, *parts[1:]])) == 0
    assert files_of(tmp_path / "out") == files_of(small_dataset)


def test_a_merge_that_was_cut_short_goes_on(
    parts, small_settings, small_dataset, files_of, tmp_path, monkeypatch
):
    output, calls = tmp_path / "out", []

    def dies(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 9:
            raise KeyboardInterrupt
        real(source, target)

    real = os.link
    monkeypatch.setattr(os, "link", dies)
    with pytest.raises(KeyboardInterrupt):
        merge(merging(small_settings, output, parts))
    assert not (output / "manifest.json").exists()
    monkeypatch.setattr(os, "link", real)
    assert merge(merging(small_settings, output, parts)) == 0
    assert files_of(output) == files_of(small_dataset)


def test_other_file_systems_are_copied_from_and_that_is_said(
    parts, small_settings, small_dataset, files_of, tmp_path, monkeypatch, caplog
):
    def elsewhere(source: Path, target: Path) -> None:
        raise OSError(datagen.run.merge.errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", elsewhere)
    output = tmp_path / "out"
    assert merge(merging(small_settings, output, parts)) == 0
    assert files_of(output) == files_of(small_dataset)
    assert "were copied" in caplog.text


def test_what_is_no_part_is_refused_before_anything_is_written(parts, small_settings, tmp_path):
    output = tmp_path / "out"
    other = tmp_path / "other"
    shutil.copytree(parts[2], other)
    text = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(text.replace("seed: 5", "seed: 6"))
    for given, more, message in (
        ([], [], "no parts"),
        ([tmp_path / "nothing"], [], "no config.yaml"),
        (parts[:2], [], "scenes are in none of the parts: test"),
        ([*parts, parts[0]], [], "in use by another run"),
        ([*parts[:2], other], [], "seed=6, not 5"),
        (parts, ["train.scenes=3"], "scenes.train="),
    ):
        shown = message if given != parts[:2] else "scenes are in none of the parts"
        with pytest.raises(TronError, match=shown):
            merge(merging(small_settings, output, given, *more))
        assert not (output / "config.yaml").exists()
    twin = tmp_path / "twin"
    shutil.copytree(parts[0], twin)
    with pytest.raises(TronError, match="is in two parts"):
        merge(merging(small_settings, output, [*parts, twin]))


def test_an_incomplete_merge_is_made_where_it_is_asked_for(parts, small_settings, tmp_path):
    output = tmp_path / "out"
    assert merge(merging(small_settings, output, parts[:2], "merge_incomplete=true")) == 0
    assert validate(output) == 0
    assert merge(merging(small_settings, output, parts)) == 0, "the rest is added later"


def test_failures_of_parts_are_those_of_the_whole(small_settings, files_of, tmp_path, monkeypatch):
    def breaks(item, *_):
        raise ValueError(f"no scene {item.index}")

    monkeypatch.setattr("datagen.sources.synthetic.make_scene", breaks)
    output = tmp_path / "out"
    assert make(small_settings(output)) == 4
    whole = files_of(output)
    shutil.rmtree(output)
    folders = [tmp_path / str(number) for number in (1, 2)]
    for number, folder in enumerate(folders, start=1):
        assert make(small_settings(folder, f"shard={number}/2")) == 2
    assert merge(merging(small_settings, output, folders)) == 4
    assert files_of(output) == whole
