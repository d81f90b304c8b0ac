"""Benchmark `exchange`: scenes as files of other programs, each read by a program that is not ours."""

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
    """Parts, sizes, and where the other programs are."""

    name: ClassVar[str] = "exchange"

    parts: list[Part] = Field(description="what is measured", min_length=1)
    seed: int = 0
    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    threads: PositiveInt | None = Field(default=None, description="of Dr.Jit and of Cycles; null: one a core")
    splat_transform: Path | None = Field(
        default=None, description="PlayCanvas's splat-transform; null: the one on PATH, if any"
    )
    blender_python: Path | None = Field(
        default=None,
        description="a Python that has bpy, of an environment of its own; null: no mesh, no models",
    )
    real_data: Path | None = Field(description="folder with assets and hdri; null: no mesh, no models")
    worlds: PositiveInt = Field(default=3, description="scenes of splats, each under another kind of light")
    surfels: PositiveInt = Field(default=20_000, description="of each scene of splats, about")
    mesh_surfels: PositiveInt = Field(default=60_000, description="of the model that becomes a mesh, about")
    views: PositiveInt = Field(default=3, description="of the mesh")
    width: PositiveInt = Field(default=256, description="of the square views of the mesh")
    paths: PositiveInt = Field(default=144, description="of a pixel of the mesh, by Cycles and by Mitsuba")
    model_paths: PositiveInt = Field(default=1024, description="of a pixel of a model, by either")
    texture: int = Field(default=2048, ge=64, le=8192, description="pixels of a side of the mesh's textures")
    scans: list[Path] | None = Field(
        default=None, description="plain 3DGS PLYs that viewers show; null: those of real_data/splats"
    )
    scan_views: int = Field(default=8, ge=2, description="of each scan")
    scan_sides: list[PositiveInt] = Field(
        default=[384, 512, 1024], min_length=1, description="of these views"
    )
    playcanvas: Path | None = Field(
        default=None,
        description="node_modules/playcanvas, the npm package; null: no picture of a real viewer",
    )

    def check(self) -> None:
        """Find the programs that are given."""
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
        """Measure part after part; one line on stderr for each figure.

        Raises:
            StageFailed: tron-export failed.
            TronError: a program that is given is not there, or Blender cannot read the mesh.
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
