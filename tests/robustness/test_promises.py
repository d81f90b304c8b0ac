"""Ten promises of the data engine (docs/guides/datasets.md), each held to both sources."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import psutil
import pytest

import datagen.dataset.spool
import datagen.run.dataset
import datagen.sources.captured
import datagen.sources.synthetic
from datagen.run.dataset import make
from datagen.run.validate import validate
from datagen.settings.command import Settings
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.io.images import read_image
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips, verify
from tron.storage import locked

pytestmark = pytest.mark.usefixtures("variant")

SCRIPT = Path(sys.executable).with_name("tron-datagen")


@dataclass(frozen=True)
class Source:
    """One of the two sources at its smallest.

    Attributes:
        words: overrides of tron-datagen for two scenes or captures, in this process.
        maker: module and name of what makes one.
        outside: a word that is refused, and what the line must name.
    """

    name: str
    words: Sequence[str]
    maker: tuple[ModuleType, str]
    outside: tuple[str, str]

    def settings(self, output: Path, *more: str) -> Settings:
        """Settings of a dataset in ``output``."""
        words = [*self.words, "cluster=none", f"output_dir={output}", *more]
        return check(compose_recipe("conf.datagen", Settings, words), Settings)


ONE_DATA_ENGINE = pytest.mark.parametrize(
    "source", ["synthetic", pytest.param("captured", marks=pytest.mark.long)], indirect=True
)
"""For what both sources leave to the same code: the second is asked in the long tests."""


@pytest.fixture(scope="module", params=["synthetic", "captured"])
def source(request: pytest.FixtureRequest, tiny_scenes: list[str]) -> Source:
    if request.param == "synthetic":
        maker = datagen.sources.synthetic, "make_scene"
        return Source("synthetic", tiny_scenes, maker, ("train.frames=94", "train.frames"))
    words = request.getfixturevalue("pair_words")
    maker = datagen.sources.captured, "make_capture"
    return Source("captured", words, maker, ("captured.frames=0", "captured.frames"))


@pytest.fixture(scope="module")
def dataset(source: Source, request: pytest.FixtureRequest) -> Path:
    """A whole dataset of the source; nobody writes into it."""
    return request.getfixturevalue("tiny_dataset" if source.name == "synthetic" else "tiny_pairs")


def names(dataset: Path) -> list[str]:
    """Names of a dataset's scenes."""
    return sorted(path.parent.name for path in dataset.glob("scenes/*/record.json"))


def ended(settings: Settings) -> str:
    """How a run ended: its failures and a full disk are no accidents."""
    try:
        return "failed" if make(settings) else "finished"
    except TronError as error:
        return f"refused: {error}"


def without(dataset: Path, copy: Path, name: str) -> Path:
    """A copy of a dataset in which one scene has never been made."""
    shutil.copytree(dataset, copy)
    record = json.loads((copy / "scenes" / name / "record.json").read_text())
    for entry in record["shards"]:
        (copy / entry["name"]).unlink()
    shutil.rmtree(copy / "scenes" / name)
    return copy


def test_1_deterministic_a_scene_depends_on_its_seed_and_number_alone(
    source: Source, dataset: Path, tmp_path: Path, files_of: Callable
) -> None:
    last = names(dataset)[-1]
    assert make(source.settings(tmp_path / "alone", f"only=[{last}]")) == 0
    whole, alone = files_of(dataset), files_of(tmp_path / "alone")
    own = [path for path in whole if path.startswith(f"scenes/{last}/")]
    own += [entry.name for entry in Manifest.load(tmp_path / "alone").shards]
    assert len(own) > 2
    assert {path: alone[path] for path in own} == {path: whole[path] for path in own}


