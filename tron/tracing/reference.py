"""Slow float64 NumPy reference of the tracer: the oracle of every test, sharing no code with the tracer.

Only constants are shared; intersection, ordering, stopping and compositing are written again here in the most
obvious way.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from tron.gaussians.harmonics import eval_sh
from tron.tracing.compositing import APART, STOP_TRANSMITTANCE
from tron.tracing.hierarchy.transmittance import (
    AGAINST,
    BACK_FACE_SPACINGS,
    OPAQUE_TRANSMITTANCE,
    SHEET_SPACINGS,
)
from tron.tracing.kernel import MAX_ALPHA, MIN_ALPHA, MIN_RESPONSE, T_MIN
from tron.tracing.surface import EVEN, FACES


class Scene(Protocol):
    """The attributes read from a ``GaussianScene``; tests by finite differences pass float64 arrays."""

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    kernel_degree: int
    spacing: float


@dataclass(frozen=True)
class ReferenceHits:
    """Composited values of P rays, float64: the sums over hits of ``w = T alpha``, before any normalisation.

    Attributes:
        normal, base_color, rgb: (P, 3).
        face: (P, 3), the part of ``normal`` from the face that is met, if the ray sees two; else all of it.
        roughness, metallic, mean_depth: (P,).
        transmittance: (P,) after the last counted hit.
        median_depth: (P,) distance of the first hit after which T < 0.5, or 0.
        lift: (P,) distance from the first hit after which T < 0.9 to the median hit, or 0.
        hits: (P,) int, number of composited hits.
        margin: (P,) smallest difference between a value and the threshold it is compared with before the ray
            stops (T_MIN, alpha cut, stop, median, lift, faces); if it is tiny, float32 may decide otherwise.
        gap: (P,) smallest distance along the ray between two consecutive composited hits; if it is tiny,
            rounding may swap them.
        candidates: (P,) int, surfels whose kernel counts where the ray hits them, on either side.
        front: (P,) int, candidates that the ray hits from the front.
    """

    normal: np.ndarray
    face: np.ndarray
    base_color: np.ndarray
    rgb: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    mean_depth: np.ndarray
    transmittance: np.ndarray
    median_depth: np.ndarray
    lift: np.ndarray
    hits: np.ndarray
    margin: np.ndarray
    gap: np.ndarray
    candidates: np.ndarray
    front: np.ndarray


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """(M, 3, 3) float64 rotations of (M, 4) wxyz quaternions, normalised first."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


@dataclass(frozen=True)
class _Meetings:
    """P rays against all M surfels, each array (P, M) unless said.

    Attributes:
        t: distance to the surfel's plane. alpha: opacity there, clipped.
        radius: (M,) longer radius of the disk within which the kernel counts.
        counted: the kernel counts there, on either side. front: the ray meets the front.
        normal: (M, 3). aside: distance of the ray's origin from the surfel's plane.
        margin: distance of response and opacity from their cuts.
    """

    t: np.ndarray
    alpha: np.ndarray
    radius: np.ndarray
    counted: np.ndarray
    front: np.ndarray
    normal: np.ndarray
    aside: np.ndarray
    margin: np.ndarray


