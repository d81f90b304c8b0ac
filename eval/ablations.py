"""Benchmark `ablations`: change one choice at a time, and score and show the result.

Choices of the renderer are made on small worlds of surfels (:mod:`eval.applications.worlds`), whose true
meshes Mitsuba path-traces under the same light: rays, surfels, bounces, sub-pixels, seeds, networks, and the
weights of the paper's two latents. The source of surfels and the prior are judged on a capture under lights
that its photos never saw. Fusions of latents are judged by trainings that differ in the fusion alone.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting.buffers import MEMBERS, Buffers, region_mask
from eval.relighting.networks import Network, drawn, find_weights, guided, load_networks
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.stages import ONE_THREAD, Child, Stages, script_path
from tron.cameras import Camera
from tron.cli.installation import require_own_packages
from tron.color import to_display
from tron.estimation import FINAL, PREVIEW, Estimation
from tron.metrics import capped_psnr
from tron.report.page import Picture, Pictures
from tron.runtime import activate, set_torch_threads
from tron.seeds import generator, integer
from tron.shards.reader import read_clips

if TYPE_CHECKING:
    from eval.applications.worlds import World
    from tron.relighting import Illumination

log = logging.getLogger("tron.eval")

Part = Literal[
    "rays", "surfels", "bounces", "supersampling", "seeds", "network", "weights", "fusion", "sources"
]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
LIGHTS = ("sun", "soft")
"""Kinds of light, in turns over the worlds."""
GBUFFERS = "gbuffers"
"""Surfels of a capture's true maps, beside the priors."""
PRIORS = {"precomputed": "maps of DiffusionRenderer", "rgbx": "a checkpoint of RGB->X"}
"""Prior that asks for what nobody can download here -> what that is."""
SHOWN = 192
"""Least width of a picture, pixels."""


class Choice(NamedTuple):
    """One variant of a frame: surfels, estimation of the light, and the seed of its rays."""

    surfels: int
    estimation: Estimation
    seed: int


class Ablations(Benchmark):
    """Settings: parts and sizes; finished captures and trainings are reused."""

    name: ClassVar[str] = "ablations"

    parts: list[Part] = Field(description="choices to vary", min_length=1)
    renderer: Path | list[Path] | None = Field(
        default=None, description="weights of networks, or names of shipped ones; null: both shipped networks"
    )
    seed: int = 0
    variant: str = Field(default="llvm_ad_rgb", description="Mitsuba variant; cuda_ad_rgb on a GPU")
    threads: PositiveInt | None = Field(default=None, description="threads of Dr.Jit; null: one per core")
    worlds: PositiveInt = Field(default=3, description="number of scenes, each under another kind of light")
    width: PositiveInt = Field(default=192, description="width of the square frames, pixels")
    path_spp: PositiveInt = Field(default=256, description="path-traced samples per pixel of the truth")
    rays: list[Annotated[int, Field(ge=2, multiple_of=2)]] = Field(
        description="numbers of shadow rays per pixel to compare"
    )
    surfels: list[PositiveInt] = Field(description="numbers of surfels to compare")
    usual: PositiveInt = Field(default=50_000, description="number of surfels while another choice is varied")
    seeds: PositiveInt = Field(default=4, description="number of ray seeds to compare")
    captures: list[str] = Field(description="arguments of tron-datagen that make captures and relight them")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct, the same for every prior")
    priors: dict[Name, list[str]] = Field(description="prior -> further arguments of tron-reconstruct")
    dataset: list[str] = Field(description="arguments of tron-datagen that make the fusions' training data")
    train: list[str] = Field(description="arguments of tron-train, the same for every fusion")
    fusions: dict[Name, list[str]] = Field(description="fusion -> further arguments of tron-train")

    def check(self) -> None:
        """Find the checkpoints, and the commands that the parts call."""
        if {"network", "weights"} & set(self.parts):
            for path in self._weights():
                find_weights(path)
        commands = {"sources": ["tron-datagen", "tron-reconstruct"], "fusion": ["tron-datagen", "tron-train"]}
        for part in set(commands) & set(self.parts):
            require_own_packages("datagen", "train")
            for each in commands[part]:
                script_path(each)

    def run(self, output_dir: Path) -> Outcome:
        """Vary the choices part by part; write one line per figure to stderr.

        Raises:
            StageFailed: a command failed.
            TronError: weights, captures or data are not what they should be.
        """
        self.check()
        activate(self.variant, self.threads)
        set_torch_threads(self.threads or 1)
        run = Run(self, output_dir.absolute())
        for part in self.parts:
            run.stages.restart(f"part {part}")  # a figure of this run, never of one before
            with run.stages.timed(f"part {part}", [["tron-eval", f"benchmark.parts=[{part}]"]]):
                getattr(run, part)()
        return run.outcome

    def _weights(self) -> list[Path]:
        given = [self.renderer] if isinstance(self.renderer, Path) else self.renderer
        return list(given or (Path("paper"), Path("surfaces")))


