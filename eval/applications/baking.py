"""Files of `tron-bake` against frames under the same light, at views that no fit saw.

A scene is drawn three ways from its harmonics: by TRON with its own kernel, by TRON with the kernel of 3DGS
(degree 2) that files for other viewers have, and by a rasteriser of 3DGS in NumPy that shares no code with
TRON's (:mod:`eval.applications.splat_rasteriser`). All are held against ``lit`` of the same surfels, so the
baking is judged and not the surfels. Only pixels that surfels fill count.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from eval.applications.splat_rasteriser import rasterise
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.tracing.scene import LIGHTS
from tron.cameras import Camera
from tron.color import to_display
from tron.estimation import Estimation
from tron.gaussians.edit import with_kernel
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats
from tron.metrics import capped_psnr
from tron.relighting import Relighter
from tron.relighting.baking import baked
from tron.report.page import Picture, Pictures
from tron.seeds import generator, integer
from tron.tracing import SurfelTracer
from tron.trajectories import plan_cameras

SCENES = 4
"""Scenes that are baked, each as diffuse as can be and by its own materials."""
VIEWS, SIDE = 4, 192
"""Held-out views of each, pixels along a side."""
FINENESS = 3
"""Sub-pixels along a pixel's side of all that is drawn from harmonics, as frames have 2."""
FRAMES = Estimation(rays=64, supersample=2)
FILLED = 0.995
"""Opacity from which a pixel counts."""
KINDS = {"diffuse": "roughness 1, no metal", "glossy": "its own materials"}
DRAWN = {
    "psnr": "by TRON",
    "degree2_psnr": "by TRON, kernel of 3DGS",
    "rasteriser_psnr": "by a 3DGS rasteriser",
}


@dataclass
class Baked:
    """One scene under one light, baked.

    Attributes:
        scene: name of the scene. kind: of :data:`KINDS`.
        psnr: way of :data:`DRAWN` -> dB of each view.
        images: pictures of the first view, the truth first.
    """

    scene: str
    kind: str
    psnr: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in DRAWN})
    images: list[np.ndarray] = field(default_factory=list)


def measure_baking(folders: Sequence[Path], seed: int, outcome: Outcome) -> None:
    """Bake the first scenes, each under a sun or a soft light, and score renderings of the baked files."""
    found = []
    for number, folder in enumerate(folders[:SCENES]):
        own = GaussianScene.load(folder / "surfels.ply")
        light = list(LIGHTS)[number % len(LIGHTS)]
        for kind in KINDS:
            found.append(_judged(folder.name, kind, own, light, number, seed))
            outcome.show("bake", f"bake-{folder.name}-{kind}", _pictures(found[-1], light))
    outcome.add(baking_rows(found, seed))


def baking_rows(found: Sequence[Baked], seed: int) -> Iterator[Row]:
    """Yield means over scenes of a kind, losses by other kernels, and the figures of every scene."""
    for kind in KINDS:
        of_kind = [each for each in found if each.kind == kind]
        for name in DRAWN:
            values = [(each.scene, value) for each in of_kind for value in each.psnr[name]]
            yield mean_row(f"bake.{name}.{kind}", "dB", values, seed)
        for name in list(DRAWN)[1:]:
            lost = [
                (each.scene, own - other)
                for each in of_kind
                for own, other in zip(each.psnr["psnr"], each.psnr[name], strict=True)
            ]
            yield mean_row(f"bake.{name.removesuffix('_psnr')}_loss.{kind}", "dB", lost, seed)
    for each in found:
        for name, values in each.psnr.items():
            metric = f"bake.scene_{name}_{each.kind}.{each.scene.replace('-', '_')}"
            yield Row(metric=metric, value=float(np.mean(values)), unit="dB", n=len(values))


def _judged(name: str, kind: str, own: GaussianScene, light: str, number: int, seed: int) -> Baked:
    scene = own
    if kind == "diffuse":
        scene = replace(own, roughness=np.ones_like(own.roughness), metallic=np.zeros_like(own.metallic))
    turn = float(generator(seed, "applications", "bake", number).uniform(0, 360))
    relighter = Relighter(scene, FRAMES, integer(seed, "applications", "bake", number), proxy="never")
    lit = relighter.under(LIGHTS[light]().rotated(turn))
    cameras = plan_cameras(scene, "orbit", VIEWS, width=SIDE, height=SIDE, fov_deg=40)
    frames = [lit.render(camera, k, background=(0, 0, 0)) for k, camera in enumerate(cameras)]
    exposure = frames[0].exposure("none")
    relit = baked(lit, exposure, "none")
    plain, found = with_kernel(relit, 2), Baked(name, kind)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "relit.ply"
        write_splats(file, plain)
        for camera, frame in zip(cameras, frames):
            truth, filled = to_display(frame.lit, exposure), frame.mask > FILLED
            fine = camera.resized(FINENESS * SIDE, FINENESS * SIDE)
            drawn = [
                _harmonics(relit, fine),
                _harmonics(plain, fine),
                np.clip(rasterise(file, fine)[0], 0, 1),
            ]
            images = [_coarse(image) for image in drawn]
            for way, image in zip(DRAWN, images, strict=True):
                found.psnr[way].append(capped_psnr(image, truth, filled))
            if not found.images:
                found.images = [truth, *images]
    return found


def _harmonics(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """Render a scene's harmonics over black: (H, W, 3) display values."""
    view = SurfelTracer(scene).gbuffer(camera)
    return view.images({"rgb": view.rgb})["rgb"]


def _coarse(image: np.ndarray) -> np.ndarray:
    """Average over blocks of FINENESS x FINENESS pixels."""
    return image.reshape(SIDE, FINENESS, SIDE, FINENESS, 3).mean((1, 3))


def _pictures(found: Baked, light: str) -> Pictures:
    where = f"scene {found.scene}, {KINDS[found.kind]}, light {light}"
    truth, *drawn = found.images
    pictures = [Picture(truth, "lit, the truth here", f"lit with 64 rays a pixel, {where}", strong=True)]
    for (name, title), image in zip(DRAWN.items(), drawn, strict=True):
        words = f"harmonics {title}, {where}"
        pictures.append(Picture(image, title, words, f"{found.psnr[name][0]:.1f} dB"))
    return Pictures(f"Scene {found.scene} · {KINDS[found.kind]} · light {light}", pictures, columns=4)
