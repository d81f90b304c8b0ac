"""Clusters: what is missing is said before work starts, a scheduler that runs is used and left as it was."""

import importlib.util
import logging
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest
from dask.distributed import Client, LocalCluster, Scheduler, SpecCluster, deploy

from datagen.cli import cli
from datagen.run.captures import make_captures
from datagen.run.clusters import ADDRESS, require_cluster, workers
from datagen.run.dataset import make
from datagen.run.worker_log import WorkerLog
from datagen.settings.command import Settings
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError

Tiny = Callable[..., Settings]


@pytest.fixture
def tiny(tiny_scenes) -> Tiny:
    def tiny(output: Path, *overrides: str) -> Settings:
        words = [*tiny_scenes, f"output_dir={output}", *overrides]
        return check(compose_recipe("conf.datagen", Settings, words), Settings)

    return tiny


@pytest.fixture(scope="module")
def empty_scheduler() -> Iterator[str]:
    cluster = LocalCluster(n_workers=0, threads_per_worker=1, dashboard_address=":0")
    with cluster, Client(cluster) as client:
        yield client.scheduler_info()["address"]


def test_none_is_this_process_and_null_is_too(tiny, tmp_path):
    assert tiny(tmp_path, "cluster=none").cluster is None
    assert tiny(tmp_path, "cluster=null").cluster is None
    cluster = tiny(tmp_path).cluster
    assert cluster is not None
    assert cluster["_target_"] == "dask.distributed.LocalCluster"


def test_one_kind_of_cluster_keeps_no_key_of_another(tiny, tmp_path):
    local = tiny(tmp_path).cluster
    slurm = tiny(tmp_path, "cluster=slurm", "cluster.queue=long").cluster
    assert local is not None
    assert slurm is not None
    assert "dashboard_address" in local
    assert slurm.keys() & {"threads_per_worker", "memory_limit", "dashboard_address"} == set()
    assert (slurm["queue"], slurm["log_directory"]) == ("long", f"{tmp_path}/slurm")


def test_what_a_cluster_lacks_is_one_line(tiny, tmp_path, monkeypatch):
    find, which, base = importlib.util.find_spec, shutil.which, tiny(tmp_path)
    slurm, extra = "dask_jobqueue.SLURMCluster", r"pip install 'tron-relight\[cluster\]'"
    rows = [
        ({"_target_": slurm}, 2, "dask_jobqueue", f"dask_jobqueue: {extra}"),
        ({"_target_": "dask.distributed.SSHCluster"}, 2, "asyncssh", f"asyncssh: {extra}"),
        ({"_target_": slurm}, 2, "sbatch", "command sbatch not found"),
        ({"_target_": slurm}, None, None, "'workers' has no value .*: say how many to start: workers=N"),
        ({"_target_": ADDRESS, "scheduler_file": "absent.json"}, None, None, r"not found \(absent.json\)"),
        ({"_target_": "nowhere.Cluster"}, None, None, "needs the package nowhere"),
        ({"_target_": "dask.distributed.NoCluster"}, None, None, "cannot be loaded"),
    ]
    for cluster, wanted, without, message in rows:
        monkeypatch.setattr(
            importlib.util, "find_spec", lambda name, gone=without: None if name == gone else find(name)
        )
        sbatch = None if without == "sbatch" else "/usr/bin/sbatch"
        monkeypatch.setattr(shutil, "which", lambda name, at=sbatch: at if name == "sbatch" else which(name))
        with pytest.raises(TronError, match=message) as caught:
            require_cluster(base.model_copy(update={"cluster": cluster, "workers": wanted}))
        assert "\n" not in str(caught.value)


def test_a_cluster_is_looked_at_before_anything_is_written(tiny, tmp_path):
    for work, mode in ((make, "make"), (make_captures, "captures")):
        with pytest.raises(TronError, match="cluster=address has no address"):
            work(tiny(tmp_path / "out", "cluster=address", f"mode={mode}"))
        assert not (tmp_path / "out").exists()


def test_ssh_needs_hosts(tiny, tmp_path):
    with pytest.raises(TronError, match=r"'cluster\.hosts' has no value"):
        tiny(tmp_path, "cluster=ssh")


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_a_cluster_without_workers_is_not_waited_for_longer_than_told(tiny, tmp_path, empty_scheduler):
    with pytest.raises(TronError, match=r"no worker came within worker_timeout=1 s"):
        make(tiny(tmp_path, "cluster=address", f"cluster.address={empty_scheduler}", "worker_timeout=1"))


