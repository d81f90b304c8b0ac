"""Run a task for every scene, in this process or on the cluster, with progress, times and failures.

Dask distributes the scenes, restarts dead workers, and tries their scenes up to ATTEMPTS times. The worker
itself does two things that Dask cannot: a scene beyond its time limit ends the process by `faulthandler`,
which writes the stack; and after `recycle_after` scenes a worker returns its next one and restarts, because
Mitsuba's memory grows.
"""

from __future__ import annotations

import faulthandler
import hashlib
import json
import logging
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from datagen.clock import clocked
from datagen.dataset.records import Work
from datagen.files.sources import Sources, tell_stand_ins
from datagen.run.account import Failure
from datagen.run.clusters import ATTEMPTS, logs_folder, ours, workers
from datagen.run.cost import time_limit
from datagen.run.store import StoreError
from datagen.settings.command import Settings
from tron.cli.progress import Progress
from tron.errors import TronError
from tron.termination import termination_unwinds

log = logging.getLogger(__name__)

TIMES_NAME = "times.jsonl"
"""File among the logs: a line a scene, as they are finished, with its seconds by stage and its worker."""

Made = TypeVar("Made")
Task = Callable[[Work, Settings, Sources], Made]
"""Function that makes something of one scene, in a worker; it can be pickled."""

_made_here = 0
"""Scenes that this worker's process has made."""


@dataclass(frozen=True)
class Attempt(Generic[Made]):
    """Result or failure of a task, its seconds by stage, and the worker's name, as in its log.

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
    """Run a task for every scene with a progress display; return the failed scenes, by name.

    Args:
        task, items, settings, sources: the task, the scenes and what they are made with.
        size: weight of a scene in the estimate of the remaining time.
        unit: unit of the weights.

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
    """Yield scenes when they are finished, in any order."""
    if settings.cluster is None:
        for item in items:
            yield item, _attempt(task, settings, sources, item)
    elif items:
        yield from _by_workers(task, items, settings, sources)


def _by_workers(
    task: Task[Made], items: Sequence[Work], settings: Settings, sources: Sources
) -> Generator[tuple[Work, Attempt[Made]], None, None]:
    for item in items:
        _stack_file(settings, item).unlink(missing_ok=True)
    folder = hashlib.sha256(str(settings.output_dir.absolute()).encode()).hexdigest()[:16]
    with workers(settings, len(items)) as client:
        from dask.distributed import KilledWorker, as_completed

        work = partial(_in_worker, task, settings, sources)
        # One group of keys, of its own on a scheduler that may serve several runs: it waits at the scheduler.
        futures = client.map(work, items, key=[(f"scenes-{folder}", item.name) for item in items])
        waiting = {future.key: item for future, item in zip(futures, items)}
        done = as_completed(futures)
        del futures
        for future in done:
            item = waiting.pop(future.key)
            if future.cancelled():
                raise TronError("the scheduler is gone", mend="start this again: it goes on")
            error = future.exception()
            made = None if error else future.result()
            future.release()  # a worker that holds no result can end
            if error is None:
                assert made is not None
                yield item, made
            elif isinstance(error, KilledWorker) and not _stack_file(settings, item).exists():
                # It waited on workers that others have killed.
                again = client.submit(work, item, key=(f"scenes-{folder}-again", *future.key))
                waiting[again.key] = item
                done.add(again)
            elif isinstance(error, KilledWorker):
                reason = f"worker lost: {ATTEMPTS} workers ended while they made it"
                text = f"{reason}\nThe workers' logs may say why: {logs_folder(settings)}\n"
                yield item, Attempt(Failure(reason, text))
            else:
                yield item, Attempt(Failure.of(error, "worker lost: "))


def _attempt(task: Task[Made], settings: Settings, sources: Sources, item: Work) -> Attempt[Made]:
    """Run a task; return any error as an outcome, because one scene's failure must not end the run."""
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


def _in_worker(task: Task[Made], settings: Settings, sources: Sources, item: Work) -> Attempt[Made]:
    """Run a task in a worker, with its log, within the time limit of a scene."""
    from dask.distributed import Reschedule, Status, get_worker

    global _made_here
    worker = get_worker()
    if _made_here >= settings.recycle_after and ours(settings) and worker.nanny:
        while worker.data:  # a result that nobody has fetched would be lost, and made again
            time.sleep(0.02)
        worker.loop.add_callback(worker.close_gracefully, restart=True)
        while worker.status == Status.running:
            time.sleep(0.02)
        raise Reschedule
    seconds = time_limit(item, settings)
    stack = _stack_file(settings, item)
    if stack.is_file() and (where := stack.read_text("utf-8")):
        reason = f"took longer than scene_timeout={seconds:.0f} s"
        return Attempt(Failure(reason, f"{reason}\n{where}"), worker=str(worker.name))
    log.info("%s begins", item.name)
    with _limited(stack, seconds, end=worker.nanny is not None):
        made = _attempt(task, settings, sources, item)
    _made_here += 1
    if isinstance(made.outcome, Failure):
        log.error("%s failed: %s\n%s", item.name, made.outcome.reason, made.outcome.traceback)
    else:
        log.info("%s is made", item.name)
    return Attempt(made.outcome, made.seconds, str(worker.name), made.fatal)


@contextmanager
def _limited(stack: Path, seconds: float, end: bool) -> Iterator[None]:
    """Write the stack if the block exceeds its limit; optionally end this process, for its nanny to restart.

    `faulthandler` does so from a thread of its own, even where native code holds Python's lock.
    """
    stack.parent.mkdir(parents=True, exist_ok=True)
    with stack.open("w", encoding="utf-8") as file:
        faulthandler.dump_traceback_later(seconds, exit=end, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
    stack.unlink(missing_ok=True)


def _stack_file(settings: Settings, item: Work) -> Path:
    """Return the file that exists while a worker makes a scene, and has the stack if it hung."""
    return logs_folder(settings) / f"{item.name}.stack"


def _note(settings: Settings, item: Work, attempt: Attempt[Any]) -> None:
    """Add a scene's line to the file of times."""
    path = logs_folder(settings) / TIMES_NAME
    line = {
        "scene": item.name,
        "mode": settings.mode,
        "made": not isinstance(attempt.outcome, Failure),
        "worker": attempt.worker,
        "seconds": {stage: round(value, 4) for stage, value in attempt.seconds.items()},
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        mend = "free some space, or choose another output_dir"
        raise TronError(f"cannot write: {error.strerror or error}", path, mend) from error
