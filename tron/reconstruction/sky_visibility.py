"""Visibility of the sky at surface points: shadow rays in given directions, and transport to cubemap texels.

    T_pj = V(p, w_j) (n_p . w_j)+ solid_j / pi

so that sum_j T_pj L_j is the irradiance / pi of a light of radiance L_j. One ray a texel, jittered within it
anew for each point, so that a texel's shadow has no edge; traced once, for no light in particular.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from tron.aligned import aligned
from tron.seeds import generator
from tron.shading.cubemap import texel_directions
from tron.shading.irradiance import ORIGIN_OFFSET, Occluder

_FAN = 4
_RAYS = 1 << 20  # at once


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
        lanes = [mi.Bool(aligned(active[:, k])) for k in range(_FAN)]
        vectors = [_device(mi.Vector3f, towards[:, k]) for k in range(_FAN)]
        seen = tracer.transmittances(_device(mi.Point3f, start[some][point]), vectors, lanes)
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


def _device(kind: type, vectors: np.ndarray) -> mi.Vector3f:
    return kind(*[mi.Float(aligned(column.astype(np.float32))) for column in vectors.T])
