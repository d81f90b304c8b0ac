"""Benchmark `tracing`: speed and accuracy of the tracer against others, and hard cases of guidance."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.renderers.blender import blender_version
from eval.report.outcome import Outcome
from eval.timing import Timed, write_times
from eval.tracing.accuracy import camera_errors, compare_images, shadow_errors
from eval.tracing.furnace import measure_furnace
from eval.tracing.hard_cases import measure_hard_cases
from eval.tracing.peers import SHAPES, Contenders
from eval.tracing.scene import LIGHTS
from eval.tracing.speed import (
    Found,
    measure_bounce,
    measure_camera,
    measure_direct,
    measure_gradient,
    measure_shadow,
    measure_shapes,
)
from tron.color import to_display
from tron.errors import TronError
from tron.report.page import Picture, Pictures
from tron.runtime import activate

Part = Literal["camera", "shadow", "gradient", "irradiance", "guidance", "error", "bounce", "furnace"]
Case = tuple[PositiveInt, PositiveInt]


class Tracing(Benchmark):
    """Settings: parts and sizes; times.json beside results.json has the seconds of every round."""

    name: ClassVar[str] = "tracing"

    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    seed: int = 0
    rounds: PositiveInt = Field(
        default=5, description="rounds of timing in turns; three rounds of anything over a second"
    )
    parts: list[Part] = Field(description="parts to measure", min_length=1)
    surfels: list[PositiveInt] = Field(description="numbers of surfels of the scene", min_length=1)
    pixels: list[PositiveInt] = Field(description="widths of the image, multiples of 4", min_length=1)
    shadow_rays: PositiveInt = Field(default=200_000, description="number of random shadow rays")
    shadow_spp: PositiveInt = Field(default=64, description="rays per pixel of the traced irradiance pass")
    gradient: list[Case] = Field(description="(surfels, pixels) of the gradient steps")
    irradiance: Case = Field(description="(surfels, pixels) of the comparison with Mitsuba's direct")
    error_rays: PositiveInt = Field(default=2000, description="number of rays compared with float64")
    bounce: list[Case] = Field(description="(surfels, pixels) of transport, bake and frames with bounces")
    blender_python: Path | None = Field(
        default=None, description="Python with bpy, in an environment of its own; null: no Cycles"
    )

    def check(self) -> None:
        """Refuse sizes that do not fit the tile order of the rays, and a Python without Blender."""
        odd = [size for size in self.pixels if size % 4]
        if odd:
            raise TronError(f"images of {odd[0]} pixels", "benchmark.pixels", "give multiples of 4")
        if "furnace" in self.parts and self.blender_python is not None:
            blender_version(self.blender_python)

    def run(self, output_dir: Path) -> Outcome:
        """Measure part by part; write one line per figure to stderr."""
        self.check()
        activate(self.variant)
        outcome, timed, shape = Outcome(output_dir), list[Timed](), SHAPES[0]
        if {"camera", "gradient"} & set(self.parts):
            shape = measure_shapes(Contenders.of(self.surfels[0], self.seed), self.pixels[0], 3)

        def keep(found: Found) -> None:
            timed.append(found[0])
            outcome.add(found[1])

        for part in self.parts:
            match part:
                case "camera":
                    for count in self.surfels:
                        contenders = Contenders.of(count, self.seed, shape)
                        for size in self.pixels:
                            keep(measure_camera(contenders, size, self.rounds))
                    smallest = Contenders.of(self.surfels[0], self.seed, shape)
                    outcome.show("camera", "camera", compare_images(smallest, max(self.pixels)))
                case "shadow":
                    sizes = self.pixels[0], self.shadow_rays, self.shadow_spp
                    for count in self.surfels:
                        contenders = Contenders.of(count, self.seed)
                        keep(measure_shadow(contenders, *sizes, self.seed, self.rounds))
                case "gradient":
                    for count, size in self.gradient:
                        keep(measure_gradient(Contenders.of(count, self.seed, shape), size, self.rounds))
                case "irradiance":
                    timed += self._measure_irradiance(outcome)
                case "guidance":
                    outcome.add(measure_hard_cases(self.rounds))
                case "error":
                    contenders = Contenders.of(self.surfels[0], self.seed)
                    for errors in (camera_errors, shadow_errors):
                        outcome.add(errors(contenders, self.pixels[0], self.error_rays, self.seed))
                case "bounce":
                    for count, size in self.bounce:
                        keep(measure_bounce(Contenders.of(count, self.seed), size, self.rounds))
                case "furnace":
                    if self.blender_python is not None:
                        outcome.inputs["blender"] = blender_version(self.blender_python)
                    threads = os.cpu_count() or 1
                    measure_furnace(self.blender_python, self.rounds, self.seed, threads, outcome)
        write_times(output_dir / "times.json", timed)
        return outcome

    def _measure_irradiance(self, outcome: Outcome) -> list[Timed]:
        """Measure the ratio under every light, the worst ratio, and the seconds of the pass."""
        count, size = self.irradiance
        contenders, found = Contenders.of(count, self.seed), []
        for light in LIGHTS:
            timed, ratio, images, exposure = measure_direct(contenders, size, light, self.seed, self.rounds)
            pictures = [
                Picture(to_display(image, exposure), title, f"irradiance under {light}: {title}")
                for title, image in images.items()
            ]
            outcome.show("irradiance", f"direct-{light}", Pictures(f"Light: {light}", pictures, columns=2))
            found.append((timed, ratio, light))
        name = "irradiance.seconds_ratio_to_mitsuba_direct"
        outcome.add(timed.row(f"{name}_{light}", ratio, "x") for timed, ratio, light in found)
        worst = found[int(np.argmax([ratio for _, ratio, _ in found]))]
        seconds = max(timed.times["tron"].median for timed, *_ in found)
        outcome.add(
            [
                worst[0].row(name, worst[1], "x"),
                worst[0].row("irradiance.seconds_64spp", seconds, "s"),
            ]
        )
        return [timed for timed, *_ in found]
