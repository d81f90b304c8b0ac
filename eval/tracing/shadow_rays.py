"""Shadow rays: transmittance through TRON's hierarchy against restarts, one any hit, and one closest hit.

Two sets of rays. Random ones leave the visible surface under cosine-distributed directions of their own: the
worst case of every packet tracer. The others are those of the irradiance pass, in its order, by running the
pass itself with something else in the way of the light; what is not tracing is timed with nothing in the way
and taken off both sides.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.peers import embree
from eval.peers.contenders import Contenders, spelled
from eval.peers.scene import camera
from eval.peers.timing import Times, interleaved
from eval.results import Row
from eval.tracing.lights import soft
from tron import seeds
from tron.gaussians.scene import GaussianScene
from tron.shading.environment import EnvironmentLight
from tron.shading.irradiance import ORIGIN_OFFSET, irradiance
from tron.tracing import GBuffer
from tron.tracing.bvh import build_bvh, refit

MOVED = 0.1
"""Share of the surfels that move between two frames, for the refit."""
STRAYS, STRAY_DISTANCE = 20, 10_000.0
"""Surfels that a reconstruction left far outside, and how far, world units."""


@dataclass(frozen=True)
class ShadowRays:
    """Times over ``count`` surfels; ``rays`` random rays, ``pass_rays`` of the irradiance pass."""

    count: int
    rays: int
    pass_rays: int
    times: Mapping[str, Times]

    def rows(self) -> list[Row]:
        """Ratios with TRON's build counted and the peers' not, rays a second, and the builds apart."""
        case, times = spelled(self.count), self.times
        build = times["build"].median
        random = times["random tron"].median
        idle = times["pass idle"].median
        ours, closest, anything = (times[f"pass {name}"].median - idle for name in ("tron", "closest", "any"))
        figures = {
            "shadow.ratio_to_embree_restart": (times["random restart"].median / (random + build), "x"),
            "shadow.ratio_to_embree_closest_hit": (closest / (ours + build), "x"),
            "shadow.ratio_to_embree_closest_hit_random": (
                times["random closest"].median / (random + build),
                "x",
            ),
            "shadow.ratio_to_embree_any_hit": (anything / (ours + build), "x"),
            "shadow.ratio_to_embree_any_hit_random": (times["random any"].median / (random + build), "x"),
            "shadow.mrays_random": (self.rays / random / 1e6, "Mrays/s"),
            "shadow.mrays_irradiance": (self.pass_rays / ours / 1e6, "Mrays/s"),
            "shadow.embree_restart_mrays_random": (
                self.rays / times["random restart"].median / 1e6,
                "Mrays/s",
            ),
            "shadow.embree_closest_hit_mrays_random": (
                self.rays / times["random closest"].median / 1e6,
                "Mrays/s",
            ),
            "shadow.embree_closest_hit_mrays_irradiance": (self.pass_rays / closest / 1e6, "Mrays/s"),
            "shadow.embree_any_hit_mrays_random": (self.rays / times["random any"].median / 1e6, "Mrays/s"),
            "shadow.embree_any_hit_mrays_irradiance": (self.pass_rays / anything / 1e6, "Mrays/s"),
            "shadow.stray_slowdown": (times["random strays"].over(times["random tron"]), "x"),
            "bvh.build_ms": (1e3 * build, "ms"),
            "bvh.refit_ms": (1e3 * times["refit"].median, "ms"),
            "bvh.embree_build_ms": (1e3 * times["embree build"].median, "ms"),
            "bvh.trace_after_refit": (times["random refitted"].median / times["random rebuilt"].median, "x"),
        }
        n = min(len(t.seconds) for t in times.values())
        return [Row(metric=f"{name}.{case}", value=v, unit=unit, n=n) for name, (v, unit) in figures.items()]


class _Occluder(abc.ABC):
    """What the irradiance pass asks of a tracer; fans of rays are traced one by one."""

    def __init__(self, scene: GaussianScene) -> None:
        self.scene = scene

    @abc.abstractmethod
    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Transmittance of one ray a lane."""

    def transmittances(
        self, origin: mi.Point3f, directions: Sequence[mi.Vector3f], active: Sequence[mi.Bool]
    ) -> list[mi.Float]:
        """One transmittance for each direction."""
        return [self.transmittance(origin, d, a) for d, a in zip(directions, active, strict=True)]


class Unshadowed(_Occluder):
    """Nothing in the way: what the irradiance pass costs without its tracing."""

    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """1 for all that could be traced; the ray is still used, so that no one optimises it away."""
        return dr.select(active & (origin.x + direction.x > 1e30), mi.Float(0), 1)


