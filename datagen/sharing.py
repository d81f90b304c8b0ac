"""Time saved by path tracing a frame under many lights at once, at equal mean error.

One by one, each light has a frame of Mitsuba's ``path``, as :func:`datagen.pathtrace.render_frames` makes it;
together, all have one of :func:`datagen.pathtrace.render_lights`. Both are held against what ``path`` gives
with ``REFERENCE`` times the paths and other seeds. The error under a light is the mean over pixels and
channels of

    (x - r)^2 / (r^2 + 0.01)        (Rousselle et al. 2011)

after the light's exposure, which brings all lights to one scale; what the reference itself is off by, known
from its two halves, is taken off. Then comes the mean over lights. Both ways take turns in one process; what
is prepared once for all frames of a clip, lights and hierarchies, is left out on both sides.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.build import Geometry
from datagen.drawn_scene import draw_and_build
from datagen.equal_error import equal, timed
from datagen.lights import FAMILIES, classify
from datagen.pathtrace import render_frames, render_lights, stacked_lights
from datagen.plan import Work
from datagen.ready_sources import ready_sources
from datagen.scene import scene_name
from datagen.settings import Settings
from tron.cameras import Camera
from tron.color import to_display
from tron.images import write_image
from tron.runtime import activate, describe_machine
from tron.seeds import generator, integer
from tron.shading.environment import EnvironmentMap
from tron.storage import write_atomic

log = logging.getLogger(__name__)

RESULT_NAME = "sharing.json"
REFERENCE = 16
"""Paths of the reference over those of a frame."""
EACH = 10
"""Lights of high contrast, and as many of low: the paper's."""
SHARES = (0.25, 0.5625, 1.0, 1.5625)
"""Paths of frames together over those one by one: errors between them are interpolated."""


def measure_sharing(settings: Settings) -> None:
    """Measure on scenes of the test split, drawn here; writes sharing.json and a picture of each scene.

    Raises:
        TronError: a scene cannot be made.
    """
    activate(settings.variant, settings.sharing.threads)
    sources, cases = ready_sources(settings), []
    for index in range(settings.sharing.scenes):
        item = Work("test", index, scene_name("test", index), first_shard=0)
        spec, geometry = draw_and_build(item, settings, sources, ["overcast"])
        size = settings.sharing.size
        camera = spec.clip(0, 1, size, size)[0]
        seed = integer(settings.seed, "sharing", index)
        frame = LitFrame(geometry, camera, draw_lights(seed, settings.environment_height))
        found = frame.measure(settings.sharing.path_spp, settings.sharing.rounds, seed)
        stem = settings.output_dir / "sharing" / spec.name
        write_image(stem.with_suffix(".png"), found.pop("picture"))
        cases.append({"scene": spec.name, "style": spec.style, **found})
        log.info("%s: %.2f times as fast together", spec.name, cases[-1]["gain"])
        record = {"machine": describe_machine(), "cases": cases}
        write_atomic(settings.output_dir / RESULT_NAME, json.dumps(record, indent=1) + "\n")


def draw_lights(seed: int, height: int) -> list[EnvironmentMap]:
    """``EACH`` maps of high contrast, then as many of low, of every family that needs no files, in turns."""
    families = [name for name in FAMILIES if name != "hdri"]
    wanted: dict[str, list[EnvironmentMap]] = {"high": [], "low": []}
    k = 0
    while min(len(found) for found in wanted.values()) < EACH:
        rng = generator(seed, "lights", k)
        environment = FAMILIES[families[k % len(families)]].draw(rng, []).bake(height).baked()
        found = wanted.get(classify(environment), [])
        if len(found) < EACH:
            found.append(environment.resized(height))
        k += 1
    return wanted["high"] + wanted["low"]


