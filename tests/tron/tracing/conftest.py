"""Random and hand-made surfel scenes for the tracing tests."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer


def _random_scene(count: int, *, degree: int = 2, sh_degree: int = 3, seed: int = 0) -> GaussianScene:
    rng = seeds.generator(seed, "tests", "random surfels", count, degree)
    quats = rng.normal(size=(count, 4))
    sh = np.zeros((count, 16, 3))
    used = (sh_degree + 1) ** 2
    sh[:, :used] = 0.3 * rng.normal(size=(count, used, 3))
    return GaussianScene(
        means=rng.uniform(-1, 1, (count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=np.log(rng.uniform(0.02, 0.3, (count, 2))),
        opacity_logits=2 * rng.normal(size=count),
        sh=sh,
        base_color=rng.random((count, 3)),
        roughness=rng.random(count),
        metallic=rng.random(count),
        object_id=np.zeros(count),
        kernel_degree=degree,
        spacing=0.05,
    ).validate()


def _disks(
    means: np.ndarray, normals_down: np.ndarray, *, opacity: float, sigma: float, degree: int = 2
) -> GaussianScene:
    """Horizontal disks; ``normals_down`` (M,) bool turns a disk over (half a turn about x)."""
    count = len(means)
    quats = np.where(np.asarray(normals_down)[:, None], [[0.0, 1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0, 0.0]])
    return GaussianScene(
        means=np.asarray(means, float),
        quats=quats,
        log_scales=np.full((count, 2), np.log(sigma)),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity))),
        sh=np.zeros((count, 16, 3)),
        base_color=np.linspace(0.1, 0.9, 3 * count).reshape(count, 3),
        roughness=np.linspace(0.2, 0.8, count),
        metallic=np.linspace(0.0, 1.0, count),
        object_id=np.zeros(count),
        kernel_degree=degree,
        spacing=0.1,
    ).validate()


@pytest.fixture
def random_scene() -> Callable[..., GaussianScene]:
    return _random_scene


@pytest.fixture
def disks() -> Callable[..., GaussianScene]:
    return _disks


def _random_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Origins (count, 3) about the unit cube and unit directions (count, 3), float32."""
    rng = seeds.generator(seed, "tests", "rays")
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.uniform(-1.5, 1.5, (count, 3)).astype(np.float32), directions.astype(np.float32)


def _shadows(tracer: SurfelTracer, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(P,) transmittances of rays (P, 3)."""
    columns = [np.ascontiguousarray(np.asarray(rays, np.float32).T) for rays in (origins, directions)]
    return np.array(tracer.transmittance(mi.Point3f(columns[0]), mi.Vector3f(columns[1])))


@pytest.fixture
def random_rays() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return _random_rays


@pytest.fixture
def shadows() -> Callable[..., np.ndarray]:
    return _shadows
