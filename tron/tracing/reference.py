"""Slow float64 NumPy versions of the tracer: the oracle of every test, sharing no code with what it judges.

Only constants are shared; intersection, ordering, stopping and compositing are written again here in the most
obvious way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tron.gaussians.harmonics import eval_sh
from tron.tracing.compositing import STOP_TRANSMITTANCE
from tron.tracing.kernel import MAX_ALPHA, MIN_ALPHA, MIN_RESPONSE, T_MIN
from tron.tracing.transmittance import BACK_FACE_SPACINGS, OPAQUE_TRANSMITTANCE

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene


@dataclass(frozen=True)
class ReferenceHits:
    """Composited values of P rays, float64: the sums over hits of ``w = T alpha``, before any normalisation.

    Attributes:
        normal, base_color, rgb: (P, 3).
        roughness, metallic, mean_depth: (P,).
        transmittance: (P,) after the last counted hit.
        median_depth: (P,) distance of the first hit after which T < 0.5, or 0.
        hits: (P,) int, number of composited hits.
        margin: (P,) smallest distance of any compared value to a threshold (alpha cut, stop, median): pixels
            with a tiny margin may differ in float32.
    """

    normal: np.ndarray
    base_color: np.ndarray
    rgb: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    mean_depth: np.ndarray
    transmittance: np.ndarray
    median_depth: np.ndarray
    hits: np.ndarray
    margin: np.ndarray


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """(M, 3, 3) float64 rotations of (M, 4) wxyz quaternions, normalised first."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


class _Surfels:
    """A scene in float64, and one ray against all of it."""

    def __init__(self, scene: GaussianScene) -> None:
        rotations = rotation_matrices(scene.quats.astype(np.float64))
        scales = np.exp(scene.log_scales.astype(np.float64))
        self.means = scene.means.astype(np.float64)
        self.normals = rotations[:, :, 2]
        self.axis_u = rotations[:, :, 0] / scales[:, :1]
        self.axis_v = rotations[:, :, 1] / scales[:, 1:]
        self.opacities = 1.0 / (1.0 + np.exp(-scene.opacity_logits.astype(np.float64)))
        self.degree = scene.kernel_degree

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
        """t, alpha, counted (by the kernel alone), front and margin, each (M,), for one ray."""
        facing = self.normals @ direction
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            t = ((self.means - origin) * self.normals).sum(1) / facing
            offset = origin + t[:, None] * direction - self.means
            q = (offset * self.axis_u).sum(1) ** 2 + (offset * self.axis_v).sum(1) ** 2
            response = np.exp(-q / 2) if self.degree == 2 else np.exp(-4.5 / 81 * q * q)
        response = np.nan_to_num(response)
        alpha = np.minimum(self.opacities * response, MAX_ALPHA)
        counted = (response >= MIN_RESPONSE) & (self.opacities * response >= MIN_ALPHA)
        margin = np.minimum(np.abs(response - MIN_RESPONSE), np.abs(self.opacities * response - MIN_ALPHA))
        return np.nan_to_num(t), alpha, counted & np.isfinite(t), facing < 0, margin


def composite(scene: GaussianScene, origins: np.ndarray, directions: np.ndarray) -> ReferenceHits:
    """Front-to-back compositing of front-facing surfels along each ray, ordered by (t, id).

    Args:
        scene: the surfels.
        origins, directions: (P, 3), world; directions of unit length.
    """
    surfels, rays = _Surfels(scene), len(origins)
    features = np.concatenate(
        [surfels.normals, scene.base_color, scene.roughness[:, None], scene.metallic[:, None]], 1
    ).astype(np.float64)
    out = np.zeros((rays, 12))
    transmittance, median, hits = np.ones(rays), np.zeros(rays), np.zeros(rays, int)
    margins = np.full(rays, np.inf)
    for ray in range(rays):
        origin, direction = origins[ray].astype(np.float64), directions[ray].astype(np.float64)
        t, alpha, counted, front, margin = surfels.intersect(origin, direction)
        near_cut = front & (t > 0)
        margins[ray] = margin[near_cut].min() if near_cut.any() else np.inf
        ids = np.flatnonzero(counted & front & (t > T_MIN))
        ids = ids[np.lexsort((ids, t[ids]))]
        rgb = eval_sh(scene.sh[ids].astype(np.float64), np.tile(direction, (len(ids), 1)))
        remaining = 1.0
        for i, color in zip(ids, rgb, strict=True):
            weight, after = remaining * alpha[i], remaining * (1 - alpha[i])
            out[ray] += weight * np.concatenate([features[i], color, [t[i]]])
            if remaining >= 0.5 > after:
                median[ray] = t[i]
            remaining = after
            hits[ray] += 1
            margins[ray] = min(margins[ray], abs(after - 0.5), abs(after - STOP_TRANSMITTANCE))
            if remaining < STOP_TRANSMITTANCE:
                break
        transmittance[ray] = remaining
    return ReferenceHits(
        normal=out[:, 0:3],
        base_color=out[:, 3:6],
        roughness=out[:, 6],
        metallic=out[:, 7],
        rgb=out[:, 8:11],
        mean_depth=out[:, 11],
        transmittance=transmittance,
        median_depth=median,
        hits=hits,
        margin=margins,
    )


def transmittance(
    scene: GaussianScene, origins: np.ndarray, directions: np.ndarray, *, two_sided: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance of shadow rays and its margin to a threshold, both (P,) float64.

    Front faces count from t = 0, back faces beyond ``BACK_FACE_SPACINGS`` spacings (never, if one-sided).
    """
    surfels = _Surfels(scene)
    result, margins = np.ones(len(origins)), np.full(len(origins), np.inf)
    reach = BACK_FACE_SPACINGS * scene.spacing
    for ray in range(len(origins)):
        origin, direction = origins[ray].astype(np.float64), directions[ray].astype(np.float64)
        t, alpha, counted, front, margin = surfels.intersect(origin, direction)
        blocks = counted & np.where(front, t > 0, two_sided & (t > reach))
        product = np.prod(1 - alpha[blocks])
        result[ray] = product if product >= OPAQUE_TRANSMITTANCE else 0.0
        near = np.where(front, np.abs(t), np.abs(t - reach))
        thresholds = np.minimum(margin, np.where(counted, near, np.inf))
        margins[ray] = min(thresholds.min(initial=np.inf), abs(product - OPAQUE_TRANSMITTANCE))
    return result, margins
