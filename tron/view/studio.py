"""The wished state of a view, and the one thread that renders it: the only thread that uses Dr.Jit.

Callers on any thread set the wish (:meth:`Studio.wish`, :meth:`Studio.look`). The thread compares it with its
own state and does the next piece of work towards it:

    while input arrives   light baked at surfels with few rays, no shadow rays per pixel; at a lower
                          resolution if that is slow
    at rest               the same with all rays, at full resolution
    then                  four passes of 16 shadow rays per pixel, each on its own sub-pixel, averaged
    at last               the remaining noise is removed (:mod:`tron.view.finishing`)

A pass is cancelled, between two bands of the picture, as soon as its wish is out of date. Pictures at rest
are delivered only while they match the current wish. The last of them does not depend on earlier wishes, to
the bit with one thread of Dr.Jit.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.runtime import activate
from tron.shading.environments.environment import EnvironmentMap
from tron.view.finishing import Finish
from tron.view.stage import SUB_PIXELS, Part, Stage, Wish, bands

log = logging.getLogger(__name__)
T = TypeVar("T")
Opener = Callable[[], tuple[GaussianScene, Mapping[str, Any] | None]]
"""Gives a scene, and what a stage is told of it."""

REST_SECONDS = 0.25
"""Seconds after the last input from which the view is at rest: a dragging hand sends 20 inputs a second."""
MOVING_SECONDS = 0.11
"""Longest time of a picture while input arrives; beyond it, the next ones get a lower resolution."""
SMALLEST = 0.3
"""Lowest such resolution, as a share of the full one."""
WORKING = "working"
"""Status of a wish before more is known."""
PASSED = 2 + len(SUB_PIXELS)
"""Level of a view after all passes: 0 of nothing, 1 of a rough picture, 2 of one at rest, then one a pass."""


_ONE_AT_A_TIME = threading.Lock()
"""Held by the studio of a process that works. Dr.Jit 1.5 asks Python for the fields of arguments while it
holds its own lock; a second thread that computes meanwhile has Python's and waits for that one, for ever."""


@dataclass(frozen=True)
class Picture:
    """A rendered picture of a view.

    Attributes:
        image: (H, W, 3) uint8.
        wish: that it is of.
        camera: likewise, up is +z; its size is that of the view, the image's may be smaller.
        refined: 0 while something moves, above 0 at rest, 1 when nothing is left to do.
        seconds: that its last piece took.
    """

    image: np.ndarray
    wish: Wish
    camera: Camera
    refined: float
    seconds: float


@dataclass
class _View:
    camera: Camera
    level: int = 0
    scale: float = 0.5
    drawn: float = 0.0
    passes: list[dict[str, np.ndarray]] = field(default_factory=list, repr=False)  # sums, those of each part


class _Outdated(Exception):
    """What was under way is of a wish that is past."""


