"""Time of Mitsuba's path tracer to reach the error of guidance.

The truth of a frame is what the path tracer converges to. Its error and ours are RMS errors of display
values, after exposure and AgX, over pixels whose centre hits the scene. The path tracer gets more and more
samples until its error equals ours; between two measured numbers of samples, error and time are interpolated
as powers of the number. Samples are the data engine's, stratified over pixel, light and lobe, and the same
kernels serve every number. Both take turns on one machine, in one process.

The error of the truth itself, estimated from its two halves, is subtracted from both squared errors.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Mapping
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np

from datagen.dataset.records import Work, scene_folder
from datagen.files.sources import ready_sources
from datagen.run.plan import chosen, plan
from datagen.settings.command import EqualErrorSettings, Settings
from datagen.truth.build import Geometry, scene_geometry
from datagen.truth.pathtrace import gbuffers, render_frames
from datagen.world.lights import HdriSpec
from datagen.world.scene import SceneSpec
from tron.cameras import Camera
from tron.color import to_display
from tron.errors import TronError
from tron.estimation import FINAL, FINEST, PREVIEW, Estimation
from tron.gaussians.scene import GaussianScene
from tron.io.images import write_image
from tron.relighting import EnvironmentMap, Relighter
from tron.runtime import activate, describe_machine
from tron.seeds import integer
from tron.shading.bounces.bounce import BouncedLight
from tron.shading.lighting import Lighting
from tron.storage import write_atomic

log = logging.getLogger(__name__)

RESULT_NAME = "equal_error.json"
WAYS = {
    "lit_preview": PREVIEW,
    "lit_64_rays": FINAL,
    "lit_16_rays": FINAL.model_copy(update={"rays": 16}),
    "lit_supersampled": FINAL.model_copy(update={"supersample": 2}),
    "lit_with_reflections": FINEST.model_copy(update={"filtered": False}),
}
"""Frames of ours that are judged; the first is tron-relight's default, which the target holds."""
BEST = "lit_with_reflections"
"""The way that is shown beside the path tracer."""
PATHS = (1, 4, 9, 16, 36, 64, 144, 256, 576)
"""Paths a pixel, squares: the sampler rounds others up."""


def measure_equal_error(settings: Settings) -> None:
    """Judge the first frame of each light of the test scenes in ``settings.output_dir``.

    Writes equal_error.json and beside it, below equal_error/, the pictures of each frame: ours, the path
    tracer's in our time, and the truth.

    Raises:
        TronError: a scene of the settings has not been made.
    """
    scenes = [item for item in chosen(plan(settings), settings.only) if item.split == "test"]
    missing = [item.name for item in scenes if not _surfels(settings, item).is_file()]
    if missing or not scenes:
        name = missing[0] if missing else "test"
        raise TronError(f"scene {name} is not there", settings.output_dir, "make it by mode=make first")
    activate(settings.variant)
    sources = ready_sources(settings)
    cases: list[dict[str, Any]] = []
    for item in scenes:
        spec = SceneSpec.model_validate_json(_surfels(settings, item).with_name("spec.json").read_bytes())
        scene = GaussianScene.load(_surfels(settings, item))
        cases += _judge_scene(spec, scene_geometry(spec, settings, sources), scene, settings)
        record = {"machine": describe_machine(), "cases": cases}
        write_atomic(settings.output_dir / RESULT_NAME, json.dumps(record, indent=1) + "\n")


def _surfels(settings: Settings, item: Work) -> Path:
    return scene_folder(settings.output_dir, item.name) / "surfels.ply"


def _judge_scene(
    spec: SceneSpec, geometry: Geometry, scene: GaussianScene, settings: Settings
) -> list[dict[str, Any]]:
    """Return a case for each light of the scene."""
    recipe, wanted = settings.split(spec.split), settings.equal_error
    relighter = Relighter(scene, proxy="never")
    copy(relighter).prepare()  # compiles it
    _, seconds = timed(lambda: relighter.transport.rays.met)
    cases = []
    for number, light in enumerate(spec.lights):
        environment = light.bake(settings.environment_height, settings.environments)
        (camera,) = spec.clip(number, 1, recipe.width, recipe.height)
        frame = _Frame(geometry, camera, environment, wanted, integer(spec.seed, spec.name, number, "equal"))
        case = {
            "scene": spec.name,
            "light": Path(light.path).stem if isinstance(light, HdriSpec) else light.family,
            "pixels": camera.width * camera.height,
            "surfels": len(scene),
            "transport_seconds": seconds,
            **frame.judge(relighter, settings.output_dir / "equal_error" / f"{spec.name}-l{number}"),
        }
        for name, way in case["ways"].items():
            said = spec.name, case["light"], name, way["error"], way["seconds"], way["paths"], way["ratio"]
            log.info("%s under %s, %s: error %.4f in %.2f s; %.1f paths, %.2f of their time", *said)
        cases.append(case)
    return cases


