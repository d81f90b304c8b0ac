"""TRON's own methods: render a scene's surfels under every light, by each of several ways.

Surfels are made from the training views' true maps, or reconstructed from the photos by tron-reconstruct.
Buffers are traced once per frame for all ways; :mod:`eval.relighting` has the formulas of the ways. Pictures
are linear, so that one factor on light can be fitted to reconstructions from photos; for these the display
values of a network are taken back through AgX.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, PositiveInt

from eval.methods.making import Making
from eval.protocol.method import ColorSpace, Given, Method, MethodWriter, write_method
from eval.protocol.suite import Suite, SuiteScene
from eval.relighting import baselines
from eval.relighting.buffers import Buffers
from eval.relighting.fits import product_terms
from eval.relighting.networks import Network, load_networks
from eval.stages import Child, Stages, script_path
from tron.cameras import Camera
from tron.captures.folder import read_capture_folder
from tron.cli.installation import require_own_packages
from tron.color import from_agx
from tron.denoising import require
from tron.errors import TronError
from tron.estimation import QUALITY
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.relighting import Illumination, Relighter
from tron.runtime import describe_machine
from tron.seeds import integer

log = logging.getLogger("tron.eval")

DENOISED = {each.name: name for name, each in baselines.DENOISED.items()}
"""Way -> the denoiser that it is through."""
TITLES = {
    "pbr": "split sum, no shadows",
    "pbr_x_irradiance": "pbr × irradiance",
    "shadow_ratio": "pbr × share of light",
    "shadowed": "shadowed",
    "lit": "lit",
    **{each.name: each.title for each in baselines.DENOISED.values()},
    "network": "neural renderer",
}
if TYPE_CHECKING:
    Way = str
else:
    Way = Literal[tuple(TITLES)]
MADE: Mapping[str, Callable[[Buffers], np.ndarray]] = {
    "pbr_x_irradiance": lambda buffers: sum(product_terms(buffers)) / buffers.exposure,  # pyright: ignore
    "shadow_ratio": baselines.shadow_ratio,
}
"""Way -> linear radiance (K, H, W, 3), for ways that are not a buffer. The product has no fitted scale here;
the factor on light replaces it."""
_FIELDS = ("depth", "normal", "base_color", "roughness", "metallic")


class Surfels(Making):
    """Settings: surfels of every scene, and ways to render them; each way writes a folder ``NAME_WAY``."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,19}$", description="prefix of the methods' names")
    surfels: Literal["true_maps", "photos"] = Field(
        description="true_maps: from true maps of the training views; photos: by tron-reconstruct"
    )
    ways: list[Way] = Field(description="ways to render the surfels", min_length=1)
    quality: Literal["preview", "final"] = Field(description="quality, as in tron-relight")
    count: PositiveInt = Field(description="number of surfels of a scene with surfels=true_maps")
    reconstruct: list[str] = Field(description="arguments of tron-reconstruct with surfels=photos")
    renderer: str = Field(description="weights for the way network: a file, or a shipped checkpoint's name")

    def make(self, output_dir: Path) -> list[Path]:
        """Make surfels, lights and frames scene by scene; finished scenes are skipped."""
        suite, stages = self.read_suite(), None
        for way in DENOISED.keys() & self.ways:
            require(DENOISED[way], f"method.ways=[{way}]")
        if "network" in self.ways and suite.file.tone_curve != "agx":
            raise TronError(
                "the network was trained on AgX pictures", suite.folder, "leave network out of method.ways"
            )
        network = (
            next(iter(load_networks("neural", [self.renderer]).values())) if "network" in self.ways else None
        )
        if self.surfels == "true_maps":
            _require_true_maps(suite)
        else:
            require_own_packages("tron.reconstruction")
            script_path("tron-reconstruct")
            stages = Stages(output_dir)
        fits, frames = [], []
        folders: dict[Way, Path] = {way: output_dir / f"{self.name}_{way}" for way in self.ways}
        with ExitStack() as opened:
            writers: dict[Way, MethodWriter] = {
                way: opened.enter_context(write_method(folder, self._method(suite, way)))
                for way, folder in folders.items()
            }
            for scene in suite.scenes.values():
                if all(writer.has(scene.name, "normals") for writer in writers.values()):
                    continue
                surfels, seconds = self._surfels(scene, output_dir, stages)
                fits.append(seconds)
                frames += self._show(scene, surfels, network, writers)
                log.info("%s: %d surfels in %.0f s", scene.name, len(surfels), seconds)
            for writer in writers.values():
                if fits:
                    writer.seconds(float(np.mean(fits)), float(np.median(frames)))
        return list(folders.values())

    def _method(self, suite: Suite, way: Way) -> Method:
        photos = self.surfels == "photos"
        space: ColorSpace = "display" if way == "network" and not photos else "linear"
        saw: list[Given] = ["photos", "masks"] if photos else ["true_maps"]
        machine = describe_machine()
        return Method(
            name=f"{self.name}_{way}",
            title=f"TRON, {TITLES[way]}, from {'photos' if photos else 'true maps'}",
            suite=suite.id,
            color_space=space,
            background="environment",
            scale="scene" if photos else "absolute",
            saw=[*saw, "other_scenes"] if way == "network" else saw,
            machine=f"{machine.get('cpu', '')}; a picture's time is of all buffers together",
        )

    def _surfels(self, scene: SuiteScene, folder: Path, stages: Stages | None) -> tuple[GaussianScene, float]:
        """Return surfels, and the seconds to make them."""
        begun = time.perf_counter()
        if stages is None:
            capture = read_capture_folder(scene.train)
            up = capture.up.tolist()
            made = surfels_from_gbuffers(_true_views(scene), count=self.count, up=up)
            return made, time.perf_counter() - begun
        made_in = folder / "reconstructed" / self.name / scene.name
        arguments = [f"capture={scene.train}", *self.reconstruct, f"output_dir={made_in}"]
        seconds = stages.run(f"{self.name}, {scene.name}", [Child(scene.name, "tron-reconstruct", arguments)])
        return GaussianScene.load(made_in / "scene.ply"), seconds

    def _show(
        self,
        scene: SuiteScene,
        surfels: GaussianScene,
        network: Network | None,
        writers: Mapping[Way, MethodWriter],
    ) -> list[float]:
        """Write the scene's pictures and maps; return the seconds of each frame."""
        capture, seconds = read_capture_folder(scene.train), []
        proxy = "auto" if self.surfels == "photos" else "never"  # what true maps make is one layer
        estimation, cameras = QUALITY[self.quality], capture.train_cameras
        relighter = Relighter(surfels, estimation, self.seed, proxy=proxy, cameras=cameras)
        for light, of_light in scene.lights.items():
            lit = relighter.under(scene.light(light), integer(self.seed, "methods", scene.name, light))
            shot: dict[str, list[np.ndarray]] = {}
            for k, camera in enumerate(scene.cameras):
                begun = time.perf_counter()
                for name, image in self._frame(lit, scene, light, k, camera).items():
                    shot.setdefault(name, []).append(image)
                seconds.append(time.perf_counter() - begun)
            buffers = Buffers({name: np.stack(images) for name, images in shot.items()}, of_light.exposure)
            for way, writer in writers.items():
                if writer.has(scene.name, light):
                    continue
                if way == "network":
                    assert network is not None
                    shown = network.show(buffers)
                    if self.surfels == "photos":
                        shown = from_agx(shown) / np.float32(of_light.exposure)
                else:
                    shown = MADE[way](buffers) if way in MADE else buffers[way]
                writer.frames(scene.name, light, shown)
        maps = [relighter.gbuffer(camera).numpy() for camera in scene.cameras]
        for writer in writers.values():
            for what, name in (("albedo", "base_color"), ("normals", "normal")):
                if not writer.has(scene.name, what):
                    getattr(writer, what)(scene.name, np.stack([each[name] for each in maps]))
        return seconds

    def _frame(
        self, lit: Illumination, scene: SuiteScene, light: str, k: int, camera: Camera
    ) -> dict[str, np.ndarray]:
        """Return the buffers of a frame for ways and networks, over the environment."""
        frame = lit.trace(camera, integer(self.seed, "methods", scene.name, light, k))
        guidance = frame.shade()
        (maps,) = lit.relighter.surface_maps(camera, lit.estimation)
        images = {
            name: guidance[name] for name in ("pbr", "irradiance", "unshadowed", "shadowed", "lit", "mask")
        }
        for way in DENOISED.keys() & self.ways:
            images[way] = frame.denoised(DENOISED[way], maps).shade().lit
        return images | maps


def _require_true_maps(suite: Suite) -> None:
    """Raise TronError if a training view lacks a map that surfels need."""
    for scene in suite.scenes.values():
        for view in read_capture_folder(scene.train).views:
            if missing := [name for name in _FIELDS if not view.has(name)]:
                mend = "make surfels from photos: method=photos"
                raise TronError(f"training view {view.name} has no true {missing[0]}", scene.train, mend)


def _true_views(scene: SuiteScene) -> Iterator[GBufferView]:
    """Yield G-buffers of the training views."""
    for view in read_capture_folder(scene.train).views:
        depth, normal = view.read("depth"), view.read("normal")
        yield GBufferView(
            view.camera,
            view.camera.position + view.camera.rays() * depth[..., None],
            normal,
            view.read("base_color"),
            view.read("roughness"),
            view.read("metallic"),
            None,
            (depth > 0) & normal.any(axis=-1),
            np.zeros(depth.shape, int),
        )
