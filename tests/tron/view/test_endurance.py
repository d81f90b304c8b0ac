"""Random wishes, edits and views: what they end with, and what the process grows by in as long as is told.

python -m tests.tron.view.test_endurance 1800
"""

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.stage import BALL, FLOOR, RING, make_scene
from tron.cameras import Camera
from tron.editing import Clicks, Duplicate, Edit, Insert, Material, Move, Remove, Selection, Separate
from tron.gaussians.scene import GaussianScene
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.view.finishing import Finish
from tron.view.stage import BUFFERS, Left, Wish
from tron.view.studio import PASSED, REST_SECONDS, Picture, Studio

OBJECTS = (FLOOR, BALL, RING)
SETTLING = 0.25
"""Share of the time before growth counts: caches fill, kernels are compiled."""


LEFT_ALONE = 20
"""One wish of so many is left to become final and is compared with a fresh start."""
HANDED = 0.5
"""Seconds that a picture may take from the studio's last look at the wish to here, on a busy machine."""


@dataclass
class Endured:
    """What came of it.

    Attributes:
        wishes: that were made.
        pictures: that were shown, and how many of them were final.
        finals: likewise.
        stale: pictures at rest that were of a wish that was past when they were shown.
        notices: of wishes that could not be.
        samples: (n, 2) seconds and resident megabytes.
    """

    wishes: int
    pictures: int
    finals: int
    stale: int
    notices: int
    samples: np.ndarray

    @property
    def growth(self) -> float:
        """Megabytes: the most of the last quarter over the most before growth counts."""
        seconds, resident = self.samples.T
        whole = seconds[-1]
        early, late = resident[seconds <= SETTLING * whole], resident[seconds >= 0.75 * whole]
        return float(late.max() - early.max())


