"""Settings of the benchmark `reconstruction`, and what a run of it measures.

:mod:`eval.reconstruction.benchmark` fills :class:`Measured`; the pages read nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

from eval.peers.settings import SpeedBenchmark
from eval.peers.timing import Timed
from eval.reconstruction.runs import Run, gain_rows, light_rows, rows_of
from eval.reconstruction.scans import Scan, scan_rows
from eval.results import Row
from eval.stages import Stages

Part = Literal["scenes", "photos", "splats", "fox", "steps"]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
TRON, VOLPRIM, SHIPPED = "tron", "volprim", "volprim_as_shipped"
CHANNELS = ("radiance", "normal", "base color", "light")


class SplatSettings(BaseModel):
    """Scans of some scenes as other programs leave them, and what tron-reconstruct makes of those."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scenes: PositiveInt = Field(default=1, description="scenes, from the first")
    scan: list[str] = Field(description="arguments of tron-reconstruct for what becomes the scan")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct for the scan as a capture")


class ReconstructionSettings(SpeedBenchmark):
    """Parts of the benchmark, and the arguments of the commands."""

    name: ClassVar[str] = "reconstruction"

    parts: list[Part] = Field(description="what is measured", min_length=1)
    datagen: list[str] = Field(description="arguments of tron-datagen, which makes the captures")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct for every scene and way")
    ways: dict[Name, list[str]] = Field(description="further ones of each way; the first is the main one")
    photographs: list[str] = Field(
        description="arguments of tron-datagen, which makes the same scenes as photographs, and relights them"
    )
    photos: dict[Name, list[str]] = Field(
        description="further arguments of each way to reconstruct the photographs, none of which is a way's"
    )
    before: Name = Field(default="classical", description="way over which photographs' gain is told")
    relit: list[Name] = Field(description="ways whose surfels are relit, beside those of photographs")
    splats: SplatSettings = Field(description="scans of plain splats, made and taken as captures")
    real_data: Path | None = Field(description="folder with captures/fox and hdri; null: no fox")
    fox_downscale: PositiveFloat = Field(default=8, description="factor by which the photos are reduced")
    fox: list[str] = Field(description="further arguments of tron-reconstruct for the fox")
    hdris: list[str] = Field(description="files of hdri under which the fox is relit")
    relight: list[str] = Field(description="arguments of tron-relight")
    relit_views: PositiveInt = Field(default=3, description="held-out views of the fox that are shown")
    relit_enlarged: PositiveInt = Field(
        default=2, description="relit pixels per pixel of the photo, along a side"
    )
    step_pixels: list[PositiveInt] = Field(
        description="widths of the view of the steps beside the peer; the first is the main one", min_length=1
    )
    step_degree2: list[str] = Field(
        description="arguments of tron-reconstruct, after the first way's, for a scene of the peer's kernel"
    )
    growth_surfels: list[PositiveInt] = Field(description="surfels of the growth chart")
    growth_pixels: list[PositiveInt] = Field(description="widths of the growth chart, multiples of 4")
    growth_at: tuple[PositiveInt, PositiveInt] = Field(
        description="surfels where pixels grow, pixels a side where surfels grow"
    )

    def target(self, metric: str, title: str) -> tuple[str, float] | None:
        """Line of a target on a chart: its title and its value, if there is such a target."""
        return next(((title, target.value) for target in self.targets if target.metric == metric), None)


@dataclass(frozen=True)
class Compared:
    """One held-out view of a path-traced scene.

    Attributes:
        scene: name of the scene.
        family: of its light; empty if unknown.
        view: name of the view.
        truth: channel -> (H, W, 3) display values, of the capture.
        ways: way -> channel -> the same, of the reconstruction.
        figures: way -> channel -> a short figure of that very picture, where there is one.
    """

    scene: str
    family: str
    view: str
    truth: dict[str, np.ndarray]
    ways: dict[str, dict[str, np.ndarray]]
    figures: dict[str, dict[str, str]]


