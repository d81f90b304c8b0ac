"""Captures as training pairs: seconds of a scene, and runs that are killed in each phase of one."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from eval.datagen.runs import differences, family, make, require_success, running, scene_times, tree
from eval.datagen.settings import CapturedSettings
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Cell, Section, Table
from tron.seeds import generator

PHASES = {
    "photos": "reading photos and poses",
    "first surfels": "first surfels",
    "steps": "surfels are learnt from photos",
    "light and materials": "light and materials",
    "guidance": "guidance of its photos",
    "shards": "writing its clips",
}
"""Phase -> what the log of tron-datagen says when a capture comes to it."""

LOOK_SECONDS = 0.02
"""Seconds between two looks into the log: the shortest phase takes a tenth of a second."""

SHORT = {"photos": 0.05, "first surfels": 1.0, "light and materials": 1.0, "guidance": 1.0, "shards": 0.02}
"""Seconds into a phase up to which it is killed, drawn evenly; of steps up to ``most_steps_seconds``."""


@dataclass(frozen=True)
class Captured:
    """Findings.

    Attributes:
        kills: phase -> files that differ from those of an undisturbed run, after a kill in that phase.
        seconds: of each scene of the timed run.
        recipe: arguments of that run.
    """

    kills: dict[str, list[str]]
    seconds: list[float]
    recipe: Sequence[str]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Phases whose kill left no trace, and the mean seconds of a scene."""
        same = sum(not different for different in self.kills.values())
        yield Row(metric="captured.kill_identical", value=same, unit="phases", n=len(self.kills))
        mean = sum(self.seconds) / len(self.seconds)
        yield Row(metric="captured.seconds_per_scene", value=mean, unit="s", n=len(self.seconds))

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Every phase in a table."""
        rows = [
            [phase, Cell("same bytes", "good") if not found else Cell(f"{found[0]} differs", "bad")]
            for phase, found in self.kills.items()
        ]
        caption = (
            "SIGKILL of the command and its workers in each phase of a capture; the run is started again, "
            "and the finished dataset is compared with that of an undisturbed run, byte by byte. "
            f"A scene of {' '.join(self.recipe)} takes {sum(self.seconds) / len(self.seconds):.0f} s."
        )
        return [
            Section("captured", "Captures", [Table(caption, ["Killed in", "In the end"], rows, words=[0])])
        ]


def measure_captured(settings: CapturedSettings, seed: int, folder: Path) -> Captured:
    """Make captures and pairs of them, once to time it, then killed in each phase.

    Raises:
        StageFailed: a run failed by itself.
        TronError: a phase was never seen.
    """
    kills = _kills(settings, seed, folder)
    views = folder / "views"
    shutil.rmtree(views, ignore_errors=True)
    make(["mode=captures", *settings.views], views)
    output = folder / "timed"
    shutil.rmtree(output, ignore_errors=True)
    make([f"captures={views / 'captures'}", *settings.timed], output)
    found = [each.total for each in scene_times(output)]
    for each in (views, output):
        shutil.rmtree(each)
    return Captured(kills, found, settings.timed)


def _kills(settings: CapturedSettings, seed: int, folder: Path) -> dict[str, list[str]]:
    views, whole, output = folder / "small_views", folder / "undisturbed", folder / "killed"
    for each in (views, whole):
        shutil.rmtree(each, ignore_errors=True)
    make(["mode=captures", *settings.small_views], views)
    arguments = [f"captures={views / 'captures'}", *settings.small]
    make(arguments, whole)
    truth = tree(whole)
    rng = generator(seed, "eval", "captured", "kills")
    found = {}
    for phase in PHASES:
        shutil.rmtree(output, ignore_errors=True)
        _kill_in(phase, arguments, output, rng.uniform(0, SHORT.get(phase, settings.most_steps_seconds)))
        make(arguments, output)
        found[phase] = differences(truth, tree(output))
    for each in (views, whole, output):
        shutil.rmtree(each)
    return found


def _kill_in(phase: str, arguments: Sequence[str], output: Path, seconds: float) -> None:
    """Run until a capture has been in a phase for so many seconds, then kill the command and its workers.

    Raises:
        StageFailed: it failed before.
        TronError: it was finished before.
    """
    log = output.with_suffix(".log")
    begin = log.stat().st_size if log.is_file() else 0
    with running(arguments, output) as process:
        while not _said(PHASES[phase], output, log, begin):
            try:
                require_success(process.wait(LOOK_SECONDS), arguments, output)
            except subprocess.TimeoutExpired:
                continue
            raise TronError(f"a run was finished before it came to {phase}", output)
        time.sleep(seconds)
        seen = family(psutil.Process(process.pid))
        for each in seen:
            try:
                each.kill()
            except psutil.NoSuchProcess:
                continue
        process.wait()
    psutil.wait_procs(seen)
    if list(output.glob("scenes/*/record.json")):  # there is one scene
        raise TronError(f"a run was finished before it could be killed in {phase}", output)


def _said(words: str, output: Path, log: Path, begin: int) -> bool:
    """Whether the log of the command, or that of a worker, holds these words."""
    logs = {log: begin, **dict.fromkeys((output / "logs").glob("worker-*.log"), 0)}
    for path, offset in logs.items():
        if path.is_file() and words.encode() in path.read_bytes()[offset:]:
            return True
    return False
