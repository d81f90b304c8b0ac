"""Benchmark `reconstruction`: how good surfels from photos are, how long they take, and what a step costs."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark
from eval.report.outcome import Outcome
from eval.results import Row
from eval.stages import Child, Stages, script_path
from tron.errors import TronError
from tron.storage import write_atomic

if TYPE_CHECKING:
    from eval.peers.timing import Times
    from eval.reconstruction.pictures import Compared
    from eval.reconstruction.relit import Fox
    from eval.reconstruction.runs import Run
    from eval.reconstruction.step import Steps
    from tron.captures import View

log = logging.getLogger("tron.eval")

Part = Literal["scenes", "fox", "steps"]
DEGREE2 = "degree2"
"""Folder of the scene of the steps with the peer's own kernel, beside those of the ways."""
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


@dataclasses.dataclass
class Measured:
    """Everything a run of the benchmark found, before it is put into words.

    Attributes:
        runs: way -> a reconstruction of each scene. compared: pictures of each scene.
        fox: the real capture; None with the reason in ``no_fox``. relit_seconds: of all its lights.
        steps: beside the peer, on a scene reconstructed with either kernel. growth: (surfels, pixels a side)
            -> times.
    """

    runs: dict[str, list[Run]] = dataclasses.field(default_factory=dict)
    compared: list[Compared] = dataclasses.field(default_factory=list)
    fox: Fox | None = None
    no_fox: str = ""
    relit_seconds: float = 0.0
    steps: list[Steps] = dataclasses.field(default_factory=list)
    growth: dict[tuple[int, int], Times] = dataclasses.field(default_factory=dict)

    def seconds(self) -> dict[str, dict[str, list[float]]]:
        """Every time of a step that was taken: case -> contestant -> seconds of its rounds."""
        cases = {f"trained {steps.count} {steps.case}": steps.times for steps in self.steps}
        cases |= {f"growth {count} {size}": {"tron": times} for (count, size), times in self.growth.items()}
        return {
            case: {name: [round(s, 6) for s in taken.seconds] for name, taken in times.items()}
            for case, times in cases.items()
        }


@dataclasses.dataclass
class _FoxRun:
    """Where the commands left the fox: its capture, the folder, wall seconds, the views that are shown, and
    light -> (map, folder of its frames).
    """

    capture: Path
    folder: Path
    seconds: float
    views: list[View]
    lights: dict[str, tuple[Path, Path]] = dataclasses.field(default_factory=dict)
    relit_seconds: float = 0.0


