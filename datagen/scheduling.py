"""A task for every scene, in this process or on the cluster, with progress and what failed."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, TypeVar

from datagen.clusters import ours, recycle, worker_count, workers
from datagen.failures import Failure
from datagen.plan import Sources, Work
from datagen.settings import Settings
from tron.cli.progress import Progress

log = logging.getLogger(__name__)

Made = TypeVar("Made")
Task = Callable[[Work, Settings, Sources], Made]
"""Function that makes something of one scene, in a worker; it can be pickled."""


def make_each(
    task: Task[Any],
    items: Sequence[Work],
    settings: Settings,
    sources: Sources,
    size: Callable[[Work], int],
    unit: str,
) -> dict[str, Failure]:
    """Do a task for every scene and show how far that is; return those that failed, by name.

    Args:
        task, items, settings, sources: the task, the scenes and what they are made with.
        size: the weight of a scene in the estimate of the time that is left.
        unit: what weights count.
    """
    failed: dict[str, Failure] = {}
    with Progress("scenes", sum(map(size, items)), unit=unit) as progress:
        for item, outcome in outcomes(task, items, settings, sources):
            if isinstance(outcome, Failure):
                failed[item.name] = outcome
                log.error("%s failed: %s", item.name, outcome.reason)
            progress.advance(size(item), item.name)
    return failed


def outcomes(
    task: Task[Made], items: Sequence[Work], settings: Settings, sources: Sources
) -> Iterator[tuple[Work, Made | Failure]]:
    """Scenes as they are finished, in any order, each with what its task gave or why it gave nothing."""
    if settings.cluster is None or not items:
        for item in items:
            yield item, attempt(task, item, settings, sources)
        return
    from dask.distributed import as_completed

    with workers(settings, len(items)) as client:
        queue, left = iter(items), len(items)
        mine = ours(settings)
        while left:
            wave = list(islice(queue, worker_count(client) * settings.recycle_after if mine else None))
            futures = {
                client.submit(
                    attempt_logged, task, item, settings, sources, key=_key(settings, item), pure=False
                ): item
                for item in wave
            }
            for future in as_completed(futures):
                # A worker that died (killed for memory, crashed in native code) surfaces here, after Dask's
                # retries.
                error = future.exception()
                outcome = Failure.of(error, "worker lost: ") if error else future.result()
                future.release()  # a result that is still held is computed again when its worker is replaced
                yield futures[future], outcome
            left -= len(wave)
            if mine and left:
                recycle(client, settings.worker_timeout)


def attempt(task: Task[Made], item: Work, settings: Settings, sources: Sources) -> Made | Failure:
    """Do a task; whatever goes wrong is an outcome: one scene's failure is not the run's."""
    try:
        return task(item, settings, sources)
    except Exception as error:
        log.debug("scene %s", item.name, exc_info=True)
        return Failure.of(error)


def attempt_logged(task: Task[Made], item: Work, settings: Settings, sources: Sources) -> Made | Failure:
    """The same in a worker, whose log tells of it."""
    log.info("%s begins", item.name)
    outcome = attempt(task, item, settings, sources)
    if isinstance(outcome, Failure):
        log.error("%s failed: %s\n%s", item.name, outcome.reason, outcome.traceback)
    else:
        log.info("%s is made", item.name)
    return outcome


def _key(settings: Settings, item: Work) -> str:
    """A task's name on a scheduler that may serve several runs."""
    return f"{item.name}-{hashlib.sha256(str(settings.output_dir.absolute()).encode()).hexdigest()[:16]}"
