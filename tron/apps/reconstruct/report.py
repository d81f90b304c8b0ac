"""report.html of a reconstruction: the scene in three lights, what was found, how sure each figure is.

Its sentences stand in report.html.j2. The three lights are formulae, and show the scene from where it was
photographed: a low sun shadows and relief, soft boxes reflections, a cloudy sky materials. The light that was
found is shown as the balls that film crews hold up.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from tron.apps.reconstruct.pictures import chosen_views, view_pictures
from tron.apps.reconstruct.settings import ReportSettings
from tron.cameras import Camera
from tron.captures import Capture
from tron.cli.progress import track
from tron.color import to_display
from tron.estimation import QUALITY
from tron.framing import upright
from tron.gaussians.scene import GaussianScene
from tron.io.video import VideoWriter
from tron.relighting import Relighter
from tron.relighting.proxy import Proxy
from tron.report.page import Cell, Film, Films, Picture, Pictures, Table, Tile, format_value
from tron.report.render import render_template
from tron.scans.camera_files import filmed_orbit, frame_size
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import write_atomic
from tron.trajectories import turn_cameras

TRUTH = ("normal", "base_color", "roughness", "metallic")
SMALLER_IS_BETTER = ("lpips", "roughness_mae", "metallic_mae", "metallic_wrong")
LEVEL = 0.95
LEAST = 5
"""Views from which a range is printed."""
MAP_HEIGHT = 128
"""Rows of the map of a light."""
FPS = 12
BALL = 160
"""Pixels along a side of a ball's picture."""
_GREY = 0.5
_DIFFUSE_HEIGHT = 24
"""Rows of the map that a matt ball's light is summed over."""
FIGURES = {
    "psnr": ("PSNR of the {views}", "dB", "higher is better; {views} that were not learnt from"),
    "psnr_subject": ("on the subject", "dB", "the same where the mask is"),
    "ssim": ("SSIM", "1", "1 is the {view} itself"),
    "lpips": ("LPIPS", "1", "0 is the {view} itself"),
    "normal_mae_deg": ("Normals, mean error", "deg", "against the capture's true normals"),
    "normal_median_deg": ("Normals, median error", "deg", "the same, less moved by edges"),
    "base_color_psnr": (
        "Base color", "dB", "after one factor a view and channel, fitted to the truth that judges"
    ),
    "roughness_mae": ("Roughness, mean error", "1", "against the capture's own"),
    "metallic_mae": ("Metallic, mean error", "1", "against the capture's own"),
    "metallic_wrong": ("Metallic, on the wrong side of a half", "1", "share of the pixels"),
}  # fmt: skip
"""Figure of metrics.json -> its title, its unit, what it says."""


def write_page(
    path: Path,
    settings: ReportSettings,
    report: Mapping[str, Any],
    scene: GaussianScene,
    capture: Capture,
    light: EnvironmentMap | None,
    called: str = "photo",
    proxy: Proxy | None = None,
) -> None:
    """Write the page of a finished reconstruction.

    Args:
        path: of the file.
        settings: how much is shown.
        report: what metrics.json holds.
        scene: the surfels.
        capture: that they were found from.
        light: that the scene was seen in, where it was found.
        called: one picture of the capture: "photo", or "filmed view" of a scan of splats.
        proxy: what light sees of a scan that was kept.
    """
    figures = {
        key: (title.format(views=f"{called}s"), unit, says.format(view=called, views=f"{called}s"))
        for key, (title, unit, says) in FIGURES.items()
    }
    test, seconds = report["test"] or {}, format_value(sum(report["seconds"].values()), "s")
    tiles = [
        Tile(f"{title}, held out", format_value(test[key], unit))
        for key, (title, unit, _) in figures.items()
        if key in test and key in ("psnr", "ssim", "normal_mae_deg", "base_color_psnr")
    ]
    said, sun_height = report["light"] or {}, None
    if said.get("sun"):
        up = np.dot(said["sun"]["direction"], report["capture"]["up"])
        sun_height = np.degrees(np.arcsin(np.clip(up, -1, 1)))
    page = render_template(
        "tron.apps.reconstruct", "report.html.j2", "reconstruction",
        report=report, called=called, seconds=seconds, said=said, sun_height=sun_height,
        tiles=[*tiles, Tile("Surfels", f"{report['surfels']:,}"), Tile("Time", seconds)],
        figures=_figures(report, figures),
        films=_films(scene, capture, settings, proxy) if settings.frames else [],
        views=_views(scene, capture, light, settings, report, called, proxy),
        balls=None if light is None else _balls(light), contrast=None if light is None else light.contrast(),
        truth={field for view in capture.test_views for field in TRUTH if view.has(field)},
        table=Table, films_of=Films, pictures_of=Pictures, shown=format_value, exp=np.exp,
    )  # fmt: skip
    write_atomic(path, page)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Student's interval of the mean of views at LEVEL; None of fewer than LEAST."""
    if len(values) < LEAST:
        return None
    spread = float(np.std(values, ddof=1)) / len(values) ** 0.5
    reach = float(scipy.stats.t.ppf(0.5 + LEVEL / 2, len(values) - 1)) * spread
    return float(np.mean(values)) - reach, float(np.mean(values)) + reach