class Studio:
    """A scene to be looked at and changed; closed by :meth:`close`, or as a context.

    Args:
        scene: valid, in the frame of its file.
        lights: lights by name, or the files that hold them.
        home: camera that exposure is metered in, in the frame where up is +z.
        show: called with the number of a view and its next picture, on the studio's thread.
        notice: called with a line for the user where a wish cannot be fulfilled: it is taken back.
        finish: of pictures of lit, by their width and height; None: none at all, or none of that size.
        busy: called with what is worked on, and the share of it that is done, as long as no picture of the
            wish of the moment is there; on any thread.
        light: name of the first one; None: the first of them.
        seed: root of all random numbers.
        variant: of Mitsuba.
        threads: of Dr.Jit; None: as it is.
        about: the scene, as of :class:`tron.view.stage.Stage`.
    """

    def __init__(
        self,
        scene: GaussianScene,
        lights: Mapping[str, EnvironmentMap | Path],
        home: Camera,
        show: Callable[[int, Picture], None],
        notice: Callable[[str], None] = log.warning,
        *,
        finish: Callable[[int, int], Finish | None] = lambda *_: None,
        busy: Callable[[str, float], None] = lambda *_: None,
        light: str | None = None,
        seed: int = 0,
        variant: str = "llvm_ad_rgb",
        threads: int | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        if not lights:
            raise TronError("there is no light", mend="give one at least")
        self._make: Callable[..., Stage] = lambda scene, about: Stage(
            scene, lights, home, seed, self._watch, busy, about
        )
        self._first = scene, about
        self._of: Opener | None = None  # what is to be opened instead
        self._machine = variant, threads
        self._show, self._notice, self._finish, self._busy = show, notice, finish, busy
        self._changed = threading.Condition()
        self._wish, self._done = Wish(next(iter(lights)) if light is None else light), None
        self._wishes = 0  # that there have been
        self._bringing: int | None = None  # the one that the stage is brought to
        self._refused: Wish | None = None
        self._views: dict[int, _View] = {}
        self._asked: deque[tuple[int, Callable[[Stage], Any], Future[Any]]] = deque()
        self._closing, self._version, self._began = False, 0, 0
        self._moved = -np.inf
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)
        self._thread.start()

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def wished(self) -> Wish:
        """The current wish."""
        with self._changed:
            return self._wish

    def wish(self, **changes: Any) -> Wish:
        """Change what is to be seen: attributes of :class:`Wish`. Returns the wish."""
        with self._changed:
            return self._want(replace(self._wish, **changes))

    def change(self, of: Callable[[Wish], Wish]) -> Wish:
        """Change the wish by a function of the old one, atomically."""
        with self._changed:
            return self._want(of(self._wish))

    def look(self, view: int, camera: Camera | None) -> None:
        """Set a view's camera, +z up; None: the view is closed."""
        with self._changed:
            if camera is None:
                self._views.pop(view, None)
                return
            known = self._views.get(view)
            scale, drawn = (known.scale, known.drawn) if known else (0.5, 0.0)
            self._views[view] = _View(camera, scale=scale, drawn=drawn)
            self._moved = time.perf_counter()
            self._version += 1
            if self._refused == self._done:  # it is the view that could not be drawn
                self._refused = None
            self._changed.notify()

    def ask(self, question: Callable[[Stage], T]) -> Future[T]:
        """Let the studio's thread answer a question between two pieces of work, once the wish is met.

        It may take as long as that wish. If the wish cannot be met, the question is not answered.
        """
        answer: Future[T] = Future()
        with self._changed:
            if self._closing:
                answer.cancel()
            else:
                self._asked.append((self._wishes, question, answer))
                self._version += 1  # a pass that is under way is given up; it waits for its wish to be done
                self._changed.notify()
        return answer

    def reopen(self, of: Opener) -> None:
        """Switch to another scene with as many surfels; wishes, including edits, are applied to it.

        Args:
            of: called on the studio's thread. If it fails, a notice is given and the old scene stays.
        """
        with self._changed:
            self._of, self._refused = of, None
            self._version += 1
            self._wishes += 1
            # New ones: what is being drawn of the scene before is of none of them.
            self._views = {n: _View(v.camera, scale=v.scale, drawn=v.drawn) for n, v in self._views.items()}
            self._changed.notify()

    def close(self) -> None:
        """End the thread and cancel its work. Safe to repeat."""
        with self._changed:
            self._closing = True
            self._version += 1
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _want(self, wish: Wish) -> Wish:
        if wish == self._wish:
            return wish
        self._wish, self._moved = wish, time.perf_counter()
        self._version += 1
        self._wishes += 1
        self._refused = None
        for view in self._views.values():
            view.level = 0
        self._busy(WORKING, 0.0)
        self._changed.notify()
        return wish

    def _run(self) -> None:
        stage: Stage | None = None
        while True:
            with self._changed:
                self._wait()
                if self._closing:
                    for *_, answer in self._asked:
                        answer.cancel()
                    return
                self._began, wish, number = self._version, self._wish, self._wishes
                of = self._of
                rough = time.perf_counter() - self._moved < REST_SECONDS
            try:
                with _ONE_AT_A_TIME:
                    if stage is None:
                        activate(*self._machine)
                        stage = self._make(*self._first)
                    if of is not None:
                        stage = self._other(of, stage)
                    self._work(stage, wish, number, rough)
            except _Outdated:
                pass
            except Exception as error:
                if not isinstance(error, TronError):
                    log.exception("drawing failed")
                self._refuse(wish, number, str(error) or type(error).__name__)

    def _other(self, of: Opener, stage: Stage) -> Stage:
        """A stage of another scene; if it cannot be opened, notify and keep the old one."""
        try:
            return self._make(*of())
        except Exception as error:
            if not isinstance(error, TronError):
                log.exception("opening a scene failed")
            self._notice(str(error) or type(error).__name__)
            return stage
        finally:
            with self._changed:
                if self._of is of:  # another may have come meanwhile
                    self._of = None

    def _wait(self) -> None:
        """Wait for work; holds the lock."""
        while not self._closing and not self._asked:
            left = self._moved + REST_SECONDS - time.perf_counter()
            levels = [
                view.level for view in self._views.values() if view.level < self._last(view, self._wish)
            ]
            if self._wish == self._refused or not levels:
                self._changed.wait()
            elif min(levels) > 0 and left > 0:
                self._changed.wait(left)
            else:
                return

    def _work(self, stage: Stage, wish: Wish, number: int, rough: bool) -> None:
        """The next piece of work: questions first, then a picture for the least refined view."""
        if wish != self._refused:
            self._bringing = number
            try:
                stage.bring(wish, rough)
            finally:
                self._bringing = None
            self._done = wish
        with self._changed:
            asked = self._taken(number)
            views = self._views.items()
            open_ones = [(v.level, v.drawn, view) for view, v in views if v.level < self._last(v, wish)]
        for question, answer in asked:
            try:
                answer.set_result(question(stage))
            except Exception as error:
                answer.set_exception(error)
        if not open_ones or wish == self._refused:
            return
        level, _, view = min(open_ones)
        if level == 0 or not rough:
            self._draw(stage, wish, view, rough)

    def _taken(self, number: int) -> list[tuple[Callable[[Stage], Any], Future[Any]]]:
        """The questions of a wish and of those before it: others wait for their own. Holds the lock."""
        taken = [(question, answer) for asked, question, answer in self._asked if asked <= number]
        self._asked = deque(each for each in self._asked if each[0] > number)
        return taken

    def _draw(self, stage: Stage, wish: Wish, number: int, rough: bool) -> None:
        with self._changed:
            view = self._views.get(number)
            if view is None:
                return
            level, camera, scale = view.level, view.camera, view.scale
        began = time.perf_counter()
        if rough or level < 2:
            seen = camera
            if rough:
                size = (max(16, round(scale * side)) for side in (camera.width, camera.height))
                seen = camera.resized(*size)
            parts = stage.parts(wish, seen)
            images = [stage.linear(part, part.camera, rough=rough)[part.buffer] for part in parts]
            view.passes = []
            reached = 1 if rough else 2
        elif level < PASSED:
            parts = stage.parts(wish, camera)
            found = [self._pass(stage, part, level - 2) for part in parts]
            for sums, one in zip(view.passes, found):
                for name in one:
                    one[name] += sums[name]
            view.passes = found
            images = [one[part.buffer] / np.float32(level - 1) for one, part in zip(found, parts)]
            reached = level + 1
        else:
            parts = stage.parts(wish, camera)
            images = [self._finished(stage, *each) for each in zip(parts, view.passes)]
            reached = level + 1
        shown = beside([stage.display(wish, *each) for each in zip(parts, images)])
        seconds = time.perf_counter() - began
        refined = 0.0 if rough else min((reached - 1) / (self._last(view, wish) - 1), 1.0)
        picture = Picture(shown, wish, camera, refined, seconds)
        with self._changed:
            still = self._views.get(number) is view and self._wish == wish and not self._closing
            if not (rough or still):
                raise _Outdated
            now = self._views.get(number)
            if now is not None:
                now.drawn = time.perf_counter()
                if rough:
                    factor = np.clip((MOVING_SECONDS / max(seconds, 1e-3)) ** 0.5, 0.8, 1.15)
                    now.scale = float(np.clip(scale * factor, SMALLEST, 1.0))
            if still:
                view.level = reached
        if now is not None:
            self._show(number, picture)

    def _pass(self, stage: Stage, part: Part, number: int) -> dict[str, np.ndarray]:
        """One pass over a part of a picture, given up between two bands once it is out of date."""
        finish = self._finish_of(part)
        more = () if finish is None else finish.buffers
        found = []
        for band, window in enumerate(bands(part.camera)):
            self._watch()
            found.append(stage.linear(part, window, number, band, more=more))
        return {name: np.concatenate([each[name] for each in found]) for name in found[0]}

    def _finished(self, stage: Stage, part: Part, sums: dict[str, np.ndarray]) -> np.ndarray:
        """A part after all passes, denoised if a finish is available."""
        means = {name: each / np.float32(PASSED - 2) for name, each in sums.items()}
        finish = self._finish_of(part)
        if finish is None:
            return means[part.buffer]
        try:
            return stage.finished(part, means, finish)
        except _Outdated:
            raise
        except Exception as error:  # of libraries that are there, but do not run here
            log.warning("pictures stay as their passes leave them: %s", error)
            self._finish = lambda *_: None
            return means[part.buffer]

    def _finish_of(self, part: Part) -> Finish | None:
        return self._finish(part.camera.width, part.camera.height) if part.buffer == "lit" else None

    def _last(self, view: _View, wish: Wish) -> int:
        """Level of a finished view."""
        if wish.quality == "preview":
            return 2
        finish = self._finish(view.camera.width, view.camera.height) if wish.buffer == "lit" else None
        return PASSED + (finish is not None)

    def _watch(self) -> None:
        """Raise _Outdated where a wish has come since the piece of work began; or a view, or a question.

        What is made for a wish, such as a proxy, is for all views and questions, and goes on.
        """
        with self._changed:
            brought = self._bringing
            old = self._version != self._began if brought is None else self._wishes != brought
            if old or self._closing:
                raise _Outdated

    def _refuse(self, wish: Wish, number: int, why: str) -> None:
        """Return to the last wish that could be met, and notify."""
        with self._changed:
            if self._wish == wish and self._done is not None and self._done != wish:
                self._want(self._done)
            else:
                self._refused = wish
            asked = self._taken(number)
        for _, answer in asked:
            answer.set_exception(TronError(why))
        self._notice(why)


def beside(parts: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W, 3) uint8 of parts from left to right, a white line between two."""
    whole, column = np.concatenate(parts, axis=1), parts[0].shape[1]
    if len(parts) > 1:
        whole[:, max(column - 1, 0) : column + 1] = 255
    return whole
