"""Run other console commands as stages: streamed, timed, and skipped if finished.

A stage is one or more commands that run at the same time. Its seconds are kept in ``stages.json`` and add up
over interrupted attempts, so that a resumed demo still tells how long the whole of it took.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pydantic
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat

from tron.errors import TronError
from tron.run_folder import CHOOSE_ANOTHER, RunFolder
from tron.runtime import describe_machine
from tron.termination import termination_noted

ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment of a command that computes on one thread."""
MESSAGE_LINES = 12
"""Last lines of a failed child that are kept for its error message."""
PATIENCE = 20.0
"""Seconds that a child has to end by itself after it was asked to."""


def checkout() -> str:
    """Return the short commit of the running code, with a + for local changes; empty outside a checkout."""
    machine = describe_machine()
    commit = str(machine.get("commit") or "")[:10]
    return commit + "+" if commit and machine.get("dirty") else commit


class StageFailed(Exception):
    """A child ended with a non-zero exit code; str() has the command, the code and its last output."""

    def __init__(self, command: str, exit_code: int, words: str):
        super().__init__(f"{command} failed with exit code {exit_code}: {words or 'it said nothing'}")
        self.exit_code = exit_code if exit_code > 0 else 1  # killed by a signal: -9 is no exit code of ours


class StageRecord(BaseModel):
    """One stage in stages.json."""

    model_config = ConfigDict(extra="forbid")

    commands: list[list[str]] = Field(description="commands as typed")
    seconds: NonNegativeFloat = Field(
        default=0.0, description="wall time of all attempts without nested stages"
    )
    attempts: int = Field(default=0, ge=0)
    finished: bool = False
    commit: str = Field(default="", description="checkout() of the code that finished the stage")


class StageFile(BaseModel):
    """Contents of stages.json: stage name -> record, in the order of first runs."""

    model_config = ConfigDict(extra="forbid")

    stages: dict[str, StageRecord] = Field(default_factory=dict)


@dataclass(frozen=True)
class Child:
    """One command.

    Attributes:
        label: prefix of its lines in the log.
        script: console script.
        arguments: arguments of the script.
        environment: additions to its environment.
    """

    label: str
    script: str
    arguments: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)

    @property
    def typed(self) -> list[str]:
        """The command as typed."""
        return [self.script, *self.arguments]


class Stages:
    """Runner of stages, with records in ``folder/stages.json``."""

    def __init__(self, folder: Path):
        self.folder = RunFolder(folder, "a stage", "stages.json")
        self._counted = 0.0
        try:
            self.file = StageFile.model_validate(self.folder.recipe() or {})
        except pydantic.ValidationError as error:
            raise TronError("not a record of stages", self.folder.record, CHOOSE_ANOTHER) from error

    @property
    def records(self) -> dict[str, StageRecord]:
        """Stage name -> record."""
        return self.file.stages

    def run(self, name: str, children: Sequence[Child]) -> float:
        """Run the children at the same time unless the stage is finished; return its seconds in all attempts.

        Raises:
            TronError: a console script is missing, or the stage was done or begun by other commands.
            StageFailed: a child failed; the others are ended, and the time spent is kept.
        """
        commands = [child.typed for child in children]
        record = self.records.setdefault(name, StageRecord(commands=commands))
        self.folder.require({name: _settings(commands)}, {name: _settings(record.commands)})
        if not record.finished:
            with self.timed(name, commands):
                run_together(children)
            return record.seconds
        _say(name, f"done before, {record.seconds:.0f} s")
        if record.commit != checkout():
            made_by = record.commit or "unknown"
            _say(name, f"made by another commit ({made_by}): delete {self.folder.folder} to redo it")
        return record.seconds

    @contextmanager
    def timed(self, name: str, commands: list[list[str]]) -> Iterator[StageRecord]:
        """Add the seconds of the block to the stage's record, and mark it finished if the block succeeds.

        Seconds of stages within the block count for these stages only, so all records add up to the time
        passed.
        """
        record = self.records.setdefault(name, StageRecord(commands=commands))
        record.attempts += 1
        start, before = time.perf_counter(), self._counted
        try:
            yield record
            record.finished, record.commit = True, checkout()
        finally:
            spent = time.perf_counter() - start
            record.seconds += spent - (self._counted - before)
            self._counted = before + spent
            self.folder.keep(self.file.model_dump(mode="json"))

    def restart(self, name: str) -> None:
        """Forget a cheap stage that is measured again every time."""
        self.records.pop(name, None)


def _settings(commands: list[list[str]]) -> dict[str, dict[str, str]]:
    """Return commands as plain values: number, script, and settings by key."""
    return {
        str(number): {
            "command": script,
            **{key: value for key, _, value in (each.partition("=") for each in rest)},
        }
        for number, (script, *rest) in enumerate(commands)
    }


def script_path(name: str) -> str:
    """Return the path of a console script beside this Python; TronError if it is not installed there."""
    folder = Path(sys.executable).parent
    found = shutil.which(name, path=str(folder))
    if found is None:
        raise TronError(f"command {name} not found", folder, "in TRON's folder: pip install -e '.[all]'")
    return found


def run_together(children: Sequence[Child]) -> None:
    """Run commands at the same time until all have ended; print their output lines with their labels.

    When one fails, or this process is interrupted, the others are asked to end and, after PATIENCE, killed.

    Raises:
        TronError: a console script is missing; nothing was started.
        StageFailed: the first child, in the order given, that failed by itself.
    """
    paths = [script_path(child.script) for child in children]
    with termination_noted() as termination, ExitStack() as running:
        started = [running.enter_context(_running(child, path)) for child, path in zip(children, paths)]
        while not termination.asked:
            codes = [process.poll() for process, _ in started]
            for child, code, (_, last) in zip(children, codes, started):
                if code:
                    running.close()  # which reads their last lines
                    # the last line that the command itself speaks in, else its last line
                    spoken = [line for line in last if line.startswith(f"{child.script}: ")]
                    raise StageFailed(" ".join(child.typed), code, (spoken or [*last] or [""])[-1])
            if None not in codes:
                return
            time.sleep(0.05)


@contextmanager
def _running(child: Child, path: str) -> Iterator[tuple[subprocess.Popen[str], deque[str]]]:
    """Run a process while the block runs; a thread prints its output and keeps the last lines."""
    last: deque[str] = deque(maxlen=MESSAGE_LINES)
    _say(child.label, "$ " + " ".join(child.typed))
    process = subprocess.Popen(
        [path, *child.arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={**os.environ, "PYTHONUNBUFFERED": "1", **child.environment},
    )

    def stream() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if text := line.rstrip():
                last.append(text)
                _say(child.label, text)

    thread = threading.Thread(target=stream, daemon=True)
    thread.start()
    try:
        yield process, last
    finally:
        end(process)
        thread.join(PATIENCE)


def end(process: subprocess.Popen) -> None:
    """Terminate a process that still runs, and kill it if it has not ended within PATIENCE seconds."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            # Not for ever: an interrupted `Popen.poll` may have left the process's lock taken.
            with suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE)


def _say(label: str, text: str) -> None:
    print(f"[{label}] {text}", flush=True)