@dataclass(frozen=True)
class Fox:
    """The real capture as it was photographed, reconstructed and relit.

    Attributes:
        run: the reconstruction.
        photos: name of a held-out view -> (H, W, 3) display values.
        rendered: name -> channel -> (H, W, 3) display values, of the surfels.
        relit: name of a light -> its picture, then one picture a view.
        relit_seconds: of all the lights together.
        light: picture of the fitted light, if one was fitted.
    """

    run: Run
    photos: dict[str, np.ndarray]
    rendered: dict[str, dict[str, np.ndarray]]
    relit: dict[str, list[np.ndarray]]
    relit_seconds: float
    light: np.ndarray | None

    def rows(self) -> Iterator[Row]:
        """Figures of the reconstruction, and the time of relighting it."""
        report = self.run.report
        for name, key, unit in (("test_psnr", "psnr", "dB"), ("ssim", "ssim", "1"), ("lpips", "lpips", "1")):
            if key in report.test:
                n = len(report.capture.held_out)
                yield Row(metric=f"fox.{name}", value=report.test[key], unit=unit, n=n)
        views = int(report.train["views"])
        yield Row(metric="fox.train_psnr", value=report.train["psnr"], unit="dB", n=views)
        for name, value, unit in (
            ("seconds", self.run.seconds, "s"),
            ("surfels_seconds", report.seconds.surfels, "s"),
            ("light_seconds", report.seconds.light, "s"),
            ("surfels", report.surfels, "surfels"),
            ("views", report.capture.views, "views"),
        ):
            yield Row(metric=f"fox.{name}", value=value, unit=unit, n=1)
        if self.relit:
            yield Row(metric="fox.relight_seconds", value=self.relit_seconds, unit="s", n=len(self.relit))


@dataclass(frozen=True)
class Steps(Timed):
    """Times of whole steps, of either side, on a reconstructed scene.

    Attributes:
        degree: of the kernel, on both sides.
        agreement: PSNR in dB between the two sides' pictures before the first step.
        shape: the peer's plugin for its primitives, the faster of the two.
    """

    kind = "step"
    degree: int
    agreement: float
    shape: str

    @property
    def case(self) -> str:
        """Name of the case in metrics, such as degree4_128."""
        return f"degree{self.degree}_{self.size}"

    def ratio(self, peer: str = VOLPRIM) -> float:
        """Time of the peer's step over TRON's."""
        return self.times[peer].over(self.times[TRON])

    def rows(self) -> Iterator[Row]:
        """Ratios to the peer, the times of all, and how alike the pictures are."""
        for peer in (VOLPRIM, SHIPPED):
            if peer in self.times:
                yield self.row(f"step.ratio_to_{peer}", self.ratio(peer), "x", peer)
        for name, times in self.times.items():
            yield self.row(f"step.{name}_ms", 1e3 * times.median, "ms", name)
        yield Row(metric=f"step.psnr_to_volprim.{self.case}", value=self.agreement, unit="dB", n=1)


@dataclass(frozen=True)
class Growth(Timed):
    """Times of TRON's own step on drawn surfels."""

    kind = "growth"

    @property
    def seconds(self) -> float:
        """Median of a step."""
        return self.times[TRON].median


@dataclass
class Measured:
    """Findings of a run, before they are put into words.

    Attributes:
        settings: of the run.
        stages: the commands.
        runs: way -> a reconstruction of each scene.
        scans: way -> a scan of each scene; "raw" as it is, "splats" as tron-reconstruct made it anew.
        compared: pictures of each scene.
        fox: the real capture; None with the reason in ``no_fox``.
        steps: beside the peer, on a scene reconstructed with either kernel.
        growth: TRON's own step as sizes grow.
    """

    settings: ReconstructionSettings
    stages: Stages
    runs: dict[str, list[Run]] = field(default_factory=dict)
    scans: dict[str, list[Scan]] = field(default_factory=dict)
    compared: list[Compared] = field(default_factory=list)
    fox: Fox | None = None
    no_fox: str = ""
    steps: list[Steps] = field(default_factory=list)
    growth: list[Growth] = field(default_factory=list)

    def prefix(self, way: str) -> str:
        """Beginning of the metrics of a way: the first one's name no way."""
        first = next(iter(self.settings.ways), None)
        return "reconstruction" if way == first else f"reconstruction.{way}"

    def rows(self) -> Iterator[Row]:
        """Every figure."""
        for way, runs in self.runs.items():
            yield from rows_of(self.prefix(way), runs, self.settings.seed)
            yield from light_rows(self.prefix(way), runs, self.settings.seed)
            if way in self.settings.photos:
                before = self.runs.get(self.settings.before, [])
                yield from gain_rows(self.prefix(way), runs, before, self.settings.seed)
        for way, scans in self.scans.items():
            yield from scan_rows(way, scans, self.settings.seed)
        if self.fox is not None:
            yield from self.fox.rows()
        main = {steps.degree: steps for steps in reversed(self.steps)}  # the first size of each degree
        for steps in self.steps:
            if steps is main[steps.degree]:
                ratio = steps.row("step.ratio_to_volprim", steps.ratio(), "x", VOLPRIM)
                yield ratio.model_copy(update={"metric": f"step.ratio_to_volprim.degree{steps.degree}"})
            yield from steps.rows()
        for growth in self.growth:
            yield growth.row("step.seconds", growth.seconds, "s")
