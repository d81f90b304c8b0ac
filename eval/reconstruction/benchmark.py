"""Benchmark `reconstruction`: how good surfels from photos are, how long they take, and what a step costs."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from eval.peers.timing import write_times
from eval.reconstruction import page
from eval.reconstruction.measured import Measured, ReconstructionSettings
from eval.reconstruction.relit import FoxRun, chosen_views, collect_fox, write_cameras
from eval.reconstruction.runs import Run, collect_run
from eval.report.outcome import Outcome
from eval.stages import Child, Stages, script_path
from tron.errors import TronError

log = logging.getLogger("tron.eval")

PHOTOGRAPHS = "photographs"
"""Folder of the captures that are photographs, and of the truth of relighting."""
DEGREE2 = "degree2"
"""Folder of the scene of the steps with the peer's own kernel, beside those of the ways."""


class Made(NamedTuple):
    """Files that a command left of one scene, and its wall seconds."""

    scene: str
    way: str
    capture: Path
    folder: Path
    seconds: float


def scene_names(dataset: Path) -> list[str]:
    """Names of the captures in a folder of tron-datagen."""
    return sorted(path.parent.name for path in (dataset / "captures").glob("*/transforms.json"))


def relit_truths(dataset: Path, scene: str) -> list[Path]:
    """Folders of a scene's held-out views under other lights."""
    return sorted(path.parent for path in (dataset / "relit").glob(f"{scene}_*/transforms.json"))


