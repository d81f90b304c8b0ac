"""Benchmark `reconstruction`: quality of surfels from photos, and time to make them."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, DirectoryPath, Field, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark
from eval.reconstruction.fox import FoxRun, chosen_views, collect_fox, write_cameras
from eval.reconstruction.runs import Run, collect_run, light_rows, mean_curve, rows_of
from eval.report.outcome import Outcome
from eval.stages import Child, Stages, script_path
from tron.errors import TronError

if TYPE_CHECKING:
    from eval.reconstruction.scans import Scan

log = logging.getLogger("tron.eval")

DEFAULT_VARIANT = "llvm_ad_rgb"
PHOTOGRAPHS = "photographs"
"""Folder of the captures that are photographs, and of the truth of relighting."""
SCANNED = "scanned"
"""Folder of the photographs that the thick scan is learnt from, with truth of its own."""
WAYS = {
    "random": "random points, true prior",
    "depth_init": "depth maps, true prior",
    "photos": "photographs, no prior",
}
SCANS = {"raw": "the file as it is", "splats": "the file as a capture"}
Part = Literal["scenes", "photos", "splats", "fox"]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


class Made(NamedTuple):
    """Files that a command wrote for one scene, and its wall time in seconds."""

    scene: str
    way: str
    capture: Path
    folder: Path
    seconds: float


def scene_names(dataset: Path) -> list[str]:
    """Return the names of the captures in a folder of tron-datagen."""
    return sorted(path.parent.name for path in (dataset / "captures").glob("*/transforms.json"))


def relit_truths(dataset: Path, scene: str) -> list[Path]:
    """Return the folders of a scene's held-out views under other lights."""
    return sorted(path.parent for path in (dataset / "relit").glob(f"{scene}_*/transforms.json"))


