"""The sky: its visibility at surface points, and its radiance in photos.

Visibility is shadow rays in given directions, and transport to cubemap texels.

    T_pj = V(p, w_j) (n_p . w_j)+ solid_j / pi

so that sum_j T_pj L_j is the irradiance / pi of a light of radiance L_j. One ray a texel, jittered within it
anew for each point, so that a texel's shadow has no edge; traced once, for no light in particular.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from tron.captures import View
from tron.captures.view import ToneCurve, linear_light
from tron.reconstruction.light.surface_points import SKY
from tron.reconstruction.light.surfel_colors import grouped_median
from tron.reconstruction.progress import Track, untracked
from tron.runtime import aligned, lanes
from tron.seeds import generator
from tron.shading.direct.irradiance import ORIGIN_OFFSET, Occluder
from tron.shading.environments.cubemap import direction_face, texel_directions
from tron.shading.guidance import ViewTracer
from tron.tracing.hierarchy.transmittance import Fans

_FAN = 4
_RAYS = 1 << 20  # at once
_EMPTY = 0.05  # opacity below which a pixel shows what lies behind the scene
_PER_VIEW = 20_000
_BELIEVED = 20.0  # pixels that a texel needs to be half believed


def visibility_towards(
    tracer: Occluder, position: np.ndarray, normal: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """(P, K) float32 transmittance from points along directions; 0 below their horizons.

    Args:
        tracer: what is in the way.
        position, normal: (P, 3) world, normals unit.
        directions: (K, 3) unit, of all points, or (P, K, 3) of each.
    """
    count, rays = len(position), directions.shape[-2]
    found = np.zeros((count, rays), np.float32)
    start = (position + normal * (ORIGIN_OFFSET * tracer.scene.spacing)).astype(np.float32)
    step = max(1, _RAYS // max(rays, 1))
    for first in range(0, count, step):
        some = slice(first, first + step)
        along = directions[some] if directions.ndim == 3 else directions
        along = np.broadcast_to(along, (len(start[some]), rays, 3))
        above = np.einsum("pkc,pc->pk", along, normal[some]) > 0
        point, fan = np.nonzero(_in_fans(above).any(-1))
        if not len(point):
            continue
        active, towards = _in_fans(above)[point, fan], _vectors_in_fans(along)[point, fan]
        going = [mi.Bool(aligned(active[:, k])) for k in range(_FAN)]
        vectors = [lanes(mi.Vector3f, towards[:, k]) for k in range(_FAN)]
        origin, leaves = lanes(mi.Point3f, start[some][point]), lanes(mi.Vector3f, normal[some][point])
        seen = tracer.transmittances(Fans(origin, vectors, going, leaves))
        block = np.zeros((len(start[some]), -(-rays // _FAN), _FAN), np.float32)
        block[point, fan] = np.stack([np.array(part) for part in seen], -1) * active
        found[some] = block.reshape(len(block), -1)[:, :rays]
    return found


def sky_transport(
    tracer: Occluder, position: np.ndarray, normal: np.ndarray, resolution: int, seed: int
) -> np.ndarray:
    """(P, 6 resolution^2) float32 transport T to the texels of a cubemap, in its order.

    Arguments as of :func:`visibility_towards`; ``seed`` is the root of the rays' places within the texels.
    """
    centres, solid = cube_texels(resolution)
    draw = generator(seed, "joint light", "transport")
    found = np.zeros((len(position), len(centres)), np.float32)
    step = max(1, _RAYS // len(centres))
    for first in range(0, len(position), step):
        some = slice(first, first + step)
        jitter = draw.uniform(-0.9, 0.9, (len(position[some]), *centres.shape)) / resolution
        along = centres + jitter
        along = (along / np.linalg.norm(along, axis=-1, keepdims=True)).astype(np.float32)
        cosine = np.maximum(np.einsum("pkc,pc->pk", along, normal[some]), 0)
        seen = visibility_towards(tracer, position[some], normal[some], along)
        found[some] = seen * cosine * (solid / np.pi)
    return found


def cube_texels(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (D, 3) of a cubemap's texels and their solid angles (D,), which sum to 4 pi."""
    centres = np.array(texel_directions(resolution)).T.astype(np.float64)
    # On the face's plane at distance 1 the cosine is 1 / length: d(solid) = du dv / length^3.
    solid = np.abs(centres).max(1) ** 3
    return centres, solid * (4 * np.pi / solid.sum())


