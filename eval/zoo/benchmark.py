"""Benchmark `zoo`: `lit` against path tracing on every kind of material, shape and light."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import DirectoryPath, Field, PositiveInt

from eval.benchmark import Benchmark
from eval.renderers.blender import INSTALL, blender_version
from eval.report.outcome import Outcome
from eval.stages import Stages
from tron.cli.progress import track
from tron.errors import TronError

Part = Literal["cells", "sheets"]
Kind = Literal["ball", "bowl", "box", "steps", "sheet", "leaf", "wire", "crate", "room", "relief", "thick"]


class Zoo(Benchmark):
    """Settings of the zoo; the seed draws shapes, materials and lights."""

    name: ClassVar[str] = "zoo"

    parts: list[Part] = Field(description="parts to measure", min_length=1)
    seed: int = Field(default=0, description="seed; targets are for 0, other seeds are for development")
    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    threads: PositiveInt | None = Field(
        default=None, description="Cycles and Dr.Jit threads; null: one a core"
    )
    shapes: list[Kind] = Field(description="kinds of shapes", min_length=1)
    lights: list[str] | None = Field(default=None, description="names of lights; null: all")
    materials: PositiveInt | None = Field(default=None, description="most materials per shape; null: all")
    real_data: DirectoryPath | None = Field(
        default=None, description="folder with hdri; without it maps are drawn"
    )
    denoisers: bool = Field(default=True, description="measure denoisers and the shipped network too")
    blender_python: Path | None = Field(
        default=None, description="Python with bpy, in an environment of its own; null: no Cycles"
    )

    def check(self) -> None:
        """Refuse a Python without Blender."""
        if self.blender_python is not None:
            blender_version(self.blender_python)

    def run(self, output_dir: Path) -> Outcome:
        """Measure part by part; write one line per shape and figure to stderr.

        Raises:
            TronError: a light does not exist, or Blender failed.
        """
        # The renderer: not for a mistyped key
        from eval.zoo.sheets import measured_sheets, sheet_rows
        from tron.runtime import activate

        self.check()
        activate(self.variant, self.threads)
        outcome, stages = Outcome(output_dir), Stages(output_dir)
        for part in self.parts:
            stages.restart(f"part {part}")  # a figure of this run, never of one before
            with stages.timed(f"part {part}", [["tron-eval", f"benchmark.parts=[{part}]"]]):
                if part == "cells":
                    self._measure_cells(outcome)
                else:
                    outcome.add(sheet_rows(list(measured_sheets(self.seed))))
        return outcome

    def _measure_cells(self, outcome: Outcome) -> None:
        from eval.relighting.networks import load_networks
        from eval.zoo.cells import measured
        from eval.zoo.lights import draw_lights, photographed
        from eval.zoo.rows import zoo_rows
        from eval.zoo.shapes import individuals
        from eval.zoo.wall import draw_wall
        from eval.zoo.witness import chosen, witness_rows, witnessed
        from tron.denoising import DENOISERS, lacking
        from tron.neural.shipped import DEFAULT, installed
        from tron.report.page import Picture, Pictures

        lights = draw_lights(self.real_data and self.real_data / "hdri", self.seed)
        names = [light.name for light in lights]
        outcome.inputs["lights"] = names
        if not photographed(lights):
            outcome.lack(
                "zoo.ball.rough_error.venice",
                "drawn maps light it: give benchmark.real_data=FOLDER with hdri",
            )
        for name in self.lights or []:
            if name not in names:
                raise TronError(f"no light {name}", "benchmark.lights", f"they are {', '.join(names)}")
        lights = [light for light in lights if self.lights is None or light.name in self.lights]
        networks, denoisers = {}, []
        if self.denoisers and DEFAULT in installed():
            networks = {"network": load_networks("neural", [DEFAULT])["neural_lit"]}
        for name in DENOISERS if self.denoisers else ():
            if (error := lacking(name, "the zoo")) is None:
                denoisers.append(name)
            else:
                outcome.lack(f"zoo.psnr.preview_{name}", str(error))
        cells, shapes = [], {}
        drawn = list(individuals(self.shapes, self.materials, self.seed))
        for shape, materials in track(drawn, "shapes"):
            shapes[shape.kind, shape.number] = shape
            cells += measured(shape, materials, lights, self.seed, denoisers, networks)
        outcome.add(zoo_rows(cells))
        words = "every cell of the zoo, coloured by its mean, and the worst beside path tracing"
        outcome.show("wall", "wall", Pictures("The wall", [Picture(draw_wall(cells), "", words)], columns=1))
        if self.blender_python is None:
            outcome.lack("zoo.cycles.worst_mean", f"benchmark.blender_python is not given: {INSTALL}")
            return
        outcome.inputs["blender"] = blender_version(self.blender_python)
        threads, folder = self.threads or os.cpu_count() or 1, outcome.folder.absolute() / "cycles"
        some = chosen(cells, shapes, self.seed)
        outcome.add(
            witness_rows(
                list(witnessed(self.blender_python, some, shapes, lights, folder, self.seed, threads))
            )
        )
