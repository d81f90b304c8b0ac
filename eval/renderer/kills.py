"""Trainings that are ended at random moments and started again, held against one that nobody disturbed."""

from __future__ import annotations

import csv
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.datagen.runs import require_success, running
from eval.renderer.datasets import WEIGHTS
from eval.results import Row
from eval.stages import ONE_THREAD
from tron.report.page import Cell, Section, Table
from tron.seeds import generator

SCRIPT = "tron-train"
SIGNALS = (signal.SIGTERM, signal.SIGKILL)
EACH_RUN = 4
"""Signals that a training suffers before it is finished and compared."""
LOOK_SECONDS = 0.02
BEGUN = b"Stage "
"""Words of tron-train's log when a stage begins."""


@dataclass(frozen=True)
class Ended:
    """One signal: its name, seconds after training began, and the last step that metrics.csv knew then."""

    name: str
    seconds: float
    step: int


@dataclass(frozen=True)
class Kills:
    """Findings: of each training its signals, and whether its weights are the same bytes in the end."""

    trainings: Sequence[tuple[Sequence[Ended], bool]]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Signals whose training came out the same, of all."""
        total = sum(len(ended) for ended, _ in self.trainings)
        same = sum(len(ended) for ended, identical in self.trainings if identical)
        yield Row(metric="renderer.kill_identical", value=same, unit="kills", n=total)
        yield Row(metric="renderer.kill_identical_share", value=same / total, unit="fraction", n=total)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Every training in a table."""
        rows = [
            [
                f"training {number}",
                "; ".join(f"{each.name} at {each.seconds:.2f} s, step {each.step} kept" for each in ended),
                Cell("same bytes", "good") if identical else Cell("weights differ", "bad"),
            ]
            for number, (ended, identical) in enumerate(self.trainings, 1)
        ]
        caption = (
            "SIGTERM and SIGKILL in turns at random moments of a training on one thread, which is started "
            "again by the same command; its weights are compared with those of an undisturbed one."
        )
        table = Table(caption, ["", "Signals", "In the end"], rows, words=[1])
        return [Section("kills", "Trainings that were ended and went on", [table])]


def measure_kills(recipe: Sequence[str], dataset: Path, count: int, seed: int, folder: Path) -> Kills:
    """Send so many signals in all.

    Raises:
        StageFailed: a training failed by itself.
    """
    arguments = [*recipe, f"dataset={dataset}", "threads=1"]
    whole, output = folder / "undisturbed", folder / "killed"
    shutil.rmtree(whole, ignore_errors=True)
    usual = _finish(arguments, whole)
    truth = (whole / WEIGHTS).read_bytes()
    rng = generator(seed, "eval", "renderer", "kills")
    trainings: list[tuple[list[Ended], bool]] = []
    left = count
    while left:
        shutil.rmtree(output, ignore_errors=True)
        ended: list[Ended] = []
        finished = False
        while not finished and len(ended) < min(EACH_RUN, left):
            number = sum(len(each) for each, _ in trainings) + len(ended)
            found = _end(arguments, output, rng.uniform(0, usual), SIGNALS[number % len(SIGNALS)])
            finished = found is None
            if found is not None:
                ended.append(found)
        _finish(arguments, output)
        if ended:  # else it was finished before the first
            trainings.append((ended, (output / WEIGHTS).read_bytes() == truth))
            left -= len(ended)
    return Kills(trainings)


def _finish(arguments: Sequence[str], output: Path) -> float:
    """Run to the end; seconds since the first stage began, 0 where the training was finished before.

    Raises:
        StageFailed: it failed.
    """
    output.with_suffix(".log").unlink(missing_ok=True)
    with running(arguments, output, ONE_THREAD, SCRIPT) as process:
        begun = _begun(process, arguments, output)
        code = process.wait()
    require_success(code, arguments, output, SCRIPT)
    return time.perf_counter() - begun if begun else 0.0


def _end(arguments: Sequence[str], output: Path, seconds: float, number: signal.Signals) -> Ended | None:
    """Run, wait until it trains and so long, and send the signal; None where it was finished before.

    Raises:
        StageFailed: it failed before.
    """
    output.with_suffix(".log").unlink(missing_ok=True)
    with running(arguments, output, ONE_THREAD, SCRIPT) as process:
        if _begun(process, arguments, output) is None:
            return None
        try:
            require_success(process.wait(seconds), arguments, output, SCRIPT)
            return None
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        process.wait()
    return Ended(number.name, seconds, _last_step(output / "metrics.csv"))


def _begun(process: subprocess.Popen[bytes], arguments: Sequence[str], output: Path) -> float | None:
    """Wait for a run to say that a stage begins; when it did, None where it ended without.

    Raises:
        StageFailed: it failed before.
    """
    log = output.with_suffix(".log")
    while BEGUN not in log.read_bytes():
        try:
            require_success(process.wait(LOOK_SECONDS), arguments, output, SCRIPT)
            return None
        except subprocess.TimeoutExpired:
            continue
    return time.perf_counter()


def _last_step(path: Path) -> int:
    """The step of the last row of metrics.csv, 0 without one."""
    if not path.is_file():
        return 0
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return int(rows[-1]["step"]) if rows else 0