class _Frame:
    """One view under one light, by the path tracer."""

    def __init__(
        self,
        geometry: Geometry,
        camera: Camera,
        environment: EnvironmentMap,
        settings: EqualErrorSettings,
        seed: int,
    ) -> None:
        self._scene, self._camera, self._seed = geometry.lit(environment), camera, seed % 2**31
        self._environment, self._rounds = environment, settings.rounds
        (seen,) = gbuffers(geometry, [camera])
        self._inside = seen.valid
        halves = [self._paths(settings.reference_spp // 2, 1 + half) for half in range(2)]
        self._truth = (halves[0] + halves[1]) / 2
        shown = [self._shown(half) for half in halves]
        self._noise = float(((shown[0] - shown[1])[self._inside] ** 2).mean() / 4)

    def _paths(self, spp: int, stream: int = 0) -> np.ndarray:
        return render_frames(self._scene, [self._camera], spp, [self._seed + stream])[0]

    def _shown(self, image: np.ndarray) -> np.ndarray:
        return to_display(image, self._environment.exposure())

    def _error(self, image: np.ndarray) -> float:
        """Return the RMS error of display values over pixels that hit the scene."""
        off = (self._shown(image) - self._shown(self._truth))[self._inside].astype(np.float64)
        return math.sqrt(max((off**2).mean() - self._noise, 1e-12))

    def judge(self, relighter: Relighter, pictures: Path) -> dict[str, Any]:
        """Measure times and errors of our frames, and of the path tracer's as far as needed."""
        lighting = Lighting(self._environment)

        def bake() -> BouncedLight | None:
            return relighter.under(lighting).bounced

        light = relighter.under(lighting)

        def ours(estimation: Estimation) -> Callable[[], np.ndarray]:
            of_frame = {"rays", "filtered", "reflections", "supersample"}
            framed = light.framed(**estimation.model_dump(include=of_frame))
            return lambda: framed.render(self._camera, self._seed).lit

        frames = {name: ours(estimation) for name, estimation in WAYS.items()}
        images = {name: render() for name, render in frames.items()}
        errors = {name: self._error(image) for name, image in images.items()}
        paths: dict[int, float] = {}
        for spp in PATHS:
            paths[spp] = self._error(self._paths(spp))
            if paths[spp] < min(errors.values()):
                break
        contestants: dict[str, Callable[[], Any]] = {"bake": bake, **frames}
        contestants |= {str(spp): lambda spp=spp: self._paths(spp) for spp in paths}
        taken = {name: [] for name in contestants}
        for _ in range(self._rounds):
            for name, work in contestants.items():
                taken[name].append(timed(work)[1])
        seconds = {name: float(np.median(values)) for name, values in taken.items()}
        by_paths = {spp: (error, seconds[str(spp)]) for spp, error in paths.items()}
        ways = {}
        for name, error in errors.items():
            spp, theirs = equal(by_paths, error)
            ways[name] = {
                "error": error, "seconds": seconds[name], "paths": spp, "path_seconds": theirs,
                "ratio": seconds[name] / theirs,
                "ratio_with_bake": (seconds[name] + seconds["bake"]) / theirs,
            }  # fmt: skip
        self._write(pictures, images[BEST], seconds[BEST], by_paths)
        return {
            "bake_seconds": seconds["bake"],
            "ways": ways,
            "path_tracer": [
                {"paths": spp, "error": error, "seconds": s} for spp, (error, s) in by_paths.items()
            ],
        }

    def _write(
        self, stem: Path, ours: np.ndarray, seconds: float, by_paths: Mapping[int, tuple[float, float]]
    ) -> None:
        affordable = [spp for spp, (_, theirs) in by_paths.items() if theirs <= seconds]
        same_time = self._paths(max(affordable, default=PATHS[0]))
        shown = [self._shown(image) for image in (ours, same_time, self._truth)]
        write_image(stem.with_suffix(".png"), np.concatenate(shown, axis=1))


def equal(by_paths: Mapping[int, tuple[float, float]], error: float) -> tuple[float, float]:
    """Return the samples per pixel, and their seconds, at which the path tracer's error is ``error``.

    Between two measured numbers of samples the error is a power law, and beyond the last it falls as between
    the last two. The result is never below the least measured number.

    Args:
        by_paths: number of paths -> (error, seconds).
        error: above 0.
    """
    numbers = sorted(by_paths)
    if len(numbers) == 1 or by_paths[numbers[0]][0] <= error:
        return float(numbers[0]), by_paths[numbers[0]][1]
    upper = next((i for i, n in enumerate(numbers) if by_paths[n][0] <= error), len(numbers) - 1)
    low, high = numbers[upper - 1], numbers[upper]
    (e0, s0), (e1, s1) = by_paths[low], by_paths[high]
    at = math.log(e0 / error) / max(math.log(e0 / e1), 1e-9)
    return low * (high / low) ** at, s0 * (s1 / s0) ** at


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the evaluated result of ``work``, and its seconds."""
    import drjit as dr

    dr.sync_thread()
    started = time.perf_counter()
    made = work()
    dr.eval(made)
    dr.sync_thread()
    return made, time.perf_counter() - started
