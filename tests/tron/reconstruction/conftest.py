"""Two spheres of surfels that shade each other, seen from all sides under a known light."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import agx
from tron.estimation import Estimation
from tron.gaussians import GaussianScene
from tron.gaussians.harmonics import SH_COUNT, rgb_to_dc
from tron.gaussians.scene import quats_from_normals
from tron.shading import EnvironmentMap, Lighting, render_guidance
from tron.shading.direct.irradiance import irradiance
from tron.tracing import SurfelTracer

SIZE = 32


def spheres(per_sphere: int = 1200) -> GaussianScene:
    """Radius 0.5 about (-0.6, 0, 0) and 0.4 about (0.5, 0.1, 0.2), on Fibonacci's spirals."""
    i = np.arange(per_sphere) + 0.5
    z, angle = 1 - 2 * i / per_sphere, i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    normals = np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
    centres = np.array([[-0.6, 0, 0], [0.5, 0.1, 0.2]])
    radii = np.array([0.5, 0.4])
    count = 2 * per_sphere
    spacing = np.repeat(np.sqrt(4 * np.pi / per_sphere) * radii, per_sphere)
    return GaussianScene(
        means=(centres[:, None] + radii[:, None, None] * normals).reshape(-1, 3),
        quats=quats_from_normals(np.tile(normals, (2, 1))),
        log_scales=np.repeat(np.log(0.6 * spacing)[:, None], 2, 1),
        opacity_logits=np.full(count, 4.6),
        sh=np.zeros((count, SH_COUNT, 3)),
        base_color=np.tile([0.6, 0.5, 0.4], (count, 1)),
        roughness=np.full(count, 0.4),
        metallic=np.zeros(count),
        object_id=np.repeat([1, 2], per_sphere),
        kernel_degree=2,
        spacing=float(spacing.mean()),
    )


@pytest.fixture(scope="session")
def tracer(variant: str) -> SurfelTracer:
    return SurfelTracer(spheres())


@pytest.fixture(scope="session")
def studio() -> EnvironmentMap:
    """Two soft lights of different colours, a dim room and a dimmer floor."""
    image = np.full((32, 64, 3), 0.15, np.float32)
    image[20:] = 0.05
    image[8:14, 5:16] = (8.0, 7.0, 6.0)
    image[6:11, 36:42] = (3.0, 4.0, 7.0)
    return EnvironmentMap(image)


@pytest.fixture(scope="session")
def captured(tracer: SurfelTracer) -> Callable[..., Capture]:
    """A capture of the spheres: photos under a light; the prior is its irradiance times ``prior_scale``."""

    @cache
    def capture(light: EnvironmentMap, views: int = 8, prior_scale: float = 1.0) -> Capture:
        lighting, exposure = Lighting(light, 64), light.exposure()
        made = []
        for i in range(views):
            turn, height = 2 * np.pi * i / views, (2.5, 0.3, -2.5)[i % 3]
            eye = np.array([3 * np.cos(turn), 3 * np.sin(turn), height])
            camera = Camera.look_at(
                eye / np.linalg.norm(eye) * 4, (0, 0, 0), fov_deg=32, width=SIZE, height=SIZE
            )
            gbuffer = tracer.gbuffer(camera)
            prior = [irradiance(tracer, gbuffer, lighting.light, 64, seed)[0] for seed in range(2)]
            prior = prior_scale * np.mean([gbuffer.image(p) for p in prior], 0)
            shadowed = render_guidance(tracer, camera, lighting, Estimation(rays=64), seed=9).shadowed
            made.append(View(f"{i}", camera, agx(exposure * shadowed), "display", irradiance=prior))
        return Capture(tuple(made), exposure=exposure)

    return capture


def painted_spheres(per_sphere: int = 300) -> GaussianScene:
    """The spheres with colours that change smoothly from place to place, base color among them."""
    scene = spheres(per_sphere)
    paint = 0.5 + 0.35 * np.sin(5 * scene.means + np.array([0.0, 2.0, 4.0]))
    scene.sh[:, 0] = rgb_to_dc(paint)
    scene.base_color = np.ascontiguousarray(paint[:, ::-1], np.float32)
    scene.roughness = (0.3 + 0.4 * (scene.means[:, 2] > 0)).astype(np.float32)
    scene.metallic = (scene.means[:, 0] > 0).astype(np.float32)
    return scene.validate()


def seen_by(tracer: SurfelTracer, camera: Camera, name: str) -> View:
    """What a camera sees of a scene, its true maps included; the opacity is the mask."""
    seen = tracer.gbuffer(camera).numpy()
    solid = (seen["opacity"] > 0.5)[..., None]
    opacity = np.maximum(seen["opacity"], 1e-6)[..., None]
    return View(
        name,
        camera,
        np.clip(seen["rgb"] / opacity, 0, 1) * (opacity > 1e-3),  # straight, as in RGBA files
        "display",
        normal=seen["normal"] * solid,
        base_color=np.clip(seen["base_color"], 0, 1) * solid,
        roughness=np.clip(seen["roughness"], 0, 1),
        metallic=np.clip(seen["metallic"], 0, 1),
        depth=seen["depth"],
        mask=np.clip(seen["opacity"], 0, 1),
    )


@pytest.fixture(scope="session")
def painted(variant: str) -> GaussianScene:
    """Two spheres in many colours; not to be changed."""
    return painted_spheres()


@pytest.fixture(scope="session")
def capture_of(variant: str, around: Callable[..., list[Camera]]) -> Callable[..., Capture]:
    """Makes the capture of a scene with all true maps; every fourth of its views is held out."""

    def make(scene: GaussianScene, views: int = 12) -> Capture:
        tracer = SurfelTracer(scene)
        made = [seen_by(tracer, camera, f"{i:02d}") for i, camera in enumerate(around(views, size=SIZE))]
        return Capture(tuple(made), test=frozenset(view.name for view in made[::4]))

    return make


@pytest.fixture(scope="session")
def painted_capture(painted: GaussianScene, capture_of) -> Capture:
    """Twelve views of the painted spheres, three of them held out."""
    return capture_of(painted)


@pytest.fixture
def one_thread(variant: str) -> None:
    """Sums in a fixed order; the fixture drjit_threads gives the threads back."""
    if variant.startswith("cuda"):
        pytest.skip("a GPU adds in no fixed order: nothing repeats there bit by bit")
    import drjit as dr
    import torch

    dr.set_thread_count(1)
    torch.set_num_threads(1)
