"""Ctrl-C at random moments of whole commands: the same command, typed again, goes on to the same bytes."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from tron import seeds

pytestmark = pytest.mark.long

MOMENTS = 2
"""Ten were measured (dev/LOG.md), which takes eight minutes."""
KEPT = re.compile(r"stopped: step (\d+)(?: of stage (\w+))? is kept")


@dataclass(frozen=True)
class Interrupted:
    """A command and what it must leave.

    Attributes:
        words: of the command line, without the output folder.
        results: files whose bytes are compared.
        resumed: what a run says that goes on from the step in braces.
    """

    words: Sequence[str]
    results: Sequence[str]
    resumed: str

    def start(self, out: Path) -> subprocess.Popen[str]:
        """The command, in a session of its own; a shell's background jobs are born deaf to Ctrl-C."""
        words = [str(Path(sys.executable).with_name(self.words[0])), *self.words[1:], f"output_dir={out}"]
        env = os.environ | {"OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            words, stderr=subprocess.PIPE, text=True, env=env, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip

    def run(self, out: Path) -> str:
        """Run it to its end; what it said."""
        process = self.start(out)
        said = process.communicate()[1]
        assert process.returncode == 0, said
        return said

    def bytes_of(self, out: Path) -> list[bytes]:
        """The results."""
        return [(out / name).read_bytes() for name in self.results]


@pytest.fixture(scope="module")
def train(tiny_dataset: Path) -> Interrupted:
    stages = (
        "stages=[{name: one, split: train, steps: 500, batch_size: 1, crop: 12},"
        "{name: two, split: train, steps: 300, batch_size: 1, crop: 12}]"
    )
    words = ("tron-train", f"dataset={tiny_dataset}", stages, "validation.split=null",
             "checkpoint_every=1000", "threads=1", "renderer=pixel_mlp")  # fmt: skip
    return Interrupted(words, ["renderer.safetensors"], "from step {}")


@pytest.fixture(scope="module")
def reconstruct(tiny_captures: Path) -> Interrupted:
    capture = sorted(path for path in tiny_captures.iterdir() if path.is_dir())[0]
    words = (
        *("tron-reconstruct", f"capture={capture}", "threads=1", "steps_scaler=1", "checkpoint_every=1000"),
        *("initial.source=depth", "initial.count=400", "radiance.steps=150", "radiance.density.most=400"),
        "report=null",
    )
    return Interrupted(words, ["scene.ply", "environment.exr"], "resuming from step {}")


def test_training_goes_on(train: Interrupted, tmp_path: Path) -> None:
    interrupt_at_random_moments("train", train, tmp_path)


def test_a_reconstruction_goes_on(reconstruct: Interrupted, tmp_path: Path) -> None:
    interrupt_at_random_moments("reconstruct", reconstruct, tmp_path)


def wait(process: subprocess.Popen[str], seconds: float = math.inf) -> float:
    """Wait until a process has had so much of a core, or ended; seconds that it has had.

    Other work on the machine moves what happens at a time of the clock, and hardly this.
    """
    had = 0.0
    with suppress(psutil.NoSuchProcess):
        watched = psutil.Process(process.pid)
        while had < seconds and watched.status() != psutil.STATUS_ZOMBIE:
            had = sum(watched.cpu_times()[:2])
            time.sleep(0.003)
    return had


def interrupt_at_random_moments(name: str, command: Interrupted, tmp_path: Path) -> None:
    """From the first import to the last file; the first run warms what is cached."""
    seconds = 0.0
    for out in ("cold", "whole"):
        process = command.start(tmp_path / out)
        seconds = wait(process)
        assert process.wait() == 0, process.communicate()[1]
    whole = command.bytes_of(tmp_path / "whole")
    assert command.bytes_of(tmp_path / "cold") == whole
    for number in range(MOMENTS):
        out = tmp_path / str(number)
        moment = seconds * seeds.generator(0, "ctrl-c", name, number).uniform()
        process = command.start(out)
        wait(process, moment)
        finished = all((out / result).is_file() for result in command.results)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=120)[1]
        where = f"{name}, moment {number}, {moment:.2f} of {seconds:.2f} s:\n{said}"
        assert process.returncode == 130 or finished, where
        assert "Traceback" not in said, where
        kept = KEPT.search(said)
        again = command.run(out)
        print(f"{where.splitlines()[0]} {process.returncode} {kept and kept[0]}")
        assert kept is None or command.resumed.format(kept[1]) in again, f"{where}\nagain:\n{again}"
        assert command.bytes_of(out) == whole, where
