"""Relight thick scans: the file as it is, with and without a proxy, and with materials carried to it.

Shadows are judged where the true visibility is known: specks are pixels that should get over 90 % of their
light and show less than half; leaks are pixels that should get less than a quarter and show more than half.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from eval.light_scale import fitted_factor
from eval.reconstruction.light import irradiance, light_errors, read_light
from eval.reconstruction.relighting import display, relit_frames
from eval.results import Row
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.color import luminance, to_display
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.metrics import capped_psnr, scale_albedo
from tron.relighting import Relighter
from tron.relighting.proxy import Choice, seen_by
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance
from tron.tracing import SurfelTracer

LIT, HALF, DARK = 0.9, 0.5, 0.25
"""Shares of the light that count as all of it, as half, and as shadow."""
PROXY: dict[str, Choice] = {"raw_today": "never", "raw": "auto", "carried": "auto"}
"""Ways to relight a scan, and what light sees then."""
ESTIMATION = Estimation(rays=16, filtered=True)
"""Of all ways: enough rays for surfels, as :class:`Estimation` says; final quality took 23 minutes."""
GAINS = {
    "raw_gain": ("relight_psnr", "raw", "raw_today"),
    "raw_irradiance_gain": ("irradiance_psnr", "raw", "raw_today"),
    "leaks_more": ("leaks", "raw", "raw_today"),
    "gain": ("relight_psnr", "carried", "raw"),
    "base_color_gain": ("base_color_psnr", "carried", "raw"),
}
"""Row -> a figure of one way less that of another."""


def collect_thick(way: str, folder: Path, capture: Path, truths: Sequence[Path]) -> dict[str, float]:
    """Return figures of a scan by name: from :func:`relit_figures`, of base color and of the fitted light.

    Args:
        way: of PROXY.
        folder: has scene.ply, and environment.exr if a light was fitted.
        capture: capture of the photographs, with true maps of its held-out views.
        truths: the held-out views under other lights (``tron-datagen``'s relit/NAME_1_sun).
    """
    scene, photographed = GaussianScene.load(folder / "scene.ply"), read_capture_folder(capture)
    views, cameras = photographed.test_views, [view.camera for view in photographed.train_views]
    seed = integer(0, "reconstruction", "relit bounces")
    relighter = Relighter(scene, ESTIMATION, seed, proxy=PROXY[way], cameras=cameras)
    figures = relit_figures(relighter, views, truths)
    figures["base_color_psnr"] = _base_color_psnr(scene, views)
    found, true = read_light(folder), read_light(capture)
    if found is not None and true is not None:
        figures["light_error"] = light_errors(found, true)["scaled_error"]
    return figures


def relit_figures(relighter: Relighter, views: Sequence[View], truths: Sequence[Path]) -> dict[str, float]:
    """Return means over lights of ``relight_psnr`` and ``irradiance_psnr`` (dB), and shares of pixels.

    The shares are ``specks``, ``leaks`` (see the module) and ``half``: pixels below half of their light.

    Args:
        relighter: the scan.
        views: views with true normals.
        truths: path-traced views of the same cameras, each folder under one light.
    """
    pictures, found = [], []
    for path in truths:
        capture, light = read_capture_folder(path), EnvironmentMap.load(path / "environment.exr")
        frames = relit_frames(relighter.under(light), capture)
        pictures.append((np.stack([frame["lit"] for frame in frames]), capture.exposure, *display(capture)))
        for frame, view, known in zip(frames, capture.views, views, strict=True):
            found.append(dict(_of_shadows(frame, view, known.read("normal"), light, capture.exposure)))
    factor = fitted_factor(pictures)
    psnrs = [
        capped_psnr(to_display(shown, factor * exposure), truth, covered)
        for radiance, exposure, truths_, covers in pictures
        for shown, truth, covered in zip(radiance, truths_, covers)
        if covered.any()
    ]
    names = dict.fromkeys(name for each in found for name in each)
    means = {name: float(np.mean([each[name] for each in found if name in each])) for name in names}
    return {"relight_psnr": float(np.mean(psnrs)), **means}


def thick_rows(ways: Mapping[str, Mapping[str, float]]) -> Iterator[Row]:
    """Yield rows ``splats.thick.*``: the carried scan, the file (``raw_*``, ``raw_today_*``), and the gain.

    ``ways`` are keys of PROXY -> figures by :func:`collect_thick`.
    """
    for way, figures in ways.items():
        for name, value in figures.items():
            shown = name if way == "carried" else f"{way}_{name.removeprefix('relight_')}"
            unit = "dB" if name.endswith("psnr") else "fraction"
            yield Row(metric=f"splats.thick.{shown}", value=value, unit=unit, n=1)
    for gain, (name, way, over) in GAINS.items():
        if all(name in ways.get(each, {}) for each in (way, over)):
            unit = "dB" if name.endswith("psnr") else "fraction"
            value = ways[way][name] - ways[over][name]
            yield Row(metric=f"splats.thick.{gain}", value=value, unit=unit, n=1)


def _of_shadows(
    frame: Guidance, view: View, normal: np.ndarray, light: EnvironmentMap, exposure: float
) -> Iterator[tuple[str, float]]:
    """Yield the shadow figures of a frame with known true normals (H, W, 3)."""
    where = (view.read("mask") == 1) & normal.any(axis=-1)
    arrived, shown, of = view.read("irradiance"), frame["irradiance"], frame["unshadowed"]
    (open_,) = irradiance([light], normal[where])
    where[where] = luminance(open_) > 1e-6
    if not where.any():
        return
    yield "irradiance_psnr", capped_psnr(to_display(shown, exposure), to_display(arrived, exposure), where)
    open_ = open_[luminance(open_) > 1e-6]
    true, ours = luminance(arrived[where]), luminance(shown[where])
    share = ours / np.maximum(luminance(of[where]), 1e-9)
    lit, dark = true > LIT * luminance(open_), true < DARK * luminance(open_)
    yield "half", float((ours < HALF * true).mean())
    if lit.any():
        yield "specks", float((share[lit] < HALF).mean())
    if dark.any():
        yield "leaks", float((share[dark] > HALF).mean())


def _base_color_psnr(scene: GaussianScene, views: Sequence[View]) -> float:
    """Return the mean base color PSNR over the views, dB, after one factor per view and channel."""
    tracer, psnrs = SurfelTracer(scene), []
    for view in views:
        truth, subject = view.read("base_color"), view.read("mask") == 1
        if subject.any():
            scaled = scale_albedo(seen_by(tracer, view.camera).numpy()["base_color"], truth, subject)
            psnrs.append(capped_psnr(np.clip(scaled, 0, 1), truth, subject))
    return float(np.mean(psnrs))
