"""Settings of the benchmark `tracing`, and what a run of it measures.

:mod:`eval.tracing.benchmark` fills :class:`Measured`; the pages read nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PositiveInt

from eval.peers.settings import SpeedBenchmark
from eval.peers.timing import Timed, Times, format_count
from eval.results import Row, mean_row
from tron.color import to_display
from tron.errors import TronError

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
    "bounce",
    "equal_error",
]
Case = tuple[PositiveInt, PositiveInt]

TRON, BINNING = "tron", "binning"
USUAL = "tron_outside"
"""TRON again, on the usual scene with as many surfels: what a camera inside is held against."""


class TracingSettings(SpeedBenchmark):
    """Parts of the benchmark and their sizes."""

    name: ClassVar[str] = "tracing"

    parts: list[Part] = Field(description="what is measured", min_length=1)
    surfels: list[PositiveInt] = Field(description="sizes of the scene", min_length=1)
    pixels: list[PositiveInt] = Field(description="widths of the image, multiples of 4", min_length=1)
    sh_degree: int = Field(default=0, ge=0, le=3, description="harmonics' degree in the comparison")
    room: Case = Field(description="(surfels, pixels) of the frame from within a room")
    ground: Case = Field(description="(surfels, pixels) of the frame from a ground that one stands on")
    growth_surfels: list[PositiveInt] = Field(description="scenes of the growth chart, at the first size")
    growth_pixels: list[PositiveInt] = Field(description="images of the growth chart, second-size scene")
    shadow_rays: PositiveInt = Field(default=200_000, description="random shadow rays")
    shadow_spp: PositiveInt = Field(default=64, description="rays per pixel of the traced irradiance pass")
    gradient: list[Case] = Field(description="(surfels, pixels) of the gradient steps")
    irradiance: Case = Field(description="(surfels, pixels) of the comparison with Mitsuba's direct")
    noise: Case = Field(description="(surfels, pixels) of the error of irradiance")
    few_rays: Case = Field(description="(surfels, pixels) of irradiance of few rays, filtered and not")
    reference_spp: PositiveInt = Field(default=4096, description="rays per pixel of the reference irradiance")
    error_rays: PositiveInt = Field(default=2000, description="rays held against float64")
    memory_surfels: PositiveInt = Field(default=1_000_000, description="scene whose peak memory is measured")
    bounce: list[Case] = Field(description="(surfels, pixels) of transport, bake and frames with bounces")
    equal_error: list[str] = Field(
        description="arguments of tron-datagen for the scenes on which guidance and path tracer are compared"
    )

    @property
    def middle(self) -> tuple[int, int]:
        """Case of the targets: the second scene at the last size."""
        return self.surfels[min(1, len(self.surfels) - 1)], self.pixels[-1]

    def check(self) -> None:
        """Refuse sizes that the tile order of the rays cannot take."""
        sizes = (*self.pixels, self.room[1], self.ground[1], *self.growth_pixels)
        odd = [size for size in sizes if size % 4]
        if odd:
            raise TronError(f"images of {odd[0]} pixels", "benchmark.pixels", "give multiples of 4")


@dataclass(frozen=True)
class CameraRays(Timed):
    """Times of one frame.

    Attributes:
        place: name of the place; empty for the usual one.
        recipe: name of the surfels' recipe; empty for the usual one.
    """

    kind = "camera"
    place: str = ""
    recipe: str = ""

    @property
    def case(self) -> str:
        """Name of the case in metrics, such as 50k_512 or room_50k_512."""
        return f"{self.place}_{super().case}" if self.place else super().case

    @property
    def label(self) -> str:
        """Name in times.json."""
        return f"{super().label}, {self.recipe}" if self.recipe else super().label

    @property
    def peers(self) -> list[str]:
        """Names of the peers that ran."""
        return [name for name in self.times if name not in (TRON, BINNING, USUAL)]

    def mrays(self, name: str = TRON) -> float:
        """Million rays a second."""
        return self.size**2 / self.times[name].median / 1e6

    def ratio(self, peer: str) -> float:
        """Time of the peer over TRON's."""
        return self.times[peer].over(self.times[TRON])

    def rows(self) -> Iterator[Row]:
        """Ratios to the peers that ran, rays a second of all, and the time of binning within TRON's."""
        suffix = f"_{self.recipe}" if self.recipe else ""
        for name in self.peers:
            yield self.row(f"primary.ratio_to_{name}{suffix}", self.ratio(name), "x", name)
        for name in (TRON, *self.peers):
            metric = "primary.mrays" if name == TRON else f"primary.{name}_mrays"
            yield self.row(f"{metric}{suffix}", self.mrays(name), "Mrays/s", name)
        binning = 1e3 * self.times[BINNING].median
        yield self.row(f"primary.binning_ms{suffix}", binning, "ms", BINNING)
        if USUAL in self.times:
            ratio = self.times[TRON].over(self.times[USUAL])
            yield replace(self, place="").row("primary.inside_over_outside", ratio, "x", TRON)


