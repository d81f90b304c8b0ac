"""Benchmark `tracing`: the tracer's speed, exactness and noise, beside what a user would pick instead."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.report.outcome import Outcome
from eval.results import Row
from tron.errors import TronError
from tron.storage import write_atomic

if TYPE_CHECKING:
    from eval.peers.contenders import Contenders
    from eval.peers.scene import Place
    from eval.peers.timing import Times
    from eval.tracing.camera_rays import CameraRays
    from eval.tracing.few_rays import FewRays
    from eval.tracing.gradients import GradientStep
    from eval.tracing.irradiance import DirectTimes, Noise
    from eval.tracing.shadow_rays import ShadowRays

log = logging.getLogger("tron.eval")

Part = Literal[
    "camera",
    "inside",
    "growth",
    "shadow",
    "gradient",
    "irradiance",
    "noise",
    "few_rays",
    "error",
    "memory",
]
Case = tuple[PositiveInt, PositiveInt]


@dataclasses.dataclass
class Measured:
    """Everything a run of the benchmark found, before it is put into words.

    Attributes:
        camera: case such as "50k_512" -> times of one frame; those of the growth charts included.
        inside: frames of a camera within its scene, the room first.
        harmonics, from_gbuffers: the second recipe's and the degree-3 comparison's times, if measured.
        shapes: times of the peer's two plugins, and the one that was taken.
        pictures: name -> (H, W, 3) display values. inside_pictures: the same, by place.
        hits: mean candidates, front-facing and effective hits a camera ray.
    """

    camera: dict[str, CameraRays] = dataclasses.field(default_factory=dict)
    inside: list[CameraRays] = dataclasses.field(default_factory=list)
    harmonics: CameraRays | None = None
    from_gbuffers: CameraRays | None = None
    shapes: dict[str, Times] = dataclasses.field(default_factory=dict)
    shape: str = "ellipsoids"
    shadow: list[ShadowRays] = dataclasses.field(default_factory=list)
    gradient: list[GradientStep] = dataclasses.field(default_factory=list)
    direct: list[DirectTimes] = dataclasses.field(default_factory=list)
    noise: list[Noise] = dataclasses.field(default_factory=list)
    few_rays: list[FewRays] = dataclasses.field(default_factory=list)
    error: list[Row] = dataclasses.field(default_factory=list)
    memory: dict[str, float] = dataclasses.field(default_factory=dict)
    hits: tuple[float, float, float] | None = None
    pictures: dict[str, Any] = dataclasses.field(default_factory=dict)
    inside_pictures: dict[str, Any] = dataclasses.field(default_factory=dict)

    def seconds(self) -> dict[str, dict[str, list[float]]]:
        """Every time that was taken: case -> contestant -> seconds of its rounds."""
        cases = {f"camera {case}": frame.times for case, frame in self.camera.items()}
        cases |= {f"camera {frame.case}": frame.times for frame in self.inside}
        for name, frame in (("degree 3", self.harmonics), ("from G-buffers", self.from_gbuffers)):
            if frame is not None:
                cases[f"camera {frame.case}, {name}"] = frame.times
        cases |= {f"shadow {shadow.count}": shadow.times for shadow in self.shadow}
        cases |= {f"gradient {step.case}": step.times for step in self.gradient}
        cases |= {f"irradiance {found.light}": found.times for found in self.direct}
        return {
            case: {name: [round(s, 6) for s in taken.seconds] for name, taken in times.items()}
            for case, times in cases.items()
        }


class Tracing(Benchmark):
    """Settings: which parts, at which sizes. Beside the page, times.json keeps every round's seconds."""

    name: ClassVar[str] = "tracing"

    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    seed: int = 0
    parts: list[Part] = Field(description="what is measured", min_length=1)
    surfels: list[PositiveInt] = Field(description="sizes of the scene", min_length=1)
    pixels: list[PositiveInt] = Field(description="widths of the image, multiples of 4", min_length=1)
    sh_degree: int = Field(default=0, ge=0, le=3, description="harmonics' degree in the comparison")
    room: Case = Field(description="(surfels, pixels) of the frame from within a room")
    ground: Case = Field(description="(surfels, pixels) of the frame from a ground that one stands on")
    growth_surfels: list[PositiveInt] = Field(description="scenes of the growth chart, at the first size")
    growth_pixels: list[PositiveInt] = Field(description="images of the growth chart, second-size scene")
    shadow_rays: PositiveInt = Field(default=200_000, description="random shadow rays")
    shadow_spp: PositiveInt = Field(default=64, description="rays a pixel of the traced irradiance pass")
    gradient: list[Case] = Field(description="(surfels, pixels) of the gradient steps")
    irradiance: Case = Field(description="(surfels, pixels) of the comparison with Mitsuba's direct")
    noise: Case = Field(description="(surfels, pixels) of the error of irradiance")
    few_rays: Case = Field(description="(surfels, pixels) of irradiance of few rays, filtered and not")
    reference_spp: PositiveInt = Field(default=4096, description="rays a pixel of the reference irradiance")
    error_rays: PositiveInt = Field(default=2000, description="rays held against float64")
    memory_surfels: PositiveInt = Field(default=1_000_000, description="scene whose peak memory is measured")
    repetitions: PositiveInt = Field(default=5, description="rounds of interleaved timing")
    slow_repetitions: PositiveInt = Field(default=3, description="rounds for what takes over a second")

    def check(self) -> None:
        """Refuse sizes that the tile order of the rays cannot take."""
        sizes = (*self.pixels, self.room[1], self.ground[1], *self.growth_pixels)
        odd = [size for size in sizes if size % 4]
        if odd:
            raise TronError(f"images of {odd[0]} pixels", "benchmark.pixels", "give multiples of 4")

    def run(self, output_dir: Path) -> Outcome:
        """Measure part after part; one line on stderr for each case."""
        self.check()
        from tron.runtime import activate

        activate(self.variant)
        from eval.tracing import page

        measured = Measured()
        for part in self.parts:
            getattr(self, f"_measure_{part}")(measured)
        write_atomic(output_dir / "times.json", json.dumps(measured.seconds(), indent=1) + "\n")
        return page.outcome(self, measured, list(rows(measured, self)), output_dir)

    def _contenders(self, count: int, place: Place | None = None, **recipe: Any) -> Contenders:
        from eval.peers.contenders import Contenders
        from eval.peers.scene import OUTSIDE, STUDY, surfels

        made, place = dataclasses.replace(STUDY, **{"sh_degree": self.sh_degree, **recipe}), place or OUTSIDE
        return Contenders(surfels(count, self.seed, made, place), made.sh_degree, place=place)

    def _measure_camera(self, measured: Measured) -> None:
        from eval.peers import volprim
        from eval.peers.scene import FROM_GBUFFERS
        from eval.tracing.agreement import compare_images, hits_a_ray
        from eval.tracing.camera_rays import SHIPPED, VOLPRIM, faster_shape

        same_stop, shipped = volprim.load_integrator(volprim.OUR_STOP), volprim.load_integrator()
        integrators = {VOLPRIM: same_stop, SHIPPED: shipped}
        for k, count in enumerate(self.surfels):
            contenders = self._contenders(count)
            if k == 0:
                measured.shape, measured.shapes = faster_shape(contenders, self.pixels[0], same_stop)
                measured.hits = hits_a_ray(contenders.scene, self.pixels[0], self.seed)
            contenders.shape = measured.shape
            for size in self.pixels:
                self._time_frame(measured, contenders, size, integrators)
            if k == 0:
                measured.pictures |= compare_images(contenders, max(self.pixels), same_stop)
        count, size = self._middle
        harmonics = self._contenders(count, sh_degree=3)
        harmonics.shape = measured.shape
        measured.harmonics = self._frame(harmonics, size, {VOLPRIM: same_stop})
        flat = self._contenders(count, **dataclasses.asdict(FROM_GBUFFERS))
        measured.from_gbuffers = self._frame(flat, size, {})

    def _measure_inside(self, measured: Measured) -> None:
        from eval.peers import volprim
        from eval.peers.scene import GROUND, ROOM
        from eval.tracing.camera_rays import SHIPPED, VOLPRIM, faster_shape

        same_stop, shipped = volprim.load_integrator(volprim.OUR_STOP), volprim.load_integrator()
        integrators = {VOLPRIM: same_stop, SHIPPED: shipped}
        for place, (count, size) in ((ROOM, self.room), (GROUND, self.ground)):
            contenders = self._contenders(count, place)
            contenders.shape, _ = faster_shape(contenders, self.pixels[0], same_stop)
            usual = self._contenders(count) if place is ROOM else None
            measured.inside.append(self._frame(contenders, size, integrators, usual))
            picture = contenders.tracer.gbuffer(place.camera(size)).numpy()["rgb"]
            measured.inside_pictures[place.name] = picture.clip(0, 1)

    @property
    def _middle(self) -> tuple[int, int]:
        """The case of the targets: the second scene at the last size."""
        return self.surfels[min(1, len(self.surfels) - 1)], self.pixels[-1]

    def _measure_growth(self, measured: Measured) -> None:
        from eval.peers import volprim
        from eval.tracing.camera_rays import VOLPRIM

        integrators = {VOLPRIM: volprim.load_integrator(volprim.OUR_STOP)}
        cases = [(count, self.pixels[0]) for count in self.growth_surfels]
        cases += [(self._middle[0], size) for size in self.growth_pixels]
        for count in dict.fromkeys(count for count, _ in cases):
            contenders = self._contenders(count)
            contenders.shape = measured.shape
            for size in dict.fromkeys(size for other, size in cases if other == count):
                self._time_frame(measured, contenders, size, integrators)

    def _time_frame(
        self, measured: Measured, contenders: Contenders, size: int, integrators: dict[str, Any]
    ) -> None:
        case = f"{contenders.label}_{size}"
        if case not in measured.camera:
            measured.camera[case] = self._frame(contenders, size, integrators)

    def _frame(
        self,
        contenders: Contenders,
        size: int,
        integrators: dict[str, Any],
        usual: Contenders | None = None,
    ) -> CameraRays:
        from eval.tracing.camera_rays import TRON, measure_camera_rays

        rounds = self.repetitions, self.slow_repetitions
        frame = measure_camera_rays(contenders, size, integrators, *rounds, usual)
        told = ", ".join(f"{name} {1e3 * times.median:.1f} ms" for name, times in frame.times.items())
        log.info("camera rays %s: %.2f Mrays/s (%s)", frame.case, frame.mrays(TRON), told)
        return frame

    def _measure_shadow(self, measured: Measured) -> None:
        from eval.tracing.shadow_rays import measure_shadow_rays

        for count in self.surfels:
            found = measure_shadow_rays(
                self._contenders(count),
                self.pixels[0],
                self.shadow_rays,
                self.shadow_spp,
                self.seed,
                self.repetitions,
                self.slow_repetitions,
            )
            measured.shadow.append(found)
            for row in found.rows():
                log.info("%s: %.3f %s", row.metric, row.value, row.unit)

    def _measure_gradient(self, measured: Measured) -> None:
        from eval.tracing.gradients import measure_gradient

        for count, size in self.gradient:
            contenders = self._contenders(count)
            contenders.shape = measured.shape
            step = measure_gradient(contenders, size, self.repetitions, self.slow_repetitions)
            measured.gradient.append(step)
            log.info("gradient step %s: %.1f times as fast as volprim", step.case, step.ratio)

    def _measure_irradiance(self, measured: Measured) -> None:
        from eval.tracing.irradiance import measure_direct
        from eval.tracing.lights import LIGHTS

        count, size = self.irradiance
        contenders = self._contenders(count)
        for light in LIGHTS:
            found = measure_direct(contenders, size, light, self.seed, self.slow_repetitions)
            measured.direct.append(found)
            told = ", ".join(f"{name} {times.median:.2f} s" for name, times in found.times.items())
            log.info("irradiance under %s: %.2f times Mitsuba's direct (%s)", light, found.ratio, told)

    def _measure_noise(self, measured: Measured) -> None:
        from eval.tracing.irradiance import measure_noise
        from eval.tracing.lights import LIGHTS

        count, size = self.noise
        contenders = self._contenders(count)
        for light in LIGHTS:
            found = measure_noise(contenders, size, light, self.reference_spp, self.seed)
            measured.noise.append(found)
            told = ", ".join(f"{name} {value:.5f}" for name, value in {**found.rmse, **found.blocks}.items())
            log.info("irradiance under %s: %s", light, told)

    def _measure_few_rays(self, measured: Measured) -> None:
        from eval.tracing.few_rays import few_rays_rows, measure_few_rays
        from eval.tracing.lights import LIGHTS

        count, size = self.few_rays
        contenders = self._contenders(count)
        for light in LIGHTS:
            measured.few_rays.append(measure_few_rays(contenders, size, light, self.reference_spp, self.seed))
        for row in few_rays_rows(measured.few_rays):
            log.info("%s: %.4f", row.metric, row.value)

    def _measure_error(self, measured: Measured) -> None:
        from eval.tracing.accuracy import camera_errors, shadow_errors

        contenders = self._contenders(self.surfels[0])
        size = self.pixels[0]
        measured.error += camera_errors(contenders, size, self.error_rays, self.seed)
        measured.error += shadow_errors(contenders, size, self.error_rays, self.seed)
        for row in measured.error:
            log.info("%s: %.3g", row.metric, row.value)

    def _measure_memory(self, measured: Measured) -> None:
        from eval.tracing.memory import measure_memory

        measured.memory = measure_memory(self.memory_surfels, self.pixels[-1], self.variant, self.seed)
        log.info("memory of %d surfels: %s", self.memory_surfels, measured.memory)


