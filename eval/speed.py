"""Benchmark `speed`: frames per second of every way to light a scene, and seconds until an edit is seen.

The camera turns around a small world of surfels under a sun. All ways take turns in one process
(:mod:`eval.timing`); a figure is a median of rounds. A frame ends when its picture is in host memory. Work
that does not depend on the camera is done before: hierarchies, transport, the bake of the light. An edit
redoes the part of this work that it changes. The paper's figures are shown beside ours, with the paper's
machine.
"""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting.networks import Network, drawn, find_weights, load_networks
from eval.report.outcome import Outcome
from eval.results import Results, Row
from eval.stages import Child, Stages
from eval.timing import Timed, interleaved, write_times
from tron.cameras import Camera
from tron.estimation import FINAL, PREVIEW, Estimation
from tron.runtime import activate, describe_machine, set_torch_threads
from tron.seeds import generator
from tron.trajectories import turn_cameras

if TYPE_CHECKING:
    from eval.applications.worlds import World
    from tron.relighting import Illumination

log = logging.getLogger(__name__)

PAPER = {"pbr": (51.81, 19.3), "pbr_x_irradiance": (8.90, 112.3), "full": (1.6, 625.0)}
"""Frames a second, and milliseconds to the first frame, of the paper's table of relighting: the former two on
an NVIDIA L40, the whole pipeline on a desktop with an NVIDIA A6000. It tells no size of the frames."""
WINDOW = 5
"""Frames that the networks average along their motion, as tron-relight does."""
EXPOSURE = 0.5
CORES = 2
"""Threads of the network's share of a frame, which has a target."""
DEVICES = {"llvm_ad_rgb": "cpu", "cuda_ad_rgb": "gpu"}
"""Mitsuba variant -> its name in rows."""
Edit = Literal["light", "material", "object"]
Draw = Callable[["Illumination", Sequence[Camera]], np.ndarray]
"""Pictures (K, H, W, 3) of K cameras."""