@dataclass(frozen=True)
class ShadowRays(Timed):
    """Times of shadow rays, and of what is made before.

    Contestants are named for their rays and the tracer: "random tron", "irradiance embree_any_hit".

    Attributes:
        rays: number of the random rays.
        pass_rays: number of the rays of the irradiance pass.
    """

    kind = "shadow"
    rays: int
    pass_rays: int

    @property
    def case(self) -> str:
        """Name of the case in metrics, such as 50k."""
        return format_count(self.count)

    def rows(self) -> Iterator[Row]:
        """Rays a second and ratios, of random rays and of the pass's, then builds, in the table's order.

        TRON's build is in the ratios; the peers' builds are not. What the pass costs with nothing in the way
        is taken off both sides.
        """
        median = {name: times.median for name, times in self.times.items()}
        for rays, count in (("random", self.rays), ("irradiance", self.pass_rays)):
            idle = median.get(f"{rays} idle", 0.0)
            names = [name.split()[1] for name in self.times if name.startswith(f"{rays} ")]
            seconds = {name: median[f"{rays} {name}"] - idle for name in names if name != "idle"}
            ours = seconds[TRON] + median["build"]
            for name, taken in seconds.items():
                metric = f"mrays_{rays}" if name == TRON else f"{name}_mrays_{rays}"
                yield self.row(f"shadow.{metric}", count / taken / 1e6, "Mrays/s")
            for name, taken in seconds.items():
                if name != TRON:
                    suffix = "_random" if rays == "random" and name != "embree_restart" else ""
                    yield self.row(f"shadow.ratio_to_{name}{suffix}", taken / ours, "x")
        for name in ("build", "refit", "embree_build"):
            yield self.row(f"bvh.{name}_ms", 1e3 * median[name], "ms")
        yield self.row("bvh.trace_after_refit", median["refitted"] / median["rebuilt"], "x")
        strays = self.times["strays"].over(self.times["random tron"])
        yield self.row("shadow.stray_slowdown", strays, "x")


@dataclass(frozen=True)
class GradientStep(Timed):
    """Times of a forward and backward pass.

    Attributes:
        agreement: cosine between both sides' gradients by the harmonics.
    """

    kind = "gradient"
    agreement: float

    @property
    def ratio(self) -> float:
        """Time of the peer over TRON's."""
        return self.times["volprim"].over(self.times[TRON])

    def rows(self) -> Iterator[Row]:
        """The ratio, both times and the agreement of the gradients."""
        yield self.row("gradient.ratio_to_volprim", self.ratio, "x")
        yield self.row("gradient.ms", 1e3 * self.times[TRON].median, "ms")
        yield self.row("gradient.volprim_ms", 1e3 * self.times["volprim"].median, "ms")
        yield self.row("gradient.cosine_with_volprim", self.agreement, "1")


@dataclass(frozen=True)
class LitImages:
    """Irradiance under one light.

    Attributes:
        light: name of the light.
        exposure: of their display.
        images: name -> (H, W, 3), linear.
    """

    light: str
    exposure: float
    images: Mapping[str, np.ndarray]

    def displayed(self, name: str) -> np.ndarray:
        """(H, W, 3) display values."""
        return to_display(self.images[name], self.exposure)