def _meet(scene: Scene, origins: np.ndarray, directions: np.ndarray) -> _Meetings:
    rotations = rotation_matrices(np.asarray(scene.quats, np.float64))
    scales = np.exp(np.asarray(scene.log_scales, np.float64))
    means = np.asarray(scene.means, np.float64)
    opacities = 1.0 / (1.0 + np.exp(-np.asarray(scene.opacity_logits, np.float64)))
    facing = np.einsum("pk,mk->pm", directions, rotations[:, :, 2])
    to_centre = means - origins[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = np.einsum("pmk,mk->pm", to_centre, rotations[:, :, 2]) / facing
        offset = t[:, :, None] * directions[:, None] - to_centre
        u = np.einsum("pmk,mk->pm", offset, rotations[:, :, 0]) / scales[:, 0]
        v = np.einsum("pmk,mk->pm", offset, rotations[:, :, 1]) / scales[:, 1]
        q = u**2 + v**2
        response = np.exp(-q / 2) if scene.kernel_degree == 2 else np.exp(-4.5 / 81 * q * q)
    response = np.nan_to_num(response)
    raw = opacities * response
    return _Meetings(
        t=np.nan_to_num(t),
        alpha=np.minimum(raw, MAX_ALPHA),
        radius=scales.max(1) * _cut(opacities, scene.kernel_degree),
        counted=(response >= MIN_RESPONSE) & (raw >= MIN_ALPHA) & np.isfinite(t),
        front=facing < 0,
        normal=rotations[:, :, 2],
        aside=np.abs(np.nan_to_num(t) * facing),
        # A surfel is cut by the threshold that it falls below first; the other has no effect.
        margin=np.abs(np.minimum(response - MIN_RESPONSE, raw - MIN_ALPHA)),
    )


def _cut(opacities: np.ndarray, degree: int) -> np.ndarray:
    """Distance in standard deviations up to which a surfel counts, 0 where it never does."""
    faintest = np.minimum(np.maximum(MIN_RESPONSE, MIN_ALPHA / np.maximum(opacities, 1e-12)), 1)
    exponent = -np.log(faintest)
    return np.sqrt(2 * exponent) if degree == 2 else (81 / 4.5 * exponent) ** 0.25


def composite(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, sh_directions: np.ndarray | None = None
) -> ReferenceHits:
    """Front-to-back compositing of front-facing surfels along each ray, ordered by (t, id).

    Args:
        scene: the surfels.
        origins, directions: (P, 3), world; directions of unit length.
        sh_directions: (P, 3), to evaluate radiance in these directions instead of the rays'.
    """
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    views = directions if sh_directions is None else np.asarray(sh_directions, np.float64)
    # A block of rays holds arrays of rays x surfels x 3.
    block = max(1, 1_000_000 // max(1, len(scene.means)))
    parts = [
        _composite_block(scene, origins[i : i + block], directions[i : i + block], views[i : i + block])
        for i in range(0, len(origins), block)
    ]
    return ReferenceHits(
        **{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(ReferenceHits)}
    )


def _composite_block(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, views: np.ndarray
) -> ReferenceHits:
    hit, rays = _meet(scene, origins, directions), len(origins)
    normals = rotation_matrices(np.asarray(scene.quats, np.float64))[:, :, 2]
    materials = np.concatenate(
        [normals, scene.base_color, scene.roughness[:, None], scene.metallic[:, None]], 1
    ).astype(np.float64)
    visible = hit.counted & hit.front & (hit.t > T_MIN)
    along = np.where(visible, hit.t, np.inf)
    order = np.argsort(along, axis=1, kind="stable")  # stable: coincident surfels stay in the order of ids
    most = int(visible.sum(1).max(initial=0))
    out = np.zeros((rays, 12))
    remaining, median, begin, hits = np.ones(rays), np.zeros(rays), np.zeros(rays), np.zeros(rays, int)
    last, margin, gap = np.zeros(rays), np.full(rays, np.inf), np.full(rays, np.inf)
    lists: list[list[tuple[int, float]]] = [[] for _ in range(rays)]
    for slot in range(most):
        ray = np.flatnonzero((visible.sum(1) > slot) & (remaining >= STOP_TRANSMITTANCE))
        surfel = order[ray, slot]
        t, alpha = hit.t[ray, surfel], hit.alpha[ray, surfel]
        rgb = eval_sh(np.asarray(scene.sh, np.float64)[surfel], views[ray])
        before, after = remaining[ray], remaining[ray] * (1 - alpha)
        values = np.concatenate([materials[surfel], rgb, t[:, None]], 1)
        out[ray] += (before * alpha)[:, None] * values
        for r, number, weight in zip(ray, surfel, before * alpha, strict=True):
            lists[r].append((int(number), float(weight)))
        median[ray] = np.where((before >= 0.5) & (after < 0.5), t, median[ray])
        begin[ray] = np.where((before >= 0.9) & (after < 0.9), t, begin[ray])
        if slot > 0:
            gap[ray] = np.minimum(gap[ray], t - last[ray])
        for threshold in (0.9, 0.5, STOP_TRANSMITTANCE):
            margin[ray] = np.minimum(margin[ray], np.abs(after - threshold))
        remaining[ray], last[ray] = after, t
        hits[ray] += 1
    met = [_face(scene, normals, hit.radius, *each) for each in zip(lists, origins, directions, strict=True)]
    margin = np.minimum(margin, [close for _, close in met])
    # Hits behind the one that stopped a ray are not compared with anything.
    reached = np.where(remaining < STOP_TRANSMITTANCE, last, np.inf)
    compared = hit.front & (hit.t > 0) & (hit.t <= reached[:, None] + 1e-5)
    cuts = np.where(compared, hit.margin, np.inf).min(1, initial=np.inf)
    starts = np.where(hit.counted & hit.front, np.abs(hit.t - T_MIN), np.inf).min(1, initial=np.inf)
    return ReferenceHits(
        normal=out[:, 0:3],
        face=np.array([face for face, _ in met]).reshape(rays, 3),
        base_color=out[:, 3:6],
        roughness=out[:, 6],
        metallic=out[:, 7],
        rgb=out[:, 8:11],
        mean_depth=out[:, 11],
        transmittance=remaining,
        median_depth=median,
        lift=np.where(median > 0, median - begin, 0),
        hits=hits,
        margin=np.minimum(np.minimum(margin, cuts), starts),
        gap=gap,
        candidates=(hit.counted & (hit.t > T_MIN)).sum(1),
        front=visible.sum(1),
    )


def _face(
    scene: Scene, normals: np.ndarray, radii: np.ndarray, hits: list[tuple[int, float]], origin: np.ndarray,
    direction: np.ndarray,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Sum of ``w n`` over the face that a ray meets, and the margin by which that face was chosen."""
    groups: tuple[list[int], list[int]] = ([], [])
    total, weights, margin = np.zeros((2, 3)), np.zeros(2), np.inf
    for surfel, weight in hits:
        own = 0
        if groups[0]:
            cosine = normals[surfel] @ total[0] / weights[0]
            margin, own = min(margin, abs(cosine - APART)), int(cosine < APART)
        groups[own].append(surfel)
        total[own] += weight * normals[surfel]
        weights[own] += weight
    if not groups[1]:
        return total[0], margin
    lengths = np.linalg.norm(total, axis=1)
    unit = total / lengths[:, None]
    cosine, even = unit[0] @ unit[1], lengths / weights
    margin = min(margin, abs(cosine - FACES), *np.abs(even - EVEN))
    if cosine >= FACES or even.min() <= EVEN:
        return total.sum(0), margin
    a, b = (np.asarray(scene.means[group[0]], np.float64) for group in groups)
    point = origin + direction * (unit[0] @ (a - origin)) / (unit[0] @ direction)
    height, reach = unit[1] @ (point - b), max(radii[group[0]] for group in groups)
    behind = np.array([unit[0] @ (b - a), unit[1] @ (a - b)])
    margin = min(margin, *np.abs(behind), abs(abs(height) - reach))
    ridge = bool((behind < 0).all()) and abs(height) < reach
    margin = min(margin, abs(height if ridge else weights[0] - weights[1]))
    return total[int(height >= 0 if ridge else weights[1] > weights[0])], margin


def transmittance(
    scene: Scene,
    origins: np.ndarray,
    directions: np.ndarray,
    *,
    two_sided: bool = True,
    normals: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance of shadow rays and its margin to a threshold, both (P,) float64.

    Front faces count from t = 0, back faces beyond ``BACK_FACE_SPACINGS`` spacings of the scene, scaled up
    for surfels of more than the median radius (never, if one-sided). If two-sided, a front face is ignored
    when it faces against ``normals`` (P, 3) of the surface that the ray leaves, is nearer than two spacings,
    and its plane lies within ``SHEET_SPACINGS`` of the origin; these spacings are the surfel's own.
    """
    hit, blocks, nearby = _blocking(scene, origins, directions, two_sided, normals)
    product = np.where(blocks, 1 - hit.alpha, 1.0).prod(1)
    margin = np.minimum(nearby, np.abs(product - OPAQUE_TRANSMITTANCE))
    return np.where(product >= OPAQUE_TRANSMITTANCE, product, 0.0), margin


def first_hit_probabilities(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, *, two_sided: bool = True
) -> np.ndarray:
    """(P, M) float64 weights T_i alpha_i of each surfel along each ray, sided as in :func:`transmittance`."""
    hit, blocks, _ = _blocking(scene, origins, directions, two_sided)
    order = np.argsort(np.where(blocks, hit.t, np.inf), axis=1, kind="stable")
    alpha = np.take_along_axis(np.where(blocks, hit.alpha, 0.0), order, 1)
    before = np.cumprod(np.concatenate([np.ones((len(alpha), 1)), 1 - alpha[:, :-1]], 1), 1)
    weights = np.empty_like(alpha)
    np.put_along_axis(weights, order, before * alpha, 1)
    return weights


def _blocking(
    scene: Scene,
    origins: np.ndarray,
    directions: np.ndarray,
    two_sided: bool,
    normals: np.ndarray | None = None,
) -> tuple[_Meetings, np.ndarray, np.ndarray]:
    """Intersections of shadow rays, whether each blocks (P, M), and each ray's margin in that decision."""
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    hit = _meet(scene, origins, directions)
    radii = hit.radius[hit.radius > 0]
    own = BACK_FACE_SPACINGS * scene.spacing * hit.radius / (np.median(radii) if len(radii) else 1.0)
    reach = np.maximum(own, BACK_FACE_SPACINGS * scene.spacing)
    blocks = hit.counted & np.where(hit.front, hit.t > 0, two_sided & (hit.t > reach))
    starts = np.where(hit.front, np.abs(hit.t), np.abs(hit.t - reach))
    if normals is not None and two_sided:
        along, sheet = normals @ hit.normal.T, SHEET_SPACINGS / BACK_FACE_SPACINGS * own
        blocks &= ~(hit.front & (along < -AGAINST) & (hit.aside < sheet) & (hit.t <= own))
        near = np.minimum(np.abs(along + AGAINST), np.minimum(np.abs(hit.aside - sheet), np.abs(hit.t - own)))
        starts = np.minimum(starts, np.where(hit.front, near, np.inf))
    nearby = np.minimum(hit.margin, np.where(hit.counted, starts, np.inf)).min(1, initial=np.inf)
    return hit, blocks, nearby
