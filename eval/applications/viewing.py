"""Frames per second of the viewer's studio, without a browser, under simulated user input.

Simulated inputs arrive at 40 Hz. Frames are the pictures that the studio returns while something moves; they
may be smaller than the window, and their size is reported. CPU time is summed over all threads of the
process, so it holds on a machine with other load too.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import numpy as np

from eval.applications.worlds import GROUND, World, draw_world, view_of
from eval.report.outcome import Outcome
from eval.results import Row
from tron.cameras import Camera
from tron.editing import Material, Move, Selection
from tron.errors import TronError
from tron.seeds import generator, integer
from tron.trajectories import turn_cameras
from tron.view.stage import Stage
from tron.view.studio import Picture, Studio

T = TypeVar("T")
SURFELS = 50_000
SIZE, LARGE = (512, 288), (1024, 576)
"""Width and height of the window, and of the one whose refinement is interrupted."""
HERTZ = 40.0
"""Inputs a second."""
SECONDS = 6.0
"""Of each kind of input, after a few that do not count."""
FIRST_SECONDS = 3.0
"""In which kernels of a kind of input are compiled."""
COUNTED = 100
"""Frames of each kind whose kernels are looked at, or as many as half a minute gives."""
INTERRUPTS = 10
PATIENCE = 300.0
KINDS = ("camera", "light", "material", "object")


class Gallery:
    """Pictures from the studio, with their times and views."""

    def __init__(self) -> None:
        self.pictures: list[tuple[float, int, Picture]] = []
        self._came = threading.Condition()

    def show(self, view: int, picture: Picture) -> None:
        """Keep a picture; called by the studio."""
        with self._came:
            self.pictures.append((time.perf_counter(), view, picture))
            self._came.notify_all()

    def clear(self) -> None:
        """Forget all pictures."""
        with self._came:
            self.pictures.clear()

    def until(self, holds: Callable[[float, int, Picture], bool]) -> float:
        """Wait for a picture that meets a condition; return its time.

        Raises:
            TronError: none did within PATIENCE seconds.
        """

        def found() -> float | None:
            return next((each[0] for each in self.pictures if holds(*each)), None)

        with self._came:
            if not self._came.wait_for(lambda: found() is not None, PATIENCE):
                raise TronError(f"the studio showed no such picture in {PATIENCE:.0f} s")
            when = found()
        assert when is not None
        return when

    def rough(self, view: int = 0) -> list[Picture]:
        """Return the pictures of a view that were drawn while something moved."""
        with self._came:
            return [picture for _, of, picture in self.pictures if of == view and picture.refined == 0]


@dataclass(frozen=True)
class Hand:
    """Simulated user input, one kind after another.

    Attributes:
        studio: receiver of the inputs. world: world on show. home: start camera.
    """

    studio: Studio
    world: World
    home: Camera

    def move(self, kind: str, step: int) -> None:
        """Send input number ``step`` of a kind; every step differs."""
        thing = Selection(object=GROUND + 1)
        match kind:
            case "camera":
                self.studio.look(0, turned(self.home, 0.7 * step))
            case "light":
                self.studio.wish(turn=float(step % 360))
            case "material":
                roughness = 0.1 + 0.8 * (step % 401) / 401
                self.studio.wish(edits=(Material(select=thing, roughness=roughness),))
            case "object":
                by = (0.002 * (step % 200) + 0.001, 0.0, 0.0)
                self.studio.wish(edits=(Move(select=thing, by=by),))

    def play(self, kind: str, first: int, goes_on: Callable[[float], bool]) -> tuple[int, float]:
        """Send inputs at HERTZ while ``goes_on(seconds)``; return the next step's number, and the seconds."""
        began, step = time.perf_counter(), first
        while goes_on(time.perf_counter() - began):
            self.move(kind, step)
            step += 1
            time.sleep(1 / HERTZ)
        return step, time.perf_counter() - began