class Reconstruction(ReconstructionSettings):
    """Parts of the benchmark, and the arguments of the commands.

    Beside the page, times.json keeps the steps' rounds.
    """

    def check(self) -> None:
        """Find the commands that the parts call."""
        if not self.ways:
            raise TronError("no way to reconstruct", "benchmark.ways", "give at least one")
        both = sorted(set(self.ways) & set(self.photos))
        if both:
            raise TronError(f"way {both[0]} is of photos and of scenes", "benchmark.photos", "rename it")
        for name in ("tron-datagen", "tron-reconstruct", "tron-relight"):
            script_path(name)

    def run(self, output_dir: Path) -> Outcome:
        """Run the commands that are not finished, one after the other; then score, picture and time.

        Raises:
            StageFailed: a command failed; what was finished before it is kept and is not redone.
        """
        self.check()
        folder = output_dir.absolute()
        measured = Measured(self, Stages(folder))
        # Commands first: what comes after them is done in this process, anew each time.
        runs = self._reconstruct_scenes(measured.stages, folder) if "scenes" in self.parts else []
        if "photos" in self.parts:
            runs += self._reconstruct_photos(measured.stages, folder)
        scans = self._reconstruct_splats(measured.stages, folder) if "splats" in self.parts else []
        if "steps" in self.parts:
            self._reconstruct_for_steps(measured.stages, folder)
        fox = self._reconstruct_fox(measured, folder) if "fox" in self.parts else None
        from tron.runtime import activate, set_torch_threads

        activate(self.variant)
        set_torch_threads(1)  # as tron-reconstruct does: Dr.Jit has the cores
        self._collect_scenes(runs, folder, measured)
        self._collect_scans(scans, folder, measured)
        if fox is not None:
            measured.fox = collect_fox(fox)
        if "steps" in self.parts:
            self._measure_steps(folder, measured)
            self._measure_growth(measured)
            write_times(folder / "times.json", [*measured.steps, *measured.growth])
        return page.outcome(measured, output_dir)

    def _reconstruct_scenes(self, stages: Stages, folder: Path) -> list[Made]:
        """Every scene in every way."""
        return self._reconstruct_all(stages, folder, self._dataset(stages, folder), self.ways)

    def _reconstruct_photos(self, stages: Stages, folder: Path) -> list[Made]:
        """The same scenes from photographs, without any prior."""
        return self._reconstruct_all(stages, folder, self._photographs(stages, folder), self.photos)

    def _dataset(self, stages: Stages, folder: Path) -> Path:
        dataset = folder / "dataset"
        stages.run("datagen", [Child("datagen", "tron-datagen", [*self.datagen, f"output_dir={dataset}"])])
        return dataset

    def _photographs(self, stages: Stages, folder: Path) -> Path:
        """Captures of photographs, and their held-out views under other lights."""
        dataset = folder / PHOTOGRAPHS
        arguments = [*self.photographs, f"output_dir={dataset}"]
        stages.run("photographs", [Child("photographs", "tron-datagen", arguments)])
        return dataset

    def _reconstruct_all(
        self, stages: Stages, folder: Path, dataset: Path, ways: Mapping[str, list[str]]
    ) -> list[Made]:
        return [
            self._reconstruct_scene(stages, folder, dataset, scene, way, arguments)
            for scene in scene_names(dataset)
            for way, arguments in ways.items()
        ]

    def _reconstruct_scene(
        self, stages: Stages, folder: Path, dataset: Path, scene: str, way: str, arguments: list[str]
    ) -> Made:
        capture, out = dataset / "captures" / scene, folder / "scenes" / scene / way
        seconds = self._run(stages, f"{scene} {way}", capture, [*self.reconstruct, *arguments], out)
        return Made(scene, way, capture, out, seconds)

    def _reconstruct_splats(self, stages: Stages, folder: Path) -> list[Made]:
        """Scans of some scenes, raw and reconstructed."""
        from eval.reconstruction.scans import write_scan
        from tron.gaussians.scene import GaussianScene

        dataset, made = self._dataset(stages, folder), []
        self._photographs(stages, folder)
        for scene in scene_names(dataset)[: self.splats.scenes]:
            scanned = self._reconstruct_scene(stages, folder, dataset, scene, "scan", self.splats.scan)
            raw = folder / "scans" / scene / "scene.ply"
            if not raw.is_file():
                write_scan(raw, GaussianScene.load(scanned.folder / "scene.ply"), self.seed)
            out = folder / "scenes" / scene / "splats"
            seconds = self._run(stages, f"{scene} splats", raw, self.splats.reconstruct, out)
            made.append(Made(scene, "raw", scanned.capture, raw.parent, scanned.seconds))
            made.append(Made(scene, "splats", scanned.capture, out, seconds))
        return made

    def _run(
        self, stages: Stages, label: str, capture: Path, arguments: list[str], output_dir: Path
    ) -> float:
        """Reconstruct one capture; its wall seconds."""
        typed = [f"capture={capture}", *arguments, *self.override()]
        typed += [f"seed={self.seed}", f"output_dir={output_dir}"]
        return stages.run(label, [Child(label, "tron-reconstruct", typed)])

    def _reconstruct_for_steps(self, stages: Stages, folder: Path) -> None:
        """The scene of the steps once more, with the peer's own kernel."""
        from eval.reconstruction.subjects import first_trained

        way, arguments = next(iter(self.ways.items()))
        scene, dataset = first_trained(folder, way), folder / "dataset"
        self._reconstruct_scene(stages, folder, dataset, scene, DEGREE2, [*arguments, *self.step_degree2])

    def _collect_scenes(self, made: Sequence[Made], folder: Path, measured: Measured) -> None:
        from eval.reconstruction.pictures import compare_scene, write_sheet
        from eval.reconstruction.relighting import relight

        scenes: dict[str, dict[str, Run]] = {}
        for each in made:
            run = collect_run(each.scene, each.folder, each.capture, each.seconds)
            truths = relit_truths(folder / PHOTOGRAPHS, each.scene)
            if truths and (each.way in self.photos or each.way in self.relit):
                relit = relight(each.folder / "scene.ply", truths)
                log.info("%s %s: relit %.2f dB", each.scene, each.way, relit.psnr)
                run = replace(run, relit=relit)
            measured.runs.setdefault(each.way, []).append(run)
            scenes.setdefault(each.scene, {})[each.way] = run
        measured.compared += [compare_scene(ways) for ways in scenes.values()]
        for compared in measured.compared:
            write_sheet(folder / "pictures", compared)

    def _collect_scans(self, made: Sequence[Made], folder: Path, measured: Measured) -> None:
        from eval.reconstruction.scans import collect_scan

        for each in made:
            truths = relit_truths(folder / PHOTOGRAPHS, each.scene)
            scan = collect_scan(each.scene, each.folder / "scene.ply", each.capture, truths, each.seconds)
            measured.scans.setdefault(each.way, []).append(scan)

    def _reconstruct_fox(self, measured: Measured, folder: Path) -> FoxRun | None:
        """Reconstruct and relight the fox; None, with the reason in ``measured``, if that cannot be."""
        data, stages = self.real_data, measured.stages
        if data is None or not (data / "captures" / "fox").is_dir():
            measured.no_fox = "benchmark.real_data is null" if data is None else f"no captures/fox in {data}"
            log.warning("the fox is left out: %s", measured.no_fox)
            return None
        capture, out, cameras = data / "captures" / "fox", folder / "fox", folder / "fox_cameras.json"
        arguments = [f"downscale={self.fox_downscale:g}", *self.fox]
        seconds = self._run(stages, "fox", capture, arguments, out)
        made = FoxRun(capture, out, seconds, chosen_views(capture, self.fox_downscale, self.relit_views))
        write_cameras(cameras, made.views)
        camera = made.views[0].camera
        for hdri in self.hdris:
            environment = data / "hdri" / hdri
            if not environment.is_file():
                log.warning("the fox is not relit under %s: there is no such file", environment)
                continue
            frames, label = folder / "fox_relit" / environment.stem, f"fox under {environment.stem}"
            typed = [
                f"scene={out / 'scene.ply'}",
                f"environment={environment}",
                f"cameras={cameras}",
                f"width={camera.width * self.relit_enlarged}",
                f"height={camera.height * self.relit_enlarged}",
                *self.relight,
                *self.override(),
                f"output_dir={frames}",
            ]
            made.relit_seconds += stages.run(label, [Child(label, "tron-relight", typed)])
            made.lights[environment.stem] = environment, frames
        return made

    def _measure_steps(self, folder: Path, measured: Measured) -> None:
        from eval.reconstruction.step import measure_steps
        from eval.reconstruction.subjects import trained

        for way in (DEGREE2, next(iter(self.ways))):
            for size in self.step_pixels:
                found = measure_steps(*trained(folder, way, size), self.seed, self.rounds)
                measured.steps.append(found)
                seconds = ", ".join(f"{name} {times.median:.3f} s" for name, times in found.times.items())
                log.info(
                    "a step of %d surfels, %s: %.1f times volprim (%s)",
                    found.count,
                    found.case,
                    found.ratio(),
                    seconds,
                )

    def _measure_growth(self, measured: Measured) -> None:
        from eval.reconstruction.step import measure_growth
        from eval.reconstruction.subjects import drawn

        surfels, pixels = self.growth_at
        cases = [(count, pixels) for count in self.growth_surfels]
        cases += [(surfels, size) for size in self.growth_pixels]
        for count, size in dict.fromkeys(cases):
            found = measure_growth(*drawn(count, size, self.seed), self.seed, self.repetitions)
            measured.growth.append(found)
            log.info("a step of %d surfels at %d: %.3f s", count, size, found.seconds)
