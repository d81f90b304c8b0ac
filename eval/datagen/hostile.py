"""Hostile files, each given to what would read it: one line within a second and 200 MB, and nothing executed.

They are read in a child process, kind by kind, the good file first: it pays for imports. A child that dies
has refused nothing that was left.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.datagen.hostile_files import GOOD, hostile_files
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Cell, Section, Table

SECONDS = 1.0
MEGABYTES = 200.0
PATIENCE = 300.0
"""Seconds after which a child counts as hung."""


@dataclass(frozen=True)
class Attempt:
    """One file as its reader met it.

    Attributes:
        said: the error's text; None where the file was taken.
        seconds: of processor time.
        megabytes: by which the peak of resident memory grew.
        executed: something in the file was run.
    """

    kind: str
    what: str
    said: str | None
    seconds: float
    megabytes: float
    executed: bool

    def problem(self) -> str | None:
        """Why the file does not count as refused; None where it does."""
        if self.executed:
            return "it was executed"
        if self.said is None:
            return "it was taken"
        if "\n" in self.said:
            return "more than one line"
        if self.seconds > SECONDS:
            return f"it took {self.seconds:.1f} s"
        if self.megabytes > MEGABYTES:
            return f"it took {self.megabytes:.0f} MB"
        return None


@dataclass(frozen=True)
class Hostile:
    """All attempts."""

    attempts: Sequence[Attempt]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Files refused, all files, and what the worst of them cost."""
        count = len(self.attempts)
        refused = sum(each.problem() is None for each in self.attempts)
        yield Row(metric="hostile.refused", value=refused, unit="files", n=count)
        yield Row(
            metric="hostile.seconds", value=max(each.seconds for each in self.attempts), unit="s", n=count
        )
        yield Row(metric="hostile.mb", value=max(e.megabytes for e in self.attempts), unit="MB", n=count)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Every file in a table."""
        rows = []
        for each in self.attempts:
            problem = each.problem()
            verdict = Cell("refused", "good") if problem is None else Cell(problem, "bad")
            said = (each.said or "")[:160]
            rows.append([each.kind, each.what, said, f"{each.seconds:.2f}", f"{each.megabytes:.0f}", verdict])
        caption = (
            f"Files that lie, are enormous or would run a program, each given to its reader: one line within "
            f"{SECONDS:g} s of processor time and {MEGABYTES:g} MB, and nothing executed."
        )
        headings = ["Read as", "What is wrong", "What is said", "s", "MB", ""]
        return [Section("hostile", "Hostile files", [Table(caption, headings, rows, words=[1, 2])])]


def measure_hostile(folder: Path) -> Hostile:
    """Write every file and have it read.

    Raises:
        TronError: a good file was refused, so that refusals say nothing.
    """
    attempts: list[Attempt] = []
    for kind, builders in hostile_files().items():
        home = folder / kind
        shutil.rmtree(home, ignore_errors=True)
        given: dict[str, Path] = {}
        for number, (what, build) in enumerate(builders.items()):
            place = home / f"{number:02d}"
            place.mkdir(parents=True)
            given[what] = build(place)
        good, *others = _read(kind, given)
        if good.said is not None:
            raise TronError(f"a good {kind} is refused: {good.said}", given[GOOD])
        attempts += others
        shutil.rmtree(home)
    return Hostile(attempts)


def _read(kind: str, given: Mapping[str, Path]) -> list[Attempt]:
    """Attempts of one kind; files after one that ended the child are given to a new child."""
    attempts: list[Attempt] = []
    names = list(given)
    while len(attempts) < len(names):
        left = names[len(attempts) :]
        # A child begins with the good file, so that imports are not counted.
        first = [] if left[0] == GOOD else [GOOD]
        said = _child(kind, [given[name] for name in [*first, *left]])[len(first) :]
        attempts += [Attempt(kind, name, **line) for name, line in zip(left, said)]
        if len(said) < len(left):
            ended = {"said": None, "seconds": 0.0, "megabytes": 0.0, "executed": False}
            attempts.append(Attempt(kind, f"{left[len(said)]} (the reader died)", **ended))
    return attempts


def _child(kind: str, paths: Sequence[Path]) -> list[dict]:
    command = [sys.executable, "-m", "eval.datagen.hostile_reader", kind, *map(str, paths)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
        output = done.stdout
    except subprocess.TimeoutExpired as error:
        output = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
    return [json.loads(line[1:]) for line in output.splitlines() if line.startswith("@")]
