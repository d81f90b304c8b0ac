"""Camera + scene -> GBuffer: one traced, composited and normalised surface point a pixel.

Normalising (facts.md 4b): composited channels are alpha-weighted sums, so materials are divided by
opacity and the normal is brought back to unit length. The surface point is at the median depth; where
transmittance never falls below one half there is no median, and the alpha-weighted mean depth stands in
where opacity is not zero.
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.tracing.compositing import STOP_TRANSMITTANCE, Composite, HitList, composite
from tron.tracing.hits import MAX_HITS, collect, sort
from tron.tracing.kernel import SurfelRecords
from tron.tracing.tiles import LANES, TILE, TileLists


@dataclass
class GBuffer:
    """What a camera sees, per pixel, as Dr.Jit arrays of ``width * height`` lanes in row-major order.

    Attributes:
        position: mi.Point3f, world; meaningless where opacity is 0.
        depth: mi.Float, distance along the unit ray to the median hit, world units; 0 where there is none.
        normal: mi.Normal3f, unit, world, geometric; zero where opacity is 0.
        base_color: mi.Color3f, linear.
        roughness, metallic: mi.Float.
        rgb: mi.Color3f, composited SH radiance in display space, premultiplied by opacity.
        opacity: mi.Float, 1 - T.
        direction: mi.Vector3f, unit ray from the camera into the scene, world.
        overflow: mi.UInt32, hits left out because the ray met more than ``MAX_HITS``.
        hits: the composited ids in tile order (see :class:`HitList`), for the adjoint.
        width, height: pixels.
    """

    position: mi.Point3f
    depth: mi.Float
    normal: mi.Normal3f
    base_color: mi.Color3f
    roughness: mi.Float
    metallic: mi.Float
    rgb: mi.Color3f
    opacity: mi.Float
    direction: mi.Vector3f
    overflow: mi.UInt32
    hits: HitList
    width: int
    height: int

    def numpy(self) -> dict[str, np.ndarray]:
        """Every per-pixel field as (H, W) or (H, W, 3) float32 (overflow: uint32)."""
        skipped = ("hits", "width", "height")
        return {f.name: self._image(getattr(self, f.name)) for f in fields(self) if f.name not in skipped}

    def _image(self, value: mi.Float) -> np.ndarray:
        array = np.array(value)
        shape = (self.height, self.width) if array.ndim == 1 else (self.height, self.width, -1)
        return np.ascontiguousarray(array.T.reshape(shape))


@dataclass
class _TileRays:
    """Rays of all pixels in tile order: lane = tile * 16 + pixel within the tile."""

    origin: mi.Point3f
    direction: mi.Vector3f
    tile: mi.UInt32
    inside: mi.Bool


def _tile_rays(camera: Camera, tiles_x: int, tiles_y: int) -> _TileRays:
    """Pixel-centre rays. The camera's numbers are opaque, or every view would compile its own kernel."""
    lane = dr.arange(mi.UInt32, tiles_x * tiles_y * LANES)
    tile, pixel = lane // LANES, lane % LANES
    across, width, height = (dr.opaque(mi.UInt32, n) for n in (tiles_x, camera.width, camera.height))
    x = (tile % across) * TILE + pixel % TILE
    y = (tile // across) * TILE + pixel // TILE
    fx, fy, cx, cy = (dr.opaque(mi.Float, float(v)) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    rotation = camera.camera_to_world[:3, :3]
    right, down, forward = (mi.Vector3f([float(v) for v in rotation[:, k]]) for k in range(3))
    origin = mi.Point3f([float(v) for v in camera.position])
    dr.make_opaque(right, down, forward, origin)
    direction = dr.normalize(
        ((mi.Float(x) + 0.5 - cx) / fx) * right + ((mi.Float(y) + 0.5 - cy) / fy) * down + forward
    )
    return _TileRays(origin, direction, tile, (x < width) & (y < height))


def _row_major_lanes(width: int, height: int, tiles_x: int) -> mi.UInt32:
    """For each pixel in row-major order, its lane in tile order."""
    pixel = dr.arange(mi.UInt32, width * height)
    across, columns = dr.opaque(mi.UInt32, tiles_x), dr.opaque(mi.UInt32, width)
    x, y = pixel % columns, pixel // columns
    return ((y // TILE) * across + x // TILE) * LANES + (y % TILE) * TILE + x % TILE


def trace_tiles(
    records: SurfelRecords, lists: TileLists, rays: _TileRays
) -> tuple[Composite, HitList, mi.UInt32]:
    """Collect, sort and composite in one kernel: the sums, the hit list and the hits met, in tile order."""
    start = dr.gather(mi.UInt32, lists.start, rays.tile)
    count = dr.select(rays.inside, dr.gather(mi.UInt32, lists.count, rays.tile), 0)
    out = HitList.empty(dr.width(rays.tile))
    hits = collect(records, lists.entries, start, count, rays.origin, rays.direction, STOP_TRANSMITTANCE)
    sort(hits)
    sums = composite(records, hits, rays.direction, out)
    out.count = sums.count
    dr.eval(
        sums.channels, sums.mean_depth, sums.transmittance, sums.median_depth, out.ids, out.count, hits.met
    )
    return sums, out, hits.met


def trace_gbuffer(records: SurfelRecords, lists: TileLists, camera: Camera) -> GBuffer:
    """Render a camera's G-buffer from its tile lists (see :class:`GBuffer`)."""
    rays = _tile_rays(camera, lists.tiles_x, lists.tiles_y)
    sums, hits, met = trace_tiles(records, lists, rays)
    lane = _row_major_lanes(camera.width, camera.height, lists.tiles_x)

    def gather(value: mi.Float) -> mi.Float:
        return dr.gather(type(value), value, lane)

    opacity = 1 - gather(sums.transmittance)
    seen = opacity > 0
    inverse = dr.select(seen, dr.rcp(opacity), 0)
    channels = [gather(channel) for channel in sums.channels]
    normal = mi.Normal3f(*channels[0:3])
    length = dr.norm(normal)
    depth = gather(sums.median_depth)
    distance = dr.select(depth > 0, depth, gather(sums.mean_depth) * inverse)
    direction = gather(rays.direction)
    met = gather(met)
    buffer = GBuffer(
        position=rays.origin + distance * direction,
        depth=depth,
        normal=dr.select(length > 0, normal / length, 0),
        base_color=mi.Color3f(*channels[4:7]) * inverse,
        roughness=channels[3] * inverse,
        metallic=channels[7] * inverse,
        rgb=mi.Color3f(*channels[8:11]),
        opacity=opacity,
        direction=direction,
        overflow=dr.select(met > MAX_HITS, met - MAX_HITS, 0),
        hits=hits,
        width=camera.width,
        height=camera.height,
    )
    dr.eval(*(getattr(buffer, f.name) for f in fields(buffer) if f.name not in ("hits", "width", "height")))
    return buffer
