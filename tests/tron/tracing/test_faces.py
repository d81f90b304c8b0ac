"""Normals where faces meet: in closed form those of the solid that a ray enters, no mean of both faces."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.tracing import SurfelTracer
from tron.tracing.parameters import SurfelParameters

pytestmark = pytest.mark.usefixtures("variant")
SPACING = 0.04
FOG = 0.35
"""Deviation of a scan's normals, radians."""


def surfels(points: np.ndarray, normals: np.ndarray, *, opacity: float = 0.95) -> GaussianScene:
    count = len(points)
    return GaussianScene(
        means=points,
        quats=quats_from_normals(normals.astype(np.float32)),
        log_scales=np.full((count, 2), np.log(0.4 * SPACING)),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity))),
        sh=np.zeros((count, 16, 3)),
        base_color=np.full((count, 3), 0.5),
        roughness=np.full(count, 0.2),
        metallic=np.ones(count),
        object_id=np.zeros(count),
        kernel_degree=4,
        spacing=SPACING,
    ).validate()


def corner(sign: float) -> GaussianScene:
    """Three faces of the cube from -1 to 0, up to their edges; of sign -1 they are walls seen from within."""
    rng = seeds.generator(0, "tests", "faces", "corner")
    side = -(np.arange(25) + 0.5) * SPACING
    points, normals = [], []
    for axis in range(3):
        flat = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        flat = flat + rng.uniform(-0.3, 0.3, flat.shape) * SPACING
        points.append(sign * np.insert(flat, axis, 0.0, axis=1))
        normals.append(np.tile(np.eye(3)[axis], (len(flat), 1)))
    return surfels(np.concatenate(points), np.concatenate(normals))


def ball(radius: float, *, layers: int = 1, tilt: float = 0.0, depth: float = 0.0) -> GaussianScene:
    """Surfels a spacing apart; of several layers, tilted and off the surface by chance, as a scan's are."""
    rng = seeds.generator(0, "tests", "faces", "ball")
    count = round(4 * np.pi * radius**2 / SPACING**2)
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    out = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], 1)
    out = np.tile(out, (layers, 1))
    normals = out + rng.normal(0, tilt, out.shape) if tilt else out
    points = out * (radius + depth * SPACING * rng.normal(size=(len(out), 1)))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return surfels(points, normals, opacity=0.6 if layers > 1 else 0.95)


def off(normals: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors."""
    return np.degrees(np.arccos(np.clip((normals * truth).sum(-1), -1, 1)))


def mean_normals(seen: dict[str, np.ndarray]) -> np.ndarray:
    total = seen["normal_sum"]
    return total / np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["ridges", "valleys"])
def test_a_pixel_of_a_crease_has_the_normal_of_the_face_that_its_ray_meets(sign: float):
    eye = np.array([2.0, 1.3, 0.7])
    camera = Camera.look_at(eye, (0, 0, 0), fov_deg=20, width=64, height=64)
    seen = SurfelTracer(corner(sign)).gbuffer(camera).numpy()
    # A ray is in what is convex from the latest of its planes on, in what is hollow from the earliest.
    planes = -eye / camera.rays()
    meets = planes.argmax(-1) if sign > 0 else planes.argmin(-1)
    truth = np.eye(3)[meets]
    along = np.take_along_axis(planes, meets[..., None], -1)
    inside = (np.abs(eye + along * camera.rays()) < 0.9).all(-1)  # no rim of the three
    assert inside.mean() > 0.3
    assert (off(mean_normals(seen), truth)[inside] > 5).mean() > (0.03 if sign > 0 else 0.005)
    assert (off(seen["normal"], truth)[inside] > 5).mean() < 0.002
    if sign > 0:  # light is gathered where the ray enters, not on surfels that reach past the ridge
        away = np.linalg.norm(seen["position"] - eye - along * camera.rays(), axis=-1)
        assert (away[inside] > 0.1 * SPACING).mean() < 0.002


@pytest.mark.parametrize(
    ("shape", "most"),
    [
        ({"radius": 0.5}, 0.0),
        ({"radius": 0.08}, 0.0),  # two pixels
        ({"radius": 0.5, "layers": 4, "tilt": FOG, "depth": 0.8}, 0.02),
    ],
    ids=["ball", "bead", "fog"],
)
def test_what_is_round_or_a_scans_fog_has_the_mean(shape: dict, most: float):
    camera = Camera.look_at(
        (2.0, 0.5, 0.4), (0, 0, 0), fov_deg=0.04 * 64 / 2.1 * 180 / np.pi, width=64, height=64
    )
    seen = SurfelTracer(ball(**shape)).gbuffer(camera).numpy()
    there = seen["opacity"] > 0.5
    assert (off(seen["normal"], mean_normals(seen))[there] > 1).mean() <= most


def test_what_is_differentiated_has_the_mean():
    scene = corner(1.0)
    parameters = SurfelParameters.from_scene(scene)
    dr.enable_grad(parameters.quats)
    camera = Camera.look_at((2.0, 1.3, 0.7), (0, 0, 0), fov_deg=20, width=32, height=32)
    seen = SurfelTracer(scene, parameters=parameters).gbuffer(camera).numpy()
    np.testing.assert_allclose(seen["normal"], mean_normals(seen), atol=1e-5)
