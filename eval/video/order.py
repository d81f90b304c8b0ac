"""Check that the measures rank clips correctly: an analytic clip, and three spoiled versions of it.

A textured floor, a wall and a ball before it, lit by a lamp, with a highlight on the ball that moves with the
view; depth and colour are exact. The good clip is the truth with a renderer's noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from eval.results import Row
from eval.video.steadiness import Steadiness, Surfaces
from tron.cameras import Camera
from tron.flow import surface_motion
from tron.seeds import generator

FRAMES, SIZE = 12, 64
NOISE = 0.004
"""Standard deviation of the good clip's noise, display values."""
FLASH = 0.04
"""Factor on the flickering clip's every other frame, above and below 1."""
GOOD, FLICKERING, FROZEN, SHUFFLED = "good", "flickering", "frozen", "shuffled"
LOWER = (  # measure, the better clip, the worse one
    ("warping", GOOD, FLICKERING),
    ("warping", GOOD, FROZEN),
    ("warping", FROZEN, SHUFFLED),
    ("warping", FLICKERING, SHUFFLED),
    ("flicker", GOOD, FROZEN),
    ("flicker", GOOD, FLICKERING),
    ("flicker", FROZEN, FLICKERING),
    ("flicker", GOOD, SHUFFLED),
    ("far", GOOD, FROZEN),
    ("far", GOOD, SHUFFLED),
    ("far", FLICKERING, FROZEN),
    ("far", FLICKERING, SHUFFLED),
)
"""What must come out: of each measure the first clip lower than the second."""


def made_clip() -> tuple[list[Camera], np.ndarray, np.ndarray]:
    """Return cameras, depth (K, H, W) along the rays, and display colours (K, H, W, 3)."""
    places = np.linspace(-0.9, 0.9, FRAMES)
    cameras = [
        Camera.look_at((x, -4.0, 1.6), (0.0, 0.0, 0.6), fov_deg=40, width=SIZE, height=SIZE) for x in places
    ]
    drawn = [_drawn(camera) for camera in cameras]
    return cameras, np.stack([depth for depth, _ in drawn]), np.stack([colors for _, colors in drawn])


def spoiled(truth: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Return the clip: good; every other frame brighter; first frame repeated; frames in random order."""
    random = generator(seed, "video", "order")
    good = np.clip(truth + NOISE * random.standard_normal(truth.shape), 0, 1)
    flash = 1 + FLASH * (-1.0) ** np.arange(len(truth))
    order = random.permutation(len(truth))
    while (np.abs(np.diff(order)) == 1).any():  # no two neighbours stay neighbours
        order = random.permutation(len(truth))
    return {
        GOOD: good,
        FLICKERING: np.clip(good * flash[:, None, None, None], 0, 1),
        FROZEN: np.repeat(good[:1], len(good), 0),
        SHUFFLED: good[order],
    }


def order_rows(seed: int) -> Iterator[Row]:
    """Yield rows of three measures of four clips, plain frame differences, and ``video.order_correct``."""
    cameras, depth, truth = made_clip()
    surfaces = Surfaces.of(surface_motion(cameras, depth.__getitem__), depth > 0)
    clips = spoiled(truth, seed)
    measured = {name: Steadiness.of(frames, surfaces) for name, frames in clips.items()}
    for name, found in measured.items():
        for measure in ("warping", "flicker", "far"):
            difference = getattr(found, measure)
            yield Row(
                metric=f"video.made_{measure}.{name}",
                value=float(np.sqrt(difference.mean)),
                unit="fraction",
                n=difference.pixels,
            )
        plain = float(np.sqrt((np.diff(clips[name], axis=0) ** 2).mean()))
        yield Row(metric=f"video.made_plain.{name}", value=plain, unit="fraction", n=len(truth) - 1)
    yield Row(metric="video.order_correct", value=float(ordered(measured)), unit="1", n=len(LOWER))


def ordered(measured: Mapping[str, Steadiness]) -> bool:
    """Whether every line of :data:`LOWER` holds."""
    return all(
        getattr(measured[better], measure).mean < getattr(measured[worse], measure).mean
        for measure, better, worse in LOWER
    )


def _drawn(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return distance (H, W) along the rays and colours (H, W, 3) of one view."""
    origin, rays = camera.position, camera.exact_rays()
    centre, radius, lamp = np.array([0.1, 0.0, 0.6]), 0.6, np.array([-2.0, -3.0, 4.0])
    with np.errstate(divide="ignore"):
        floor = -origin[2] / rays[..., 2]  # z = 0
        wall = (1.5 - origin[1]) / rays[..., 1]  # y = 1.5
    near = rays @ (centre - origin)
    beside = near**2 - (centre - origin) @ (centre - origin) + radius**2
    ball = np.where(beside > 0, near - np.sqrt(np.maximum(beside, 0)), np.inf)
    found = np.stack([np.where(each > 0, each, np.inf) for each in (floor, wall, ball)])
    which, depth = found.argmin(0), found.min(0)
    points = origin + rays * depth[..., None]
    normals = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])[which]
    normals = np.where((which == 2)[..., None], (points - centre) / radius, normals)
    to_lamp = lamp - points
    to_lamp /= np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    cosine = np.clip((normals * to_lamp).sum(-1), 0, 1)
    half = to_lamp - rays
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    gloss = np.where(which == 2, np.clip((normals * half).sum(-1), 0, 1) ** 40, 0.0)
    waves = np.sin(points[..., None, :] * np.array([[7.0], [9.0], [11.0]]) + np.array([0.3, 1.1, 2.0])).sum(
        -1
    )
    base = 0.45 + 0.12 * waves
    return depth, np.clip(base * (0.25 + 0.7 * cosine[..., None]) + 0.3 * gloss[..., None], 0, 1)
