"""`cluster=slurm` and `srun tron-train` through a real Slurm of one node on the loopback address.

In one file, so that one process of pytest-xdist starts the daemons.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from tron import seeds
from tron.cameras import Camera
from tron.estimation import MATERIAL
from tron.shards.manifest import Manifest
from tron.shards.schema import TARGET, ClipMeta, guidance_members, light_members
from tron.shards.writer import ShardWriter

pytestmark = pytest.mark.long

LONGEST = 500.0
SLURM = ["cluster=slurm", "cluster.queue=all", "cluster.memory=1GB", "cluster.walltime=00:20:00"]
NEEDED = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "sinfo", "scancel")

CONFIG = """
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={megabytes} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=60 State=UP
"""


@pytest.fixture(scope="module")
def slurm() -> Iterator[dict[str, str]]:
    """The environment in which sbatch, srun and their kin reach the node; it is gone when the tests are."""
    missing = [name for name in NEEDED if _command(name) is None]
    if missing:
        pytest.skip(f"no Slurm: {', '.join(missing)} not found (apt-get install slurm-wlm munge)")
    if os.geteuid() != 0:
        pytest.skip("a Slurm of one node is started by root alone")
    folder = Path(tempfile.mkdtemp(prefix="tron-slurm-"))
    folder.chmod(0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    host, cores = socket.gethostname().partition(".")[0], os.cpu_count() or 1
    megabytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    config = CONFIG.format(host=host, folder=folder, ports=_free_ports(2), cores=cores, megabytes=megabytes)
    (folder / "slurm.conf").write_text(config)
    (folder / "munge.key").write_bytes(os.urandom(1024))
    (folder / "munge.key").chmod(0o400)
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
    munge = [
        f"--{name}={folder / 'munge'}.{name.partition('-')[0]}" for name in ("socket", "pid-file", "log-file")
    ]
    munge += [f"--key-file={folder / 'munge.key'}", f"--seed-file={folder / 'munge.seed'}"]
    daemons = [
        ["munged", "--foreground", "--force", *munge],
        ["slurmctld", "-D"],
        ["slurmd", "-D", "-N", host],
    ]
    running: list[subprocess.Popen[bytes]] = []
    try:
        for name, *arguments in daemons:
            with (folder / f"{name}.out").open("wb") as log:
                command = [str(_command(name)), *arguments]
                running.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
            time.sleep(1.0)
        _wait_until_idle(environment, running, folder)
        yield environment
    finally:
        subprocess.run(["scancel", "--user=root", "--full"], env=environment, check=False, timeout=30)
        for process in reversed(running):
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def _command(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def _wait_until_idle(
    environment: dict[str, str], running: list[subprocess.Popen[bytes]], folder: Path
) -> None:
    deadline = time.monotonic() + 60
    while True:
        asked = subprocess.run(
            ["sinfo", "--noheader", "--format=%T"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if asked.stdout.strip() == "idle":
            return
        if time.monotonic() > deadline or any(process.poll() is not None for process in running):
            said = "\n".join(
                f"{p.name}: {p.read_text(errors='replace')[-500:]}" for p in folder.glob("*.out")
            )
            pytest.fail(f"Slurm did not start: {asked.stdout}{asked.stderr}\n{said}")
        time.sleep(0.5)


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


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    with ShardWriter(folder, "train", 4) as writer:
        for number in range(4):
            key = f"train{number:03d}-l0"
            meta = ClipMeta(
                key=key,
                scene=key[:-3],
                light="l0",
                light_family="studio",
                split="train",
                frames=1,
                width=16,
                height=16,
                cameras=[Camera.look_at((0, -4, 1), (0, 0, 0), fov_deg=35, width=16, height=16).to_dict()],  # type: ignore[arg-type]
                exposure=1.0,
                color_space=dict.fromkeys((*light_members(), TARGET), "linear"),
            )
            noise = seeds.generator(0, "dataset", number).random((16, 16, 3), np.float32)
            one = np.ones((16, 16, 1), np.float32)
            colours = dict.fromkeys((*guidance_members(), TARGET), noise)
            writer.write(meta, [{**colours, "mask": one, "foreground": one}])
    Manifest(config_sha256="0" * 64, shards=writer.entries, material=MATERIAL).save(folder)
    return folder


def test_two_tasks_of_srun_train_together(slurm, dataset, tmp_path):
    words = [
        f"dataset={dataset}",
        f"output_dir={tmp_path / 'out'}",
        "renderer=pixel_mlp",
        "stages=[{name: one, split: train, steps: 3, batch_size: 1, crop: 16}]",
        "validation.split=null",
        "accelerator=cpu",
        "devices=2",
    ]
    script = Path(sys.executable).with_name("tron-train")
    done = subprocess.run(
        ["srun", "--nodes=1", "--ntasks-per-node=2", "--overcommit", str(script), *words],
        env=slurm,
        capture_output=True,
        text=True,
        timeout=LONGEST,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "renderer.safetensors").is_file()
    assert yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["processes"] == 2
    assert done.stderr.count("Stage 1 of 1") == 1