class Reconstruction(Benchmark):
    """Settings: which parts, and the arguments of the commands. Beside the page, times.json keeps the steps'
    rounds.
    """

    name: ClassVar[str] = "reconstruction"

    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    seed: int = 0
    parts: list[Part] = Field(description="what is measured", min_length=1)
    datagen: list[str] = Field(description="arguments of tron-datagen, which makes the captures")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct for every scene and way")
    ways: dict[Name, list[str]] = Field(description="further ones of each way; the first is the main one")
    real_data: Path | None = Field(description="folder with captures/fox and hdri; null: no fox")
    fox_downscale: PositiveFloat = Field(default=8, description="factor by which the photos are reduced")
    fox: list[str] = Field(description="further arguments of tron-reconstruct for the fox")
    hdris: list[str] = Field(description="files of hdri under which the fox is relit")
    relight: list[str] = Field(description="arguments of tron-relight")
    relit_views: PositiveInt = Field(default=3, description="held-out views of the fox that are shown")
    relit_enlarged: PositiveInt = Field(default=2, description="pixels of a relit side a pixel of the photo")
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
    repetitions: PositiveInt = Field(default=5, description="rounds of interleaved timing")
    slow_repetitions: PositiveInt = Field(default=3, description="rounds for what takes over a second")

    def check(self) -> None:
        """Find the commands that the parts call."""
        if not self.ways:
            raise TronError("no way to reconstruct", "benchmark.ways", "give at least one")
        for name in ("tron-datagen", "tron-reconstruct", "tron-relight"):
            script_path(name)

    def run(self, output_dir: Path) -> Outcome:
        """Run the commands that are not finished, one after the other; then score, picture and time.

        Raises:
            StageFailed: a command failed; what was finished before it is kept and is not redone.
        """
        self.check()
        folder = output_dir.absolute()
        stages, measured = Stages(folder), Measured()
        # Commands first: what comes after them is done in this process, anew each time.
        made = self._reconstruct_scenes(stages, folder) if "scenes" in self.parts else {}
        if "steps" in self.parts:
            self._reconstruct_for_steps(stages, folder)
        fox = self._reconstruct_fox(stages, folder, measured) if "fox" in self.parts else None
        from tron.runtime import activate, set_torch_threads

        activate(self.variant)
        set_torch_threads(1)  # as tron-reconstruct does: Dr.Jit has the cores
        self._collect_scenes(made, folder, measured)
        if fox is not None:
            self._collect_fox(fox, measured)
        if "steps" in self.parts:
            self._measure_steps(folder, measured)
            self._measure_growth(measured)
            write_atomic(folder / "times.json", json.dumps(measured.seconds(), indent=1) + "\n")
        from eval.reconstruction import page

        return page.outcome(self, measured, list(rows(measured, self.seed)), stages, output_dir)

    def _reconstruct_scenes(self, stages: Stages, folder: Path) -> dict[tuple[str, str], float]:
        """(way, scene) -> wall seconds, every scene in every way."""
        dataset = folder / "dataset"
        stages.run("datagen", [Child("datagen", "tron-datagen", [*self.datagen, f"output_dir={dataset}"])])
        seconds = {}
        for scene in _scenes(dataset):
            for way, arguments in self.ways.items():
                seconds[way, scene] = self._reconstruct_scene(stages, folder, scene, way, arguments)
        return seconds

    def _reconstruct_scene(
        self, stages: Stages, folder: Path, scene: str, way: str, arguments: list[str]
    ) -> float:
        label = f"{scene} {way}"
        capture, out = folder / "dataset" / "captures" / scene, folder / "scenes" / scene / way
        typed = [*self.reconstruct, *arguments, *self._with_variant(), f"seed={self.seed}"]
        typed = [f"capture={capture}", *typed, f"output_dir={out}"]
        return stages.run(label, [Child(label, "tron-reconstruct", typed)])

    def _reconstruct_for_steps(self, stages: Stages, folder: Path) -> None:
        """The scene of the steps once more, with the peer's own kernel."""
        from eval.reconstruction.subjects import first_trained

        way = next(iter(self.ways))
        arguments = [*self.ways[way], *self.step_degree2]
        self._reconstruct_scene(stages, folder, first_trained(folder, way), DEGREE2, arguments)

    def _with_variant(self) -> list[str]:
        return [] if self.variant == "llvm_ad_rgb" else [f"variant={self.variant}"]

    def _collect_scenes(self, made: dict[tuple[str, str], float], folder: Path, measured: Measured) -> None:
        from eval.reconstruction.light import errors_of_files
        from eval.reconstruction.pictures import compare_scene, write_sheet
        from eval.reconstruction.runs import Run, light_family, read_report

        for (way, scene), seconds in made.items():
            capture, out = folder / "dataset" / "captures" / scene, folder / "scenes" / scene / way
            light = errors_of_files(out / "environment.exr", capture / "environment.exr")
            run = Run(scene, out, capture, read_report(out), seconds, light, light_family(capture))
            measured.runs.setdefault(way, []).append(run)
        for scene in dict.fromkeys(scene for _, scene in made):
            ways = {way: run for way, runs in measured.runs.items() for run in runs if run.name == scene}
            measured.compared.append(compare_scene(ways))
            write_sheet(folder / "pictures", measured.compared[-1])

    def _reconstruct_fox(self, stages: Stages, folder: Path, measured: Measured) -> _FoxRun | None:
        """Reconstruct and relight the fox; None, with the reason in ``measured``, if that cannot be."""
        from eval.reconstruction.relit import chosen_views, write_cameras

        data = self.real_data
        if data is None or not (data / "captures" / "fox").is_dir():
            measured.no_fox = "benchmark.real_data is null" if data is None else f"no captures/fox in {data}"
            log.warning("the fox is left out: %s", measured.no_fox)
            return None
        capture, out = data / "captures" / "fox", folder / "fox"
        typed = [f"capture={capture}", f"downscale={self.fox_downscale:g}", *self.fox]
        typed += [*self._with_variant(), f"seed={self.seed}", f"output_dir={out}"]
        seconds = stages.run("fox", [Child("fox", "tron-reconstruct", typed)])
        made = _FoxRun(capture, out, seconds, chosen_views(capture, self.fox_downscale, self.relit_views))
        write_cameras(folder / "fox_cameras.json", made.views)
        camera = made.views[0].camera
        sides = {"width": camera.width, "height": camera.height}
        for hdri in self.hdris:
            environment = data / "hdri" / hdri
            name = environment.stem
            if not environment.is_file():
                log.warning("the fox is not relit under %s: there is no such file", environment)
                continue
            made.lights[name] = environment, folder / "fox_relit" / name
            typed = [f"scene={out / 'scene.ply'}", f"environment={environment}"]
            typed += [f"cameras={folder / 'fox_cameras.json'}"]
            typed += [f"{side}={pixels * self.relit_enlarged}" for side, pixels in sides.items()]
            typed += [*self.relight, *self._with_variant(), f"output_dir={folder / 'fox_relit' / name}"]
            label = f"fox under {name}"
            made.relit_seconds += stages.run(label, [Child(label, "tron-relight", typed)])
        return made

    def _collect_fox(self, made: _FoxRun, measured: Measured) -> None:
        from eval.reconstruction.relit import collect
        from eval.reconstruction.runs import Run, read_report

        run = Run("fox", made.folder, made.capture, read_report(made.folder), made.seconds)
        measured.fox = collect(run, made.views, made.lights)
        measured.relit_seconds = made.relit_seconds

    def _measure_steps(self, folder: Path, measured: Measured) -> None:
        from eval.reconstruction.step import measure_steps
        from eval.reconstruction.subjects import trained

        rounds = self.repetitions, self.slow_repetitions
        for way in (DEGREE2, next(iter(self.ways))):
            for size in self.step_pixels:
                scene, view, extent = trained(folder, way, size)
                found = measure_steps(scene, view, extent, self.seed, *rounds)
                measured.steps.append(found)
                told = ", ".join(f"{name} {times.median:.3f} s" for name, times in found.times.items())
                ratio = found.ratio()
                log.info(
                    "a step of %d surfels, %s: %.1f times volprim (%s)", found.count, found.case, ratio, told
                )

    def _measure_growth(self, measured: Measured) -> None:
        from eval.reconstruction.step import measure_growth
        from eval.reconstruction.subjects import drawn

        surfels, pixels = self.growth_at
        cases = [(count, pixels) for count in self.growth_surfels]
        cases += [(surfels, size) for size in self.growth_pixels]
        for count, size in dict.fromkeys(cases):
            scene, view, extent = drawn(count, size, self.seed)
            times = measure_growth(scene, view, extent, self.seed, self.repetitions)
            measured.growth[count, size] = times
            log.info("a step of %d surfels at %d: %.3f s", count, size, times.median)


