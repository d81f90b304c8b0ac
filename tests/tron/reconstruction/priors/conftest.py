"""A white room's worth of views: spheres on a floor, seen from a ring, with maps that are known exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import linear_to_srgb

WIDTH, HEIGHT = 48, 40
Geometry = dict[str, dict[str, np.ndarray]]


def _ring(count: int = 4, width: int = WIDTH, height: int = HEIGHT, elevation: float = 0.35) -> list[Camera]:
    """Cameras around the origin that look at it, z up."""
    turns = 2 * np.pi * np.arange(count) / count + 0.3
    eyes = [(4 * np.cos(t), 4 * np.sin(t), 4 * elevation) for t in turns]
    return [Camera.look_at(eye, (0, 0, 0.3), fov_deg=45, width=width, height=height) for eye in eyes]


def _plain(count: int = 3, **maps) -> Capture:
    """Grey views named frame_0 and on, the last one held out."""
    views = [
        View(f"frame_{i}", camera, np.full((HEIGHT, WIDTH, 3), 0.5), "display", **maps)
        for i, camera in enumerate(_ring(count))
    ]
    return Capture(tuple(views), test=frozenset({views[-1].name}))


def _trace(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance (H, W), normal and position (H, W, 3) of a unit sphere at (0, 0, 1) on a disc 5 across."""
    rays, origin = camera.rays().astype(np.float64), camera.position
    centre = np.array([0.0, 0.0, 1.0])
    b = rays @ (origin - centre)
    inside = b * b - (origin - centre) @ (origin - centre) + 1
    sphere = np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
    floor = np.where(rays[..., 2] < 0, -origin[2] / np.minimum(rays[..., 2], -1e-9), np.inf)
    hit = origin + np.where(np.isfinite(floor), floor, 0)[..., None] * rays
    floor = np.where(np.linalg.norm(hit[..., :2], axis=-1) < 2.5, floor, np.inf)
    depth = np.minimum(sphere, floor)
    seen = np.isfinite(depth)
    depth = np.where(seen, depth, 0)
    position = origin + depth[..., None] * rays
    normal = np.where((sphere <= floor)[..., None], position - centre, (0.0, 0.0, 1.0)) * seen[..., None]
    return depth, normal, position


@pytest.fixture(scope="session")
def ring() -> Callable[..., list[Camera]]:
    """Makes cameras on a ring; see above."""
    return _ring


@pytest.fixture(scope="session")
def plain() -> Callable[..., Capture]:
    """Makes captures of grey photos, 40 x 48 pixels; see above."""
    return _plain


@pytest.fixture(scope="session")
def lambertian() -> Callable[..., tuple[Capture, Geometry, Mapping[str, Mapping[str, np.ndarray]]]]:
    """Diffuse sRGB photos of a two-coloured sphere on a floor under grey light, and the truth."""

    def make(light: Callable[[np.ndarray], np.ndarray]) -> tuple[Capture, Geometry, Mapping]:
        views, geometry, truth = [], {}, {}
        for i, camera in enumerate(_ring(6, 64, 64)):
            depth, normal, position = _trace(camera)
            stripes = np.sin(6 * position[..., 0]) > 0
            sphere = np.where(stripes[..., None], (0.6, 0.25, 0.15), (0.2, 0.35, 0.6))
            base = np.where((position[..., 2] < 1e-6)[..., None], (0.3, 0.5, 0.25), sphere)
            base = base * (depth > 0)[..., None]
            irradiance = light(normal)
            views.append(View(f"{i}", camera, linear_to_srgb(base * irradiance[..., None]), "display"))
            opacity = (depth > 0).astype(np.float32)
            geometry[f"{i}"] = {"depth": depth, "normal": normal.astype(np.float32), "opacity": opacity}
            truth[f"{i}"] = {"base_color": base, "irradiance": irradiance, "surface": depth > 0}
        return Capture(tuple(views)), geometry, truth

    return make
