"""Runs that are killed at random moments and started again, held against one that nobody disturbed."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from eval.datagen.runs import differences, family, make, require_success, running, tree
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Cell, Section, Table
from tron.seeds import generator

VICTIMS = ("command", "everything")
"""What gets SIGKILL: the command, whose workers must notice, or all its processes, as in a power cut."""
EARLIEST = 0.05
"""Share of an undisturbed run's time before which nothing is killed: Python is only just starting."""
EACH_TREE = 4
"""Kills that a dataset suffers before it is finished and compared."""
ORPHAN_SECONDS = 60.0
"""Seconds after which workers that outlive their command are an error."""


@dataclass(frozen=True)
class Kill:
    """One SIGKILL: when (seconds into the run), of what, and how many scenes were finished by then."""

    seconds: float
    victim: str
    finished: int


@dataclass(frozen=True)
class Kills:
    """Datasets that were killed and finished.

    Attributes:
        trees: of each dataset its kills and the files that differ from the undisturbed one's.
        scenes: of a dataset.
        orphans: longest time that a worker outlived its command, s.
    """

    trees: list[tuple[list[Kill], list[str]]]
    scenes: int
    orphans: float

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Kills whose dataset came out the same, all kills, and how long workers outlived their command."""
        total = sum(len(kills) for kills, _ in self.trees)
        same = sum(len(kills) for kills, different in self.trees if not different)
        yield Row(metric="kills.identical", value=same, unit="kills", n=total)
        yield Row(metric="kills.orphan_seconds", value=self.orphans, unit="s", n=total)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Every kill in a table."""
        rows = []
        for number, (kills, different) in enumerate(self.trees, start=1):
            verdict = Cell("same bytes", "good") if not different else Cell(f"{different[0]} differs", "bad")
            said = [f"{k.victim} at {k.seconds:.1f} s, {k.finished} of {self.scenes} made" for k in kills]
            rows.append([f"dataset {number}", "; ".join(said), verdict])
        caption = (
            "SIGKILL at random moments, each time of the command alone or of all its processes; the run is "
            "started again, and the finished dataset is compared with that of an undisturbed run, byte by "
            "byte."
        )
        headings = ["", "Kills", "In the end"]
        return [Section("kills", "Killed and started again", [Table(caption, headings, rows, words=[1])])]


def measure_kills(recipe: Sequence[str], count: int, seed: int, folder: Path) -> Kills:
    """Kill runs of a recipe so many times in all; two workers.

    Raises:
        StageFailed: a run failed by itself.
        TronError: a worker outlives its command.
    """
    arguments = [*recipe, "workers=2"]
    whole, output = folder / "undisturbed", folder / "killed"
    shutil.rmtree(whole, ignore_errors=True)
    usual = make(arguments, whole)
    truth, scenes = tree(whole), len(list(whole.glob("scenes/*/record.json")))
    shutil.rmtree(whole)
    rng = generator(seed, "eval", "kills")
    trees: list[tuple[list[Kill], list[str]]] = []
    left, orphans = count, 0.0
    while left:
        shutil.rmtree(output, ignore_errors=True)
        kills: list[Kill] = []
        finished = False
        while not finished and len(kills) < min(EACH_TREE, left):
            seconds = usual * rng.uniform(EARLIEST, 1.0)
            victim = VICTIMS[rng.integers(len(VICTIMS))]
            outlived = _kill(arguments, output, seconds, victim)
            finished = outlived is None
            if outlived is not None:
                orphans = max(orphans, outlived)
                kills.append(Kill(seconds, victim, len(list(output.glob("scenes/*/record.json")))))
        make(arguments, output)
        left -= len(kills)
        if kills:  # else it was finished before the first
            trees.append((kills, differences(truth, tree(output))))
    shutil.rmtree(output, ignore_errors=True)
    return Kills(trees, scenes, orphans)


def _kill(arguments: Sequence[str], output: Path, seconds: float, victim: str) -> float | None:
    """Run for so many seconds, then kill; how long workers outlived it, None where it was finished before.

    Raises:
        StageFailed: it failed before it was killed.
        TronError: a worker outlives its command.
    """
    with running(arguments, output) as process:
        try:
            require_success(process.wait(seconds), arguments, output)
            return None
        except subprocess.TimeoutExpired:
            pass
        seen = family(psutil.Process(process.pid))
        if victim == "command":
            process.kill()
        else:
            for each in seen:
                try:
                    each.kill()
                except psutil.NoSuchProcess:
                    continue
        process.wait()
    begun = time.perf_counter()
    _, alive = psutil.wait_procs(seen, timeout=ORPHAN_SECONDS)
    if alive:
        raise TronError(f"{len(alive)} workers outlive their command by {ORPHAN_SECONDS:.0f} s", output)
    return time.perf_counter() - begun
