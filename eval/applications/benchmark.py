"""Benchmark `applications`: each application of a scene against an independent reference."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import DirectoryPath, Field, PositiveInt

from eval.benchmark import Benchmark
from eval.report.outcome import Outcome
from eval.stages import Child, Stages, script_path
from tron.cli.installation import require_own_packages
from tron.errors import TronError

log = logging.getLogger(__name__)

Part = Literal["select", "bake", "harmonise", "motion", "meshes", "viewer"]
SCENES = "scenes"
"""Of a data set's folder: one a scene, with surfels.ply."""


class Applications(Benchmark):
    """Settings: parts of the benchmark; finished scenes are reused."""

    name: ClassVar[str] = "applications"

    parts: list[Part] = Field(description="parts to measure", min_length=1)
    seed: int = 0
    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    threads: PositiveInt | None = Field(default=None, description="threads of Dr.Jit; null: one per core")
    scenes: list[str] = Field(
        description="arguments of tron-datagen: scenes with true object ids, for selecting and baking"
    )
    data: Path | None = Field(default=None, description="folder of these scenes if they exist already")
    real_data: DirectoryPath | None = Field(
        default=None, description="folder with assets and hdri; null: no meshes"
    )

    def check(self) -> None:
        """Check that the scenes exist, or the command that makes them."""
        if not {"select", "bake"} & set(self.parts):
            return
        if self.data is not None:
            _folders(self.data)
        else:
            require_own_packages("datagen")
            script_path("tron-datagen")

    def run(self, output_dir: Path) -> Outcome:
        """Measure part by part; write one line per figure to stderr.

        Raises:
            StageFailed: the command that makes the scenes failed.
            TronError: scenes are not what they should be.
        """
        # The renderer: not for a mistyped key
        from eval.applications.baking import measure_baking
        from eval.applications.harmonising import measure_harmonising
        from eval.applications.meshes import measure_meshes
        from eval.applications.moving import measure_motion
        from eval.applications.selecting import measure_selections
        from eval.applications.viewing import measure_viewer
        from tron.runtime import activate

        self.check()
        output_dir = output_dir.absolute()
        outcome, stages = Outcome(output_dir), Stages(output_dir)
        activate(self.variant, self.threads)
        for part in self.parts:
            stages.restart(f"part {part}")  # a figure of this run, never of one before
            with stages.timed(f"part {part}", [["tron-eval", f"benchmark.parts=[{part}]"]]):
                match part:
                    case "select":
                        measure_selections(self._scenes(stages, output_dir), self.seed, outcome)
                    case "bake":
                        measure_baking(self._scenes(stages, output_dir), self.seed, outcome)
                    case "harmonise":
                        measure_harmonising(self.seed, outcome)
                    case "motion":
                        measure_motion(self.seed, outcome)
                    case "meshes":
                        if self.real_data is None or not (self.real_data / "assets").is_dir():
                            log.warning("no meshes: give benchmark.real_data=FOLDER with assets and hdri")
                        else:
                            measure_meshes(self.real_data, self.seed, outcome)
                    case "viewer":
                        measure_viewer(self.seed, outcome, self.threads)
        return outcome

    def _scenes(self, stages: Stages, folder: Path) -> list[Path]:
        """Return the folders of the scenes; make the scenes on first use."""
        if self.data is not None:
            return _folders(self.data)
        made = folder / SCENES
        stages.run(SCENES, [Child(SCENES, "tron-datagen", [*self.scenes, f"output_dir={made}"])])
        return _folders(made)


def _folders(dataset: Path) -> list[Path]:
    """Return the folders of a data set's scenes, sorted; TronError if it has none."""
    found = sorted(path.parent for path in (dataset / SCENES).glob("*/surfels.ply"))
    if not found:
        raise TronError(
            "no scenes with surfels.ply", dataset, "give a folder that tron-datagen wrote, or null"
        )
    return found
