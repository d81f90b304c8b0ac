"""Scheduling: no scene waits for another's; what hangs or kills its worker is named, and the rest is made."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import dask.config
import pytest
from dask.distributed import LocalCluster

from datagen.clock import clocked, stage
from datagen.dataset.records import Work
from datagen.files.sources import Sources
from datagen.run.account import Failure
from datagen.run.scheduling import Attempt, attempts, make_each
from datagen.settings.command import Settings
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError


def settings_of(output: Path, *overrides: str) -> Settings:
    words = [f"output_dir={output}", "worker_timeout=60", *overrides]
    return check(compose_recipe("conf.datagen", Settings, words), Settings)


def works(*names: str) -> list[Work]:
    return [Work("train", number, name, number) for number, name in enumerate(names)]


@pytest.mark.long
def test_workers_are_replaced_one_by_one_and_a_scene_that_hangs_or_kills_is_named(tmp_path):
    """One run of two workers, each replaced after two scenes, says it all."""

    def task(item: Work, settings: Settings, sources: Sources) -> tuple[int, float, float]:
        begun = time.time()
        kind = item.name.partition("-")[0]
        if kind == "hangs":
            while True:
                time.sleep(0.05)
        marker = settings.output_dir / item.name
        if kind == "kills" or (kind == "stumbles" and not marker.exists()):
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "fails":
            raise ValueError("no such shape")
        if kind == "quick":
            marker.touch()
        # More than one worker makes before it is replaced, however long the next one takes to start.
        while kind == "slow" and len(list(settings.output_dir.glob("quick-*"))) < 3:
            time.sleep(0.05)
        return os.getpid(), begun, time.time()

    others = ["hangs-0", "fails-0", "kills-0", "stumbles-0", "quick-6"]
    names = ["slow-0", *(f"quick-{i}" for i in range(6)), *others]
    settings = settings_of(tmp_path, "workers=2", "recycle_after=2", "scene_timeout=30")
    found = {item.name: each for item, each in attempts(task, works(*names), settings, Sources())}
    assert sorted(found) == sorted(names)

    failed = {name: each.outcome for name, each in found.items() if isinstance(each.outcome, Failure)}
    assert sorted(failed) == ["fails-0", "hangs-0", "kills-0"]
    assert failed["fails-0"].reason == "ValueError: no such shape"
    assert failed["hangs-0"].reason == "took longer than scene_timeout=30 s"
    assert "in task" in failed["hangs-0"].traceback, "where it hung"
    assert failed["kills-0"].reason == "worker lost: 3 workers ended while they made it"

    made = {name: each.outcome for name, each in found.items() if not isinstance(each.outcome, Failure)}
    slow, quick = made.pop("slow-0"), [made[f"quick-{i}"] for i in range(6)]
    meanwhile = {pid for pid, begun, _ in quick if begun < slow[2]}
    assert slow[0] not in meanwhile
    assert len(meanwhile) >= 2, "while one worker is slow another goes on, and is even replaced"
    for process in {pid for pid, _, _ in made.values()}:
        assert sum(pid == process for pid, _, _ in made.values()) <= 2, "no process makes more than two"
    for pid in {pid for pid, _, _ in [slow, *made.values()]}:
        assert not Path(f"/proc/{pid}").exists(), "no worker outlives the run"


@pytest.mark.long
def test_a_scheduler_that_goes_away_ends_the_run_in_one_line(tmp_path):
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0")

    def task(item: Work, *_: object) -> str:
        time.sleep(0.0 if item.name == "first" else 60.0)
        return item.name

    with cluster, dask.config.set({"distributed.comm.timeouts.connect": "2s"}):
        address = ["cluster=address", f"cluster.address={cluster.scheduler_address}"]
        made = attempts(task, works("first", "second"), settings_of(tmp_path, *address), Sources())
        assert next(made)[1].outcome == "first"
        cluster.close(timeout=20)
        with pytest.raises(TronError, match="the scheduler is gone: start this again"):
            next(made)


def test_every_scene_has_a_line_with_its_seconds_by_stage(tmp_path):
    settings = settings_of(tmp_path, "cluster=none")

    def task(item: Work, *_: object) -> str:
        if item.name == "fails":
            raise ValueError("no")
        time.sleep(0.2 if item.name == "slow" else 0.0)
        with stage("write"):
            return item.name

    failed = make_each(task, works("quick", "slow", "fails"), settings, Sources(), lambda _: 1, "clips")
    assert list(failed) == ["fails"]
    lines = [json.loads(line) for line in (tmp_path / "logs" / "times.jsonl").read_text().splitlines()]
    assert [(line["scene"], line["made"]) for line in lines] == [
        ("quick", True),
        ("slow", True),
        ("fails", False),
    ]
    assert lines[1]["seconds"]["rest"] == pytest.approx(0.2, abs=0.1)
    assert "write" in lines[1]["seconds"]


def test_times_that_cannot_be_written_end_the_run_in_one_line_and_its_workers_before(tmp_path, monkeypatch):
    (tmp_path / "logs").write_text("a file where the folder goes")
    ended = []

    def pretend(_: object, items: Sequence[Work], *__: object) -> Iterator[tuple[Work, Attempt[str]]]:
        try:
            for item in items:
                yield item, Attempt(item.name)
        finally:
            ended.append("workers")

    monkeypatch.setattr("datagen.run.scheduling.attempts", pretend)
    settings = settings_of(tmp_path, "cluster=none")
    with pytest.raises(TronError) as told:  # which holds on to the run's frames
        make_each(lambda *_: None, works("a", "b"), settings, Sources(), lambda _: 1, "clips")
    assert ended == ["workers"]
    assert told.match(r"cannot write.*times\.jsonl")


def test_a_clock_counts_the_innermost_stage(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def passes(seconds: float) -> None:
        now[0] += seconds

    @stage("refine")
    def fails() -> None:
        passes(16.0)
        raise KeyError

    with suppress(KeyError), clocked() as seconds:
        passes(1.0)
        with stage("surfels"):
            passes(2.0)
            with stage("refine"):
                passes(4.0)
            passes(8.0)
        fails()
    assert seconds == {"rest": 1.0, "surfels": 10.0, "refine": 20.0}
    with stage("unclocked"):
        passes(1.0)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_no_process(tiny_scenes, tmp_path, number):
    command = [str(Path(sys.executable).with_name("tron-datagen")), *tiny_scenes, "train.scenes=400"]
    process = subprocess.Popen(
        [*command, f"output_dir={tmp_path}", "workers=2"], stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("scenes/*/record.json")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    family = descendants(process.pid)
    assert len(family) >= 2
    process.send_signal(number)
    begun = time.monotonic()
    _, said = process.communicate(timeout=60)
    assert time.monotonic() - begun < 20
    assert process.returncode == (130 if number == signal.SIGINT else 143), said
    assert "Traceback" not in said
    time.sleep(1.0)
    assert [pid for pid in family if alive(pid)] == []


def descendants(pid: int) -> list[int]:
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, path.read_text().split()):
            found += [child, *descendants(child)]
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
