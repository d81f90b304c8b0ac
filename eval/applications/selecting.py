"""Select a thing of a scene by random clicks: three on the thing and five beside it.

A click is a pixel of one of eight views around the scene, drawn evenly among the pixels that show the thing,
or among the other pixels. The truth is the object id of every surfel, which the selection does not see. If
clicks of both kinds hit one surfel, the command refuses, and clicks are drawn again, as a user moves one.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from eval.applications.worlds import draw_world
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from tron.cameras import Camera
from tron.color import linear_to_srgb
from tron.editing import Clicks, Selection, Views
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.report.page import Picture, Pictures
from tron.seeds import generator
from tron.tracing import SurfelTracer
from tron.trajectories import plan_cameras

VIEWS, SIDE = 8, 128
"""Views that are clicked in, and pixels along a side of each."""
INSIDE, OUTSIDE = 3, 5
"""Clicks on the thing and beside it."""
TRIALS = 3
"""Draws of clicks for each thing."""
LEAST_PIXELS = 200
"""Things that all views together show on fewer pixels are not asked for."""
SOLID = 0.9
"""Opacity from which a pixel shows a thing."""
GOOD = 0.95
"""IoU of a selection that needs no further click."""
LARGE, ROUNDS = 150_000, 5
"""Surfels of the scene that is timed, and rounds of it."""
SHOWN = 3
"""Scenes that are shown."""


@dataclass(frozen=True)
class Draw:
    """One selection.

    Attributes:
        scene: its name. number: the thing's object id. clicks: (x, y) by view, inside and outside.
        selected: (M,) bool. iou: IoU with the truth. refused: number of draws that were refused before.
    """

    scene: str
    number: int
    clicks: tuple[Clicks, ...]
    selected: np.ndarray
    iou: float
    refused: int


class Clicked:
    """A scene and the surfels seen in its views."""

    def __init__(self, name: str, scene: GaussianScene) -> None:
        self.name, self.scene = name, scene
        cameras = plan_cameras(scene, "orbit", VIEWS, width=SIDE, height=SIDE, fov_deg=40)
        self.views = Views(cameras)
        tracer, tree = SurfelTracer(scene), KDTree(scene.means)
        shown = []
        for camera in cameras:
            seen = tracer.gbuffer(camera).numpy()
            nearest = np.asarray(tree.query(seen["position"].reshape(-1, 3))[1])
            ids = scene.object_id[nearest].reshape(SIDE, SIDE)
            shown.append(np.where(seen["opacity"] < SOLID, -1, ids))
        self.shown = np.stack(shown)
        """(V, H, W) object ids, -1 where there is nothing."""

    def things(self) -> list[int]:
        """Return object ids with enough pixels; none if the scene has a single object."""
        ids, counts = np.unique(self.shown[self.shown >= 0], return_counts=True)
        return [int(i) for i, count in zip(ids, counts) if count > LEAST_PIXELS and len(ids) > 1]

    def drawn(self, number: int, trial: int, seed: int) -> Draw:
        """Select a thing by clicks drawn from a seed."""
        rng = generator(seed, "applications", "clicks", self.name, number, trial)
        here, other = self.shown == number, (self.shown >= 0) & (self.shown != number)
        truth = self.scene.object_id == number
        for refused in range(20):
            clicks = (*_clicks(here, INSIDE, "inside", rng), *_clicks(other, OUTSIDE, "outside", rng))
            try:
                selected = Selection(clicks=clicks).of(self.scene, self.views)
            except TronError:
                continue
            iou = float((selected & truth).sum() / (selected | truth).sum())
            return Draw(self.name, number, clicks, selected, iou, refused)
        raise TronError(f"no clicks on object {number} were taken", self.name)


def _clicks(where: np.ndarray, count: int, side: str, rng: np.random.Generator) -> Iterator[Clicks]:
    """Draw ``count`` pixels of (V, H, W) bool as clicks in their views."""
    pixels = np.argwhere(where)
    for view, y, x in pixels[rng.choice(len(pixels), count, replace=False)].tolist():
        yield Clicks.model_validate({side: [(x + 0.5, y + 0.5)], "view": view})


def measure_selections(folders: list[Path], seed: int, outcome: Outcome) -> None:
    """Measure selections of all things of the scenes, show some, and time a large one."""
    draws = list[Draw]()
    for k, folder in enumerate(folders):
        clicked = Clicked(folder.name, GaussianScene.load(folder / "surfels.ply"))
        found = [clicked.drawn(n, trial, seed) for n in clicked.things() for trial in range(TRIALS)]
        draws += found
        if k < SHOWN:
            # the first trial of the thing in the middle: neither the best nor the worst
            first = sorted(found[::TRIALS], key=lambda draw: draw.iou)
            outcome.show("select", f"select-{folder.name}", _pictures(clicked, first[len(first) // 2]))
    outcome.add(selection_rows(draws, seed))
    outcome.add(seconds_rows(seed))


def selection_rows(draws: list[Draw], seed: int) -> Iterator[Row]:
    """Yield mean and median IoU and the share of good selections; ``seed`` draws the intervals' scenes."""
    yield mean_row("select.iou", "1", [(draw.scene, draw.iou) for draw in draws], seed)
    ious = [draw.iou for draw in draws]
    yield Row(metric="select.iou_median", value=float(np.median(ious)), unit="1", n=len(ious))
    good = [(draw.scene, float(draw.iou >= GOOD)) for draw in draws]
    yield mean_row("select.good", "fraction", good, seed)
    refused = sum(draw.refused for draw in draws)
    yield Row(metric="select.refused", value=refused / (refused + len(draws)), unit="fraction", n=len(draws))
    for scene in dict.fromkeys(draw.scene for draw in draws):
        of_scene = [draw.iou for draw in draws if draw.scene == scene]
        name = f"select.scene_iou.{scene.replace('-', '_')}"
        yield Row(metric=name, value=float(np.mean(of_scene)), unit="1", n=len(of_scene))