@dataclass(frozen=True, eq=False)
class Judged:
    """A world's frame: its truth (H, W, 3) in display values, its exposure, and the mask of surfaces."""

    world: World
    camera: Camera
    truth: np.ndarray
    exposure: float
    inside: np.ndarray

    def psnr(self, shown: np.ndarray) -> float:
        """Return the PSNR of display values on surfaces, dB."""
        return capped_psnr(shown, self.truth, self.inside)


class Run:
    """One method for each part of the benchmark."""

    def __init__(self, settings: Ablations, folder: Path):
        self.settings, self.folder = settings, folder
        self.outcome, self.stages = Outcome(folder), Stages(folder)
        self._lit: dict[tuple[int, int, int], Illumination] = {}

    @cached_property
    def worlds(self) -> list[Judged]:
        """The worlds with their truth."""
        from eval.applications.worlds import draw_world, view_of

        s, found = self.settings, []
        for number in range(s.worlds):
            world = draw_world(s.seed, "ablations", number, LIGHTS[number % len(LIGHTS)], things=4)
            camera = view_of(generator(s.seed, "ablations", number, "camera"), s.width, s.width)
            radiance = world.traced(camera, s.path_spp, integer(s.seed, "ablations", number, "paths"))
            exposure, inside = world.light.exposure(), world.surface(camera).depth[..., 0] > 0
            found.append(Judged(world, camera, to_display(radiance, exposure), exposure, inside))
        return found

    @cached_property
    def networks(self) -> dict[str, Network]:
        """The checkpoints, by method name."""
        return load_networks("neural", self.settings._weights())

    def rays(self) -> None:
        """Vary the number of shadow rays per pixel."""
        usual = self.settings.usual
        choices = {
            str(rays): Choice(usual, FINAL.model_copy(update={"rays": rays}), 0)
            for rays in self.settings.rays
        }
        self._vary("rays", choices, "{} rays")

    def surfels(self) -> None:
        """Vary the number of surfels of a scene."""
        self._vary("surfels", {str(n): Choice(n, FINAL, 0) for n in self.settings.surfels}, "{} surfels")

    def bounces(self) -> None:
        """Compare light with and without bounces."""
        found = {
            str(n): Choice(self.settings.usual, FINAL.model_copy(update={"bounces": n}), 0) for n in (0, 1, 4)
        }
        self._vary("bounces", found, "{} bounces")

    def supersampling(self) -> None:
        """Compare one sample per pixel with four samples that have a quarter of the rays each."""
        found = {
            str(n**2): Choice(self.settings.usual, FINAL.model_copy(update={"supersample": n}), 0)
            for n in (1, 2)
        }
        self._vary("supersampling", found, "{} a pixel")

    def seeds(self) -> None:
        """Vary the seed of the rays: the range of the figures is the spread due to chance."""
        choices = {str(n): Choice(self.settings.usual, FINAL, n) for n in range(self.settings.seeds)}
        means = self._vary("seeds", choices, "seed {}")
        spread = max(means) - min(means)
        self.outcome.add([Row(metric="seeds.spread_db", value=spread, unit="dB", n=len(means))])

    def network(self) -> None:
        """Compare the preview without a network with the preview by each network."""
        pictures, found = list[Picture](), dict[str, list[tuple[str, float]]]()
        for number, judged in enumerate(self.worlds):
            light = self._light(number, Choice(self.settings.usual, PREVIEW, 0))
            shown = {"none": to_display(light.render(judged.camera, 0).lit, judged.exposure)}
            for name, network in self.networks.items():
                shown[name] = drawn(network, light, [judged.camera], judged.exposure, 0)[0]
            for name, image in shown.items():
                found.setdefault(name, []).append((str(number), judged.psnr(image)))
            if number == 0:
                pictures = [_picture(image, name, judged) for name, image in shown.items()]
        self._keep("network", found, pictures)

    def weights(self) -> None:
        """Score 5 x 5 weights of the paper's two latents on all worlds; show the first world."""
        from tron.neural.renderer import NeuralRenderer
        from tron.neural.sweep import SWEEP, weight_sweep

        pair = self.networks.get("neural")
        if pair is None or not isinstance(pair.renderer, NeuralRenderer):
            log.warning("no rows of weights: none of the networks is of the paper's two buffers")
            return
        pictures, found = list[Picture](), dict[str, list[tuple[str, float]]]()
        for number, judged in enumerate(self.worlds):
            light = self._light(number, Choice(self.settings.usual, PREVIEW, 0))
            given = guided(pair, light, [judged.camera], judged.exposure, 0).displayed
            images = weight_sweep(pair.renderer, given)
            for of_pbr, row in zip(SWEEP, images):
                for of_irradiance, image in zip(SWEEP, row):
                    name = f"{round(100 * of_pbr)}_{round(100 * of_irradiance)}"
                    found.setdefault(name, []).append((str(number), judged.psnr(image)))
                    if number == 0:
                        pictures.append(
                            _picture(image, f"pbr {of_pbr:g}, irradiance {of_irradiance:g}", judged)
                        )
        self._keep("weights", found, pictures, columns=len(SWEEP))

    def fusion(self) -> None:
        """Score trainings that differ in the fusion of latents, on the test split of their data."""
        s, data = self.settings, self.folder / "dataset"
        self.stages.run("dataset", [Child("dataset", "tron-datagen", [*s.dataset, f"output_dir={data}"])])
        files = dict[str, Path]()
        for name, more in s.fusions.items():
            folder, label = self.folder / "fusion" / name, f"fusion {name}"
            typed = [*s.train, *more, f"dataset={data}", f"output_dir={folder}"]
            self.stages.run(label, [Child(label, "tron-train", typed, ONE_THREAD)])
            files[name] = folder / "renderer.safetensors"
        networks = {
            name: next(iter(load_networks("neural", [path]).values())) for name, path in files.items()
        }
        pictures, found = list[Picture](), dict[str, list[tuple[str, float]]]()
        for number, clip in enumerate(read_clips(data, "test", MEMBERS)):
            truth, inside = clip.displayed("rgb"), region_mask(clip, "foreground")
            for name, network in networks.items():
                shown = network.show(Buffers.of(clip))
                psnrs = [capped_psnr(*each) for each in zip(shown, truth, inside) if each[2].any()]
                found.setdefault(name, []).extend((clip.meta.scene, each) for each in psnrs)
                if number == 0 and psnrs:
                    pictures.append(
                        Picture(_enlarged(shown[0]), name, f"fused by {name}", f"{psnrs[0]:.1f} dB")
                    )
            if number == 0:
                pictures.append(Picture(_enlarged(truth[0]), "path-traced", "path-traced", strong=True))
        self._keep("fusion", found, pictures)

    def sources(self) -> None:
        """Relight surfels of true G-buffers, and of photos by each prior, under lights that no photo saw."""
        from eval.reconstruction.benchmark import relit_truths, scene_names
        from eval.reconstruction.relighting import Relit, relight, relit_pictures
        from eval.reconstruction.runs import read_report

        s, data = self.settings, self.folder / "captures"
        self.stages.run("captures", [Child("captures", "tron-datagen", [*s.captures, f"output_dir={data}"])])
        relit: dict[str, dict[str, Relit]] = {}
        figures: dict[str, dict[str, list[tuple[str, float]]]] = {}
        for scene in scene_names(data):
            capture, truths = data / "captures" / scene, relit_truths(data, scene)
            folders = {GBUFFERS: self.folder / "sources" / scene / GBUFFERS}
            _write_true_surfels(capture, folders[GBUFFERS] / "scene.ply", s.usual, s.seed)
            for name, more in s.priors.items():
                folders[name], label = self.folder / "sources" / scene / name, f"{scene} {name}"
                typed = [f"capture={capture}", *s.reconstruct, *more, f"output_dir={folders[name]}"]
                self.stages.run(label, [Child(label, "tron-reconstruct", typed)])
                test = read_report(folders[name]).test
                for figure in ("base_color_psnr", "normal_mae_deg"):
                    if figure in test:
                        figures.setdefault(figure, {}).setdefault(name, []).append((scene, test[figure]))
            relit[scene] = {name: relight(folder / "scene.ply", truths) for name, folder in folders.items()}
            for name, each in relit[scene].items():
                figures.setdefault("psnr", {}).setdefault(name, []).append((scene, each.psnr))
        for figure, of in figures.items():
            unit = "deg" if figure.endswith("_deg") else "dB"
            rows = (mean_row(f"sources.{figure}.{name}", unit, found, s.seed) for name, found in of.items())
            self.outcome.add(rows)
        for absent in PRIORS.keys() - s.priors.keys():
            log.warning(
                "no rows of prior %s, which needs %s: benchmark.priors takes it", absent, PRIORS[absent]
            )
        for scene, each in relit.items():
            self.outcome.show("sources", f"sources-{scene}", relit_pictures(f"Scene {scene}", each))

    def _light(self, number: int, choice: Choice) -> Illumination:
        """Light a world's surfels; choices that do not change the bake share it."""
        from tron.relighting import Relighter

        estimation, judged = choice.estimation, self.worlds[number]
        key = number, choice.surfels, estimation.bounces
        if key not in self._lit:
            scene = judged.world.surfels(choice.surfels)
            relighter = Relighter(scene, estimation, self.settings.seed, proxy="never")
            self._lit[key] = relighter.under(judged.world.light)
        return self._lit[key].framed(
            rays=estimation.rays, filtered=estimation.filtered, supersample=estimation.supersample
        )

    def _vary(self, part: str, choices: Mapping[str, Choice], title: str) -> list[float]:
        """Add rows and pictures of a part; return the means over the worlds, in the order of the choices."""
        pictures, found = list[Picture](), dict[str, list[tuple[str, float]]]()
        for number, judged in enumerate(self.worlds):
            for name, choice in choices.items():
                light = self._light(number, choice)
                shown = to_display(light.render(judged.camera, choice.seed).lit, judged.exposure)
                found.setdefault(name, []).append((str(number), judged.psnr(shown)))
                if number == 0:
                    pictures.append(_picture(shown, title.format(name), judged))
        return self._keep(part, found, pictures)

    def _keep(
        self,
        part: str,
        found: Mapping[str, Sequence[tuple[str, float]]],
        pictures: Sequence[Picture],
        columns: int = 4,
    ) -> list[float]:
        rows = [
            mean_row(f"{part}.psnr.{name}", "dB", each, self.settings.seed) for name, each in found.items()
        ]
        self.outcome.add(rows)
        if pictures:
            shown = list(pictures)
            if part != "fusion":
                shown.append(
                    Picture(_enlarged(self.worlds[0].truth), "path-traced", "path-traced", strong=True)
                )
            self.outcome.show(part, f"ablations-{part}", Pictures(f"Varied: {part}", shown, columns=columns))
        return [row.value for row in rows]


def _picture(shown: np.ndarray, title: str, judged: Judged) -> Picture:
    return Picture(_enlarged(shown), title, title, f"{judged.psnr(shown):.1f} dB")


def _enlarged(image: np.ndarray) -> np.ndarray:
    times = -(-SHOWN // image.shape[1])
    return image.repeat(times, 0).repeat(times, 1)


def _write_true_surfels(capture: Path, path: Path, count: int, seed: int) -> None:
    """Write surfels made from the training views' true depth, normals and materials."""
    from tron.captures.folder import read_capture_folder
    from tron.reconstruction.geometry.initial import surfels_from_depth
    from tron.reconstruction.settings import InitialSettings

    settings = InitialSettings(source="depth", count=count)
    path.parent.mkdir(parents=True, exist_ok=True)
    surfels_from_depth(read_capture_folder(capture), settings, seed).save(path)