class NeverStarts(deploy.spec.ProcessInterface):
    """A job that the queue refuses; its state stays as it was, like that of dask-jobqueue's jobs."""

    made: ClassVar[list[deploy.spec.ProcessInterface]] = []

    async def start(self) -> None:
        self.made.append(self)
        raise RuntimeError("no such queue")

    async def close(self) -> None:
        pass


def refused(**_: object) -> SpecCluster:
    scheduler = {"cls": Scheduler, "options": {"dashboard": False, "port": 0}}
    return SpecCluster(scheduler=scheduler, worker={"cls": NeverStarts})


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_workers_that_never_start_leave_the_line_that_says_so(tiny, tmp_path):
    cluster = {"_target_": f"{__name__}.refused"}
    settings = tiny(tmp_path).model_copy(update={"cluster": cluster, "workers": 1, "worker_timeout": 1})
    with pytest.raises(TronError, match=r"no worker came within worker_timeout=1 s"), workers(settings, 1):
        pass
    assert {job.status.name for job in NeverStarts.made} == {"created"}, "Dask met one that had not ended"


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_a_scheduler_that_is_not_there_is_one_line(tiny, tmp_path):
    address = ["cluster=address", "cluster.address=tcp://127.0.0.1:9", "cluster.timeout=1"]
    with pytest.raises(TronError, match=r"cluster cannot be made: .*127\.0\.0\.1:9") as caught:
        make(tiny(tmp_path, *address))
    assert "\n" not in str(caught.value)


def test_a_worker_writes_its_log_until_it_is_taken_away(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("TRON_LOG_LEVEL", "warning")  # and back again after the test
    caplog.set_level(logging.WARNING)
    log, names = logging.getLogger("datagen.somewhere"), logging.getLogger().handlers[:]
    plugin = WorkerLog(tmp_path / "logs", "info")
    plugin.setup(SimpleNamespace(name="tcp://host:1"))
    log.info("a scene begins")
    log.debug("nobody asked for this")
    plugin.teardown(None)
    log.info("too late")
    assert logging.getLogger().handlers == names
    (line,) = (tmp_path / "logs" / "worker-tcp-host-1.log").read_text().splitlines()
    assert line.endswith("INFO datagen.somewhere: a scene begins")


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_a_scene_that_fails_on_a_worker_leaves_its_traceback_and_the_workers_log(tiny, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "train-000000").write_text("in the way")
    settings = tiny(tmp_path, "workers=1", "recycle_after=1")
    assert make(settings) == 1
    trace = (tmp_path / "failures" / "train-000000.txt").read_text()
    assert trace.startswith("Traceback")
    assert "write_atomic" in trace
    (file,) = (tmp_path / "logs").glob("worker-*.log")
    said = file.read_text()
    assert "train-000000 failed: cannot write" in said
    assert "Traceback" in said
    assert said.count("begins") == 2, "the first scene is not made again when its worker is replaced"
    assert "train-000001 is made" in said
    assert f"tracebacks in {tmp_path / 'failures'}, workers' logs in {tmp_path / 'logs'}" in caplog.text
    (tmp_path / "scenes" / "train-000000").unlink()
    assert make(tiny(tmp_path, "cluster=none")) == 0
    assert not (tmp_path / "failures").exists()


def test_help_lists_the_keys_of_the_chosen_kind(capsys):
    with pytest.raises(SystemExit):
        cli(["cluster=slurm", "--help", "all"])
    page = capsys.readouterr().out
    for key in ("queue", "account", "walltime", "cores", "memory", "interface", "job_extra_directives"):
        assert f"cluster.{key}=" in page
    assert "cluster.dashboard_address" not in page


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_a_running_scheduler_makes_the_bytes_of_this_process_and_goes_on_running(
    tiny, tiny_dataset, files_of, tmp_path
):
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        (before,) = client.scheduler_info()["workers"]
        address = ["cluster=address", f"cluster.address={client.scheduler_info()['address']}"]
        assert make(tiny(tmp_path / "there", *address, "recycle_after=1")) == 0
        assert list(client.scheduler_info()["workers"]) == [before], "another's workers are not restarted"
    assert files_of(tmp_path / "there") == files_of(tiny_dataset)
