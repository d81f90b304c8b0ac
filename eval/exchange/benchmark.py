"""Benchmark `exchange`: scenes in formats of other programs, each read by another program."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.report.outcome import Outcome
from eval.stages import Stages, script_path
from tron.errors import TronError
from tron.gaussians.formats.registry import check_header

Part = Literal["splats", "mesh", "models", "viewer"]


class Exchange(Benchmark):
    """Settings: parts, sizes, and paths of the other programs."""

    name: ClassVar[str] = "exchange"

    parts: list[Part] = Field(description="parts to measure", min_length=1)
    seed: int = 0
    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    threads: PositiveInt | None = Field(
        default=None, description="Cycles and Dr.Jit threads; null: one a core"
    )
    splat_transform: Path | None = Field(
        default=None, description="PlayCanvas's splat-transform; null: the one on PATH, if any"
    )
    blender_python: Path | None = Field(
        default=None,
        description="Python with bpy, in an environment of its own; null: no mesh, no models",
    )
    real_data: Path | None = Field(
        default=None, description="folder with assets, hdri; null: no mesh, models"
    )
    worlds: PositiveInt = Field(default=3, description="number of splat scenes, each under another light")
    surfels: PositiveInt = Field(default=20_000, description="approximate number of surfels of a splat scene")
    mesh_surfels: PositiveInt = Field(default=60_000, description="approximate surfels of the exported model")
    views: PositiveInt = Field(default=3, description="number of views of the mesh")
    width: PositiveInt = Field(default=256, description="width of the square views of the mesh")
    paths: PositiveInt = Field(default=144, description="samples per pixel of the mesh, Cycles and Mitsuba")
    model_paths: PositiveInt = Field(default=1024, description="samples per pixel of a model, each renderer")
    texture: int = Field(default=2048, ge=64, le=8192, description="width of the mesh's textures")
    scans: list[Path] | None = Field(
        default=None, description="plain 3DGS PLYs to view; null: all in real_data/splats"
    )
    scan_views: int = Field(default=8, ge=2, description="number of views of each scan")
    scan_sides: list[PositiveInt] = Field(
        default=[384, 512, 1024], min_length=1, description="widths of these square views"
    )
    playcanvas: Path | None = Field(
        default=None,
        description="npm package node_modules/playcanvas; null: no comparison with a real viewer",
    )

    def check(self) -> None:
        """Find the given programs."""
        from eval.exchange.readers import find_splat_transform, splat_transform_version
        from eval.renderers.blender import blender_version

        if "splats" in self.parts and (program := find_splat_transform(self.splat_transform)):
            splat_transform_version(program)
        if "mesh" in self.parts:
            script_path("tron-export")
        if {"mesh", "models"} & set(self.parts):
            if self.real_data is not None and not self.real_data.is_dir():
                raise TronError("no such folder", self.real_data, "give benchmark.real_data, or null")
            if self.blender_python is not None:
                blender_version(self.blender_python)
        for scan in self._scans() if "viewer" in self.parts else []:
            check_header(scan)

    def _scans(self) -> list[Path]:
        if self.scans is not None:
            return self.scans
        found = [] if self.real_data is None else sorted((self.real_data / "splats").glob("*.ply"))
        return [path for path in found if ".compressed" not in path.name]

    def _measure_viewer(self, outcome: Outcome) -> None:
        from eval.exchange.playcanvas import lacking
        from eval.exchange.splats import Baked
        from eval.exchange.viewer import measure_viewer

        why = lacking(self.playcanvas)
        if why is not None:
            outcome.lack("viewer.playcanvas.behind", why)
        engine = self.playcanvas if why is None else None
        if not self._scans():
            outcome.lack("viewer.psnr", "no scan: give benchmark.scans, or benchmark.real_data")
        world = Baked.drawn(0, self.surfels, self.seed)
        with tempfile.TemporaryDirectory(prefix="tron-") as folder:
            measure_viewer(
                self._scans(), world, self.scan_views, self.scan_sides, engine, Path(folder), self.seed,
                outcome,
            )  # fmt: skip

    def run(self, output_dir: Path) -> Outcome:
        """Measure part by part; write one line per figure to stderr.

        Raises:
            StageFailed: tron-export failed.
            TronError: a given program does not exist, or Blender cannot read the mesh.
        """
        # The renderer: not for a mistyped key
        from eval.exchange.mesh import Sizes, measure_mesh
        from eval.exchange.models import measure_models
        from eval.exchange.readers import find_splat_transform, splat_transform_version
        from eval.exchange.splats import find_readers, measure_splats
        from eval.renderers.blender import blender_version
        from tron.runtime import activate

        self.check()
        activate(self.variant, self.threads)
        outcome, stages = Outcome(output_dir), Stages(output_dir)
        threads = self.threads or os.cpu_count() or 1
        for part in self.parts:
            stages.restart(f"part {part}")  # a figure of this run, never of one before
            with stages.timed(f"part {part}", [["tron-eval", f"benchmark.parts=[{part}]"]]):
                if part == "splats":
                    program = find_splat_transform(self.splat_transform)
                    if program is not None:
                        outcome.inputs["splat_transform"] = splat_transform_version(program)
                    readers = find_readers(program)
                    measure_splats(self.worlds, self.surfels, self.seed, readers, outcome)
                elif part == "viewer":
                    self._measure_viewer(outcome)
                else:
                    data, python = self.real_data, self.blender_python
                    if python is not None:
                        outcome.inputs["blender"] = blender_version(python)
                    if part == "models":
                        measure_models(data, python, self.model_paths, self.seed, threads, outcome)
                        continue
                    sizes = Sizes(self.mesh_surfels, self.views, self.width, self.paths, self.texture)
                    measure_mesh(data, python, sizes, self.seed, threads, outcome, stages)
        return outcome
