"""Pictures of a reconstruction beside the truth: one held-out view, and the light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from eval.reconstruction.light import read_light
from eval.reconstruction.measured import CHANNELS, Compared
from eval.reconstruction.runs import Run
from tron.apps.labelled_sheet import labelled_sheet
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.color import linear_to_srgb, to_display
from tron.gaussians.scene import GaussianScene
from tron.images import write_image
from tron.metrics import scale_albedo
from tron.reconstruction.evaluation import picture, wanted_picture
from tron.shading.environment import EnvironmentMap
from tron.tracing import SurfelTracer

LIGHT_HEIGHT = 64


def compare_scene(runs: Mapping[str, Run]) -> Compared:
    """The middle held-out view of a scene, as every way reconstructed it; ``runs`` maps a way to its run."""
    run = next(iter(runs.values()))
    view = middle_view(read_capture_folder(run.capture).test_views)
    everywhere = np.ones((view.camera.height, view.camera.width), bool)
    mask = view.read("mask") > 0.5 if view.has("mask") else everywhere
    truth = {"radiance": wanted_picture(view)}
    if view.has("normal"):
        truth["normal"] = _normal_picture(view.read("normal"), mask)
    if view.has("base_color"):
        truth["base color"] = _color_picture(view.read("base_color"), mask)
    light, exposure = read_light(run.capture), 1.0
    if light is not None:
        exposure = light.exposure()
        truth["light"] = light_picture(light, exposure)
    ways = {}
    for way, each in runs.items():
        ways[way] = show_view(each.folder, view, mask)
        if (found := read_light(each.folder)) is not None:
            ways[way]["light"] = light_picture(found, exposure)
    figures = {way: _figures(each, view.name) for way, each in runs.items()}
    return Compared(run.name, run.family, view.name, truth, ways, figures)


def middle_view(views: Sequence[View]) -> View:
    """The middle one of some views."""
    return views[len(views) // 2]


def show_view(folder: Path, view: View, mask: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Surfels of a reconstruction from a view: channel -> (H, W, 3) display values.

    Base color is scaled to the view's within ``mask`` (H, W), as its figure is, where there is one.
    """
    buffers = SurfelTracer(GaussianScene.load(folder / "scene.ply")).gbuffer(view.camera).numpy()
    solid = buffers["opacity"] > 0.5
    color = buffers["base_color"]
    if mask is not None and view.has("base_color"):
        color = scale_albedo(color, view.read("base_color"), mask)
    return {
        "radiance": picture(buffers),
        "normal": _normal_picture(buffers["normal"], solid),
        "base color": _color_picture(color, solid),
    }


def light_picture(light: EnvironmentMap, exposure: float | None = None) -> np.ndarray:
    """A light as a small lat-long picture, (H, 2 H, 3) display values, by its own exposure unless given."""
    return to_display(light.baked().resized(LIGHT_HEIGHT).image, exposure or light.exposure())


def write_sheet(folder: Path, compared: Compared) -> None:
    """Write all of it as one labelled picture, ``folder/SCENE.png``."""
    columns, blank = {"truth": compared.truth, **compared.ways}, np.zeros((8, 8))
    rows = {name: [images.get(name, blank) for images in columns.values()] for name in CHANNELS}
    write_image(folder / f"{compared.scene}.png", labelled_sheet(rows, list(columns)))


def _normal_picture(normal: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.where(where[..., None], np.clip(0.5 * normal + 0.5, 0, 1), 0)


def _color_picture(linear: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.where(where[..., None], linear_to_srgb(np.clip(linear, 0, 1)), 0)


def _figures(run: Run, view: str) -> dict[str, str]:
    figures = run.report.views.get(view, {})
    shown = {}
    for channel, name, form in (
        ("radiance", "psnr", "{:.1f} dB"),
        ("normal", "normal_mae_deg", "{:.1f}°"),
        ("base color", "base_color_psnr", "{:.1f} dB"),
    ):
        if name in figures:
            shown[channel] = form.format(figures[name])
    if "irradiance_error" in run.light:
        shown["light"] = f"{100 * run.light['irradiance_error']:.1f}% off"
    return shown
