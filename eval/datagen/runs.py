"""Runs of tron-datagen as a user starts them: timed, watched, killed, and the trees that they leave."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from eval.stages import StageFailed, end, script_path
from tron.cli.termination import termination_unwinds
from tron.errors import TronError

SCRIPT = "tron-datagen"
TIMES = Path("logs") / "times.jsonl"
"""Seconds of every scene, which the data engine leaves in its output_dir."""
UNPROMISED = ("logs", ".tron.lock")
"""What may differ between two datasets that are the same."""


@dataclass(frozen=True)
class SceneTime:
    """One scene of a dataset: who made it, and its seconds by stage; scenes stand as they were finished."""

    scene: str
    worker: str
    seconds: Mapping[str, float]

    @property
    def total(self) -> float:
        """All its seconds."""
        return sum(self.seconds.values())


@contextmanager
def running(
    arguments: Sequence[str],
    output: Path,
    environment: Mapping[str, str] | None = None,
    script: str = SCRIPT,
) -> Iterator[subprocess.Popen[bytes]]:
    """A run of a command into ``output``, its words in ``OUTPUT.log`` beside; the block's end ends it."""
    output.parent.mkdir(parents=True, exist_ok=True)
    command = [script_path(script), *arguments, f"output_dir={output}"]
    with termination_unwinds(), output.with_suffix(".log").open("ab") as log:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **(environment or {})},
        )
        try:
            yield process
        finally:
            end(process)


def make(
    arguments: Sequence[str],
    output: Path,
    environment: Mapping[str, str] | None = None,
    watch: Callable[[psutil.Process], None] | None = None,
) -> float:
    """Run tron-datagen to its end; return its wall seconds, start and end of its workers included.

    Args:
        arguments: of tron-datagen, but for output_dir.
        output: the folder.
        environment: additions to its environment.
        watch: called about once a second with the command's process.

    Raises:
        StageFailed: it failed.
    """
    begun = time.perf_counter()
    with running(arguments, output, environment) as process:
        seen = psutil.Process(process.pid)
        while True:
            try:
                code = process.wait(1.0 if watch else None)
                break
            except subprocess.TimeoutExpired:
                if watch is not None:
                    watch(seen)
    seconds = time.perf_counter() - begun
    require_success(code, arguments, output)
    return seconds


def require_success(code: int, arguments: Sequence[str], output: Path, script: str = SCRIPT) -> None:
    """Raise StageFailed, with the last line of its log, for a run that ended with another code than 0."""
    if code:
        words = output.with_suffix(".log").read_text(errors="replace").splitlines()[-1:]
        raise StageFailed(" ".join([script, *arguments, f"output_dir={output}"]), code, " ".join(words))


def scene_times(output: Path) -> list[SceneTime]:
    """Times of the scenes that were made in a folder, in the order in which they were finished.

    Raises:
        TronError: the file is not what tron-datagen writes.
    """
    path = output / TIMES
    try:
        lines: list[dict[str, Any]] = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        return [SceneTime(each["scene"], each["worker"], each["seconds"]) for each in lines if each["made"]]
    except (OSError, ValueError, KeyError) as error:
        raise TronError(f"not the times of a dataset: {error}", path) from error


def tree(folder: Path) -> dict[str, bytes]:
    """Path -> bytes of every file whose bytes are promised."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not set(path.relative_to(folder).parts) & set(UNPROMISED)
    }


def differences(a: Mapping[str, bytes], b: Mapping[str, bytes]) -> list[str]:
    """Names of the files that one of two trees lacks, or whose bytes differ."""
    return sorted(name for name in {*a, *b} if a.get(name) != b.get(name))


def family(process: psutil.Process) -> list[psutil.Process]:
    """A process and all that it started, theirs included; empty once it is gone."""
    try:
        return [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def resident_mb(process: psutil.Process) -> dict[int, float]:
    """Resident memory of a process and of all that it started by their numbers, MB (10^6 bytes)."""
    found = {}
    for each in family(process):
        try:
            found[each.pid] = each.memory_info().rss / 1e6
        except psutil.NoSuchProcess:  # ended since
            continue
    return found