class SplatSettings(BaseModel):
    """Settings: a scan of the first scene in the form of other programs, and its reconstruction."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scan: list[str] = Field(description="arguments of tron-reconstruct that make the scan")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct with the scan as capture")
    photographs: list[str] = Field(
        description="arguments of tron-datagen that make photographs for a thick scan and relight them"
    )
    thick: list[str] = Field(
        description="arguments of tron-reconstruct that make a thick scan of these photographs"
    )
    carry: list[str] = Field(
        description="arguments of tron-reconstruct with the thick scan as capture; its surfels stay"
    )


class Reconstruction(Benchmark):
    """Settings: parts of the benchmark, and arguments of its commands."""

    name: ClassVar[str] = "reconstruction"

    variant: str = Field(default=DEFAULT_VARIANT, description="Mitsuba variant; cuda_ad_rgb on a GPU")
    seed: int = 0
    parts: list[Part] = Field(description="parts to measure", min_length=1)
    datagen: list[str] = Field(description="arguments of tron-datagen that make the captures")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct for every scene and way")
    ways: dict[Name, list[str]] = Field(
        description="way -> further arguments of tron-reconstruct; the first way is the main one"
    )
    photographs: list[str] = Field(
        description="arguments of tron-datagen that make the same scenes as photographs and relight them"
    )
    photos: dict[Name, list[str]] = Field(
        description="way -> further arguments to reconstruct the photographs; names are not in ways"
    )
    relit: list[Name] = Field(description="ways to relight, besides all ways of the photographs")
    splats: SplatSettings = Field(description="settings of scans of plain splats, used as captures")
    real_data: DirectoryPath | None = Field(
        default=None, description="folder with captures/fox, hdri; null: no fox"
    )
    fox_downscale: PositiveFloat = Field(default=4, description="downsampling factor of the photos")
    fox: list[str] = Field(description="further arguments of tron-reconstruct for the fox")
    hdris: list[str] = Field(description="files of real_data/hdri that relight the fox")
    relight: list[str] = Field(description="arguments of tron-relight")
    relit_views: PositiveInt = Field(default=3, description="number of held-out views of the fox on the page")

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
        """Run the unfinished commands one by one; then add scores, pictures and times.

        Raises:
            StageFailed: a command failed; what was finished before it is kept and is not redone.
        """
        self.check()
        folder = output_dir.absolute()
        stages, found = Stages(folder), Outcome(folder)
        # Commands first: what comes after them is done in this process, anew each time.
        runs = self._reconstruct_scenes(stages, folder) if "scenes" in self.parts else []
        if "photos" in self.parts:
            runs += self._reconstruct_photos(stages, folder)
        scans = self._reconstruct_splats(stages, folder) if "splats" in self.parts else []
        thick = self._reconstruct_thick(stages, folder) if "splats" in self.parts else []
        fox = self._reconstruct_fox(stages, folder) if "fox" in self.parts else None
        from tron.runtime import activate, set_torch_threads

        activate(self.variant)
        set_torch_threads(1)  # as tron-reconstruct does: Dr.Jit has the cores
        self._collect_scenes(runs, found)
        self._collect_scans(scans, found)
        self._collect_thick(thick, found)
        if fox is not None:
            self._collect_fox(fox, found)
        return found

    def _variant(self) -> list[str]:
        """Return the variant as an argument of a command, if it is not the default."""
        return [] if self.variant == DEFAULT_VARIANT else [f"variant={self.variant}"]

    def _prefix(self, way: str) -> str:
        """Return the prefix of a way's metrics; the first way has none."""
        return "reconstruction" if way == next(iter(self.ways)) else f"reconstruction.{way}"

    def _reconstruct_scenes(self, stages: Stages, folder: Path) -> list[Made]:
        """Reconstruct every scene in every way."""
        return self._reconstruct_all(stages, folder, self._dataset(stages, folder), self.ways)

    def _reconstruct_photos(self, stages: Stages, folder: Path) -> list[Made]:
        """Reconstruct the same scenes from photographs, without any prior."""
        return self._reconstruct_all(stages, folder, self._photographs(stages, folder), self.photos)

    def _dataset(self, stages: Stages, folder: Path) -> Path:
        dataset = folder / "dataset"
        stages.run("datagen", [Child("datagen", "tron-datagen", [*self.datagen, f"output_dir={dataset}"])])
        return dataset

    def _photographs(self, stages: Stages, folder: Path) -> Path:
        """Make captures of photographs, and their held-out views under other lights."""
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
        """Score a scan of the first scene, raw and reconstructed."""
        from eval.reconstruction.scans import write_scan
        from tron.gaussians.scene import GaussianScene

        dataset, made = self._dataset(stages, folder), []
        self._photographs(stages, folder)
        for scene in scene_names(dataset)[:1]:
            scanned = self._reconstruct_scene(stages, folder, dataset, scene, "scan", self.splats.scan)
            raw = folder / "scans" / scene / "scene.ply"
            if not raw.is_file():
                write_scan(raw, GaussianScene.load(scanned.folder / "scene.ply"), self.seed)
            out = folder / "scenes" / scene / "splats"
            seconds = self._run(stages, f"{scene} splats", raw, self.splats.reconstruct, out)
            made.append(Made(scene, "raw", scanned.capture, raw.parent, scanned.seconds))
            made.append(Made(scene, "splats", scanned.capture, out, seconds))
        return made

    def _reconstruct_thick(self, stages: Stages, folder: Path) -> list[Made]:
        """Score a thick scan, made from photographs of its own, as it is and with materials."""
        from eval.reconstruction.scans import write_scan
        from tron.gaussians.scene import GaussianScene
        from tron.scans.camera_files import CAMERAS

        dataset = folder / SCANNED
        arguments = [*self.splats.photographs, f"output_dir={dataset}"]
        stages.run("photographs of a scan", [Child("photographs of a scan", "tron-datagen", arguments)])
        for scene in scene_names(dataset)[:1]:
            capture, learnt = dataset / "captures" / scene, folder / "scenes" / scene / "thick"
            learning = self._run(stages, f"{scene} thick", capture, self.splats.thick, learnt)
            raw, out = folder / "scans" / f"{scene}-thick", folder / "scenes" / scene / "carried"
            if not (raw / "scene.ply").is_file():
                write_scan(raw / "scene.ply", GaussianScene.load(learnt / "scene.ply"), self.seed)
            shutil.copy(learnt / CAMERAS, raw)
            seconds = self._run(stages, f"{scene} carried", raw / "scene.ply", self.splats.carry, out)
            return [
                Made(scene, "raw_today", capture, raw, learning),
                Made(scene, "raw", capture, raw, learning),
                Made(scene, "carried", capture, out, seconds),
            ]
        return []

    def _run(
        self, stages: Stages, label: str, capture: Path, arguments: list[str], output_dir: Path
    ) -> float:
        """Reconstruct one capture; return the wall time in seconds."""
        typed = [f"capture={capture}", *arguments, *self._variant()]
        typed += [f"seed={self.seed}", f"output_dir={output_dir}"]
        return stages.run(label, [Child(label, "tron-reconstruct", typed)])

    def _collect_scenes(self, made: Sequence[Made], found: Outcome) -> None:
        from eval.reconstruction.pictures import compare_scene
        from eval.reconstruction.relighting import relight, relit_pictures

        ways: dict[str, list[Run]] = {}
        for each in made:
            run = collect_run(each.scene, each.folder, each.capture, each.seconds)
            truths = relit_truths(found.folder / PHOTOGRAPHS, each.scene)
            if truths and (each.way in self.photos or each.way in self.relit):
                run = replace(run, relit=relight(each.folder / "scene.ply", truths))
            ways.setdefault(each.way, []).append(run)
        for way, runs in ways.items():
            found.add(rows_of(self._prefix(way), runs, self.seed))
            found.add(light_rows(self._prefix(way), runs, self.seed))
            if curve := mean_curve(runs):
                found.series.setdefault("scenes", {})[WAYS.get(way, way)] = curve
        for scene in dict.fromkeys(run.name for runs in ways.values() for run in runs):
            of_scene = {way: run for way, runs in ways.items() for run in runs if run.name == scene}
            found.show("views", scene, compare_scene(of_scene, WAYS))
            relit = {WAYS.get(way, way): run.relit for way, run in of_scene.items() if run.relit is not None}
            if relit:
                found.show("relit", f"{scene}-relit", relit_pictures(f"Scene {scene}", relit))

    def _collect_scans(self, made: Sequence[Made], found: Outcome) -> None:
        from eval.reconstruction.relighting import relit_pictures
        from eval.reconstruction.scans import collect_scan, normal_pictures, scan_rows

        ways: dict[str, list[Scan]] = {}
        for each in made:
            truths = relit_truths(found.folder / PHOTOGRAPHS, each.scene)
            scan = collect_scan(each.scene, each.folder / "scene.ply", each.capture, truths, each.seconds)
            ways.setdefault(each.way, []).append(scan)
        for way, scans in ways.items():
            found.add(scan_rows(way, scans, self.seed))
        for scans in zip(*ways.values()):
            titled = dict(zip((SCANS[way] for way in ways), scans))
            name = scans[0].name
            found.show("splats", f"{name}-splats", normal_pictures(titled))
            relit = {title: scan.relit for title, scan in titled.items()}
            title = f"Scene {name} under other lights"
            found.show("splats", f"{name}-splats-relit", relit_pictures(title, relit))

    def _collect_thick(self, made: Sequence[Made], found: Outcome) -> None:
        from eval.reconstruction.thick import collect_thick, thick_rows

        truths = {each.scene: relit_truths(found.folder / SCANNED, each.scene) for each in made}
        found.add(
            thick_rows(
                {
                    each.way: collect_thick(each.way, each.folder, each.capture, truths[each.scene])
                    for each in made
                }
            )
        )

    def _collect_fox(self, made: FoxRun, found: Outcome) -> None:
        fox = collect_fox(made)
        found.add(fox.rows())
        if curve := mean_curve([fox.run]):
            found.series["fox"] = {"fox": curve}
        for name, group in fox.pictures():
            found.show("fox", name, group)

    def _reconstruct_fox(self, stages: Stages, folder: Path) -> FoxRun | None:
        """Reconstruct and relight the fox; None, with a warning, if its photos are missing."""
        data = self.real_data
        if data is None or not (data / "captures" / "fox").is_dir():
            log.warning("no fox: give benchmark.real_data=FOLDER with captures/fox and hdri")
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
                f"width={camera.width}",
                f"height={camera.height}",
                *self.relight,
                *self._variant(),
                f"output_dir={frames}",
            ]
            made.relit_seconds += stages.run(label, [Child(label, "tron-relight", typed)])
            made.lights[environment.stem] = environment, frames
        return made