@dataclass(frozen=True)
class DirectTimes(Timed):
    """Times of the 64-ray pass and of Mitsuba's ``direct`` under one light.

    Attributes:
        lit: the pictures of both, "tron" and "direct".
    """

    kind = "irradiance"
    lit: LitImages

    @property
    def label(self) -> str:
        """Name in times.json."""
        return f"{self.kind} {self.lit.light}"

    @property
    def ratio(self) -> float:
        """TRON's time, its hierarchy's build and its camera rays included, over Mitsuba's faster time."""
        direct = min(t.median for name, t in self.times.items() if name.startswith("direct"))
        return sum(self.times[name].median for name in (TRON, "build", "gbuffer")) / direct


def direct_rows(measured: Sequence[DirectTimes]) -> Iterator[Row]:
    """Ratio under every light, the worst of them, and the seconds of the pass."""
    name = "irradiance.seconds_ratio_to_mitsuba_direct"
    for found in measured:
        yield found.row(f"{name}_{found.lit.light}", found.ratio, "x")
    worst = max(measured, key=lambda found: found.ratio)
    yield worst.row(name, worst.ratio, "x")
    seconds = max(found.times[TRON].median for found in measured)
    yield worst.row("irradiance.seconds_64spp", seconds, "s")


@dataclass(frozen=True)
class Noise:
    """Errors of irradiance under one light, over trials.

    Attributes:
        lit: one trial of each way, and the reference.
        trials: renderings of each way.
        rmse: way -> root mean square error, as a share of an upward plane's light.
        blocks: way -> excess correlation within blocks.
        equal_time_spp: independent rays in the time of TRON's 64.
    """

    lit: LitImages
    trials: int
    rmse: Mapping[str, float]
    blocks: Mapping[str, float]
    equal_time_spp: int


def noise_rows(noises: Sequence[Noise]) -> Iterator[Row]:
    """Rows of every light, and over the lights: root mean square errors, worst block correlation."""
    for unit, by_light, over_lights in (
        ("fraction", [noise.rmse for noise in noises], lambda values: np.sqrt(np.mean(np.square(values)))),
        ("correlation", [noise.blocks for noise in noises], lambda values: max(values, key=abs)),
    ):
        for noise, figures in zip(noises, by_light, strict=True):
            for name, value in figures.items():
                metric = f"irradiance.{name}.{noise.lit.light}"
                yield Row(metric=metric, value=value, unit=unit, n=noise.trials)
        for name in by_light[0]:
            value = float(over_lights([figures[name] for figures in by_light]))
            trials = sum(noise.trials for noise in noises)
            yield Row(metric=f"irradiance.{name}", value=value, unit=unit, n=trials)


@dataclass(frozen=True)
class FewRays:
    """Irradiance of few rays under one light; a way is such as "2" rays per pixel, or "2.filtered".

    Attributes:
        lit: one trial of each way, and the reference.
        trials: renderings of each way.
        mean: way -> mean of the pixels in shadow, over the reference's.
        rmse: way -> over all pixels with a surface, as a share of an upward plane's light.
    """

    lit: LitImages
    trials: int
    mean: Mapping[str, float]
    rmse: Mapping[str, float]


def few_rays_rows(measured: Sequence[FewRays]) -> Iterator[Row]:
    """Means and errors of every light and way, and the least and the greatest mean."""
    name = "irradiance.shadowed_mean_over_reference"
    for found in measured:
        light, n = found.lit.light, found.trials
        for way, value in found.mean.items():
            yield Row(metric=f"{name}.{light}.{way}", value=value, unit="x", n=n)
        for way, value in found.rmse.items():
            yield Row(metric=f"irradiance.few_rays_rmse.{light}.{way}", value=value, unit="fraction", n=n)
    means = [value for found in measured for value in found.mean.values()]
    trials = sum(found.trials * len(found.mean) for found in measured)
    yield Row(metric=f"{name}.least", value=min(means), unit="x", n=trials)
    yield Row(metric=f"{name}.greatest", value=max(means), unit="x", n=trials)


@dataclass(frozen=True)
class BounceTimes(Timed):
    """Times of "transport", "bake", a "frame" of 64 rays a pixel, and a "lit frame" with what was baked."""

    kind = "bounce"

    def rows(self) -> Iterator[Row]:
        """Both ratios to a frame, and the seconds of transport and bake."""
        frame = self.times["frame"]
        yield self.row("bounce.seconds_ratio_to_frame", self.times["bake"].over(frame), "x")
        yield self.row("bounce.lit_frame_ratio", self.times["lit frame"].over(frame), "x")
        for name in ("transport", "bake", "frame"):
            yield self.row(f"bounce.{name}_seconds", self.times[name].median, "s", name)