def _scenes(dataset: Path) -> list[str]:
    return sorted(path.parent.name for path in (dataset / "captures").glob("*/transforms.json"))


def rows(measured: Measured, seed: int) -> Iterator[Row]:
    """Every figure of a run; ``seed`` draws the scenes of the intervals."""
    from eval.reconstruction.runs import rows_of

    for number, (way, runs) in enumerate(measured.runs.items()):
        yield from rows_of("reconstruction" if number == 0 else f"reconstruction.{way}", runs, seed)
    if measured.fox is not None:
        yield from _fox_rows(measured)
    yield from _step_rows(measured)


def _fox_rows(measured: Measured) -> Iterator[Row]:
    fox = measured.fox
    assert fox is not None
    report = fox.run.report
    for name, key, unit in (("test_psnr", "psnr", "dB"), ("ssim", "ssim", "1"), ("lpips", "lpips", "1")):
        if key in report.test:
            yield Row(metric=f"fox.{name}", value=report.test[key], unit=unit, n=len(report.capture.held_out))
    yield Row(metric="fox.train_psnr", value=report.train["psnr"], unit="dB", n=int(report.train["views"]))
    for name, value, unit in (
        ("seconds", fox.run.seconds, "s"),
        ("surfels_seconds", report.seconds.surfels, "s"),
        ("light_seconds", report.seconds.light, "s"),
        ("surfels", report.surfels, "surfels"),
        ("views", report.capture.views, "views"),
    ):
        yield Row(metric=f"fox.{name}", value=value, unit=unit, n=1)
    if fox.relit:
        yield Row(metric="fox.relight_seconds", value=measured.relit_seconds, unit="s", n=len(fox.relit))


def _step_rows(measured: Measured) -> Iterator[Row]:
    from eval.peers.contenders import spelled
    from eval.reconstruction.step import SHIPPED, VOLPRIM

    told = set()
    for steps in measured.steps:
        if steps.degree not in told:  # the main size comes first
            told.add(steps.degree)
            metric, n = f"step.ratio_to_volprim.degree{steps.degree}", len(steps.times[VOLPRIM].seconds)
            yield Row(metric=metric, value=steps.ratio(), unit="x", n=n)
        for peer in (VOLPRIM, SHIPPED):
            if peer in steps.times:
                n = len(steps.times[peer].seconds)
                yield Row(metric=f"step.ratio_to_{peer}.{steps.case}", value=steps.ratio(peer), unit="x", n=n)
        for name, times in steps.times.items():
            metric = f"step.{name}_ms.{steps.case}"
            yield Row(metric=metric, value=1e3 * times.median, unit="ms", n=len(times.seconds))
        yield Row(metric=f"step.psnr_to_volprim.{steps.case}", value=steps.agreement, unit="dB", n=1)
    for (count, size), times in measured.growth.items():
        metric = f"step.seconds.{spelled(count)}_{size}"
        yield Row(metric=metric, value=times.median, unit="s", n=len(times.seconds))
