"""Shadow rays: transmittance through TRON's hierarchy against restarts, one any hit, and one closest hit.

Two sets of rays. Random ones leave the visible surface under cosine-distributed directions of their own: the
worst case of every packet tracer. The others are those of the irradiance pass, in its order, by running the
pass itself with something else in the way of the light; what is not tracing is timed with nothing in the way
and taken off both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.peers import embree
from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from eval.peers.timing import Rounds, interleaved
from eval.tracing.lights import soft
from eval.tracing.measured import ShadowRays
from tron import seeds
from tron.gaussians.scene import GaussianScene
from tron.shading.environment import EnvironmentLight
from tron.shading.irradiance import ORIGIN_OFFSET, irradiance
from tron.tracing import GBuffer, SurfelTracer
from tron.tracing.bvh import build_bvh, refit

MOVED = 0.1
"""Share of the surfels that move between two frames, for the refit."""
STRAYS, STRAY_DISTANCE = 20, 10_000.0
"""Surfels that a reconstruction left far outside, and how far, world units."""


@dataclass
class Occluder:
    """Tracer as the irradiance pass sees it; ``transmittance`` traces one ray a lane."""

    scene: GaussianScene
    transmittance: Callable[[mi.Point3f, mi.Vector3f, mi.Bool], mi.Float]

    def transmittances(
        self, origin: mi.Point3f, directions: Sequence[mi.Vector3f], active: Sequence[mi.Bool]
    ) -> list[mi.Float]:
        """One transmittance for each direction."""
        return [self.transmittance(origin, d, a) for d, a in zip(directions, active, strict=True)]


def occluders(contenders: Contenders) -> dict[str, Occluder]:
    """Occluders of the pass: nothing, or quads, opaque or not.

    Nothing still looks at the ray, so that no one optimises it away.
    """
    quads = contenders.quads

    def idle(origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return dr.select(active & (origin.x + direction.x > 1e30), mi.Float(0), 1)

    def closest_hit(origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        distance = embree.closest_hit(quads, origin, direction, active)
        return dr.select(active & dr.isfinite(distance), mi.Float(0), 1)

    def any_hit(origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return dr.select(active & embree.any_hit(quads, origin, direction, active), mi.Float(0), 1)

    queries = {"idle": idle, "embree_closest_hit": closest_hit, "embree_any_hit": any_hit}
    return {name: Occluder(contenders.scene, query) for name, query in queries.items()}


def count_rays(scene: GaussianScene, gbuffer: GBuffer, light: EnvironmentLight, spp: int, seed: int) -> int:
    """Number of the rays that the irradiance pass asks for."""
    total = dr.zeros(mi.UInt32, 1)

    def counted(_origin: mi.Point3f, _direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        dr.scatter_add(total, mi.UInt32(1), mi.UInt32(0), active)
        return mi.Float(1)

    irradiance(Occluder(scene, counted), gbuffer, light, spp, seed)
    return int(total[0])


def measure_shadow_rays(
    contenders: Contenders, size: int, rays: int, spp: int, seed: int, rounds: Rounds
) -> ShadowRays:
    """Time both sets of rays, the builds, and a refit after a tenth of the surfels moved."""
    scene, tracer, quads = contenders.scene, contenders.tracer, contenders.quads
    gbuffer, light = tracer.gbuffer(camera(size)), EnvironmentLight(soft())
    ray = random_rays(gbuffer, scene.spacing, rays, seed)
    restarted = embree.RestartedShadows(scene, quads)
    rebuilt, old = SurfelTracer(moved_surfels(scene, seed)), tracer.bvh
    refitted = copy(rebuilt)
    refitted.bvh = refit(old.order, old.levels, rebuilt.records)
    strayed = SurfelTracer(stray_surfels(scene, seed))
    in_the_way = {"tron": tracer, **occluders(contenders)}
    times = interleaved(
        {
            "random tron": lambda: tracer.transmittance(*ray),
            "random embree_restart": lambda: restarted.transmittance(*ray),
            "random embree_closest_hit": lambda: embree.closest_hit(quads, *ray),
            "random embree_any_hit": lambda: embree.any_hit(quads, *ray),
            **{
                f"irradiance {name}": lambda o=occluder: irradiance(o, gbuffer, light, spp, seed)
                for name, occluder in in_the_way.items()
            },
            "build": lambda: build_bvh(tracer.records).nodes,
            "refit": lambda: refit(old.order, old.levels, rebuilt.records).nodes,
            "embree_build": lambda: embree.quads(scene),
            "rebuilt": lambda: rebuilt.transmittance(*ray),
            "refitted": lambda: refitted.transmittance(*ray),
            "strays": lambda: strayed.transmittance(*ray),
        },
        rounds,
    )
    return ShadowRays(len(scene), size, times, rays, count_rays(scene, gbuffer, light, spp, seed))


def random_rays(gbuffer: GBuffer, spacing: float, rays: int, seed: int) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays from ``rays`` random visible points into cosine-distributed directions, in the pixels' order.

    Only points of at least half opacity are drawn from; origins stand off the surface as the irradiance
    pass's do.
    """
    rng = seeds.generator(seed, "tracing", "shadow rays", rays)
    buffers = gbuffer.numpy()
    visible = np.flatnonzero(buffers["opacity"].ravel() >= 0.5)
    chosen = np.sort(visible[rng.integers(0, len(visible), rays)])
    normals = buffers["normal"].reshape(-1, 3)[chosen].astype(np.float64)
    points = buffers["position"].reshape(-1, 3)[chosen] + ORIGIN_OFFSET * spacing * normals
    sphere = rng.normal(size=normals.shape)
    # A unit normal plus a uniform point of the unit sphere is cosine-distributed about the normal.
    directions = normals + 0.999999 * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    direction = mi.Vector3f(np.ascontiguousarray(directions.T, np.float32))
    dr.eval(origin, direction)
    return origin, direction


def moved_surfels(scene: GaussianScene, seed: int) -> GaussianScene:
    """The scene after one object, a tenth of all surfels, moved by half its neighbours' reach: a small step.

    The tenth is the surfels nearest to the first sphere's top, moved together by five spacings.
    """
    top = np.array([0.0, 0.0, 1.6])
    nearest = np.argsort(np.linalg.norm(scene.means - top, axis=1))[: max(1, round(MOVED * len(scene)))]
    step = seeds.generator(seed, "tracing", "step").normal(size=3)
    means = scene.means.copy()
    means[nearest] += 5 * scene.spacing * step / np.linalg.norm(step)
    return replace(scene, means=means)


def stray_surfels(scene: GaussianScene, seed: int) -> GaussianScene:
    """The scene with ``STRAYS`` of its surfels ``STRAY_DISTANCE`` away, each in a direction of its own."""
    rng = seeds.generator(seed, "tracing", "strays")
    chosen = rng.choice(len(scene), min(STRAYS, len(scene)), replace=False)
    away = rng.normal(size=(len(chosen), 3))
    means = scene.means.copy()
    means[chosen] += STRAY_DISTANCE * away / np.linalg.norm(away, axis=1, keepdims=True)
    return replace(scene, means=means)