@dataclass
class LitFrame:
    """One view of a scene, and what lights it."""

    geometry: Geometry
    camera: Camera
    environments: list[EnvironmentMap]

    def measure(self, spp: int, rounds: int, seed: int) -> dict[str, Any]:
        """Times, errors and gain; ``picture`` shows the reference, frames one by one, together, and errors.

        Args:
            spp: paths a pixel, one by one.
            rounds: times that each way is rendered, with other seeds each time.
            seed: root of all of them.
        """
        camera = self.camera
        scenes = [self.geometry.lit(environment) for environment in self.environments]
        unlit, stacked = self.geometry.lit(), stacked_lights(self.environments)

        def alone(paths: int, *stream: int | str) -> np.ndarray:
            seeds = [integer(seed, *stream, k) for k in range(len(scenes))]
            return np.stack([render_frames(s, [camera], paths, [k])[0] for s, k in zip(scenes, seeds)])

        def together(paths: int, *stream: int | str) -> np.ndarray:
            return render_lights(unlit, stacked, camera, paths, integer(seed, *stream, paths))

        halves = [alone(REFERENCE * spp // 2, "reference", half) for half in range(2)]
        reference = Reference(halves, np.array([light.exposure() for light in self.environments]))
        ways: dict[str, Callable[..., np.ndarray]] = {"alone": lambda *stream: alone(spp, "alone", *stream)}
        numbers = sorted({max(round(spp * share), 1) for share in SHARES})
        ways |= {str(n): lambda *stream, n=n: together(n, "together", *stream) for n in numbers}
        seconds: dict[str, list[float]] = {name: [] for name in ways}
        errors: dict[str, list[np.ndarray]] = {name: [] for name in ways}
        images = {name: way("warm") for name, way in ways.items()}
        for turn in range(rounds):
            for name, way in ways.items():
                images[name], taken = timed(lambda way=way, turn=turn: way(turn))
                seconds[name].append(taken)
                errors[name].append(reference.errors(images[name]))
        error = {name: float(np.mean(found)) for name, found in errors.items()}
        median = {name: float(np.median(found)) for name, found in seconds.items()}
        by_paths = {n: (error[str(n)], median[str(n)]) for n in numbers}
        paths, equal_seconds = equal(by_paths, error["alone"])
        nearest = str(min(numbers, key=lambda n: abs(n - paths)))
        return {
            "lights": len(scenes),
            "contrast": [round(float(light.contrast()), 4) for light in self.environments],
            "pixels": camera.width * camera.height,
            "paths": {"alone": spp, "together": paths},
            "seconds": median | {"together": equal_seconds},
            "error": error,
            "error_by_light": {
                name: [round(float(e), 7) for e in np.mean(found, axis=0)] for name, found in errors.items()
            },
            "bias": reference.bias(images[str(numbers[-1])]),
            "gain": median["alone"] / equal_seconds,
            "picture": reference.picture(images["alone"], images[nearest]),
        }


class Reference:
    """Frames that errors are measured against.

    Args:
        halves: two renderings (N, H, W, 3), linear, of as many paths.
        exposures: (N,) of the lights.
    """

    def __init__(self, halves: list[np.ndarray], exposures: np.ndarray) -> None:
        self._exposure = exposures.reshape(-1, 1, 1, 1)
        first, second = (np.asarray(half, np.float64) * self._exposure for half in halves)
        self.image = (first + second) / 2
        self._scale = self.image**2 + 0.01
        self._noise = ((first - second) ** 2 / 4 / self._scale).mean(axis=(1, 2, 3))

    def errors(self, image: np.ndarray) -> np.ndarray:
        """(N,) relative mean square error under each light of ``image`` (N, H, W, 3), linear."""
        off = image * self._exposure - self.image
        return (off**2 / self._scale).mean(axis=(1, 2, 3)) - self._noise

    def bias(self, image: np.ndarray) -> float:
        """Mean of ``image`` over that of the reference, less one, under the light where it is largest."""
        pixels = (1, 2, 3)
        off = (image * self._exposure).mean(pixels) / self.image.mean(pixels) - 1
        return float(off[np.argmax(np.abs(off))])

    def picture(self, alone: np.ndarray, together: np.ndarray) -> np.ndarray:
        """Display values: a row a light, of the first of each kind: truth, both ways, errors of both x 8."""
        rows = []
        for light in (0, 1, len(self.image) // 2, len(self.image) // 2 + 1):
            truth = self.image[light]
            shown = [image[light] * self._exposure[light] for image in (alone, together)]
            images = [np.asarray(to_display(x, 1.0)) for x in (truth, *shown)]
            off = [np.clip(np.abs(image - truth) * 8, 0.0, 1.0) for image in shown]
            rows.append(np.concatenate([*images, *off], 1))
        return np.concatenate(rows).astype(np.float32)