class Speed(Benchmark):
    """Settings: sizes and ways; times.json beside results.json has the seconds of every round."""

    name: ClassVar[str] = "speed"

    renderer: Path | list[Path] | None = Field(
        default=None, description="weights of networks, or names of shipped ones; null: both shipped networks"
    )
    variants: list[Literal["llvm_ad_rgb", "cuda_ad_rgb"]] | None = Field(
        default=None,
        description="Mitsuba variants, one process each; null: CPU, and GPU if there is one",
    )
    threads: PositiveInt | None = Field(
        default=None, description="torch and Dr.Jit threads; null: one a core"
    )
    seed: int = 0
    surfels: PositiveInt = Field(default=50_000, description="approximate number of surfels of the scene")
    sizes: list[PositiveInt] = Field(description="width of the square frames", min_length=1)
    edits: list[Edit] = Field(description="edits: the light turns, a thing changes or moves")
    edit_size: PositiveInt = Field(default=512, description="width of the frames after an edit")
    network_sizes: list[Annotated[int, Field(ge=8)]] = Field(
        description="width of the frames of networks alone (without making guidance) and of training steps"
    )
    rounds: PositiveInt = Field(default=5, description="rounds in turns; three if over a second")

    def check(self) -> None:
        """Find the checkpoints."""
        for path in self._weights():
            find_weights(path)

    def run(self, output_dir: Path) -> Outcome:
        """Measure with this process's variant, and with other variants in separate processes.

        Raises:
            StageFailed: another variant's process failed.
            TronError: weights or a variant are missing.
        """
        self.check()
        outcome, (own, *others) = Outcome(output_dir), self._variants()
        activate(own, self.threads)
        set_torch_threads(self.threads or os.cpu_count() or 1)
        timed = list(self._measure(DEVICES[own], outcome))
        write_times(output_dir / "times.json", timed)
        for variant in others:
            folder = output_dir.absolute() / DEVICES[variant]
            stages = Stages(output_dir)
            stages.restart(variant)  # figures of this run, never of one before
            stages.run(
                variant, [Child(variant, "tron-eval", [*self._typed(variant), f"output_dir={folder}"])]
            )
            found = Results.load(folder / "results.json").rows
            outcome.add(row for row in found if row.metric.startswith(f"speed.{DEVICES[variant]}."))
        for way, (frames, milliseconds) in PAPER.items():
            outcome.add(
                [
                    Row(metric=f"paper.fps.{way}", value=frames, unit="frames/s", n=1),
                    Row(metric=f"paper.first_frame_ms.{way}", value=milliseconds, unit="ms", n=1),
                ]
            )
        return outcome

    def _variants(self) -> list[str]:
        if self.variants is not None:
            return list(dict.fromkeys(self.variants)) or ["llvm_ad_rgb"]
        return list(DEVICES) if describe_machine()["gpu"] != "none" else ["llvm_ad_rgb"]

    def _typed(self, variant: str) -> list[str]:
        """Return arguments of tron-eval for the same measurement with another variant."""
        plain = self.model_dump(mode="json", exclude={"targets", "variants", "renderer"})
        given = [
            f"benchmark.{key}={value}".replace(" ", "") for key, value in plain.items() if value is not None
        ]
        weights = ",".join(map(str, self._weights()))
        return ["benchmark=speed", f"benchmark.variants=[{variant}]", f"renderer=[{weights}]", *given]

    def _weights(self) -> list[Path]:
        given = [self.renderer] if isinstance(self.renderer, Path) else self.renderer
        return list(given or (Path("paper"), Path("surfaces")))

    def _measure(self, device: str, outcome: Outcome) -> Iterator[Timed]:
        from eval.applications.worlds import draw_world

        networks = load_networks("neural", self._weights())
        world = draw_world(self.seed, "speed", 0, "sun", things=4)
        lights = Lights(world, self.surfels, self.seed)
        outcome.inputs["surfels"] = len(lights.scene)
        found = ways(networks, self.seed)
        for size in self.sizes:
            cameras = orbit(size, self.seed)
            numbers = count()
            work = {way.name: partial(way.frame, lights, cameras, numbers) for way in found}
            timed = Timed(f"{device} frames", str(size), interleaved(work, self.rounds))
            for way in found:
                seconds = timed.times[way.name].median / way.frames
                outcome.add([timed.row(f"speed.{device}.fps.{way.name}", 1 / seconds, "frames/s", way.name)])
            yield timed
        camera = orbit(self.edit_size, self.seed)
        for edit in self.edits:
            work = {way.name: partial(way.after, lights, camera, edit, count(1)) for way in found}
            timed = Timed(f"{device} {edit}", str(self.edit_size), interleaved(work, self.rounds))
            for way in found:
                milliseconds = 1e3 * timed.times[way.name].median
                metric = f"speed.{device}.first_frame_ms.{way.name}"
                row = timed.row(metric, milliseconds, "ms", way.name)
                outcome.add([row.model_copy(update={"metric": f"{metric}.{edit}"})])
            yield timed
        if device == "cpu":  # torch's networks run where it has put them, whatever Dr.Jit does
            yield from self._networks_alone(networks, outcome)

    def _networks_alone(self, networks: dict[str, Network], outcome: Outcome) -> Iterator[Timed]:
        for size in self.network_sizes:
            work = {
                f"{name}.{part}": run
                for name, network in networks.items()
                for part, run in passes(network, size, self.seed).items()
            }
            timed = Timed("networks", str(size), interleaved(work, self.rounds))
            for name, times in timed.times.items():
                outcome.add([timed.row(f"speed.network.{name}", 1 / times.median, "frames/s", name)])
            yield timed
        set_torch_threads(CORES)
        size = max(self.network_sizes, default=512)
        work = {name: passes(each, size, self.seed)["fps"] for name, each in networks.items()}
        timed = Timed("networks on two threads", str(size), interleaved(work, self.rounds))
        for name, times in timed.times.items():
            outcome.add([timed.row(f"speed.network.{name}.seconds", times.median, "s", name)])
        set_torch_threads(self.threads or os.cpu_count() or 1)
        yield timed


class Lights:
    """A scene under its light by every estimation of the ways, computed on first use and kept."""

    def __init__(self, world: World, surfels: int, seed: int):
        self.scene, self._environment, self._seed = world.surfels(surfels), world.light, seed
        self._made: dict[int, Illumination] = {}
        ids = self.scene.object_id
        self._thing = ids == np.unique(ids)[-1]

    def under(self, estimation: Estimation) -> Illumination:
        """Return the light by an estimation; estimations of equal bounces share all but the pixels' rays."""
        from tron.relighting import Relighter

        kind = estimation.bounces
        if kind not in self._made:
            relighter = Relighter(self.scene, estimation, self._seed, proxy="never")
            self._made[kind] = relighter.under(self._environment)
        return self._made[kind].framed(rays=estimation.rays, filtered=estimation.filtered)

    def edited(self, estimation: Estimation, edit: Edit, number: int) -> Illumination:
        """Return the light after edit ``number``; only changed parts are redone."""
        from tron.gaussians.edit import moved

        before = self.under(estimation)
        if edit == "light":
            return before.turned_to(float(7 * number % 360))
        if edit == "material":
            grey = np.where(self._thing[:, None], 0.1 + 0.8 * (number % 7) / 7, self.scene.base_color)
            scene = replace(self.scene, base_color=grey)
        else:
            by = np.array([0.002 * (number % 50), 0.0, 0.0])
            scene = moved(self.scene, self._thing, translation=by)
        light = before.relighter.bring(scene, before.lighting, before=before)
        return light.framed(rays=estimation.rays, filtered=estimation.filtered)


