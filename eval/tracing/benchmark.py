"""Benchmark `tracing`: the tracer's speed, exactness and noise, beside what a user would pick instead."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path

from eval.peers.contenders import SHIPPED, Contenders
from eval.peers.scene import FROM_GBUFFERS, GROUND, ROOM, STUDY, Recipe
from eval.peers.timing import fastest, write_times
from eval.report.outcome import Outcome
from eval.results import Row
from eval.tracing import page
from eval.tracing.accuracy import camera_errors, shadow_errors
from eval.tracing.agreement import compare_images, hits_a_ray
from eval.tracing.bounce import measure_bounce, measure_equal_error
from eval.tracing.camera_rays import measure_camera_rays, time_shapes
from eval.tracing.few_rays import measure_few_rays
from eval.tracing.gradients import measure_gradient
from eval.tracing.irradiance import measure_direct, measure_noise
from eval.tracing.lights import LIGHTS
from eval.tracing.measured import CameraRays, Measured, TracingSettings, few_rays_rows
from eval.tracing.memory import measure_memory
from eval.tracing.shadow_rays import measure_shadow_rays
from tron.runtime import activate

log = logging.getLogger("tron.eval")


class Tracing(TracingSettings):
    """Parts of the benchmark; beside the page, times.json keeps every round's seconds."""

    def run(self, output_dir: Path) -> Outcome:
        """Measure part after part; one line on stderr for each case."""
        self.check()
        activate(self.variant)
        measured = Measured(self)
        for part in self.parts:
            if part == "equal_error":
                measured.equal_error = measure_equal_error(self.equal_error, output_dir)
                _say(measured.equal_error.rows(self.seed))
            else:
                getattr(self, f"_measure_{part}")(measured)
        write_times(output_dir / "times.json", measured.timed())
        return page.outcome(measured, output_dir)

    @property
    def _recipe(self) -> Recipe:
        return replace(STUDY, sh_degree=self.sh_degree)

    def _contenders(self, count: int, shapes: Measured | None = None) -> Contenders:
        """The usual scene; primitives are of the shape that was ``measured`` to be faster, if it was."""
        contenders = Contenders.of(count, self.seed, self._recipe)
        if shapes and shapes.shapes:
            contenders.shape = fastest(shapes.shapes)
        return contenders

    def _measure_camera(self, measured: Measured) -> None:
        for k, count in enumerate(self.surfels):
            contenders = self._contenders(count, measured)
            if k == 0:
                measured.shapes = time_shapes(contenders, self.pixels[0])
                contenders.shape = fastest(measured.shapes)
                measured.hits = hits_a_ray(contenders.scene, self.pixels[0], self.seed)
            for size in self.pixels:
                self._add_frame(measured, contenders, size)
            if k == 0:
                measured.same_picture = compare_images(contenders, max(self.pixels))
        count, size = self.middle
        for recipe, without in (
            (replace(STUDY, name="sh3", sh_degree=3), [SHIPPED]),
            (FROM_GBUFFERS, ["volprim", SHIPPED]),
        ):
            contenders = Contenders.of(count, self.seed, recipe)
            contenders.shape = fastest(measured.shapes)
            measured.variants.append(self._frame(contenders, size, without))

    def _measure_inside(self, measured: Measured) -> None:
        for place, (count, size) in ((ROOM, self.room), (GROUND, self.ground)):
            contenders = Contenders.of(count, self.seed, self._recipe, place)
            contenders.shape = fastest(time_shapes(contenders, self.pixels[0]))
            usual = self._contenders(count) if place is ROOM else None
            measured.inside.append(self._frame(contenders, size, usual=usual))
            picture = contenders.tracer.gbuffer(place.camera(size)).numpy()["rgb"]
            measured.inside_pictures[place.name] = picture.clip(0, 1)

    def _measure_growth(self, measured: Measured) -> None:
        cases = [(count, self.pixels[0]) for count in self.growth_surfels]
        cases += [(self.middle[0], size) for size in self.growth_pixels]
        for count in dict.fromkeys(count for count, _ in cases):
            contenders = self._contenders(count, measured)
            for size in dict.fromkeys(size for other, size in cases if other == count):
                self._add_frame(measured, contenders, size, [SHIPPED])

    def _add_frame(
        self, measured: Measured, contenders: Contenders, size: int, without: Collection[str] = ()
    ) -> None:
        """Time a frame of the usual scene, unless its case was timed before."""
        known = {(frame.count, frame.size) for frame in measured.camera}
        if (len(contenders.scene), size) not in known:
            measured.camera.append(self._frame(contenders, size, without))

    def _frame(
        self,
        contenders: Contenders,
        size: int,
        without: Collection[str] = (),
        usual: Contenders | None = None,
    ) -> CameraRays:
        frame = measure_camera_rays(contenders, size, self.rounds, without, usual)
        _say(frame.rows())
        return frame

    def _measure_shadow(self, measured: Measured) -> None:
        sizes = self.pixels[0], self.shadow_rays, self.shadow_spp
        for count in self.surfels:
            found = measure_shadow_rays(self._contenders(count), *sizes, self.seed, self.rounds)
            measured.shadow.append(found)
            _say(found.rows())

    def _measure_gradient(self, measured: Measured) -> None:
        for count, size in self.gradient:
            step = measure_gradient(self._contenders(count, measured), size, self.rounds)
            measured.gradient.append(step)
            _say(step.rows())

    def _measure_irradiance(self, measured: Measured) -> None:
        count, size = self.irradiance
        contenders = self._contenders(count)
        for light in LIGHTS:
            found = measure_direct(contenders, size, light, self.seed, self.rounds)
            measured.direct.append(found)
            log.info("irradiance under %s: %.2f times Mitsuba's direct", light, found.ratio)

    def _measure_noise(self, measured: Measured) -> None:
        count, size = self.noise
        contenders = self._contenders(count)
        for light in LIGHTS:
            found = measure_noise(contenders, size, light, self.reference_spp, self.seed)
            measured.noise.append(found)
            for name, value in {**found.rmse, **found.blocks}.items():
                log.info("irradiance under %s: %s %.5f", light, name, value)

    def _measure_few_rays(self, measured: Measured) -> None:
        count, size = self.few_rays
        contenders = self._contenders(count)
        for light in LIGHTS:
            measured.few_rays.append(measure_few_rays(contenders, size, light, self.reference_spp, self.seed))
        _say(few_rays_rows(measured.few_rays))

    def _measure_error(self, measured: Measured) -> None:
        contenders, size = self._contenders(self.surfels[0]), self.pixels[0]
        measured.error += camera_errors(contenders, size, self.error_rays, self.seed)
        measured.error += shadow_errors(contenders, size, self.error_rays, self.seed)
        _say(measured.error)

    def _measure_bounce(self, measured: Measured) -> None:
        for count, size in self.bounce:
            found = measure_bounce(self._contenders(count), size, self.rounds)
            measured.bounce.append(found)
            _say(found.rows())

    def _measure_memory(self, measured: Measured) -> None:
        measured.memory = measure_memory(self.memory_surfels, self.pixels[-1], self.variant, self.seed)
        log.info("memory of %d surfels: %s", self.memory_surfels, measured.memory)


def _say(rows: Iterable[Row]) -> None:
    for row in rows:
        log.info("%s: %.4g %s", row.metric, row.value, row.unit)