def rows(measured: Measured, settings: Tracing) -> Iterator[Row]:
    """Every figure of a run."""
    from eval.peers.contenders import spelled
    from eval.tracing.few_rays import few_rays_rows
    from eval.tracing.irradiance import noise_rows

    for frame in measured.camera.values():
        yield from frame.rows()
    for frame in measured.inside:
        yield from frame.rows()
    if measured.harmonics is not None:
        yield from measured.harmonics.rows("_sh3")
    if measured.from_gbuffers is not None:
        yield from measured.from_gbuffers.rows("_from_gbuffers")
    for shadow in measured.shadow:
        yield from shadow.rows()
    for step in measured.gradient:
        yield from step.rows()
    if measured.direct:
        count, size = settings.irradiance
        case, n = f"{spelled(count)}_{size}", settings.slow_repetitions
        name = "irradiance.seconds_ratio_to_mitsuba_direct"
        for found in measured.direct:
            yield Row(metric=f"{name}_{found.light}.{case}", value=found.ratio, unit="x", n=n)
        worst = max(found.ratio for found in measured.direct)
        yield Row(metric=f"{name}.{case}", value=worst, unit="x", n=n)
        seconds = max(found.times["tron"].median for found in measured.direct)
        yield Row(metric=f"irradiance.seconds_64spp.{case}", value=seconds, unit="s", n=n)
    if measured.noise:
        yield from noise_rows(measured.noise)
    if measured.few_rays:
        yield from few_rays_rows(measured.few_rays)
    yield from measured.error
    for stage, value in measured.memory.items():
        metric = f"memory.{stage}_mb.{spelled(settings.memory_surfels)}"
        yield Row(metric=metric, value=value, unit="MB", n=1)
