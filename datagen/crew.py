"""The workers of a Dask cluster, each given scenes one at a time, timed, and replaced while the others go on.

Dask decides nothing here but how a task reaches a worker: a scene is submitted to a worker that has a free
thread, so it is known who makes it and since when. A worker that has made its share, or whose scene takes too
long, is replaced by its nanny, a process of its own that can kill it whatever it does.
"""

from __future__ import annotations

import logging
import threading
import time
from asyncio import CancelledError
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any

from datagen.clusters import CLOSE_SECONDS, describe_workers, logs_folder, ours
from datagen.failures import Failure
from datagen.patience import Patience
from datagen.plan import Work
from datagen.settings import Settings

log = logging.getLogger(__name__)

ATTEMPTS = 3
"""Workers that may die over a scene before it counts as failed: a job may end for reasons of its own."""
LOOK_SECONDS = 0.5
"""Longest time between two looks at the workers."""
STACK_SECONDS = 5.0
"""How long a hung worker is asked where it hangs; one that holds Python's lock cannot answer."""


@dataclass(frozen=True)
class _Turn:
    """A scene with the worker that makes it, since when (monotonic seconds), and Dask's future of it."""

    item: Work
    worker: str
    begun: float
    future: Any


class Crew:
    """Workers of a client and what they are doing.

    Args:
        client: of a scheduler that has a worker.
        settings: ``recycle_after`` and ``worker_timeout`` are used.
        patience: how long a scene may take; the caller lets it learn.
    """

    def __init__(self, client: Any, settings: Settings, patience: Patience) -> None:
        self._client, self._settings, self._patience = client, settings, patience
        self._waiting: deque[Work] = deque()
        self._turns: dict[str, _Turn] = {}  # by the future's key
        self._ended: SimpleQueue[str] = SimpleQueue()
        self._attempts: Counter[str] = Counter()
        self._made: Counter[str] = Counter()
        self._replacing: dict[str, threading.Thread] = {}
        self._given_up: set[str] = set()
        self._nannies: dict[str, bool] = {}

    def outcomes(
        self, task: Callable[[Work], Any], items: Sequence[Work], key: Callable[[Work, int], str]
    ) -> Iterator[tuple[Work, Any]]:
        """Scenes as they are finished, each with what ``task`` gave, or the Failure of the worker's end.

        Args:
            task: of a scene; it can be pickled.
            items: the scenes.
            key: name of a task on the scheduler, of a scene and the number of the attempt.
        """
        self._waiting.extend(items)
        busy_at = time.monotonic()
        while self._waiting or self._turns:
            free = self._free_threads()
            yield from self._lost()
            for worker, threads in free.items():
                for _ in range(min(threads, len(self._waiting))):
                    self._give(worker, task, self._waiting.popleft(), key)
            if self._turns or self._replacing:
                busy_at = time.monotonic()
            elif time.monotonic() - busy_at > self._settings.worker_timeout:
                yield from self._without_workers()
                return
            yield from self._done()
            yield from self._hung()
        for thread in self._replacing.values():  # a worker that is just starting ends badly
            thread.join(CLOSE_SECONDS)

    def _free_threads(self) -> dict[str, int]:
        """Threads of each worker that may be given a scene now."""
        for worker, thread in list(self._replacing.items()):
            if not thread.is_alive():
                del self._replacing[worker], self._made[worker]
        found = describe_workers(self._client)
        self._nannies = {worker: each["nanny"] is not None for worker, each in found.items()}
        busy = Counter(turn.worker for turn in self._turns.values())
        free = {}
        for worker, each in found.items():
            if worker in self._replacing or worker in self._given_up:
                continue
            if self._is_due(worker):
                if not busy[worker] and self._waiting:
                    self._replace(worker)
            else:
                free[worker] = max(each["nthreads"] - busy[worker], 0)
        return free

    def _is_due(self, worker: str) -> bool:
        return self._made[worker] >= self._settings.recycle_after and self._replaceable(worker)

    def _replaceable(self, worker: str) -> bool:
        """Whether the worker is this run's own, with a nanny that starts another in its place."""
        return ours(self._settings) and self._nannies.get(worker, False)

    def _give(
        self, worker: str, task: Callable[[Work], Any], item: Work, key: Callable[[Work, int], str]
    ) -> None:
        self._attempts[item.name] += 1
        future = self._client.submit(
            task, item, key=key(item, self._attempts[item.name]), pure=False, workers=[worker], retries=0
        )
        self._turns[future.key] = _Turn(item, worker, time.monotonic(), future)
        future.add_done_callback(lambda future: self._ended.put(future.key))

    def _done(self) -> Iterator[tuple[Work, Any]]:
        """Scenes that have ended; the first is waited for until the next look at the workers."""
        patience = LOOK_SECONDS
        while True:
            try:
                key = self._ended.get(timeout=patience) if patience else self._ended.get_nowait()
            except Empty:
                return
            patience = 0.0
            turn = self._turns.pop(key, None)
            if turn is None:  # given up, or lost with its worker
                continue
            error = turn.future.exception()
            outcome = Failure.of(error, "worker lost: ") if error else turn.future.result()
            turn.future.release()
            self._made[turn.worker] += 1
            yield turn.item, outcome

    def _lost(self) -> Iterator[tuple[Work, Failure]]:
        """Scenes whose worker is gone (killed for memory, crashed in native code, its job at an end).

        They wait again for another worker, until ATTEMPTS of them are gone.
        """
        for key, turn in list(self._turns.items()):
            if turn.worker in self._nannies:
                continue
            self._withdraw(key)
            name = turn.item.name
            if self._attempts[name] < ATTEMPTS:
                log.warning("%s: its worker is lost (%s), another makes it", name, turn.worker)
                self._waiting.appendleft(turn.item)
                continue
            logs = logs_folder(self._settings)
            reason = f"worker lost: {ATTEMPTS} workers ended while they made it"
            yield turn.item, Failure(reason, f"{reason}\nThe workers' logs may say why: {logs}\n")

    def _hung(self) -> Iterator[tuple[Work, Failure]]:
        """Scenes that take too long; their worker is replaced, and another run's worker gets no more."""
        for key, turn in list(self._turns.items()):
            limit = self._patience.limit(turn.item.split)
            if time.monotonic() - turn.begun <= limit:
                continue
            where = self._stack(turn)
            self._withdraw(key)
            reason = f"took longer than scene_timeout={limit:.0f} s on {turn.worker}"
            if self._replaceable(turn.worker):
                self._replace(turn.worker)
                self._again(turn.worker)
            else:
                reason += ", which is given no other scene"
                self._given_up.add(turn.worker)
            yield turn.item, Failure(reason, f"{reason}\n{where}\n")

    def _again(self, worker: str) -> None:
        """Withdraw what else a worker of several threads makes: it ends too, through no fault of its own."""
        for key, turn in list(self._turns.items()):
            if turn.worker == worker:
                self._withdraw(key)
                self._attempts[turn.item.name] -= 1
                self._waiting.appendleft(turn.item)

    def _withdraw(self, key: str) -> None:
        turn = self._turns.pop(key)
        self._client.cancel([turn.future], force=True)

    def _stack(self, turn: _Turn) -> str:
        """Stack of a worker that hangs, as Python prints it."""
        found: list[str] = []

        def ask() -> None:
            with suppress(Exception, CancelledError):  # its machine is gone, or this command ends
                for frames in self._client.call_stack([turn.future]).get(turn.worker, {}).values():
                    found.extend(frames)

        thread = threading.Thread(target=ask, daemon=True)
        thread.start()
        thread.join(STACK_SECONDS)
        return "".join(found) or "The worker does not say where it hangs."

    def _replace(self, worker: str) -> None:
        """Let a worker's nanny end its process and start another: Mitsuba's memory grows with every scene."""

        def restart() -> None:
            seconds = self._settings.worker_timeout
            try:
                back = self._client.restart_workers([worker], timeout=seconds, raise_for_error=False)
            except (Exception, CancelledError) as error:  # it ended by itself, or this command ends
                log.debug("worker %s is not restarted", worker, exc_info=error)
                return
            if back.get(worker) != "OK":
                log.warning("worker %s has not come back within %g s; the others go on", worker, seconds)

        thread = threading.Thread(target=restart, daemon=True)
        self._replacing[worker] = thread
        thread.start()

    def _without_workers(self) -> Iterator[tuple[Work, Failure]]:
        seconds = self._settings.worker_timeout
        reason = f"no worker was left, and none came within worker_timeout={seconds:g} s"
        while self._waiting:
            yield self._waiting.popleft(), Failure(reason, reason + "\n")
