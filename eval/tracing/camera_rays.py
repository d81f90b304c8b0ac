"""Camera rays: one frame of TRON against Mitsuba's volprim, against one closest hit, and against gsplat.

TRON's time counts everything a new camera costs: tile lists, tracing, sorting, compositing twelve channels
and normalising. The hits' ids, of which only gradients have need, are not kept: :mod:`eval.tracing.gradients`
times that. The peers' hierarchies are built before and not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.peers import embree, volprim
from eval.peers import gsplat as gsplat_peer
from eval.peers.contenders import Contenders, spelled
from eval.peers.timing import Times, interleaved
from eval.results import Row
from tron.cameras import Camera
from tron.tracing.tiles import TILE, build_tiles

TRON, BINNING = "tron", "binning"
VOLPRIM, SHIPPED = "volprim", "volprim_as_shipped"
EMBREE, GSPLAT = "embree_closest_hit", "gsplat"
USUAL = "tron_outside"
"""TRON again, on the usual scene with as many surfels: what a camera inside is held against."""
PEERS = (VOLPRIM, SHIPPED, EMBREE, GSPLAT)


@dataclass(frozen=True)
class CameraRays:
    """Times of one frame of ``size`` x ``size`` pixels over ``count`` surfels, contestant -> times.

    ``place`` is the name of the place if it is not the usual one.
    """

    count: int
    size: int
    times: Mapping[str, Times]
    place: str = ""

    @property
    def case(self) -> str:
        """How metrics spell the case, such as 50k_512 or room_50k_512."""
        return "_".join([*self.place.split(), self._sizes])

    @property
    def _sizes(self) -> str:
        return f"{spelled(self.count)}_{self.size}"

    def mrays(self, name: str) -> float:
        """Million rays a second."""
        return self.size**2 / self.times[name].median / 1e6

    def rows(self, suffix: str = "") -> list[Row]:
        """Ratios to the peers that ran, rays a second of all, and the time of binning within TRON's."""
        ours = self.times[TRON]
        rows = [
            Row(
                metric=f"primary.ratio_to_{name}{suffix}.{self.case}",
                value=self.times[name].over(ours),
                unit="x",
                n=len(self.times[name].seconds),
            )
            for name in PEERS
            if name in self.times
        ]
        for name in (TRON, *PEERS):
            if name in self.times:
                metric = "primary.mrays" if name == TRON else f"primary.{name}_mrays"
                n = len(self.times[name].seconds)
                rows.append(
                    Row(metric=f"{metric}{suffix}.{self.case}", value=self.mrays(name), unit="Mrays/s", n=n)
                )
        if BINNING in self.times:
            binning = self.times[BINNING]
            metric = f"primary.binning_ms{suffix}.{self.case}"
            rows.append(Row(metric=metric, value=1e3 * binning.median, unit="ms", n=len(binning.seconds)))
        if USUAL in self.times:
            metric = f"primary.inside_over_outside{suffix}.{self._sizes}"
            rows.append(Row(metric=metric, value=ours.over(self.times[USUAL]), unit="x", n=len(ours.seconds)))
        return rows


def measure_camera_rays(
    contenders: Contenders,
    size: int,
    integrators: Mapping[str, Any],
    repetitions: int,
    slow_repetitions: int,
    usual: Contenders | None = None,
) -> CameraRays:
    """Time all contestants on one view, in turns.

    Args:
        integrators: name (:data:`VOLPRIM`, :data:`SHIPPED`) -> the peer's integrator; one with another stop.
        usual: the same number of surfels elsewhere, of which TRON renders a frame of as many pixels beside.
    """
    view = contenders.place.camera(size)
    tracer, records, quads = contenders.tracer, contenders.records, contenders.quads
    origin, direction = tile_rays(view)
    contestants: dict[str, Any] = {
        TRON: lambda: tracer.gbuffer(view),
        EMBREE: lambda: embree.closest_hit(quads, origin, direction, coherent=True),
        BINNING: lambda: build_tiles(records, view).entries,
    }
    if integrators:
        sensor, primitives = volprim.sensor(view), contenders.primitives
        for name, integrator in integrators.items():
            contestants[name] = lambda i=integrator: volprim.render(primitives, sensor, i)
    if gsplat_peer.available():
        contestants[GSPLAT] = gsplat_peer.renderer(contenders.scene, view)
    if usual is not None:
        other = usual.place.camera(size)
        contestants[USUAL] = lambda: usual.tracer.gbuffer(other)
    times = interleaved(contestants, repetitions, slow_repetitions)
    return CameraRays(len(contenders.scene), size, times, contenders.place.name)


def tile_rays(view: Camera) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays through the pixel centres, a 4 x 4 tile after the other: the order that is best for a packet."""
    tiles = view.rays().reshape(view.height // TILE, TILE, view.width // TILE, TILE, 3)
    rays = np.ascontiguousarray(tiles.transpose(0, 2, 1, 3, 4).reshape(-1, 3).T, np.float32)
    origin = dr.repeat(mi.Point3f([float(x) for x in view.position]), rays.shape[1])
    direction = mi.Vector3f(rays)
    dr.eval(origin, direction)
    return origin, direction


def faster_shape(contenders: Contenders, size: int, integrator: Any) -> tuple[str, dict[str, Times]]:
    """Which of the peer's two plugins for its primitives renders this place faster, and both times."""
    sensor = volprim.sensor(contenders.place.camera(size))
    scenes = {
        shape: volprim.primitives(contenders.scene, contenders.sh_degree, shape) for shape in volprim.SHAPES
    }
    times = interleaved(
        {shape: lambda s=scene: volprim.render(s, sensor, integrator) for shape, scene in scenes.items()}, 3
    )
    return min(times, key=lambda shape: times[shape].median), times
