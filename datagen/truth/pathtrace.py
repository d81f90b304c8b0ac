"""Mitsuba scene -> path-traced frames, true G-buffers, and the direct irradiance that guidance is judged by.

Frames are anti-aliased (box filter). G-buffers and irradiance are taken along rays through the pixel centres:
the mean of two surfaces is a point on neither.

Kernels are compiled once and serve every view, light and scene of a recipe: seeds are opaque, and vectors
cross between NumPy and Dr.Jit a coordinate at a time, for interleaved ones name their length in the kernel.
"""

# pyright: reportArgumentType=false, reportCallIssue=false
from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.clock import stage
from datagen.truth.build import Geometry
from datagen.world.scene import BOUNCES
from tron.cameras import Camera, mitsuba_sensor
from tron.color import luminance
from tron.gaussians.initialize import GBufferView
from tron.integrators import embed, register
from tron.models.shapes import materials_at, surface_points
from tron.runtime import lanes
from tron.shading.environments.environment import EnvironmentMap

LANES = 2**22
"""Most paths or rays in flight at once: bounds memory, not quality."""


def path_segments(bounces: int) -> int:
    """Return Mitsuba's ``max_depth`` for a number of bounces: a path has one more segment at each end."""
    return bounces + 2


@stage("path_trace")
def render_frames(
    scene: mi.Scene,
    cameras: Sequence[Camera],
    spp: int,
    seeds: Sequence[int],
    bounces: int = BOUNCES,
    transparent: bool = False,
) -> np.ndarray:
    """Path-trace one frame per camera.

    Args:
        scene: a lit scene; its light is seen directly behind it.
        cameras: all of one size.
        spp: paths a pixel.
        seeds: one a frame, in [0, 2**32); frames depend on nothing else.
        bounces: times that light bounces between surfaces before it reaches the one that is seen.
        transparent: leave out the light that is seen directly, and give coverage as a fourth channel.

    Returns:
        (K, H, W, 3) float32 linear radiance; or (K, H, W, 4), radiance times coverage, and coverage, the
        share of the pixel that surfaces cover.
    """
    depth = path_segments(bounces)
    integrator = mi.load_dict(
        {"type": "path", "max_depth": depth, "rr_depth": depth, "hide_emitters": transparent}
    )
    frames = [
        _render(scene, integrator, camera, spp, seed, transparent) for camera, seed in zip(cameras, seeds)
    ]
    return np.stack(frames)


def stacked_lights(environments: Sequence[EnvironmentMap], bounces: int = BOUNCES) -> mi.Integrator:
    """Lights made ready for :func:`render_lights`; other arguments as of :func:`render_frames`.

    Raises:
        TronError: the maps differ in size, or one is turned.
    """
    register()
    return mi.load_dict(
        {
            "type": "tron_many_lights",
            "lights": embed(list(environments)),
            "max_depth": path_segments(bounces),
        }
    )


@stage("path_trace")
def render_lights(scene: mi.Scene, lights: mi.Integrator, camera: Camera, spp: int, seed: int) -> np.ndarray:
    """Path-trace one frame under each of many lights at once: all of them share its paths.

    Args:
        scene: the scene; its own light, if any, is not seen.
        lights: of :func:`stacked_lights`.
        camera, spp, seed: as of :func:`render_frames`, for one frame.

    Returns:
        (N, H, W, 3) float32 linear radiance, light by light.
    """
    image = _render(scene, lights, camera, spp, seed, transparent=False)
    colors = image[..., 3:].reshape(camera.height, camera.width, -1, 3).transpose(2, 0, 1, 3)
    return np.ascontiguousarray(colors)


