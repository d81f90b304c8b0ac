"""Settings of tron-reconstruct."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from tron.apps.scene_file import SURROUNDINGS
from tron.captures.load import CaptureSettings, LoadSettings
from tron.reconstruction.settings import FitSettings, ReconstructionSettings
from tron.runtime import Variant
from tron.scans import Treatment


class Paths(BaseModel):
    """Capture that is reconstructed, and the folder that the files go to."""

    capture: Path = Field(
        description="folder of photos, with or without poses, or of path-traced views; or a PLY of splats"
    )
    output_dir: Path = Field(description="folder for scene.ply, environment.exr, metrics.json and pictures")


class SplatSettings(BaseModel):
    """Virtual cameras that film a file of splats."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    geometry: Literal["auto", "scan", "new"] = Field(
        default="auto",
        description="scan: all of its surfels stay as they are and get materials, in a minute; new: other "
        "surfels are learnt from the film, which takes many minutes and loses detail, but gives them "
        "normals; auto: new where the scan is thin, else scan",
    )
    cameras: Literal["auto", "around", "inside", "both"] = Field(
        default="auto",
        description="around the subject, for things; inside, for rooms: from free places, in all directions; "
        "both: half of each; auto: as in cameras.json beside the file, where photos looked, else around",
    )
    views: int = Field(default=64, ge=4, le=10_000, description="number of pictures")
    surroundings: Treatment = Field(default="drop", description=SURROUNDINGS)
    side: int = Field(default=200, ge=16, le=8192, description="their width and height, pixels")


class ReportSettings(BaseModel):
    """Page of a reconstruction."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: int = Field(
        default=24, ge=0, le=1000, description="frames of each film of the scene relit; 0: no films"
    )
    side: int = Field(default=320, ge=16, le=2048, description="pixels of their longer side")
    views: int = Field(default=4, ge=1, le=100, description="held-out views that are shown")


# Bases are listed the other way round than their keys: pydantic collects fields from the last base first.
class Settings(ReconstructionSettings, CaptureSettings, Paths):
    """Everything that tron-reconstruct can be told."""

    splats: SplatSettings = Field(
        default=SplatSettings(), description="virtual cameras that render a PLY of splats"
    )
    prior: Any = Field(description="source of normals, materials and irradiance, by _target_ (prior=NAME)")
    light: FitSettings | None = Field(
        default=FitSettings(), description="environment map and scale; null fits none"
    )
    report: ReportSettings | None = Field(
        default=ReportSettings(), description="report.html; null writes none"
    )
    score_every: int = Field(
        0,
        ge=0,
        description="steps between two evaluations of the held-out views, kept in curve.json; 0: none",
    )
    lpips_weights: Path | None = Field(
        None, description="local vgg16-397923af.pth, to score LPIPS as well; nothing is downloaded"
    )
    overwrite: bool = Field(False, description="start again in an output_dir made with other settings")
    variant: Variant = "llvm_ad_rgb"
    threads: int | None = Field(
        None, ge=1, description="threads of the renderer; null: all; with 1, runs are reproducible bit by bit"
    )

    def of_loading(self) -> LoadSettings:
        """Reading of the capture; poses that are found are kept in the output folder."""
        return LoadSettings(
            **{name: getattr(self, name) for name in CaptureSettings.model_fields},
            workspace=self.output_dir / "structure_from_motion",
            threads=self.threads or 0,
            seed=self.seed,
        )

    def of_surfels(self) -> ReconstructionSettings:
        """Those that the surfels depend on."""
        return ReconstructionSettings(
            **{name: getattr(self, name) for name in ReconstructionSettings.model_fields}
        )

    def kept(self) -> dict[str, Any]:
        """Plain values for metrics.json, by which a finished run is known again."""
        return {**self.model_dump(mode="json"), "overwrite": False}