def resident() -> float:
    """Megabytes of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def random_edit(rng: np.random.Generator, model: Path) -> Edit:
    """Some of these fail: objects may be gone, or there already."""
    which = Selection(object=OBJECTS[rng.integers(3)])
    x, y, z = (float(value) for value in rng.uniform(-0.4, 0.4, 3))
    number, other = (int(each) for each in rng.choice(200, 2, replace=False))
    clicks = Selection(clicks=Clicks(inside=(number,), outside=(other,)))
    return [
        Material(select=which, roughness=float(rng.uniform()), base_color=(abs(x), abs(y), abs(z))),
        Move(select=which, by=(x, y, z), turn=float(rng.uniform(0, 360))),
        Duplicate(select=which, by=(x, y, 1.0)),
        Remove(select=which),
        Insert(file=model, at=(x, y, 2.0), scale=0.3),
        Separate(select=clicks),
    ][rng.integers(6)]


def random_wish(rng: np.random.Generator, wish: Wish, model: Path) -> dict[str, object]:
    """Attributes of a wish that a hand would change next."""
    edits = (*wish.edits[-5:], random_edit(rng, model)) if rng.integers(3) else wish.edits[:-1]
    lefts: tuple[Left, ...] = ("nothing", "nothing", "before", "capture", "light")
    number, other = (int(each) for each in rng.choice(200, 2, replace=False))
    return [
        {"light": ["east", "west"][rng.integers(2)]},
        {"turn": float(rng.uniform(0, 360))},
        {"stops": float(rng.uniform(-2, 2))},
        {"buffer": BUFFERS[rng.integers(len(BUFFERS))] if rng.integers(2) else "lit"},
        {"edits": edits, "marked": None},
        {"hidden": frozenset([OBJECTS[rng.integers(3)]] if rng.integers(2) else [])},
        {"left": lefts[rng.integers(5)], "left_light": "west", "divider": float(rng.uniform())},
        {"marked": Clicks(inside=(number,), outside=(other,)) if rng.integers(2) else None},
    ][rng.integers(8)]


def endure(
    seconds: float,
    seed: int,
    folder: Path,
    scene: GaussianScene,
    finish: Finish | None = None,
    variant: str = "llvm_ad_rgb",
) -> Endured:
    """Wish at random, mostly in haste, sometimes with a rest in which pictures become final."""
    rng, model = generator(seed, "endurance"), folder / "model.ply"
    make_scene(0.3).save(model)
    skies = np.full((2, 16, 32, 3), 0.3, np.float32)
    skies[0, 4:6, 8:11] = skies[1, 4:6, 24:27] = (30, 25, 20)
    lights = {"east": EnvironmentMap(skies[0]), "west": EnvironmentMap(skies[1])}
    home = Camera.around(scene, azimuth_deg=30, width=96, height=72)
    past: deque[tuple[float, Wish]] = deque(maxlen=50)
    lock, seen = threading.Lock(), {"pictures": 0, "finals": 0, "stale": 0, "notices": 0}

    def show(_: int, picture: Picture) -> None:
        with lock:
            seen["pictures"] += 1
            seen["finals"] += picture.refined == 1
            if picture.refined > 0 and picture.wish != studio.wished:
                when = max((at for at, wish in past if wish == picture.wish), default=-np.inf)
                seen["stale"] += time.monotonic() - when > HANDED

    def notice(_: str) -> None:
        with lock:
            seen["notices"] += 1

    samples, wishes, began = [], 0, time.monotonic()
    with Studio(
        scene, lights, home, show, notice, finish=lambda *_: finish, seed=seed, variant=variant
    ) as studio:
        while (now := time.monotonic() - began) < seconds:
            samples.append((now, resident()))
            for _ in range(rng.integers(1, 12)):
                if rng.integers(2):
                    side = int(rng.integers(48, 128))
                    view = Camera.around(scene, azimuth_deg=float(rng.uniform(0, 360)), width=side, height=72)
                    studio.look(int(rng.integers(3)), view if rng.integers(8) else None)
                else:
                    change = random_wish(rng, studio.wished, model)
                    past.append((time.monotonic(), studio.wished))
                    studio.wish(**change)
                    wishes += 1
                time.sleep(float(rng.uniform(0, 0.1)))
            time.sleep(float(rng.uniform(0, 3)) if rng.integers(4) == 0 else 0.0)
        samples.append((time.monotonic() - began, resident()))
    return Endured(wishes=wishes, samples=np.array(samples), **seen)


def final_of(studio: Studio, shown: Any) -> Picture:
    """The last picture of whatever the studio comes to rest at: wishes that cannot be are taken back."""
    shown.until(lambda: shown.pictures and shown.pictures[-1].refined == 1 and at_rest(studio, shown))
    return shown.pictures[-1]


def at_rest(studio: Studio, shown: Any) -> bool:
    """Whether the last picture is of the wish and of the view of the moment."""
    with studio._changed:
        view, last = studio._views[0], shown.pictures[-1]
        return (view.camera, studio._wish) == (last.camera, last.wish) and view.level >= PASSED


def unlike_fresh(
    count: int, seed: int, folder: Path, scene: GaussianScene, open_studio: Callable[..., Any]
) -> tuple[list[Wish], int]:
    """Wishes whose final picture, after all that came before, is another than a fresh studio's to the bit.

    Returns:
        Those wishes, and how many pictures were compared: of one wish in :data:`LEFT_ALONE`. Of the others
        some are past before anything is drawn of them, some amid a rough picture, some at rest.
    """
    rng, model = generator(seed, "fresh"), folder / "model.ply"
    make_scene(0.4).save(model)
    unlike, compared = list[Wish](), 0
    cameras = [Camera.around(scene, azimuth_deg=30 + 100 * k, width=48, height=36) for k in range(3)]
    with open_studio(threads=1) as (studio, shown):
        studio.look(0, cameras[0])
        for number in range(count):
            if not rng.integers(4):
                studio.look(0, cameras[rng.integers(3)])
            studio.wish(**random_wish(rng, studio.wished, model))
            if (number + 1) % LEFT_ALONE:
                time.sleep(float(rng.choice([0, rng.uniform(0, 0.2), rng.uniform(0, 2 * REST_SECONDS)])))
                continue
            used = final_of(studio, shown)
            shown.pictures[:-1] = []
            with open_studio(threads=1) as (fresh, other):
                fresh.change(lambda _, wish=used.wish: wish)
                fresh.look(0, used.camera)
                expected = final_of(fresh, other)
            compared += 1
            if expected.wish != used.wish or not np.array_equal(expected.image, used.image):
                unlike.append(used.wish)
    return unlike, compared


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_after_200_random_wishes_the_final_picture_is_that_of_a_fresh_start(
    scene, tmp_path, open_studio, seed
):
    unlike, compared = unlike_fresh(200, seed, tmp_path, scene, open_studio)
    assert compared == 10
    assert not unlike


@pytest.mark.long
def test_a_minute_of_random_input_leaves_memory_as_it_was(variant, scene, tmp_path):
    found = endure(60, 3, tmp_path, scene, variant=variant)
    assert found.wishes > 50
    assert found.finals > 0
    assert found.notices > 0, "some wishes cannot be"
    assert found.stale == 0
    assert found.growth < 100


if __name__ == "__main__":
    from tempfile import TemporaryDirectory

    from tron.view.opening import finish_of

    with TemporaryDirectory() as made:
        chosen = finish_of(2)(96, 72)
        found = endure(float(sys.argv[1]), 7, Path(made), make_scene(0.06), chosen)
    for at, megabytes in found.samples[:: max(1, len(found.samples) // 30)]:
        print(f"{at:7.0f} s {megabytes:7.0f} MB")
    print(
        f"{found.wishes} wishes, {found.pictures} pictures, {found.finals} final, {found.stale} stale, "
        f"{found.notices} notices; growth {found.growth:.0f} MB"
    )
