"""A reconstruction under lights that its photos never saw, against Mitsuba's path tracer.

Held-out views are lit as by tron-relight's final quality (``lit``), and compared with path-traced views in
pixels that show only surfaces. Photos alone cannot distinguish bright paint in dim light from dim paint in
bright light, so one factor on all light of a scene is fitted first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.light_scale import COVERED, fitted_factor
from tron.captures import Capture
from tron.captures.folder import read_capture_folder
from tron.color import to_display
from tron.estimation import QUALITY, Estimation
from tron.gaussians.scene import GaussianScene
from tron.metrics import capped_psnr
from tron.relighting import Illumination, Relighter
from tron.report.page import Picture, Pictures
from tron.scans.camera_files import filmed_with
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance


@dataclass(frozen=True)
class RelitLight:
    """Held-out views under one light.

    Attributes:
        psnr: mean over the views, dB, on surfaces, display values.
        truth: the middle view path-traced, (H, W, 3) display values.
        shown: the same view of the surfels, after the factor.
    """

    psnr: float
    truth: np.ndarray
    shown: np.ndarray


@dataclass(frozen=True)
class Relit:
    """Scores of a reconstruction under all its other lights.

    Attributes:
        lights: name of a light, such as "sun" -> its scores.
        factor: on the surfels' radiance, one for all lights and views.
    """

    lights: dict[str, RelitLight]
    factor: float

    @property
    def psnr(self) -> float:
        """Mean PSNR over the lights, dB."""
        return float(np.mean([light.psnr for light in self.lights.values()]))


def relight(scene: Path, truths: Sequence[Path], estimation: Estimation = QUALITY["final"]) -> Relit:
    """Light surfels by the lights of the path-traced views, and score the pictures.

    Args:
        scene: scene.ply, in the world of the views.
        truths: capture folders of the views (tron-datagen's relit/NAME_1_sun), each with its environment.exr.
        estimation: of the light.
    """
    surfels = GaussianScene.load(scene)
    captures = {path.name.rpartition("_")[2]: (path, read_capture_folder(path)) for path in truths}
    seed = integer(0, "reconstruction", "relit bounces")
    filmed = filmed_with(scene, np.eye(3), surfels.offset)
    relighter = Relighter(surfels, estimation, seed, cameras=filmed)
    pictures = {
        name: _lit_views(relighter.under(EnvironmentMap.load(path / "environment.exr")), capture)
        for name, (path, capture) in captures.items()
    }
    views = {name: display(capture) for name, (_, capture) in captures.items()}
    exposures = {name: capture.exposure for name, (_, capture) in captures.items()}
    factor = fitted_factor(
        [(pictures[name], exposures[name], truth, covered) for name, (truth, covered) in views.items()]
    )
    found = {}
    for name, (truth, covered) in views.items():
        shown = to_display(pictures[name], factor * exposures[name])
        psnrs = [capped_psnr(*each) for each in zip(shown, truth, covered) if each[2].any()]
        middle = len(truth) // 2
        found[name] = RelitLight(float(np.mean(psnrs)), truth[middle], shown[middle])
    return Relit(found, factor)


def relit_frames(light: Illumination, capture: Capture) -> list[Guidance]:
    """Return the surfels' frames from the capture's views."""
    seeds = [integer(0, "reconstruction", "relit", number) for number in range(len(capture.views))]
    return [light.render(view.camera, seed) for view, seed in zip(capture.views, seeds, strict=True)]


def _lit_views(light: Illumination, capture: Capture) -> np.ndarray:
    """Return linear radiance (K, H, W, 3) of the surfels from the capture's views."""
    return np.stack([frame.lit for frame in relit_frames(light, capture)])


def display(capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """Return true display values (K, H, W, 3), and the mask of pixels that show only surfaces (K, H, W)."""
    truth = np.stack([to_display(view.read(), capture.exposure) for view in capture.views])
    return truth, np.stack([view.read("mask") > COVERED for view in capture.views])


def relit_pictures(title: str, relit: Mapping[str, Relit]) -> Pictures:
    """Return a row of pictures for each light: the truth, then every way; ``relit``: title -> scores."""
    pictures = []
    for light, under in next(iter(relit.values())).lights.items():
        pictures.append(
            Picture(under.truth, f"{light}: path-traced", f"{title}, {light}, path-traced", strong=True)
        )
        for name, each in relit.items():
            found = each.lights[light]
            pictures.append(Picture(found.shown, name, f"{title}, {light}, {name}", f"{found.psnr:.1f} dB"))
    note = "The middle held-out view; figures are of all held-out views under that light."
    return Pictures(title, pictures, note, columns=len(relit) + 1)
