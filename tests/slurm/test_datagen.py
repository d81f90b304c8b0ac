"""`tron-datagen cluster=slurm` through a real Slurm: the bytes of this process, jobs replaced, none left."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

LONGEST = 500.0
TINY = [
    "train.scenes=3",
    "train_b.scenes=0",
    "validation.scenes=0",
    "test.scenes=0",
    "train.lights=[overcast]",
    "train.frames=1",
    "train.width=16",
    "train.height=12",
    "train.path_spp=2",
    "train.guidance_spp=2",
    "views=4",
    "view_width=24",
    "view_height=24",
    "surfels=500",
    "refine_steps=0",
    "mesh_edge=0.2",
    "environment_height=16",
    "objects=[1,1]",
]
SLURM = ["cluster=slurm", "cluster.queue=all", "cluster.memory=1GB", "cluster.walltime=00:20:00"]


def command(output: Path, *more: str) -> list[str]:
    return [str(Path(sys.executable).with_name("tron-datagen")), *TINY, f"output_dir={output}", *more]


def tree(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".tron.lock")
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if path.parent != folder / "slurm"
    }


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("here")
    subprocess.run(command(output, "cluster=none"), check=True, timeout=LONGEST)
    return output


def jobs(slurm: dict[str, str]) -> list[str]:
    asked = ["squeue", "--noheader", "--format=%i", "--states=RUNNING,PENDING"]
    return subprocess.run(asked, env=slurm, capture_output=True, text=True, check=True).stdout.split()


def test_two_jobs_make_the_bytes_of_one_process(slurm, here, tmp_path):
    done = subprocess.run(
        command(tmp_path / "out", *SLURM, "workers=2"),
        env=slurm,
        capture_output=True,
        text=True,
        timeout=LONGEST,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert tree(tmp_path / "out") == tree(here)
    assert len(list((tmp_path / "out" / "slurm").glob("*.out"))) == 2, "a log of each job"
    assert none_left(slurm)


def test_a_job_that_ends_is_replaced(slurm, here, tmp_path):
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
    assert tree(output) == tree(here)


def test_a_queue_that_is_not_there_is_one_line(slurm, tmp_path):
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