def _figures(
    report: Mapping[str, Any], figures: Mapping[str, tuple[str, str, str]]
) -> list[list[Cell | str]]:
    """A row for each figure that held-out views have: mean, range, worst, best, count, what it says."""
    held_out = [report["views"][name] for name in report["capture"]["held_out"] if name in report["views"]]
    rows: list[list[Cell | str]] = []
    for key, (title, unit, says) in figures.items():
        values = sorted(view[key] for view in held_out if key in view)
        if not values:
            continue
        around = mean_interval(values)
        between = "—" if around is None else " to ".join(format_value(end, unit) for end in around)
        ends = [format_value(value, unit) for value in (values[0], values[-1])]
        if unit == "deg" or key in SMALLER_IS_BETTER:
            ends.reverse()
        mean = Cell(format_value(float(np.mean(values)), unit), "strong")
        rows.append([title, mean, between, *ends, str(len(values)), says])
    return rows


def _films(
    scene: GaussianScene, capture: Capture, settings: ReportSettings, proxy: Proxy | None
) -> list[Film]:
    size = settings.side, settings.side
    return [
        Film(video, size, name, f"a walk around the scene under a {name}")
        for name, video in showcase_films(scene, capture, settings.frames, settings.side, proxy).items()
    ]


def _views(
    scene: GaussianScene,
    capture: Capture,
    light: EnvironmentMap | None,
    settings: ReportSettings,
    report: Mapping[str, Any],
    called: str,
    proxy: Proxy | None,
) -> list[Pictures]:
    """Some views with every channel, and what materials and light together make of them."""
    seen, blocks = Relighter(scene, proxy=proxy or "never"), []
    lit, filmed = None, capture.train_cameras
    if light is not None:
        relighter = Relighter(scene, QUALITY["preview"], proxy=proxy or "auto", cameras=filmed)
        lit = relighter.under(light)
    for number, view in enumerate(chosen_views(capture, settings.views)):
        figures = report["views"].get(view.name, {})
        channels = view_pictures(seen, view, called)
        if lit is not None:
            shown = lit.render(view.camera, number).lit
            channels["lit by the light found"] = to_display(shown, capture.exposure)
        pictures = [
            Picture(
                np.broadcast_to(np.atleast_3d(image), (*image.shape[:2], 3)),
                name,
                f"{name} of view {view.name}",
                f"{figures['psnr']:.1f} dB" if name == "radiance" and "psnr" in figures else "",
                strong=name == called,
            )
            for name, image in channels.items()
            if name not in ("opacity", "position")
        ]
        kind = "Held-out" if view.name in capture.test else "Training"
        blocks.append(Pictures(f"{kind} view {view.name}", pictures, columns=5))
    return blocks


def _balls(light: EnvironmentMap) -> list[Picture]:
    mirror, matt = ball_pictures(light)
    height = min(MAP_HEIGHT, light.image.shape[0])
    shown = to_display(light.baked().resized(height).image, light.exposure())
    return [
        Picture(mirror, "a mirror ball in it", "the light in a mirror ball"),
        Picture(matt, "a matt ball in it", "the light on a matt grey ball"),
        Picture(shown, "all around: up is up, left and right meet", "the light as a lat-long map"),
    ]


def showcase_films(
    scene: GaussianScene, capture: Capture, frames: int, side: int, proxy: Proxy | None = None
) -> dict[str, bytes]:
    """Name of each showcase light -> an MP4 of the scene in it, ``side`` pixels the longer side."""
    turn = upright(scene.up)
    cameras = turn_cameras(film_cameras(scene, capture, frames, side), turn)
    turned = None if proxy is None else Proxy(proxy.surfels.rotated(turn), proxy.voxel)
    photographed, seed = turn_cameras(capture.train_cameras, turn), integer(0, "report", "bounces")
    relighter = Relighter(
        scene.rotated(turn), QUALITY["preview"], seed, proxy=turned or "auto", cameras=photographed
    )
    films = {}
    for name, light in showcase_lights().items():
        lit, exposure, pictures = relighter.under(light), None, []
        for number, camera in enumerate(track(cameras, f"report: {name}")):
            guidance = lit.render(camera, integer(0, "report", number))
            exposure = guidance.exposure() if exposure is None else exposure
            pictures.append(to_display(guidance.lit, exposure, look="photograph"))
        films[name] = _film(pictures)
    return films


