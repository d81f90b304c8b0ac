"""The Dask cluster for scenes: checked before work starts, scaled, and waited for."""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from datagen.settings.command import Settings
from tron.cli.instantiation import make
from tron.cli.log import log_level
from tron.errors import TronError

log = logging.getLogger(__name__)

CLOSE_SECONDS = 30.0
"""Seconds that a cluster has to end."""
ATTEMPTS = 3
"""Workers that may die over a scene before it counts as failed: a job may end for reasons of its own."""

LOCAL = "dask.distributed.LocalCluster"
ADDRESS = "dask.distributed.Client"
BESIDE = {"dask.distributed.SSHCluster": "asyncssh"}
"""Packages that a cluster imports only when it starts."""


def require_cluster(settings: Settings) -> None:
    """Raise TronError, before any work, if the cluster's package, command, size or address is missing."""
    options = settings.cluster
    if options is None:
        return
    target = options["_target_"]
    for package in (target.partition(".")[0], BESIDE.get(target)):
        if package is not None and importlib.util.find_spec(package) is None:
            raise TronError(
                f"cluster {target} needs the package {package}", mend="pip install 'tron-relight[cluster]'"
            )
    if target == ADDRESS and not (options.get("address") or options.get("scheduler_file")):
        raise TronError(
            "cluster=address has no address",
            mend="give cluster.address=tcp://HOST:PORT or cluster.scheduler_file",
        )
    file = options.get("scheduler_file")
    if file and not Path(file).is_file():  # Dask would wait for it without end
        raise TronError("cluster.scheduler_file not found", file, "start the scheduler first")
    command = _submit_command(target)
    if command is None:
        return
    if shutil.which(command) is None:
        raise TronError(f"command {command} not found", target, "start this where jobs are submitted")
    if settings.workers is None:
        raise TronError("'workers' has no value", target, "say how many to start: workers=N")


def _submit_command(target: str) -> str | None:
    """Return the command by which a cluster class of dask-jobqueue submits jobs."""
    from hydra.utils import get_object

    try:
        return getattr(getattr(get_object(target), "job_cls", None), "submit_command", None)
    except Exception as error:  # whatever importing it raises
        raise TronError(f"cluster._target_ cannot be loaded: {error}", target) from error


@contextmanager
def workers(settings: Settings, most: int) -> Iterator[Any]:
    """Yield a `dask.distributed.Client` whose cluster has a worker; our own cluster ends with the block.

    Clusters that start empty are kept at `settings.workers`, at `most` the number of scenes.

    Raises:
        TronError: the cluster does not start, or no worker has come within `settings.worker_timeout`.
    """
    import dask.config
    from dask.distributed import Client

    from datagen.run.worker_log import WorkerLog

    logging.getLogger("distributed").setLevel(logging.WARNING)  # it reports every connection otherwise
    logging.getLogger("distributed.nanny").setLevel(logging.ERROR)  # that a worker is replaced is no news
    assert settings.cluster is not None
    options = dict(settings.cluster)
    target = options["_target_"]
    if target == LOCAL:
        options.setdefault("n_workers", min(settings.workers or cores(), most))
    with ExitStack() as stack:
        wait = f"{settings.worker_timeout}s"
        promises = {
            "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
            "distributed.scheduler.worker-saturation": 1.0,  # a worker has the scene it makes, no other
            "distributed.scheduler.no-workers-timeout": wait,
        }
        stack.enter_context(dask.config.set(promises))
        made = make(options, "cluster", _where(options))
        if isinstance(made, Client):
            stack.callback(_close, made)
        else:
            if made.worker_spec:
                # Dask drops a worker that is gone for 15 s, even one that restarts on a busy machine.
                stack.enter_context(dask.config.set({"distributed.deploy.lost-worker-timeout": wait}))
            else:
                # Not scale: a job that ends, by its time limit or a dead node, is then replaced.
                wanted = min(settings.workers or 1, most)
                made.adapt(minimum=wanted, maximum=wanted)
            stack.callback(_close, made)
            made = stack.enter_context(Client(made))
        try:
            made.wait_for_workers(1, timeout=settings.worker_timeout)
        except TimeoutError as error:
            raise TronError(
                f"no worker came within worker_timeout={settings.worker_timeout:g} s",
                _where(options),
                "look at the queue and the workers' logs, or wait longer",
            ) from error
        log_to = WorkerLog(logs_folder(settings).absolute(), log_level(), ours(settings))
        try:
            made.register_plugin(log_to)
        except OSError as error:
            raise TronError(
                f"a worker cannot write its log: {error}",
                logs_folder(settings),
                "all workers must see output_dir by the same path",
            ) from error
        if not ours(settings):
            stack.callback(_leave, made, log_to.name)
        yield made


def _close(cluster: Any) -> None:
    """End a cluster, or only the client of another's; Dask may wait forever for a starting worker."""
    from dask.distributed import Status

    try:
        cluster.close(timeout=CLOSE_SECONDS)
    except TimeoutError:
        log.warning("a worker does not end; it ends with this process")
    except AssertionError as error:
        # Dask's last step, once its scheduler is closed: each worker it ever made has to have ended. One
        # whose start failed (no such queue) has not, where its exception still holds it; our error says more.
        log.debug("a worker never started: %s", error)
        cluster.status = Status.closed  # or Dask waits 10 s for it when this process ends


def _leave(client: Any, plugin: str) -> None:
    with suppress(OSError):  # the scheduler is gone
        client.unregister_worker_plugin(plugin)


def logs_folder(settings: Settings) -> Path:
    """Return the folder of the workers' logs."""
    return settings.output_dir / "logs"


def ours(settings: Settings) -> bool:
    """Whether the cluster runs for this command alone, so that its workers may be restarted."""
    return settings.cluster is not None and settings.cluster["_target_"] != ADDRESS


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _where(options: Mapping[str, Any]) -> str:
    return str(options.get("address") or options.get("scheduler_file") or options["_target_"])


def worker_count(settings: Settings, most: int) -> tuple[int, str]:
    """Return the number of workers, at least one, and a remark if only the cluster knows it."""
    if settings.cluster is None:
        return 1, ", this process"
    if settings.workers is not None:
        return max(min(settings.workers, most), 1), ""
    if settings.cluster["_target_"] == LOCAL:
        return max(min(int(settings.cluster.get("n_workers") or cores()), most), 1), ""
    return 1, "; the cluster has its own number: give workers=N"
