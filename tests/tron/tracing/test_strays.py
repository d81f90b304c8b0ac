"""Surfels that strayed far from all others: rays that meet them are exact, other rays do not notice them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer, reference
from tron.tracing.hierarchy.bvh import CHILDREN, LEAF_SIZE
from tron.tracing.hierarchy.traversal import walk

pytestmark = pytest.mark.usefixtures("variant")

STRAYS = 4


def strayed(scene: GaussianScene, distance: float, growth: float = 1.0) -> GaussianScene:
    """The scene with its first ``STRAYS`` surfels at ``distance``, ``growth`` times as large."""
    away = seeds.generator(0, "tests", "strays").normal(size=(STRAYS, 3))
    means, log_scales = scene.means.copy(), scene.log_scales.copy()
    means[:STRAYS] = distance * away / np.linalg.norm(away, axis=1, keepdims=True)
    log_scales[:STRAYS] += np.log(growth)
    return dataclasses.replace(scene, means=means, log_scales=log_scales)


def rays_at_strays(scene: GaussianScene, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from about the origin to points of the strays' disks, float32."""
    rng = seeds.generator(0, "tests", "rays at strays")
    targets = rng.integers(0, STRAYS, count)
    aside = rng.normal(size=(count, 3)) * scene.scales()[targets].max(1, keepdims=True)
    origins = rng.uniform(-1.5, 1.5, (count, 3)).astype(np.float32)
    along = scene.means[targets] + aside - origins
    return origins, (along / np.linalg.norm(along, axis=1, keepdims=True)).astype(np.float32)


# float32 knows a place at 10,000 units to 0.001: only large surfels can be exact there.
@pytest.mark.parametrize(("distance", "growth"), [(30.0, 1.0), (1e4, 1e3)])
@pytest.mark.parametrize("aimed", [True, False])
def test_shadow_rays_are_exact_beside_strays(
    random_scene, random_rays, shadows, distance: float, growth: float, aimed: bool
):
    scene = strayed(random_scene(400), distance, growth)
    origins, directions = rays_at_strays(scene, 1000) if aimed else random_rays(1000)
    truth, margin = reference.transmittance(scene, origins, directions)
    steady = margin > 1e-5
    assert (~steady).mean() < 0.05
    found = shadows(SurfelTracer(scene), origins, directions)
    np.testing.assert_allclose(found[steady], truth[steady], atol=1e-4)
    if aimed:
        met = reference.transmittance(
            dataclasses.replace(scene, means=scene.means + 1e6), origins, directions
        )
        assert (truth < met[0] - 0.01).mean() > 0.3, "the strays themselves are met"


@pytest.mark.parametrize(("distance", "growth"), [(30.0, 1.0), (1e4, 1e3)])
def test_camera_rays_are_exact_beside_strays(random_scene, distance: float, growth: float):
    scene = strayed(random_scene(400), distance, growth)
    origins, directions = rays_at_strays(scene, 400)
    truth = reference.composite(scene, origins, directions)
    columns = [np.ascontiguousarray(rays.T) for rays in (origins, directions)]
    found = SurfelTracer(scene).trace(mi.Point3f(columns[0]), mi.Vector3f(columns[1]))
    steady = (truth.margin > 1e-5) & (truth.gap > 1e-6)
    assert steady.mean() > 0.9
    np.testing.assert_allclose(np.array(found.opacity)[steady], 1 - truth.transmittance[steady], atol=1e-4)


@dataclass
class _Everything:
    nearest: list[mi.Float]
    farthest: list[mi.Float]


def surfels_visited(tracer: SurfelTracer, origins: np.ndarray, directions: np.ndarray) -> float:
    """Mean number of surfels that a ray's walk visits."""
    total = dr.zeros(mi.UInt32)
    dr.make_opaque(total)

    def visit(state: _Everything, surfel: mi.UInt32, lanes: mi.Bool) -> _Everything:
        dr.scatter_add(total, mi.UInt32(1), surfel & 0, lanes)
        return state

    origin, direction = (np.ascontiguousarray(rays.T) for rays in (origins, directions))
    start = _Everything([mi.Float(0)], [dr.full(mi.Float, dr.inf, len(origins))])
    dr.eval(
        walk(tracer.bvh, mi.Point3f(origin), [mi.Vector3f(direction)], start, visit, mi.Bool(True)).farthest,
        total,
    )
    return total[0] / len(origins)


def test_other_rays_visit_hardly_more_surfels_for_strays(random_scene, random_rays):
    scene = random_scene(4000)
    scene.log_scales -= np.float32(1.5)
    origins, directions = random_rays(1000)
    alone = surfels_visited(SurfelTracer(scene), origins, directions)
    beside = surfels_visited(SurfelTracer(strayed(scene, 1e4)), origins, directions)
    assert alone > 5
    # Every ray may meet the leaves of the one node that strays share with others, and no more.
    assert beside < alone + CHILDREN * LEAF_SIZE
