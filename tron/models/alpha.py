"""Transparency as geometry: triangles are cut along the edge of their alpha, and what is clear is left out.

Surfels and shadow rays know opaque surfaces only. A leaf painted on a card becomes a mesh of the leaf's
outline, so path tracer, G-buffers and surfels agree on what is there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from PIL import Image

from tron.models.parts import Part, Sampling, Wrap

FINEST = 4.0
"""Longest edge in texels of a triangle that is cut no further."""

MOST_PIECES = 200_000
"""Triangles that a part is cut into at most; then those not yet cut stay or go whole."""

LEVELS = 16
"""Steps of the vertices' factor from 0 to 1 that triangles are told apart by: each has a mask of its own."""

LARGEST_MASK = 1024
"""Rows and columns of the mask: a finer alpha is averaged."""

_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""Corners 0 to 2 and midpoints 3 (of 0 and 1), 4 (of 1 and 2), 5 (of 2 and 0) of a triangle's quarters."""


def without_clear(part: Part, alpha: np.ndarray, cutoff: float, vertex_alpha: np.ndarray | None) -> Part:
    """The part without what is below the cut-off.

    Args:
        part: its ``sampling`` of ``base_color`` is that of alpha.
        alpha: (h, w) in [0, 1].
        cutoff: least alpha that stays.
        vertex_alpha: (V,) factor of it, taken as its mean over a triangle, or None.
    """
    factor = np.ones(len(part.faces)) if vertex_alpha is None else vertex_alpha[part.faces].mean(axis=1)
    least, most = float(alpha.min()), float(alpha.max())
    whole, clear = least * factor >= cutoff, most * factor < cutoff
    if part.uv is None or (whole | clear).all():
        return replace(part, faces=part.faces[~clear])
    matrix, wrap = part.sampling.get("base_color", Sampling(np.eye(3), "repeat"))
    at = part.uv.astype(np.float64) @ matrix[:2, :2].T + matrix[:2, 2]
    mixed = part.faces[~whole & ~clear]
    factor = factor[~whole & ~clear]
    levels = np.round(factor * LEVELS)
    pieces = []
    for level in np.unique(levels):
        own = np.flatnonzero(levels == level)
        mask = _Mask(alpha >= cutoff / float(factor[own].mean()), wrap)
        budget = MOST_PIECES * len(own) // len(mixed)
        pieces += [(own[owner], weights) for owner, weights in _cut(mask, at[mixed[own]], budget)]
    return _with_pieces(part, part.faces[whole], mixed, pieces)


class _Mask:
    """Sums over rectangles of what is opaque, of an image twice as wide and high, so that it wraps once."""

    def __init__(self, opaque: np.ndarray, wrap: Wrap):
        height, width = (min(n, LARGEST_MASK) for n in opaque.shape)
        share = Image.fromarray(opaque.astype(np.float32)).resize((width, height), Image.Resampling.BOX)
        image = (np.asarray(share) >= 0.5).astype(np.int32)
        if wrap == "mirror":
            image = np.concatenate([image, image[::-1]])
            image = np.concatenate([image, image[:, ::-1]], axis=1)
        self.size = np.array(image.shape[::-1])
        self.scale = np.array([width, height])
        self.wrap = wrap
        self.image = image
        self.sums = np.pad(
            np.tile(image, (2, 2)).cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32),
            ((1, 0), (1, 0)),
        )

    def counts(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Opaque texels and all texels of the rectangles around triangles (F, 3, 2)."""
        texels = corners * self.scale
        if self.wrap == "clamp":
            texels = np.clip(texels, 0, self.size - 1e-6)
        low = np.floor(texels.min(axis=1)).astype(np.int64)
        high = np.floor(texels.max(axis=1)).astype(np.int64) + 1
        span = np.minimum(high - low, self.size)
        low = low % self.size
        (x0, y0), (x1, y1) = low.T, (low + span).T
        inside = self.sums[y1, x1] - self.sums[y0, x1] - self.sums[y1, x0] + self.sums[y0, x0]
        return inside, span.prod(axis=1)

    def at_points(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) coordinates -> whether it is opaque there."""
        texels = points * self.scale
        if self.wrap == "clamp":
            texels = np.clip(texels, 0, self.size - 1e-6)
        x, y = np.moveaxis(np.floor(texels).astype(np.int64) % self.size, -1, 0)
        return self.image[y, x] > 0


def _cut(mask: _Mask, corners: np.ndarray, most: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Opaque pieces of triangles (F, 3, 2), about ``most`` of them at the most.

    Returns:
        for each round: (N,) triangle that a piece is of, and (N, 3, 3) its corners' barycentric coordinates.
    """
    owner = np.arange(len(corners))
    weights = np.broadcast_to(np.eye(3), (len(corners), 3, 3))
    kept, pieces = [], 0
    while len(owner):
        now = weights @ corners[owner]
        opaque, all_of_it = mask.counts(now)
        full = opaque == all_of_it
        texels = np.abs(now - np.roll(now, 1, axis=1)).max(axis=(1, 2)) * mask.scale.max()
        mixed = (opaque > 0) & ~full
        last = mixed & (texels <= FINEST)
        if pieces + full.sum() + 4 * mixed.sum() > most:
            last = mixed
        centre = now.mean(axis=1, keepdims=True)
        points = np.concatenate([centre, 0.5 * (now + centre)], axis=1)
        stays = full.copy()
        stays[last] = mask.at_points(points[last]).mean(axis=1) >= 0.5
        kept.append((owner[stays], weights[stays]))
        pieces += int(stays.sum())
        onward = mixed & ~last
        half = weights[onward]
        middle = 0.5 * (half + np.roll(half, -1, axis=1))
        six = np.concatenate([half, middle], axis=1)
        weights = six[:, _QUARTERS].reshape(-1, 3, 3)
        owner = np.repeat(owner[onward], 4)
    return kept


def _with_pieces(
    part: Part, faces: np.ndarray, cut: np.ndarray, pieces: list[tuple[np.ndarray, np.ndarray]]
) -> Part:
    """Part of whole ``faces`` and of pieces of the triangles ``cut``, whose corners are interpolated."""
    owner = np.concatenate([numbers for numbers, _ in pieces])
    weights = np.concatenate([each for _, each in pieces])
    count = len(part.vertices)

    def extended(values: np.ndarray) -> np.ndarray:
        inside = (weights @ values[cut[owner]].astype(np.float64)).reshape(-1, values.shape[1])
        return np.concatenate([values, inside.astype(values.dtype)])

    normals = extended(part.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    added = np.arange(count, count + 3 * len(owner)).reshape(-1, 3)
    return replace(
        part,
        vertices=extended(part.vertices),
        normals=normals,
        faces=np.concatenate([faces, added]),
        uv=None if part.uv is None else extended(part.uv),
        tint=None if part.tint is None else extended(part.tint),
        base_color=extended(part.base_color) if part.base_color.ndim == 2 else part.base_color,
    )
