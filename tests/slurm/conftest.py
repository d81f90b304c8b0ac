"""A real Slurm of one node on the loopback address, with a munge of its own; gone when the tests are."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

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


@pytest.fixture(scope="session")
def slurm() -> Iterator[dict[str, str]]:
    """The environment in which sbatch, srun and their kin reach the node."""
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
    with tempfile.TemporaryDirectory():
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
