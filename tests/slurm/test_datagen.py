"""`tron-datagen cluster=slurm` through a real Slurm: the bytes of this process, jobs replaced, none left."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

LONGEST = 500.0
SLURM = ["cluster=slurm", "cluster.queue=all", "cluster.memory=1GB", "cluster.walltime=00:20:00"]


@pytest.fixture(scope="module")
def command(tiny_scenes) -> Callable[..., list[str]]:
    def command(output: Path, *more: str) -> list[str]:
        script = str(Path(sys.executable).with_name("tron-datagen"))
        return [script, *tiny_scenes, "train.scenes=3", f"output_dir={output}", *more]

    return command


@pytest.fixture(scope="module")
def here(command, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("here")
    subprocess.run(command(output, "cluster=none"), check=True, timeout=LONGEST)
    return output


def jobs(slurm: dict[str, str]) -> list[str]:
    asked = ["squeue", "--noheader", "--format=%i", "--states=RUNNING,PENDING"]
    return subprocess.run(asked, env=slurm, capture_output=True, text=True, check=True).stdout.split()


def test_two_jobs_make_the_bytes_of_one_process(slurm, command, files_of, here, tmp_path):
    done = subprocess.run(
        command(tmp_path / "out", *SLURM, "workers=2"),
        env=slurm,
        capture_output=True,
        text=True,
        timeout=LONGEST,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert files_of(tmp_path / "out") == files_of(here)
    assert len(list((tmp_path / "out" / "slurm").glob("*.out"))) == 2, "a log of each job"
    assert none_left(slurm)


def test_a_job_that_ends_is_replaced(slurm, command, files_of, here, tmp_path):
    output = tmp_path / "out"
    process = subprocess.Popen(
        command(output, *SLURM, "workers=1"), env=slurm, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + LONGEST
    while not list(output.glob("scenes/*/record.json")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    (job,) = jobs(slurm)
    subprocess.run(["scancel", job], env=slurm, check=True)
    _, said = process.communicate(timeout=LONGEST)
    assert process.returncode == 0, said
    assert len(list((output / "slurm").glob("*.out"))) == 2, "it did not end with the job"
    assert files_of(output) == files_of(here)


def test_a_queue_that_is_not_there_is_one_line(slurm, command, tmp_path):
    done = subprocess.run(
        command(tmp_path / "out", *SLURM, "workers=1", "cluster.queue=nowhere", "worker_timeout=5"),
        env=slurm,
        capture_output=True,
        text=True,
        timeout=LONGEST,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("tron-datagen: no worker came within worker_timeout=5 s")


def none_left(slurm: dict[str, str]) -> bool:
    deadline = time.monotonic() + 60
    while jobs(slurm):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.2)
    return True
