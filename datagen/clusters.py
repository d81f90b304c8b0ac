"""The Dask cluster that scenes are spread over: looked at before work starts, grown to size, waited for."""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from datagen.settings import Settings
from tron.cli.instantiation import make
from tron.errors import TronError

log = logging.getLogger(__name__)

RECYCLE_SECONDS = 60.0
"""Seconds that a worker has to come back with a new process before the others go on without it."""

LOCAL = "dask.distributed.LocalCluster"
ADDRESS = "dask.distributed.Client"
BESIDE = {"dask.distributed.SSHCluster": "asyncssh"}
"""Packages that a cluster imports only when it starts."""


def require_cluster(settings: Settings) -> None:
    """Raise TronError, before any work, where the cluster's package, command, size or address is missing."""
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
    """The command by which a cluster class of dask-jobqueue submits jobs."""
    from hydra.utils import get_object

    try:
        return getattr(getattr(get_object(target), "job_cls", None), "submit_command", None)
    except Exception as error:  # whatever importing it raises
        raise TronError(f"cluster._target_ cannot be loaded: {error}", target) from error


@contextmanager
def workers(settings: Settings, most: int) -> Iterator[Any]:
    """A `dask.distributed.Client` whose cluster has a worker; the cluster ends with the block if it is ours.

    Clusters that start empty are kept at `settings.workers`, at `most` the number of scenes.

    Raises:
        TronError: the cluster does not start, or no worker has come within `settings.worker_timeout`.
    """
    from dask.distributed import Client

    logging.getLogger("distributed").setLevel(logging.WARNING)  # it reports every connection otherwise
    assert settings.cluster is not None
    options = dict(settings.cluster)
    target = options["_target_"]
    if target == LOCAL:
        options.setdefault("n_workers", min(settings.workers or cores(), most))
    with ExitStack() as stack:
        made = stack.enter_context(make(options, "cluster", _where(options)))
        if not isinstance(made, Client):
            if not made.worker_spec:
                # Not scale: a job that ends, by its time limit or a dead node, is then replaced.
                wanted = min(settings.workers or 1, most)
                made.adapt(minimum=wanted, maximum=wanted)
            made = stack.enter_context(Client(made))
        try:
            made.wait_for_workers(1, timeout=settings.worker_timeout)
        except TimeoutError as error:
            raise TronError(
                f"no worker came within worker_timeout={settings.worker_timeout:g} s",
                _where(options),
                "look at the queue and the workers' logs, or wait longer",
            ) from error
        yield made


def recycle(client: Any, seconds: float) -> None:
    """Replace the workers' processes: Mitsuba's memory grows with every scene it loads.

    Dask's own wait ends the run where one worker of many does not come back; here the others go on.
    """
    count = len(client.scheduler_info(n_workers=-1)["workers"])
    with suppress(TimeoutError):  # a process that does not end by itself is no longer the scheduler's
        client.restart(wait_for_workers=False)
    try:
        client.wait_for_workers(count, timeout=min(seconds, RECYCLE_SECONDS))
    except TimeoutError:
        client.wait_for_workers(1, timeout=seconds)
        back = len(client.scheduler_info(n_workers=-1)["workers"])
        log.warning("%d of %d workers have come back after their scenes; going on with them", back, count)


def ours(settings: Settings) -> bool:
    """Whether the cluster runs for this command alone, so that its workers may be restarted."""
    return settings.cluster is not None and settings.cluster["_target_"] != ADDRESS


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _where(options: Mapping[str, Any]) -> str:
    return str(options.get("address") or options.get("scheduler_file") or options["_target_"])