def seconds_rows(seed: int) -> Iterator[Row]:
    """Yield seconds of a selection among LARGE surfels, clicks included; the first one builds the tracer."""
    world = draw_world(seed, "large", 0, "soft", things=5)
    clicked = Clicked("large", world.surfels(LARGE))
    wall, processor = [], []
    for trial in range(ROUNDS + 1):
        began, spent = time.perf_counter(), time.process_time()
        clicked.drawn(clicked.things()[-1], trial, seed)
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - spent)
    yield Row(metric="select.seconds", value=float(np.median(wall[1:])), unit="s", n=ROUNDS)
    yield Row(metric="select.processor_seconds", value=float(np.median(processor[1:])), unit="s", n=ROUNDS)
    yield Row(metric="select.first_seconds", value=wall[0], unit="s", n=1)
    yield Row(metric="select.surfels", value=len(clicked.scene), unit="surfels", n=1)


def _pictures(clicked: Clicked, draw: Draw) -> Pictures:
    """Show the view with most clicks on the thing: colours with clicks, selection, truth."""
    inside = [click.view for click in draw.clicks if click.inside]
    view = max(set(inside), key=inside.count)
    camera = clicked.views[str(view)].resized(2 * SIDE, 2 * SIDE)
    color = linear_to_srgb(np.clip(_shown(clicked.scene, camera, clicked.scene.base_color), 0, 1))
    clicks = color.copy()
    for click in draw.clicks:
        if click.view != view:
            continue
        for side, mark in ((click.inside, (0.1, 1.0, 0.1)), (click.outside, (1.0, 0.15, 0.1))):
            for x, y in side:  # type: ignore[misc]
                row, column = int(2 * y), int(2 * x)
                clicks[max(row - 4, 0) : row + 5, max(column - 4, 0) : column + 5] = 0
                clicks[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = mark
    where = f"scene {draw.scene}, object {draw.number}"
    pictures = [
        Picture(clicks, "clicks in this view", f"base color, {where}, clicks on it green, beside red")
    ]
    truth = clicked.scene.object_id == draw.number
    for which, title in ((draw.selected, "selected"), (truth, "true object")):
        share = _shown(clicked.scene, camera, np.repeat(which[:, None], 3, 1).astype(np.float32))
        image = (0.25 + 0.75 * share) * color + 0.25 * share * (0.2, 0.9, 0.3)
        figure = f"IoU {draw.iou:.3f}" if which is draw.selected else ""
        pictures.append(Picture(np.clip(image, 0, 1), title, f"{title} bright, {where}", figure))
    note = f"{INSIDE} clicks on it, {OUTSIDE} beside it, in {VIEWS} views; shown is the one with most on it."
    return Pictures(f"Scene {draw.scene} · object {draw.number}", pictures, note, columns=3)


def _shown(scene: GaussianScene, camera: Camera, values: np.ndarray) -> np.ndarray:
    """Render values (M, 3) of the surfels in [0, 1] over black: (H, W, 3)."""
    seen = SurfelTracer(replace(scene, base_color=values)).gbuffer(camera).numpy()
    return seen["opacity"][..., None] * seen["base_color"]