def test_2_resumable_what_is_missing_is_made_again_and_nothing_else(
    source: Source, dataset: Path, tmp_path: Path, files_of: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = without(dataset, tmp_path / "broken", names(dataset)[0])
    (broken / ".train-00000.part.tar").write_bytes(b"half a shard")
    assert make(source.settings(broken)) == 0
    assert files_of(broken) == files_of(dataset)

    def never(*_: object) -> None:
        raise AssertionError("nothing is left to make")

    monkeypatch.setattr(*source.maker, never)
    before = {path: os.stat(broken / path).st_mtime_ns for path in files_of(broken)}
    assert make(source.settings(broken)) == 0
    assert {path: os.stat(broken / path).st_mtime_ns for path in files_of(broken)} == before


@pytest.mark.long
@pytest.mark.parametrize("source", ["synthetic"], indirect=True)
def test_2_resumable_after_sigkill_at_any_moment(
    source: Source, dataset: Path, tmp_path: Path, files_of: Callable
) -> None:
    """Captures are killed in each phase of theirs in tests/datagen/sources/test_captured.py."""
    output, killed = tmp_path / "killed", 0
    for attempt in range(5):
        with subprocess.Popen(
            [SCRIPT, *source.words, "cluster=none", f"output_dir={output}"], stderr=subprocess.DEVNULL
        ) as process:
            deadline = time.monotonic() + 90
            # Each attempt lives a little longer beyond the moment at which there is anything to lose.
            while not (output / "config.yaml").is_file() and process.poll() is None:
                assert time.monotonic() < deadline
                time.sleep(0.02)
            time.sleep(0.6 * attempt)
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
                killed += 1
    assert killed >= 2
    assert make(source.settings(output)) == 0
    assert files_of(output) == files_of(dataset)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Mounts a disk of so many bytes, or changes its size."""
    folder = tmp_path / "disk"

    def mount(size: int) -> Path:
        how = f"remount,size={size}" if folder.is_mount() else f"size={size}"
        folder.mkdir(exist_ok=True)
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", how, "tmpfs", folder], capture_output=True)
        if done.returncode:
            pytest.skip(f"no tmpfs can be mounted: {done.stderr.decode().strip()}")
        return folder

    yield mount
    if folder.is_mount():
        # Lazily: the traceback of a failed write may hold its file open until it is collected.
        subprocess.run(["umount", "--lazy", folder], check=True)


@ONE_DATA_ENGINE
def test_3_atomic_a_full_disk_leaves_nothing_half_written(
    source: Source,
    dataset: Path,
    small_disk: Callable[[int], Path],
    files_of: Callable,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    size = sum(len(data) for data in files_of(dataset).values())
    full = small_disk(size // 3)
    # What the check beforehand cannot know: others fill the disk while the scenes are made.
    monkeypatch.setattr(datagen.run.dataset, "require_free_space", lambda *_: None)
    assert ended(source.settings(full / "dataset")) != "finished"
    whole = files_of(dataset)
    for path, data in files_of(full / "dataset").items():
        if path in whole and path.endswith((".tar", ".ply", "record.json", "spec.json")):
            assert data == whole[path], f"{path} is not whole"
        assert not path.endswith((".part", ".part.tar")), path
    small_disk(40 * size)
    assert make(source.settings(full / "dataset")) == 0
    assert files_of(full / "dataset") == whole


def test_3_atomic_too_small_a_disk_and_a_read_only_one_are_told_before_the_first_scene(
    source: Source, small_disk: Callable[[int], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a scene is made")

    monkeypatch.setattr(*source.maker, never)
    disk = small_disk(100_000)
    with pytest.raises(TronError, match="not enough disk space"):
        make(source.settings(disk / "dataset"))
    assert not list(disk.rglob("*.tar"))
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    with pytest.raises(TronError, match="Read-only"):
        make(source.settings(disk / "other"))


@pytest.mark.parametrize("damage", ["cut", "flipped", "missing", "record"])
def test_4_accounted_for_validation_finds_what_is_damaged(
    dataset: Path, tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert validate(dataset) == 0
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    entry = Manifest.load(copy).shards[-1]
    shard = copy / entry.name
    data = shard.read_bytes()
    if damage == "cut":
        shard.write_bytes(data[:-2048])
    elif damage == "flipped":
        middle = len(data) // 2
        shard.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    elif damage == "missing":
        shard.unlink()
    else:
        (copy / "scenes" / names(copy)[0] / "surfels.ply").unlink()
    assert validate(copy) > 0
    assert (entry.name if damage != "record" else names(copy)[0]) in caplog.text


@ONE_DATA_ENGINE
def test_5_failures_are_data_with_a_command_that_tries_again(
    source: Source,
    dataset: Path,
    tmp_path: Path,
    files_of: Callable,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    first, output = names(dataset)[0], tmp_path / "out"
    real = getattr(*source.maker)

    def fails(item, *rest):
        if item.name == first:
            raise RuntimeError("no memory\nfor this")
        return real(item, *rest)

    monkeypatch.setattr(*source.maker, fails)
    assert make(source.settings(output)) == 1
    failure = json.loads((output / "failures.jsonl").read_text())
    assert (failure["scene"], failure["reason"]) == (first, "RuntimeError: no memory for this")
    assert (output / failure["traceback"]).read_text().endswith("no memory\nfor this\n")
    assert f"listed in {output / 'failures.jsonl'}, tracebacks in {output / 'failures'}" in caplog.text
    assert names(output) == names(dataset)[1:], "the others are made"
    assert verify(output) == []
    assert Manifest.load(output).failures == 1
    assert make(source.settings(output, f"only=[{names(output)[0]}]")) == 1, "what is not tried stays listed"
    assert (output / failure["traceback"]).is_file()
    monkeypatch.undo()
    words = shlex.split(failure["command"])
    assert make(check(compose_recipe("conf.datagen", Settings, words[1:]), Settings)) == 0
    assert files_of(output) == files_of(dataset)


@ONE_DATA_ENGINE
def test_6_finite_a_clip_with_nan_is_set_aside_and_never_in_a_shard(
    source: Source, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = Manifest.load(dataset).shards[0].split
    key = Manifest.load(dataset).shards[0].keys[0]
    real = datagen.dataset.spool.first_bad_value

    def spoilt(frames):
        frames = [dict(frame) for frame in frames]
        frames[0]["pbr"] = np.full_like(frames[0]["pbr"], np.nan)
        return real(frames)

    monkeypatch.setattr(datagen.dataset.spool, "first_bad_value", spoilt)
    assert make(source.settings(tmp_path)) >= 1
    assert "pbr has" in json.loads((tmp_path / "failures.jsonl").read_text().splitlines()[0])["reason"]
    assert key not in {clip for entry in Manifest.load(tmp_path).shards for clip in entry.keys}
    with np.load(tmp_path / "quarantine" / f"{key}.npz") as aside:
        assert aside["pbr"].shape[-1] == 3, "its frames are kept for who looks into it"
    assert make(source.settings(tmp_path)) >= 1, "made again it would be the same; it stays accounted for"
    monkeypatch.undo()
    for clip in read_clips(dataset, split):
        assert all(np.isfinite(member).all() for member in clip.frames.values())


def test_7_bounded_two_runs_of_one_folder_do_not_mix(source: Source, tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(TronError, match="in use by another run"):
        make(source.settings(tmp_path))


@pytest.mark.long
def test_7_bounded_memory_stays_flat_over_many_scenes(tiny_scenes: list[str], tmp_path: Path) -> None:
    """30 scenes, three lives of each worker; the last fifth of the run beside the second."""
    output, count = tmp_path / "soak", 30
    words = [each for each in tiny_scenes if not each.startswith("train.scenes")]
    words += ["recycle_after=5", f"train.scenes={count}", "workers=2", f"output_dir={output}"]
    times, samples = output / "logs" / "times.jsonl", []
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen([SCRIPT, *words], stdout=log, stderr=log)
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            done = times.read_bytes().count(b"\n") if times.is_file() else 0
            resident = 0
            for each in (watched, *watched.children(recursive=True)):
                with suppress(psutil.NoSuchProcess):
                    resident += each.memory_info().rss
            samples.append((done, resident / 1e6))
            time.sleep(1)
    assert process.returncode == 0, (tmp_path / "log").read_text()

    def peak(part: int) -> float:
        return max(mb for done, mb in samples if count * part / 5 <= done < count * (part + 1) / 5)

    assert peak(4) - peak(1) < 150


# 8, hostile input, is tests/robustness/test_hostile_files.py.


def test_9_wrong_configuration_fails_before_anything_in_a_line_that_names_the_key(
    source: Source, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from datagen.cli import cli

    word, named = source.outside
    with pytest.raises(SystemExit) as stop:
        cli([*source.words, f"output_dir={tmp_path / 'out'}", word])
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert len(said.splitlines()) == 1
    assert named in said
    assert not (tmp_path / "out").exists()


@ONE_DATA_ENGINE
def test_10_visible_sheets_page_card_and_a_bar(
    source: Source, dataset: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    page, card = ((dataset / name).read_text() for name in ("index.html", "README.md"))
    for entry in Manifest.load(dataset).shards:
        sheet = f"previews/{entry.name.removesuffix('.tar')}.png"
        assert read_image(dataset / sheet).std() > 0.01
        assert sheet in page
    assert "tron-datagen" in card
    assert "mitsuba" in card
    with caplog.at_level("INFO"):
        assert make(source.settings(tmp_path, f"only=[{names(dataset)[0]}]")) == 0
    assert re.search(r"scenes: \d+ of \d+ .*", caplog.text)