@dataclass(frozen=True)
class Way:
    """A way to make pictures of a lit scene.

    Attributes:
        name: name in rows.
        estimation: estimation of the light.
        draw: function that renders pictures of some cameras.
        frames: number of frames per call.
    """

    name: str
    estimation: Estimation
    draw: Draw
    frames: int = 1

    def frame(self, lights: Lights, cameras: Sequence[Camera], numbers: Iterator[int]) -> np.ndarray:
        """Render pictures from the next cameras of an orbit."""
        start = next(numbers)
        chosen = [cameras[(start + k) % len(cameras)] for k in range(self.frames)]
        return self.draw(lights.under(self.estimation), chosen)

    def after(
        self, lights: Lights, cameras: Sequence[Camera], edit: Edit, numbers: Iterator[int]
    ) -> np.ndarray:
        """Render the first pictures after the next edit."""
        return self.draw(lights.edited(self.estimation, edit, next(numbers)), cameras[: self.frames])


def ways(networks: dict[str, Network], seed: int) -> list[Way]:
    """Return every way: the paper's three stages, ours, and the networks on one frame and on five."""
    direct = Estimation(bounces=0)
    found = [Way("pbr", direct, _pbr)]
    for rays in (2, 64):
        estimation = direct.model_copy(update={"rays": rays})
        found.append(Way(f"pbr_x_irradiance_{rays}", estimation, partial(_product, seed)))
    found.append(Way("lit_preview", PREVIEW, partial(_lit, seed)))
    found.append(Way("lit", FINAL, partial(_lit, seed)))
    for name, network in networks.items():
        for frames in (1, WINDOW):
            draw = partial(_neural, seed, network)
            found.append(Way(f"{name}_k{frames}", PREVIEW, draw, frames))
    return found


def _pbr(light: Illumination, cameras: Sequence[Camera]) -> np.ndarray:
    """Render split-sum shading, which needs camera rays only."""
    import mitsuba as mi

    from tron.shading.guidance import Arriving, shade_surface

    def one(camera: Camera) -> np.ndarray:
        seen = light.relighter.gbuffer(camera)
        colors = shade_surface(seen, Arriving(mi.Color3f(1)), light.lighting)
        return seen.images({"pbr": colors["pbr"]})["pbr"]

    return np.stack([one(camera) for camera in cameras])


def _product(seed: int, light: Illumination, cameras: Sequence[Camera]) -> np.ndarray:
    found = [light.trace(camera, seed).images(("pbr", "irradiance")) for camera in cameras]
    return np.stack([each["pbr"] * each["irradiance"] for each in found])


def _lit(seed: int, light: Illumination, cameras: Sequence[Camera]) -> np.ndarray:
    return np.stack([light.trace(camera, seed).images(("lit",))["lit"] for camera in cameras])


def _neural(seed: int, network: Network, light: Illumination, cameras: Sequence[Camera]) -> np.ndarray:
    return drawn(network, light, cameras, EXPOSURE, seed)


def orbit(size: int, seed: int, steps: int = 60) -> list[Camera]:
    """Return square views of the world, one degree apart."""
    from eval.applications.worlds import view_of

    first = view_of(generator(seed, "speed", "camera"), size, size)
    found = []
    for angle in np.radians(np.arange(steps)):
        c, s = np.cos(angle), np.sin(angle)
        found += turn_cameras([first], np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))
    return found


def passes(network: Network, size: int, seed: int) -> dict[str, Callable[[], None]]:
    """Return name in rows -> call: a network on a frame of random buffers, or a training step of a copy."""
    import torch

    def noise() -> Iterator[torch.Tensor]:
        rng = generator(seed, "eval", "throughput", size)
        while True:
            yield torch.from_numpy(rng.uniform(-1, 1, (1, 3, 1, size, size)).astype(np.float32))

    buffers = dict(zip((*network.renderer.config.guidance, "rgb"), noise()))
    truth = buffers.pop("rgb")
    learner = copy.deepcopy(network.renderer).train().requires_grad_(True)
    optimizer = torch.optim.AdamW(learner.parameters(), lr=1e-6)

    def inference() -> None:
        with torch.no_grad():
            network.renderer(buffers)

    def training() -> None:
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(learner(buffers), truth).backward()
        optimizer.step()

    return {"fps": inference, "training_fps": training}