EQUAL_ERROR = "guidance.ratio_to_path_tracing.equal_error"


@dataclass(frozen=True)
class EqualError:
    """The data engine's record of frames at the path tracer's error.

    Attributes:
        cases: one a scene and light: "scene", "light", "surfels", "pixels", "ways", "path_tracer".
        pictures: files: ours, the path tracer's in our time, the truth, side by side.
    """

    cases: Sequence[Mapping[str, Any]]
    pictures: Sequence[Path]

    @property
    def ways(self) -> list[str]:
        """Names of our frames; the target holds the first."""
        return list(self.cases[0]["ways"])

    def rows(self, seed: int) -> Iterator[Row]:
        """Time of each of our frames over the path tracer's at its error, over scenes."""
        for number, way in enumerate(self.ways):
            found = [(case["scene"], case["ways"][way]) for case in self.cases]
            suffix = "" if number == 0 else f".{way}"
            ratios = [(scene, values["ratio"]) for scene, values in found]
            yield mean_row(f"{EQUAL_ERROR}{suffix}", "x", ratios, seed)
            baked = [(scene, values["ratio_with_bake"]) for scene, values in found]
            yield mean_row(f"{EQUAL_ERROR}.with_bake{suffix}", "x", baked, seed)
            for name, unit in (("error", "abs"), ("seconds", "s"), ("paths", "1")):
                values = [(scene, values[name]) for scene, values in found]
                yield mean_row(f"guidance.{name}.{way}", unit, values, seed)


@dataclass(frozen=True)
class SamePicture:
    """Radiance of the same surfels along the same rays, (H, W, 3) display values, and their PSNR in dB."""

    tron: np.ndarray
    volprim: np.ndarray
    psnr: float


@dataclass
class Measured:
    """Findings of a run, before they are put into words.

    Attributes:
        settings: of the run.
        camera: times of one frame in the cases of the table and of the growth charts.
        variants: the same at the middle case, of surfels by other recipes.
        inside: frames of a camera within its scene, the room first.
        shapes: times of the peer's two plugins.
        same_picture: by TRON and the peer.
        hits: mean surfels hit, hit from the front, and composited, of a camera ray.
        inside_pictures: place -> (H, W, 3) display values.
        error: rows against float64.
        memory: stage -> resident set in MB.
    """

    settings: TracingSettings
    camera: list[CameraRays] = field(default_factory=list)
    variants: list[CameraRays] = field(default_factory=list)
    inside: list[CameraRays] = field(default_factory=list)
    shapes: Mapping[str, Times] = field(default_factory=dict)
    same_picture: SamePicture | None = None
    hits: tuple[float, float, float] | None = None
    inside_pictures: dict[str, np.ndarray] = field(default_factory=dict)
    shadow: list[ShadowRays] = field(default_factory=list)
    gradient: list[GradientStep] = field(default_factory=list)
    direct: list[DirectTimes] = field(default_factory=list)
    noise: list[Noise] = field(default_factory=list)
    few_rays: list[FewRays] = field(default_factory=list)
    error: list[Row] = field(default_factory=list)
    memory: dict[str, float] = field(default_factory=dict)
    bounce: list[BounceTimes] = field(default_factory=list)
    equal_error: EqualError | None = None

    def timed(self) -> list[Timed]:
        """Every case that was timed."""
        frames = [*self.camera, *self.inside, *self.variants]
        return [*frames, *self.shadow, *self.gradient, *self.direct, *self.bounce]

    def rows(self) -> Iterator[Row]:
        """Every figure."""
        for found in (*self.camera, *self.inside, *self.variants, *self.shadow, *self.gradient, *self.bounce):
            yield from found.rows()
        if self.direct:
            yield from direct_rows(self.direct)
        if self.noise:
            yield from noise_rows(self.noise)
        if self.few_rays:
            yield from few_rays_rows(self.few_rays)
        if self.equal_error:
            yield from self.equal_error.rows(self.settings.seed)
        yield from self.error
        for stage, value in self.memory.items():
            metric = f"memory.{stage}_mb.{format_count(self.settings.memory_surfels)}"
            yield Row(metric=metric, value=value, unit="MB", n=1)
