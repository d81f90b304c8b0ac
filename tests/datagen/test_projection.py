"""mode=plan renders and writes nothing of a dataset, and foretells what it takes."""

import json
import os
import shutil
import signal
from pathlib import Path

import pytest

from datagen.cli import cli, main
from datagen.clusters import worker_count
from datagen.projection import project, read_times, scene_bytes
from tron.errors import TronError


def cells(text: str, split: str) -> list[str]:
    line = next(line for line in text.splitlines() if line.startswith(f"{split} "))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


@pytest.mark.long
def test_a_probe_foretells_bytes_and_seconds(small_settings, small_dataset: Path, tmp_path: Path, capsys):
    """Against the dataset of the same recipe; seconds are of a busy machine's processor, and only near."""
    settings = small_settings(tmp_path / "not there", "mode=plan")
    assert main(settings) == 0
    text = capsys.readouterr().out
    assert not (tmp_path / "not there").exists()
    assert "4 of 4: train-000000, train-000001, train_b-000000, test-000000" in text
    for split, scenes, clips in (("train", 2, 4), ("train_b", 1, 1), ("test", 1, 2)):
        row = cells(text, split)
        assert row[1:6] == [str(scenes), str(scenes), str(clips), str(3 * clips), "32 x 24"]
        names = [f"{split}-{k:06d}" for k in range(scenes)]
        true = sum(scene_bytes(small_dataset, name) for name in names)
        assert float(row[6]) * 1e9 == pytest.approx(true, rel=0.35)
        assert float(row[7]) > 0
        assert row[8] == f"probe: {split}-000000, {len(settings.split(split).lights)} lights, 32 x 24"


def test_scenes_that_are_there_stand_for_those_that_are_not(
    small_settings, small_dataset: Path, tmp_path: Path
):
    copy = tmp_path / "dataset"
    shutil.copytree(small_dataset, copy)
    lines = [
        {"scene": f"train-{k:06d}", "made": True, "seconds": {"path": 1800.0, "rest": 1800.0}} for k in (0, 1)
    ]
    (copy / "logs").mkdir(exist_ok=True)
    (copy / "logs" / "times.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n{half a li")
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    text = project(small_settings(copy, "train.scenes=12", "workers=4", "cluster=local"))
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before
    row = cells(text, "train")
    assert row[1:5] == ["12", "10", "20", "60"]
    assert float(row[7]) == pytest.approx(10.0), "an hour a scene"
    true = sum(scene_bytes(copy, f"train-{k:06d}") for k in (0, 1)) / 2
    assert float(row[6]) * 1e9 == pytest.approx(10 * true, rel=0.01)
    assert row[8] == "2 scenes made here"
    assert cells(text, "test")[2:5] == ["0", "0", "0"]
    assert "wall hours      2.5 with 4 workers" in text
    assert ": train-000002, train-000003, train-000004, train-000005, ... train-000011" in text


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


def test_sigterm_unwinds_a_probe_so_that_its_folder_goes_away(small_settings, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("datagen.projection.probe", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        with pytest.raises(SystemExit) as ended:
            project(small_settings(tmp_path / "new"))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended.value.code == 143


def test_workers_are_those_of_the_cluster(small_settings, tmp_path: Path):
    assert worker_count(small_settings(tmp_path), 9) == (1, ", this process")
    assert worker_count(small_settings(tmp_path, "cluster=local", "workers=5"), 3) == (3, "")
    elsewhere = small_settings(tmp_path).model_copy(
        update={"cluster": {"_target_": "dask.distributed.Client"}}
    )
    assert worker_count(elsewhere, 9)[1].startswith("; the cluster has its own number")


def test_only_scenes_that_were_made_have_seconds(tmp_path: Path):
    path = tmp_path / "times.jsonl"
    assert read_times(path) == {}
    lines = [
        {"scene": "a", "made": True, "seconds": {"x": 1, "y": 2}},
        {"scene": "b", "made": False, "seconds": {"x": 1}},
        {"scene": "a", "made": True, "seconds": {"x": 5}},
        {"scene": "a", "mode": "captures", "made": True, "seconds": {"x": 7}},
        {"scene": "c", "mode": "make", "made": True, "seconds": {"x": 8}},
        ["no line of ours"],
    ]
    path.write_text("\n".join(map(json.dumps, lines)))
    assert read_times(path) == {"a": 5, "c": 8}


def test_help_teaches_the_plan(capsys):
    with pytest.raises(SystemExit):
        cli(["--help"])
    text = capsys.readouterr().out
    assert "mode=plan" in text
    assert "variety_against" in text
