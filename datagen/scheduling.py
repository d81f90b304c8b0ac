"""A task for every scene, in this process or on the cluster, with progress, times and what failed."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeVar

from datagen.clock import clocked
from datagen.clusters import logs_folder, workers
from datagen.crew import Crew
from datagen.failures import Failure
from datagen.patience import Patience
from datagen.plan import Sources, Work
from datagen.settings import Settings
from datagen.source_list import tell_stand_ins
from datagen.store import StoreError
from tron.cli.progress import Progress
from tron.cli.termination import termination_unwinds
from tron.errors import TronError

log = logging.getLogger(__name__)

TIMES_NAME = "times.jsonl"
"""File among the logs: a line a scene, as they are finished, with its seconds by stage and its worker."""

Made = TypeVar("Made")
Task = Callable[[Work, Settings, Sources], Made]
"""Function that makes something of one scene, in a worker; it can be pickled."""


@dataclass(frozen=True)
class Attempt(Generic[Made]):
    """Result of a task, or why there is none; its seconds by stage; the worker's name, as in its log.

    ``fatal`` is an error that every other scene would meet too, so that the run ends by it.
    """

    outcome: Made | Failure
    seconds: dict[str, float] = field(default_factory=dict)
    worker: str = ""
    fatal: StoreError | None = None


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

    Raises:
        TronError: the cluster does not start, its scheduler or its store is gone, or a time cannot be
            written.
    """
    failed: dict[str, Failure] = {}
    if items:
        tell_stand_ins(settings, sources)
    # Closed here, whatever ends the block: workers do not outlive it.
    with (
        termination_unwinds(),
        closing(attempts(task, items, settings, sources)) as made,
        Progress("scenes", sum(map(size, items)), unit=unit) as progress,
    ):
        for item, attempt in made:
            if attempt.fatal is not None:
                raise attempt.fatal
            if isinstance(attempt.outcome, Failure):
                failed[item.name] = attempt.outcome
                log.error("%s failed: %s", item.name, attempt.outcome.reason)
            _note(settings, item, attempt)
            progress.advance(size(item), item.name)
    return failed


def attempts(
    task: Task[Made], items: Sequence[Work], settings: Settings, sources: Sources
) -> Generator[tuple[Work, Attempt[Made]], None, None]:
    """Scenes as they are finished, in any order."""
    if not items:
        return
    patience = Patience(settings.scene_timeout)
    make = _one_by_one if settings.cluster is None else _by_workers
    for item, made in make(task, items, settings, sources, patience):
        if not isinstance(made.outcome, Failure):  # what fails at once says nothing of the others
            patience.saw(item.split, sum(made.seconds.values()))
        yield item, made


def _one_by_one(
    task: Task[Made], items: Sequence[Work], settings: Settings, sources: Sources, patience: Patience
) -> Iterator[tuple[Work, Attempt[Made]]]:
    for item in items:
        with _told(item, patience.limit(item.split)):
            made = try_it(task, settings, sources, item)
        yield item, made


def _by_workers(
    task: Task[Made], items: Sequence[Work], settings: Settings, sources: Sources, patience: Patience
) -> Iterator[tuple[Work, Attempt[Made]]]:
    with workers(settings, len(items)) as client:
        crew = Crew(client, settings, patience)
        work = partial(try_in_worker, task, settings, sources)
        for item, outcome in crew.outcomes(work, items, partial(_key, settings)):
            yield item, outcome if isinstance(outcome, Attempt) else Attempt(outcome)


def try_it(task: Task[Made], settings: Settings, sources: Sources, item: Work) -> Attempt[Made]:
    """Do a task; whatever goes wrong is an outcome: one scene's failure is not the run's."""
    fatal = None
    with clocked() as seconds:
        try:
            outcome = task(item, settings, sources)
        except StoreError as error:
            outcome, fatal = Failure.of(error), error
        except Exception as error:
            log.debug("scene %s", item.name, exc_info=True)
            outcome = Failure.of(error)
    return Attempt(outcome, seconds, fatal=fatal)


def try_in_worker(task: Task[Made], settings: Settings, sources: Sources, item: Work) -> Attempt[Made]:
    """The same in a worker, whose log tells of it."""
    from dask.distributed import get_worker

    log.info("%s begins", item.name)
    made = try_it(task, settings, sources, item)
    outcome = made.outcome
    if isinstance(outcome, Failure):
        log.error("%s failed: %s\n%s", item.name, outcome.reason, outcome.traceback)
    else:
        log.info("%s is made", item.name)
    return Attempt(outcome, made.seconds, str(get_worker().name), made.fatal)


@contextmanager
def _told(item: Work, limit: float) -> Iterator[None]:
    """A block that makes one scene in this process, which cannot kill itself: it says that it takes long."""
    text = "%s takes longer than scene_timeout=%.0f s; with cluster=local its worker would be replaced"
    timer = threading.Timer(limit, log.error, (text, item.name, limit))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _note(settings: Settings, item: Work, attempt: Attempt[Any]) -> None:
    """Add a scene's line to the file of times."""
    path = logs_folder(settings) / TIMES_NAME
    seconds = {stage: round(value, 4) for stage, value in attempt.seconds.items()}
    made = not isinstance(attempt.outcome, Failure)
    line = {
        "scene": item.name,
        "mode": settings.mode,
        "made": made,
        "worker": attempt.worker,
        "seconds": seconds,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        mend = "free some space, or choose another output_dir"
        raise TronError(f"cannot write: {error.strerror or error}", path, mend) from error


def _key(settings: Settings, item: Work, attempt: int) -> str:
    """A task's name on a scheduler that may serve several runs."""
    folder = hashlib.sha256(str(settings.output_dir.absolute()).encode()).hexdigest()[:16]
    return f"{item.name}-{attempt}-{folder}"