def turned(camera: Camera, degrees: float) -> Camera:
    """Return the camera turned about the world's up."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    return turn_cameras([camera], np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))[0]


def measure_viewer(seed: int, outcome: Outcome, threads: int | None) -> None:
    """Measure all figures of the studio, some two minutes.

    Args:
        seed: seed of the world and of all rays.
        outcome: receives the rows.
        threads: threads of Dr.Jit; None: unchanged.
    """
    world = draw_world(seed, "viewer", 0, "sun", things=4)
    home = view_of(generator(seed, "applications", "viewer", "camera"), *SIZE)
    gallery, scene = Gallery(), world.surfels(SURFELS)
    with Studio(
        scene, {"sun": world.light}, home, gallery.show, seed=integer(seed, "viewer"), threads=threads
    ) as studio:
        hand = Hand(studio, world, home)
        studio.look(0, home)
        _at_rest(studio, gallery)
        for kind in KINDS:
            outcome.add(_frames(hand, gallery, kind))
        outcome.add(_kernels(hand, gallery))
        outcome.add(_two_clients(hand, gallery))
        outcome.add(_interrupts(hand, gallery))
    outcome.add([Row(metric="viewer.surfels", value=len(scene), unit="surfels", n=1)])


def _frames(hand: Hand, gallery: Gallery, kind: str) -> Iterator[Row]:
    """Measure frames per second under one kind of input, their CPU time and their width."""
    step, _ = hand.play(kind, 1, lambda since: since < 2)
    gallery.clear()
    spent = time.process_time()
    _, seconds = hand.play(kind, step, lambda since: since < SECONDS)
    spent, drawn = time.process_time() - spent, gallery.rough()
    count = max(len(drawn), 1)
    yield Row(metric=f"viewer.fps.{kind}", value=len(drawn) / seconds, unit="frames/s", n=count)
    yield Row(metric=f"viewer.processor_ms.{kind}", value=1e3 * spent / count, unit="ms", n=count)
    width = float(np.median([picture.image.shape[1] for picture in drawn])) if drawn else 0.0
    yield Row(metric=f"viewer.width.{kind}", value=width, unit="pixels", n=count)
    _at_rest(hand.studio, gallery)


def _kernels(hand: Hand, gallery: Gallery) -> Iterator[Row]:
    """Count kernels that COUNTED frames of each kind launch and that no first frame of any kind launched.

    A fresh machine compiles these. Dr.Jit's own ``cache_hit`` is true as well for what another run left on
    this one's disk.
    """
    known, compiled, frames = set[str](), 0, 0
    for kind in KINDS:
        with _kernel_history(hand.studio) as launched:
            step, _ = hand.play(kind, 1, lambda since: since < FIRST_SECONDS)
            _at_rest(hand.studio, gallery)
            known |= launched()
            hand.play(kind, step, lambda since: since < 30 and len(gallery.rough()) < COUNTED)
            new, count = launched() - known, len(gallery.rough())
        yield Row(metric=f"viewer.kernels_compiled.{kind}", value=len(new), unit="kernels", n=max(count, 1))
        compiled, frames, known = compiled + len(new), frames + count, known | new
        _at_rest(hand.studio, gallery)
    yield Row(metric="viewer.kernels_compiled", value=compiled, unit="kernels", n=max(frames, 1))


@contextmanager
def _kernel_history(studio: Studio) -> Iterator[Callable[[], set[str]]]:
    """Yield a call that returns the kernels that the studio launched in the block."""

    def launched() -> set[str]:
        history = _asked(studio, lambda _: dr.kernel_history([dr.KernelType.JIT]))
        return {str(each["hash"]) for each in history}

    _asked(studio, lambda _: dr.set_flag(dr.JitFlag.KernelHistory, True))
    try:
        yield launched
    finally:
        _asked(studio, lambda _: dr.set_flag(dr.JitFlag.KernelHistory, False))
        _asked(studio, lambda _: dr.kernel_history_clear())


def _two_clients(hand: Hand, gallery: Gallery) -> Iterator[Row]:
    """Yield a row: frame count of the slower of two turning views over the faster view's."""
    cameras = hand.home, turned(hand.home, 150)
    for view, camera in enumerate(cameras):
        hand.studio.look(view, camera)
    began, step = time.perf_counter(), 1
    gallery.clear()
    while time.perf_counter() - began < SECONDS:
        for view, camera in enumerate(cameras):
            hand.studio.look(view, turned(camera, 0.7 * step))
        step += 1
        time.sleep(1 / HERTZ)
    counts = [len(gallery.rough(view)) for view in range(2)]
    hand.studio.look(1, None)
    yield Row(
        metric="viewer.slower_client", value=min(counts) / max(*counts, 1), unit="x", n=max(sum(counts), 1)
    )


def _interrupts(hand: Hand, gallery: Gallery) -> Iterator[Row]:
    """Measure milliseconds from an input during a pass of a large frame to its first picture."""
    large, found = hand.home.resized(*LARGE), []
    hand.studio.look(0, large)
    for number in range(INTERRUPTS):
        gallery.clear()
        gallery.until(lambda *each: each[2].refined > 0.3)
        time.sleep(0.3)  # into the pass that follows
        camera = turned(large, number + 1.0)
        asked = time.perf_counter()
        hand.studio.look(0, camera)
        came = gallery.until(lambda *each, camera=camera: each[2].camera is camera)
        found.append(1e3 * (came - asked))
    yield Row(metric="viewer.interrupt_ms", value=float(np.median(found)), unit="ms", n=len(found))
    yield Row(metric="viewer.interrupt_ms_most", value=max(found), unit="ms", n=len(found))


def _at_rest(studio: Studio, gallery: Gallery) -> None:
    """Wait for the last picture of the current request."""
    wish = studio.wished
    gallery.until(lambda *each: each[2].refined == 1 and each[2].wish == wish)
    gallery.clear()


def _asked(studio: Studio, question: Callable[[Stage], T]) -> T:
    return studio.ask(question).result(PATIENCE)
