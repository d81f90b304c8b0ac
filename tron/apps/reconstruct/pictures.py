"""Pictures of a reconstruction: held-out views with every channel, and the light."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tron.captures import Capture, View
from tron.color import linear_to_srgb, to_display
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.io.images import write_image
from tron.reconstruction.scores import Seen, picture, wanted_picture
from tron.reconstruction.settings import FitSettings
from tron.relighting import Relighter
from tron.relighting.proxy import Proxy
from tron.report.contact_sheet import labelled_sheet
from tron.shading.environments.environment import EnvironmentMap

SHEET_VIEWS = 6
SHADOW_RAYS = 16


def write_sheet(
    path: Path,
    scene: GaussianScene,
    capture: Capture,
    environment: EnvironmentMap | None,
    settings: FitSettings | None,
    called: str = "photo",
    proxy: Proxy | None = None,
) -> None:
    """Held-out views (training views, if none is) with every channel of the G-buffer and the guidance.

    The guidance needs the ``environment`` and the ``settings`` of shadows.
    ``lit`` beside the photo, or what it is ``called``, shows how far materials and light explain it, what
    bounces included. ``proxy`` is what light sees of a scan that was kept.
    """
    views, seen = chosen_views(capture, SHEET_VIEWS), Relighter(scene, proxy=proxy or "never")
    rows: dict[str, list[np.ndarray]] = {}
    light = None
    if environment is not None and settings is not None:
        filmed, estimation = capture.train_cameras, sheet_estimation(settings)
        light = Relighter(scene, estimation, proxy=proxy or "auto", cameras=filmed).under(environment)
    for number, view in enumerate(views):
        for name, image in view_pictures(seen, view, called).items():
            rows.setdefault(name, []).append(image)
        if light is not None:
            guidance = light.render(view.camera, number)
            for name in ("pbr", "irradiance", "lit"):
                rows.setdefault(name, []).append(to_display(guidance[name], capture.exposure))
    write_image(path, labelled_sheet(rows, [view.name for view in views]))


def chosen_views(capture: Capture, count: int) -> list[View]:
    """At most ``count`` of the held-out views, evenly spread; of the training views, if none is held out."""
    views = capture.test_views or capture.train_views
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, count).astype(int))]


def view_pictures(seen: Seen, view: View, called: str = "photo") -> dict[str, np.ndarray]:
    """A view's photo and what the surfels show of it: channel -> (H, W) or (H, W, 3) display values.

    ``called``: channel of the photo.
    """
    buffers = seen.gbuffer(view.camera).numpy()
    rendered, wanted = picture(buffers), wanted_picture(view)
    return {
        called: wanted,
        "radiance": rendered,
        "error x 4": 4 * np.abs(rendered - wanted),
        "opacity": buffers["opacity"],
        "depth": _relative(buffers["depth"]),
        "position": _relative(buffers["position"], buffers["opacity"] > 0.5),
        "normal": 0.5 * buffers["normal"] + 0.5,
        "base color": linear_to_srgb(np.clip(buffers["base_color"], 0, 1)),
        "roughness": buffers["roughness"],
        "metallic": buffers["metallic"],
    }


def sheet_estimation(settings: FitSettings) -> Estimation:
    """Few rays, filtered where shadows are a ratio: the paper's plain sums are shown as they are."""
    return settings.estimation(SHADOW_RAYS, filtered=settings.estimator == "ratio")


def _relative(values: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
    """Values spread over [0, 1], each channel for itself, strays left out; black where nothing is known."""
    known = values > 0 if known is None else known
    if not known.any():
        return np.zeros_like(values)
    low, high = np.percentile(values[known], [2, 98], axis=0)
    spread = np.clip((values - low) / np.maximum(high - low, 1e-9), 0, 1)
    return np.where(known if values.ndim == 2 else known[..., None], spread, 0)


def write_light(path: Path, environment: EnvironmentMap) -> None:
    """The environment map, exposed as tron-relight would."""
    write_image(path, to_display(environment.image, environment.exposure()))