def film_cameras(scene: GaussianScene, capture: Capture, frames: int, side: int) -> list[Camera]:
    """Cameras between those of the photos, in their world, frames in their shape, ``side`` the longer one."""
    photographed = [view.camera for view in capture.views]
    first = photographed[0]
    width, height = frame_size((first.width, first.height), side)
    view = {"width": width, "height": height, "fov_deg": first.fov_deg}
    return filmed_orbit(photographed, frames, up=scene.up, **view)


def _film(frames: Sequence[np.ndarray]) -> bytes:
    height, width = frames[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with VideoWriter(path, FPS, (width, height)) as film:
            for frame in frames:
                film.write(frame)
        return path.read_bytes()


def showcase_lights() -> dict[str, EnvironmentMap]:
    """Name -> light, linear radiance, z up."""
    empty = EnvironmentMap.constant(0.0, MAP_HEIGHT)
    d = empty.directions()
    return {
        name: EnvironmentMap(radiance.astype(np.float32))
        for name, radiance in (("low sun", _sun(d)), ("soft boxes", _boxes(d)), ("cloudy sky", _clouds(d)))
    }


def _sun(d: np.ndarray) -> np.ndarray:
    """A sun of 5 degrees, 28 degrees high, with three quarters of the light; blue sky; brown ground."""
    height = d[..., 2:]
    sky = np.array([0.25, 0.42, 0.75]) * (1.1 - 0.6 * np.maximum(height, 0))
    ground = np.array([0.16, 0.13, 0.10])
    return np.where(height > 0, sky, ground) + _disk(d, -50, 28, 2.5, 0.4) * np.array([400.0, 330.0, 235.0])


def _boxes(d: np.ndarray) -> np.ndarray:
    """A warm key light, a cool one from behind and a faint one from the side, in a dark room."""
    key = _disk(d, -60, 48, 20, 3) * np.array([11.0, 9.6, 8.0])
    rim = _disk(d, 120, 30, 13, 3) * np.array([6.0, 8.0, 11.0])
    fill = _disk(d, 200, 15, 24, 6) * np.array([1.2, 1.2, 1.2])
    return 0.05 + key + rim + fill


def _clouds(d: np.ndarray) -> np.ndarray:
    """The CIE overcast sky: a third as bright at the horizon as overhead; a grey ground."""
    height = d[..., 2:]
    return np.where(height > 0, (1 + 2 * height) / 3 * np.array([0.95, 1.0, 1.08]), 0.15)


def _disk(d: np.ndarray, azimuth: float, elevation: float, radius: float, softness: float) -> np.ndarray:
    """(..., 1): 1 within ``radius`` of a direction, 0 beyond, smoothly over ``softness``; all in degrees."""
    a, e = np.radians([azimuth, elevation])
    centre = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    angle = np.degrees(np.arccos(np.clip(d @ centre, -1, 1)))
    t = np.clip((radius - angle) / (2 * softness) + 0.5, 0, 1)[..., None]
    return t * t * (3 - 2 * t)


def ball_pictures(light: EnvironmentMap, exposure: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A mirror ball and a matt grey one in a light, each (BALL, BALL, 3) display values, seen level along +y.

    ``exposure``: the light's own unless given. Around the balls is the light behind them.
    """
    exposure = exposure or light.exposure()
    x, z = (np.stack(np.meshgrid(np.arange(BALL), np.arange(BALL)), -1) + 0.5).transpose(
        2, 0, 1
    ) / BALL * 2 - 1
    x, z = 1.08 * x, -1.08 * z
    inside = x * x + z * z < 1
    normal = np.stack([x, -np.sqrt(np.where(inside, 1 - x * x - z * z, 0)), z], axis=-1)
    view = np.array([0.0, 1.0, 0.0])
    mirrored = view - 2 * (normal @ view)[..., None] * normal
    behind = np.stack([0.5 * x, np.ones_like(x), 0.5 * z], axis=-1)
    behind /= np.linalg.norm(behind, axis=-1, keepdims=True)
    backdrop = light.lookup(behind.reshape(-1, 3)).reshape(BALL, BALL, 3)
    shining = light.lookup(mirrored.reshape(-1, 3)).reshape(BALL, BALL, 3)

    small = light.baked().resized(_DIFFUSE_HEIGHT)
    weights = np.repeat(small.solid_angles(), small.image.shape[1]) / np.pi
    cosines = np.maximum(normal.reshape(-1, 3) @ small.directions().reshape(-1, 3).T, 0) * weights
    matt = _GREY * (cosines @ small.image.reshape(-1, 3)).reshape(BALL, BALL, 3)
    where = inside[..., None]
    mirror, grey = (to_display(np.where(where, ball, backdrop), exposure) for ball in (shining, matt))
    return mirror, grey