def _render(
    scene: mi.Scene, integrator: mi.Integrator, camera: Camera, spp: int, seed: int, transparent: bool
) -> np.ndarray:
    """Render all channels of a frame: (H, W, C) float32."""
    passes = -(-spp // max(LANES // (camera.width * camera.height), 1))
    part = near_product(-(-spp // passes))
    description = mitsuba_sensor(camera, part, pixel_format="rgba" if transparent else "rgb")
    # Samples that cover pixel, light and lobe evenly: at 64 spp 3 to 6 dB less noise than independent
    # ones, free.
    description["sampler"]["type"] = "multijitter"
    sensor = mi.load_dict(description)
    total = np.zeros(())
    for number in range(passes):
        # Passes of one frame need streams of their own; the odd constant keeps them apart from other frames.
        key = _pass_seed(seed, number * part)
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=part, seed=key)
        total = total + np.array(image, np.float64)
    return (total / passes).astype(np.float32)


def near_product(count: int) -> int:
    """Return the least product of two near numbers, such as 7 x 8, that is ``count`` or more.

    Mitsuba's ``multijitter`` rounds a number of samples up to it, with a warning.
    """
    columns = math.isqrt(count)
    return columns * -(-count // columns)


def _pass_seed(seed: int, done: int) -> int:
    return (seed + done * 0x9E3779B1) % 2**32


def gbuffers(geometry: Geometry, cameras: Sequence[Camera]) -> list[GBufferView]:
    """Return all views of :func:`stream_gbuffers` at once."""
    return list(stream_gbuffers(geometry, cameras))


def stream_gbuffers(geometry: Geometry, cameras: Iterable[Camera]) -> Iterator[GBufferView]:
    """True G-buffers, one view a camera, along pixel-centre rays; no more than a group of them at a time.

    Base color is the material's own, of metals too; normals are shading normals (normal maps included) on the
    camera's side. ``rgb`` is None.
    """
    scene = geometry.lit()
    waiting: list[Camera] = []
    for camera in cameras:
        waiting.append(camera)
        if sum(c.width * c.height for c in waiting) >= LANES // 2:
            yield from _views(geometry, scene, waiting)
            waiting = []
    if waiting:
        yield from _views(geometry, scene, waiting)


def _views(geometry: Geometry, scene: mi.Scene, cameras: Sequence[Camera]) -> list[GBufferView]:
    rays = [_pixel_rays(camera) for camera in cameras]
    ray = _upload(*(np.concatenate(part) for part in zip(*rays)))
    si, normal = surface_points(geometry.surfaces, scene, ray)
    valid = si.is_valid()
    base_color, roughness, metallic = materials_at(geometry.surfaces, si)
    object_id = dr.zeros(mi.UInt32, dr.width(valid))
    for surface in geometry.surfaces:
        here = valid & (si.shape == mi.ShapePtr(surface.shape))
        ids = dr.gather(mi.UInt32, mi.UInt32(surface.object_id), si.prim_index, here)
        object_id = dr.select(here, ids, object_id)
    dr.eval(si.p, normal, base_color, roughness, metallic, object_id, valid)
    columns = {
        "position": _download(si.p),
        "normal": _download(normal),
        "base_color": np.clip(_download(base_color), 0.0, 1.0),
        "roughness": np.clip(np.array(roughness), 0.0, 1.0),
        "metallic": np.clip(np.array(metallic), 0.0, 1.0),
        "valid": np.array(valid),
        "object_id": np.array(object_id).astype(np.int32),
    }
    views, start = [], 0
    for camera in cameras:
        part = slice(start, start + camera.width * camera.height)
        start = part.stop
        images = {
            name: np.ascontiguousarray(values[part].reshape(camera.height, camera.width, *values.shape[1:]))
            for name, values in columns.items()
        }
        views.append(GBufferView(camera=camera, rgb=None, **images))
    return views


class DirectIrradiance(NamedTuple):
    """E / pi, linear, (H, W, 3) float32, on surfaces at the pixel centres; 0 off surfaces."""

    shadowed: np.ndarray
    unshadowed: np.ndarray


@stage("reference")
def direct_irradiance(
    geometry: Geometry, scene: mi.Scene, camera: Camera, spp: int, seed: int
) -> DirectIrradiance:
    """Direct irradiance by Mitsuba's own light sampling and its rays against the meshes.

    Shares no code with TRON's tracer: this is what the surfels' irradiance is measured against. Half of the
    rays are drawn from the cosine lobe around the shading normal, half from Mitsuba's emitter, weighted by
    the balance heuristic (Veach 1997), which for one ray of each kind sums L cos / (pdf_cosine + pdf_light).

    Args:
        geometry, scene: the scene and its lit form.
        camera: where from.
        spp: shadow rays a pixel, rounded up to an even number.
        seed: of the sampler, in [0, 2**32).
    """
    pairs = max((spp + 1) // 2, 1)
    origins, directions = _pixel_rays(camera)
    block = max(LANES // (2 * pairs), 1)
    parts = [
        _irradiance_block(geometry, scene, origins[i : i + block], directions[i : i + block], pairs, seed + i)
        for i in range(0, len(origins), block)
    ]
    shadowed, unshadowed = (np.concatenate(part) for part in zip(*parts))
    shape = (camera.height, camera.width, 3)
    return DirectIrradiance(shadowed.reshape(shape), unshadowed.reshape(shape))


def _irradiance_block(
    geometry: Geometry, scene: mi.Scene, origins: np.ndarray, directions: np.ndarray, pairs: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    lanes = len(origins) * pairs
    si, normal = surface_points(geometry.surfaces, scene, _upload(origins, directions))
    dr.eval(si, normal)
    pixel = dr.arange(mi.UInt32, lanes) // pairs
    si, normal = dr.gather(mi.SurfaceInteraction3f, si, pixel), dr.gather(mi.Normal3f, normal, pixel)
    valid = si.is_valid()
    u = [_stratified(lanes, pairs, seed + 2 * kind) for kind in range(2)]
    emitter = scene.environment()

    light, _ = scene.sample_emitter_direction(si, u[0], False, valid)
    frame = mi.Frame3f(normal)
    cosine = frame.to_world(mi.warp.square_to_cosine_hemisphere(u[1]))

    shadowed, unshadowed = mi.Color3f(0.0), mi.Color3f(0.0)
    for direction in (light.d, cosine):
        seen = dr.zeros(mi.SurfaceInteraction3f, lanes)
        seen.wi = -direction
        radiance = emitter.eval(seen, valid)
        sample = dr.zeros(mi.DirectionSample3f, lanes)
        sample.d = direction
        sample.emitter = mi.EmitterPtr(emitter)
        pdf_light = scene.pdf_emitter_direction(si, sample, valid)
        cos = dr.maximum(dr.dot(normal, direction), 0.0)
        pdf_cosine = cos * dr.inv_pi
        counts = valid & (cos > 0.0)
        value = dr.select(counts, radiance * pdf_cosine / (pdf_light + pdf_cosine), 0.0)
        blocked = scene.ray_test(si.spawn_ray(direction), counts)
        unshadowed += value
        shadowed += dr.select(blocked, 0.0, value)
    dr.eval(shadowed, unshadowed)  # all six channels at once: one by one each would trace every ray again
    mean = [_download(dr.block_sum(x, pairs)) / np.float32(pairs) for x in (shadowed, unshadowed)]
    return mean[0], mean[1]


def _stratified(lanes: int, count: int, seed: int) -> mi.Point2f:
    """Jittered points in the unit square, ``count`` in a row on one grid: they cover a pixel evenly."""
    sampler = mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed % 2**32))
    columns = max(d for d in range(1, math.isqrt(count) + 1) if count % d == 0)
    cell = dr.arange(mi.UInt32, lanes) % count
    x = (mi.Float(cell % columns) + sampler.next_float32()) / columns
    y = (mi.Float(cell // columns) + sampler.next_float32()) / (count // columns)
    return mi.Point2f(x, y)


def _pixel_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions, (H W, 3) float32 each, row-major."""
    directions = camera.rays().reshape(-1, 3)
    origins = np.broadcast_to(camera.position.astype(np.float32), directions.shape)
    return np.ascontiguousarray(origins), directions


def _upload(origins: np.ndarray, directions: np.ndarray) -> mi.Ray3f:
    """Rays on the device, from (N, 3) float32 each."""
    return mi.Ray3f(lanes(mi.Point3f, origins), lanes(mi.Vector3f, directions))


def _download(vector: mi.Vector3f | mi.Color3f) -> np.ndarray:
    """(N, 3) float32 of an evaluated vector."""
    return np.stack([np.array(coordinate) for coordinate in vector], axis=-1)


GREY = 0.1
"""Median luminance of a metered frame, which AgX shows a little darker than middle grey."""

THIRDS = 3
"""Steps in a stop: as on a camera, which also keeps rounding errors of a frame out of its clip's exposure."""

MOST_STOPS = 6


def metered(frame: np.ndarray, foreground: np.ndarray, exposure: float) -> float:
    """Return the exposure at which a frame's median is GREY, at least the light's own.

    Rooms are darker than what lights them: exposed for the sky, all of them would be black. Pixels that are
    not finite do not count: their clip is set aside by name, and needs an exposure until then.

    Args:
        frame: (H, W, 3) linear radiance.
        foreground: (H, W) bool, pixels that show a surface; none of them leaves the exposure as it is.
        exposure: of the light (:meth:`tron.shading.environments.environment.EnvironmentMap.exposure`).
    """
    seen = luminance(frame[foreground]) * exposure
    seen = seen[np.isfinite(seen)]
    middle = float(np.median(seen)) if seen.size else GREY
    stops = np.log2(GREY / max(middle, 1e-12))
    return exposure * 2.0 ** (np.floor(np.clip(stops, 0.0, MOST_STOPS) * THIRDS) / THIRDS)
