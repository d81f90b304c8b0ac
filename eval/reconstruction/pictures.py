"""Pictures of a reconstruction beside the truth: one held-out view, and the light."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from eval.reconstruction.light import read_light
from eval.reconstruction.runs import Run
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.color import linear_to_srgb, to_display
from tron.gaussians.scene import GaussianScene
from tron.metrics import scale_albedo
from tron.reconstruction.scores import picture, wanted_picture
from tron.report.page import Picture, Pictures
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

LIGHT_HEIGHT = 64


def compare_scene(runs: Mapping[str, Run], titles: Mapping[str, str]) -> Pictures:
    """Show the middle held-out view of a scene: the truth, and a row for each way of reconstruction.

    Args:
        runs: way -> its run. titles: way -> its title.
    """
    run = next(iter(runs.values()))
    views = read_capture_folder(run.capture).test_views
    view = views[len(views) // 2]
    everywhere = np.ones((view.camera.height, view.camera.width), bool)
    mask = view.read("mask") > 0.5 if view.has("mask") else everywhere
    truth = {"radiance": wanted_picture(view)}
    if view.has("normal"):
        truth["normal"] = normal_picture(view.read("normal"), mask)
    if view.has("base_color"):
        truth["base color"] = _color_picture(view.read("base_color"), mask)
    light, exposure = read_light(run.capture), 1.0
    if light is not None:
        exposure = light.exposure()
        truth["light"] = light_picture(light, exposure)
    pictures = [
        Picture(
            image, f"true {channel}" if channel != "radiance" else "photo", f"{channel}, {run.name}, truth"
        )
        for channel, image in truth.items()
    ]
    for way, each in runs.items():
        shown, figures = show_view(each.folder, view, mask), _figures(each, view.name)
        if (found := read_light(each.folder)) is not None:
            shown["light"] = light_picture(found, exposure)
        for channel in truth:
            image = shown.get(channel, np.zeros_like(truth[channel]))
            alt = f"{channel} of scene {run.name}, {titles.get(way, way)}"
            pictures.append(Picture(image, f"{way}: {channel}", alt, figures.get(channel, "")))
    words = "; ".join(f"{way}: {titles.get(way, way)}" for way in runs)
    light_words = f" · {run.family}" if run.family else ""
    return Pictures(f"Scene {run.name}{light_words}", pictures, f"View {view.name}. {words}.", len(truth))


def show_view(folder: Path, view: View, mask: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Render surfels of a reconstruction from a view: channel -> (H, W, 3) display values.

    If there is a ``mask`` (H, W), base color is scaled to the view's base color in it, as for its figure.
    """
    buffers = SurfelTracer(GaussianScene.load(folder / "scene.ply")).gbuffer(view.camera).numpy()
    solid = buffers["opacity"] > 0.5
    color = buffers["base_color"]
    if mask is not None and view.has("base_color"):
        color = scale_albedo(color, view.read("base_color"), mask)
    return {
        "radiance": picture(buffers),
        "normal": normal_picture(buffers["normal"], solid),
        "base color": _color_picture(color, solid),
    }


def light_picture(light: EnvironmentMap, exposure: float | None = None) -> np.ndarray:
    """Return a light as a small lat-long picture, (H, 2 H, 3) display values; default: its own exposure."""
    return to_display(light.baked().resized(LIGHT_HEIGHT).image, exposure or light.exposure())


def normal_picture(normal: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return world normals (H, W, 3) as colours, black outside ``where`` (H, W)."""
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
