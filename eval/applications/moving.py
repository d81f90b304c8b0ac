"""Compare a thing moved by `tron-relight motion=` with path tracing of the same moving meshes.

A thing slides, rises and turns over a few frames before a camera that stands still, as a motion.yaml says.
Where a surface stayed, only light changes from frame to frame: the thing's shadow and its colour bleeding.
These changes, in display values, are compared with the truth's changes as in ``benchmark=renderer``
(:mod:`eval.renderer.shadows`): correlation, and slope of our change over the true change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.applications.worlds import GROUND, World, draw_thing, draw_world, moved, view_of
from eval.confidence import Statistic, interval, scene_sums
from eval.renderer.shadows import CHANGE_GAIN, change_sums, correlation, slope, stayed
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.tracing.scene import LIGHTS
from tron.cameras import Camera
from tron.color import to_display
from tron.editing.motion import Motion
from tron.editing.moving import in_motion
from tron.estimation import QUALITY
from tron.metrics import capped_psnr
from tron.relighting import Relighter
from tron.report.page import Picture, Pictures
from tron.seeds import generator, integer

WORLDS, FRAMES, SIDE, PATHS = 6, 6, 160, 196
"""Worlds, frames of each, pixels along a side, and paths a pixel of the truth."""
SURFELS = 40_000
WAY, LIFT, TURN = (0.9, 1.5), 0.5, 120.0
"""Length of its way, world units; how high it rises at most, and turns, degrees either way."""
QUALITIES = {"": QUALITY["preview"], "final_": QUALITY["final"]}
"""Beginning of a row -> ``quality`` of tron-relight; preview is its default."""
TITLES = {"": "quality=preview", "final_": "quality=final"}


@dataclass(frozen=True)
class Film:
    """One world in motion, display values.

    Attributes:
        name: name of the world.
        truth: (K, H, W, 3).
        ours: beginning of a row -> (K, H, W, 3).
        stays: (K - 1, H, W) bool, pixels whose surface stayed until the next frame.
    """

    name: str
    truth: np.ndarray
    ours: dict[str, np.ndarray]
    stays: np.ndarray


def measure_motion(seed: int, outcome: Outcome) -> None:
    """Film all worlds; add figures and pictures."""
    films = []
    for number in range(WORLDS):
        films.append(film(seed, number))
        for name, group in _pictures(films[-1]):
            outcome.show("motion", f"motion-{number}-{name}", group)
    outcome.add(motion_rows(films, seed))


def motion_rows(films: Sequence[Film], seed: int) -> Iterator[Row]:
    """Yield correlation and slope over all changes of all films, and PSNR on surfaces."""
    for prefix in QUALITIES:
        scenes, sums = [], []
        for each in films:
            ours = each.ours[prefix]
            for k, where in enumerate(each.stays):
                scenes.append(each.name)
                sums.append(
                    change_sums((each.truth[k + 1] - each.truth[k])[where], (ours[k + 1] - ours[k])[where])
                )
        found = np.stack(sums)

        def row(name: str, measure: Statistic, found: np.ndarray = found, scenes: list[str] = scenes) -> Row:
            plain = Row(metric=name, value=float(measure(found.sum(0))), unit="1", n=len(found))
            return plain.within(interval(scene_sums(scenes, found), measure, seed))

        yield row(f"motion.{prefix}shadow_correlation", correlation)
        yield row(f"motion.{prefix}shadow_slope", slope)
        values = [
            (each.name, capped_psnr(a, b)) for each in films for a, b in zip(each.ours[prefix], each.truth)
        ]
        yield mean_row(f"motion.{prefix}psnr", "dB", values, seed)
        for each in films:
            of_film = found[[k for k, name in enumerate(scenes) if name == each.name]]
            name = f"motion.{prefix}world_correlation.{each.name}"
            yield Row(metric=name, value=float(correlation(of_film.sum(0))), unit="1", n=len(of_film))


def film(seed: int, number: int) -> Film:
    """Film a world whose last part moves, under a sun or a soft light in turns."""
    rng = generator(seed, "applications", "motion", number, "film")
    world = draw_world(seed, "motion", number, list(LIGHTS)[number % 2])
    thing = draw_thing(rng)
    heading, way = rng.uniform(0, 2 * np.pi), rng.uniform(*WAY)
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    start, lift, turn = -0.5 * way * along, rng.uniform(0, LIFT), rng.uniform(-TURN, TURN)
    shares = np.arange(FRAMES) / (FRAMES - 1)
    by = [share * way * along + [0, 0, lift * np.sin(np.pi * share)] for share in shares]
    turns = (shares * turn).tolist()
    camera = view_of(rng, SIDE, SIDE)
    placed = moved(thing, start)
    whole = replace(world, parts=(*world.parts, placed))
    keys = [
        {"time": k, "by": step.tolist(), "turn": turned} for k, (step, turned) in enumerate(zip(by, turns))
    ]
    number_of_thing = GROUND + len(world.parts)
    path = {"select": {"object": number_of_thing}, "keys": keys, "about": start.tolist()}
    motion = Motion.model_validate({"objects": [path]})
    moments = [
        replace(world, parts=(*world.parts, moved(placed, step, turned, start)))
        for step, turned in zip(by, turns)
    ]
    truth, stays = _truth(moments, camera, integer(seed, "applications", "motion", number, "paths"))
    ours = _filmed(whole, motion, camera, integer(seed, "applications", "motion", number))
    return Film(f"world{number}", truth, ours, stays)


def _truth(moments: Sequence[World], camera: Camera, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return display values (K, H, W, 3), and where surfaces stay (K - 1, H, W). One seed keeps the noise."""
    exposure = moments[0].light.exposure()
    frames = np.stack([to_display(each.traced(camera, PATHS, seed), exposure) for each in moments])
    seen = [each.surface(camera) for each in moments]
    surfaces = {
        "depth_ref": np.stack([each.depth for each in seen]),
        "normal_ref": np.stack([each.normal for each in seen]),
        "base_color_ref": np.stack([each.base_color for each in seen]),
        "foreground": np.stack([each.number[..., None] > 0 for each in seen]).astype(np.float32),
    }
    return frames, np.stack([stayed(surfaces, k, k + 1) for k in range(len(moments) - 1)])


