"""Cells of the zoo: one material on one shape under one light, path-traced and by every way of TRON.

Only pixels that the shape fills count: all 16 rays of such a pixel hit it. Pixels of the silhouette are left
out, because each renderer filters the background differently; surfaces at grazing angles are not left out.
The result is divided by the surfels' opacity (:data:`HOLE`), so a hole is dark only if it covers most of a
pixel.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

from eval.relighting.networks import Network, drawn
from eval.renderers.paths import path_traced, scene_of
from eval.zoo.lights import Light
from eval.zoo.materials import Material
from eval.zoo.shapes import Shape
from tron.color import to_display
from tron.estimation import FINEST, PREVIEW
from tron.metrics import capped_psnr
from tron.models.shapes import textured
from tron.relighting import Illumination, Relighter
from tron.relighting.relighter import TracedFrame
from tron.seeds import integer

log = logging.getLogger("tron.eval")

QUALITIES = {"preview": PREVIEW, "final": FINEST}
PATHS, EVEN_PATHS = 256, 64
"""A pixel's, of the truth."""
TRIED = 3
"""One cell in so many is shown by denoisers and networks too, of every material and of every light."""
FINE = 4
"""Rays along a pixel's side that decide whether the shape fills it."""
HOLE = 0.5
"""Opacity below which a pixel counts as so opaque."""


@dataclass(eq=False)
class Cell:
    """One cell, measured.

    Attributes:
        shape: its kind. number: number of the individual.
        material: its material. light: name of the light.
        exposure: exposure of the pictures.
        covered: (H, W) share of a pixel's rays that hit the shape.
        truth: (H, W, 3) linear.
        lit: quality -> (H, W, 3) linear, divided by the surfels' opacity; with installed denoisers too, as
            ``preview_oidn``.
        psnr: way -> dB of display values, the network included.
    """

    shape: str
    number: int
    material: Material
    light: str
    exposure: float
    covered: np.ndarray
    truth: np.ndarray
    lit: dict[str, np.ndarray]
    psnr: dict[str, float] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """Description, such as ``leaf, metal 0.87 saturated, studio``."""
        return f"{self.shape}, {self.material.words}, {self.light}"

    @property
    def counts(self) -> np.ndarray:
        """(H, W) bool: pixels that the shape fills."""
        return self.covered == 1

    def mean(self, way: str) -> float:
        """Return the mean of ``lit`` over the mean of the truth."""
        return float(self.lit[way][self.counts].mean() / self.truth[self.counts].mean())

    def error(self, way: str) -> float:
        """Return the mean absolute difference from the truth over the truth's mean."""
        return float(np.abs(self.lit[way] - self.truth)[self.counts].mean() / self.truth[self.counts].mean())

    def judge(self, way: str, shown: np.ndarray) -> None:
        """Store the PSNR of display values (H, W, 3)."""
        self.psnr[way] = capped_psnr(shown, to_display(self.truth, self.exposure), self.counts)


def measured(
    shape: Shape,
    materials: Sequence[Material],
    lights: Sequence[Light],
    seed: int,
    denoisers: Sequence[str],
    networks: Mapping[str, Network],
) -> Iterator[Cell]:
    """Measure cells of an individual: every material under every light; shadows are traced once.

    Args:
        shape: the individual.
        materials: its materials.
        lights: its lights.
        seed: root of all random numbers.
        denoisers: names of denoisers, tried in one of :data:`TRIED` cells.
        networks: name -> network, tried in the same cells.
    """
    start, first, baked = time.perf_counter(), None, dict[str, Illumination]()
    share = covered(shape)
    for number, material in enumerate(materials):
        scene = shape.surfels(material)
        root = integer(seed, "zoo", "light", shape.kind, shape.number)
        choice = "always" if shape.fog else "never"
        first = first or Relighter(scene, PREVIEW, root, proxy=choice).prepare()
        relighter = first if scene is first.scene else first.changed(scene)
        meshes = [textured(part, f"part{n}").shape for n, part in enumerate(shape.of(material))]
        maps = relighter.surface_maps(shape.camera, *QUALITIES.values()) if denoisers else []
        for place, light in enumerate(lights):
            tried = (number + place) % TRIED == 0
            names = ("zoo", shape.kind, shape.number, number, light.name)
            paths = EVEN_PATHS if light.even else PATHS
            depth, rays = FINEST.bounces + 2, integer(seed, *names, "rays")
            truth = path_traced(
                meshes, light.environment, shape.camera, depth, paths, integer(seed, *names, "truth")
            )
            under = relighter.bring(scene, light.lighting, before=baked.get(light.name))
            baked.setdefault(light.name, under)
            exposure = light.environment.exposure()
            cell = Cell(shape.kind, shape.number, material, light.name, exposure, share, truth, {})
            for k, (quality, estimation) in enumerate(QUALITIES.items()):
                framed = replace(under, estimation=estimation)
                traced = framed.trace(shape.camera, rays)
                cell.lit[quality] = _whole(traced)
                for name in denoisers if tried else ():
                    cell.lit[f"{quality}_{name}"] = _whole(traced.denoised(name, maps[k]))
                for name, network in networks.items() if tried else ():
                    cell.judge(f"{quality}_{name}", drawn(network, framed, [shape.camera], exposure, rays)[0])
            for way, image in cell.lit.items():
                cell.judge(way, to_display(image, exposure))
            yield cell
    seconds, count = time.perf_counter() - start, len(materials) * len(lights)
    log.info("%s %d: %d cells in %.0f s", shape.kind, shape.number, count, seconds)


def covered(shape: Shape) -> np.ndarray:
    """Return the share of a pixel's rays that hit the shape, (H, W).

    Raises:
        ValueError: no pixel is covered (a defect of the shape).
    """
    camera = shape.camera
    fine = camera.resized(FINE * camera.width, FINE * camera.height)
    along = mi.Vector3f(fine.rays().reshape(-1, 3).T.astype(np.float32))
    meshes = [textured(part, f"part{n}").shape for n, part in enumerate(shape.parts)]
    met = scene_of(meshes).ray_test(mi.Ray3f(mi.Point3f(*camera.position.tolist()), along))
    found = np.array(met).reshape(camera.height, FINE, camera.width, FINE).mean((1, 3))
    if not (found == 1).any():
        raise ValueError(f"{shape.kind} {shape.number} fills no pixel")
    return found


def _whole(frame: TracedFrame) -> np.ndarray:
    """Return ``lit`` of a frame as if its surfels were opaque."""
    dark, bright = (frame.shade([behind] * 3).lit for behind in (0.0, 1.0))
    return dark / np.maximum(1 - (bright - dark), HOLE)