class ClosestHits(_Occluder):
    """Quads in the way: one closest-hit query a ray, opaque or not."""

    def __init__(self, scene: GaussianScene, traced: mi.Scene) -> None:
        super().__init__(scene)
        self._traced = traced

    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """0 where a quad is met."""
        found = self._traced.ray_intersect_preliminary(
            mi.Ray3f(origin, direction), coherent=mi.Bool(False), active=active
        )
        return dr.select(active & found.is_valid(), mi.Float(0), 1)


class AnyHits(_Occluder):
    """Quads in the way: one any-hit query a ray, opaque or not; what one would ask for a shadow."""

    def __init__(self, scene: GaussianScene, traced: mi.Scene) -> None:
        super().__init__(scene)
        self._traced = traced

    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """0 where a quad is met."""
        met = embree.any_hit(self._traced, origin, direction, active)
        return dr.select(active & met, mi.Float(0), 1)


class Counted(_Occluder):
    """Counts the rays that the pass asks for, as an occluder in their way."""

    def __init__(self, scene: GaussianScene) -> None:
        super().__init__(scene)
        self.total = dr.zeros(mi.UInt32, 1)

    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:  # noqa: ARG002
        """1, and one more for each ray."""
        dr.scatter_add(self.total, mi.UInt32(1), mi.UInt32(0), active)
        return mi.Float(1)


def measure_shadow_rays(
    contenders: Contenders,
    size: int,
    rays: int,
    spp: int,
    seed: int,
    repetitions: int,
    slow_repetitions: int,
) -> ShadowRays:
    """Time both sets of rays, the builds, and a refit after a tenth of the surfels moved."""
    scene, tracer = contenders.scene, contenders.tracer
    gbuffer = tracer.gbuffer(camera(size))
    origin, direction = random_rays(gbuffer, scene.spacing, rays, seed)
    light = EnvironmentLight(soft())
    restarted = embree.RestartedShadows(scene, contenders.quads)
    closest, anything = ClosestHits(scene, contenders.quads), AnyHits(scene, contenders.quads)
    idle, counted = Unshadowed(scene), Counted(scene)
    irradiance(counted, gbuffer, light, spp, seed)
    moved = moved_surfels(contenders, seed)
    old, rebuilt = tracer.bvh, build_bvh(moved.records)
    refitted = refit(old.order, old.levels, moved.records)
    moved.tracer.bvh = rebuilt
    after = Contenders(moved.scene)
    after.tracer.bvh = refitted
    strayed = Contenders(stray_surfels(scene, seed)).tracer

    def shaded(occluder: Any) -> Any:
        return irradiance(occluder, gbuffer, light, spp, seed)

    times = interleaved(
        {
            "random tron": lambda: tracer.transmittance(origin, direction),
            "random strays": lambda: strayed.transmittance(origin, direction),
            "random restart": lambda: restarted.transmittance(origin, direction),
            "random closest": lambda: embree.closest_hit(contenders.quads, origin, direction, coherent=False),
            "random any": lambda: embree.any_hit(contenders.quads, origin, direction),
            "pass tron": lambda: shaded(tracer),
            "pass closest": lambda: shaded(closest),
            "pass any": lambda: shaded(anything),
            "pass idle": lambda: shaded(idle),
            "build": lambda: build_bvh(contenders.records).nodes,
            "refit": lambda: refit(old.order, old.levels, moved.records).nodes,
            "random rebuilt": lambda: moved.tracer.transmittance(origin, direction),
            "random refitted": lambda: after.tracer.transmittance(origin, direction),
            "embree build": lambda: embree.quads(scene),
        },
        repetitions,
        slow_repetitions,
    )
    return ShadowRays(len(scene), rays, int(counted.total[0]), times)


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


def moved_surfels(contenders: Contenders, seed: int) -> Contenders:
    """The scene after one object, a tenth of all surfels, moved by half its neighbours' reach: a small step.

    The tenth is the surfels nearest to the first sphere's top, moved together by five spacings.
    """
    scene = contenders.scene
    top = np.array([0.0, 0.0, 1.6])
    nearest = np.argsort(np.linalg.norm(scene.means - top, axis=1))[: max(1, round(MOVED * len(scene)))]
    means = scene.means.copy()
    step = seeds.generator(seed, "tracing", "step").normal(size=3)
    means[nearest] += 5 * scene.spacing * step / np.linalg.norm(step)
    return Contenders(replace(scene, means=means), contenders.sh_degree, contenders.shape)


def stray_surfels(scene: GaussianScene, seed: int) -> GaussianScene:
    """The scene with ``STRAYS`` of its surfels ``STRAY_DISTANCE`` away, each in a direction of its own."""
    rng = seeds.generator(seed, "tracing", "strays")
    chosen = rng.choice(len(scene), min(STRAYS, len(scene)), replace=False)
    away = rng.normal(size=(len(chosen), 3))
    means = scene.means.copy()
    means[chosen] += STRAY_DISTANCE * away / np.linalg.norm(away, axis=1, keepdims=True)
    return replace(scene, means=means)