def _filmed(world: World, motion: Motion, camera: Camera, seed: int) -> dict[str, np.ndarray]:
    """Render the surfels by each quality; one relighter serves all frames, as in tron-relight."""
    scene, exposure = world.surfels(SURFELS), world.light.exposure()
    moving = in_motion(motion, scene, motion.end)
    found = {}
    for prefix, estimation in QUALITIES.items():
        relighter, frames = Relighter(scene, estimation, seed, proxy="never"), []
        for k in range(FRAMES):
            relighter = relighter.changed(moving.at(float(k)))
            lit = relighter.under(world.light).render(camera, integer(seed, "frame", k)).lit
            frames.append(to_display(lit, exposure))
        found[prefix] = np.stack(frames)
    return found


def _pictures(film: Film) -> Iterator[tuple[str, Pictures]]:
    """Show the frames, and their changes where surfaces stayed: a row of truth, then a row per quality."""
    frames, changes = [], []
    rows = {"path-traced": film.truth, **{TITLES[prefix]: each for prefix, each in film.ours.items()}}
    for title, images in rows.items():
        for k, image in enumerate(images):
            words = f"{title}, frame {k + 1}"
            frames.append(Picture(image, words, f"{words}, {film.name}", strong=title == "path-traced"))
        for k, where in enumerate(film.stays):
            change = np.clip(0.5 + CHANGE_GAIN * (images[k + 1] - images[k]) / 2, 0, 1)
            words = f"{title}, {k + 1} to {k + 2}"
            image = np.where(where[..., None], change, 0.5)
            changes.append(Picture(image, words, f"change of {words}, {film.name}, where surfaces stayed"))
    yield "frames", Pictures(f"{film.name} · frames", frames, columns=len(film.truth))
    yield "changes", Pictures(f"{film.name} · changes", changes, columns=len(film.stays))