def _in_fans(values: np.ndarray) -> np.ndarray:
    """(P, K) -> (P, ceil(K / fan), fan), filled up with zeros."""
    rest = -values.shape[1] % _FAN
    return np.pad(values, ((0, 0), (0, rest))).reshape(len(values), -1, _FAN)


def _vectors_in_fans(vectors: np.ndarray) -> np.ndarray:
    rest = -vectors.shape[1] % _FAN
    return np.pad(vectors, ((0, 0), (0, rest), (0, 0)), mode="edge").reshape(len(vectors), -1, _FAN, 3)


@dataclass(frozen=True)
class PhotographedSky:
    """Radiance of D texels of a cubemap, as photos show it.

    Attributes:
        radiance: (D, 3) linear, in the unit of the photos; 0 where none shows it.
        trust: (D,) in [0, 1].
    """

    radiance: np.ndarray
    trust: np.ndarray


def photographed_sky(
    tracer: ViewTracer,
    views: Sequence[View],
    gains: np.ndarray,
    exposure: float,
    curve: ToneCurve,
    resolution: int,
    seed: int,
    track: Track = untracked,
) -> PhotographedSky:
    """Gather the sky of photos: where nothing stands in the way, a pixel shows the environment's radiance.

    Pixels of the views' sky masks, and those without surfels of views without masks (behind a masked subject
    nobody knows what there is), are brought to one exposure and gathered on a cubemap's texels, each the
    median of its pixels.

    Args:
        tracer: the surfels.
        views: the photos. gains: (V, 3) exposure of each.
        exposure: of linear images. curve: of display images.
        resolution: texels along a face edge.
        seed: root of the choice among a view's pixels.
        track: wraps the loop over the views.
    """
    texels, colors = [np.zeros(0, int)], [np.zeros((0, 3))]
    for view, gain in zip(track(views, "sky"), gains, strict=True):
        if view.has("sky_mask"):
            open_sky = view.read("sky_mask") >= SKY
        elif view.has("mask"):
            continue
        else:
            open_sky = tracer.gbuffer(view.camera).numpy()["opacity"] < _EMPTY
        empty = np.flatnonzero(open_sky & view.believed())
        draw = generator(seed, "photographed sky", view.name)
        empty = draw.permutation(empty)[:_PER_VIEW]
        texels.append(_texel(view.camera.rays().reshape(-1, 3)[empty], resolution))
        colors.append(linear_light(view, exposure, curve).reshape(-1, 3)[empty] / gain)
    texel, color = np.concatenate(texels), np.concatenate(colors)
    order = np.argsort(texel, kind="stable")
    count = np.bincount(texel, minlength=6 * resolution**2)
    radiance = grouped_median(color[order], texel[order], 6 * resolution**2)
    return PhotographedSky(radiance, count / (count + _BELIEVED))


def _texel(directions: np.ndarray, resolution: int) -> np.ndarray:
    """(N,) numbers of the texels that unit world directions (N, 3) lie in."""
    if not len(directions):
        return np.zeros(0, int)
    found = direction_face(lanes(mi.Vector3f, directions))
    face, u, v = (np.array(value) for value in found)
    column, row = (np.clip(((value + 1) / 2 * resolution).astype(int), 0, resolution - 1) for value in (u, v))
    return (face.astype(int) * resolution + row) * resolution + column
