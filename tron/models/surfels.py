"""A model as surfels: points spread over its triangles, and what its textures say there.

No camera and no fit. Points are drawn evenly by area, many a surfel, and gathered in cells, so that a surfel
has the mean of the texture that it covers. Detail of normal maps is finer than surfels and left out. Surfels
within, which nobody sees, are made too. They face as the triangles' normals do; backs that are seen are made
triangles of their own by :mod:`tron.models.sides`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from tron import seeds
from tron.errors import TronError
from tron.gaussians.initialize import surfels_from_points
from tron.gaussians.scene import GaussianScene
from tron.models.parts import Part, Sampling

POINTS = 12
"""Points a surfel."""
MOST = 2_000_000
_MODES = {"repeat": "grid-wrap", "mirror": "reflect", "clamp": "nearest"}


def surfels_of_model(
    parts: Sequence[Part], spacing: float, *, kernel_degree: int = 4, object_id: int = 0, seed: int = 0
) -> GaussianScene:
    """Surfels of a model, z up.

    Args:
        parts: of :func:`tron.models.load.load_model`, or of :func:`tron.models.sides.two_sided`.
        spacing: between neighbours, in the model's units.
        kernel_degree: 2 or 4.
        object_id: of all of them.
        seed: root of the random numbers.

    Raises:
        TronError: there would be more than :data:`MOST`, or fewer than a handful.
    """
    sizes = [areas(part) for part in parts]
    area = float(sum(each.sum() for each in sizes))
    count = area / max(spacing, 1e-150) ** 2
    if not 8 <= count <= MOST:
        what = f"a surface of {area:.3g} at a spacing of {spacing:.3g} would be {count:.3g} surfels"
        raise TronError(what, mend=f"give another spacing or scale: between 8 and {MOST:,} can be made")
    rng = seeds.generator(seed, "surfels of a model")
    numbers = rng.multinomial(round(POINTS * count), [each.sum() / area for each in sizes])
    drawn = [_points(*each, rng) for each in zip(parts, sizes, numbers) if each[2]]
    if any("emission" in each for each in drawn):
        drawn = [{"emission": np.zeros_like(each["position"])} | each for each in drawn]
    values = {name: np.concatenate([each[name] for each in drawn]) for name in drawn[0]}
    return surfels_from_points(values, object_id, round(count), kernel_degree)


def areas(part: Part) -> np.ndarray:
    """(F,) areas of its triangles."""
    a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def spread(sizes: np.ndarray, number: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points on triangles of areas ``sizes`` (F,), even by area: (N,) triangles, (N, 3) shares of corners."""
    ends = np.cumsum(sizes)
    place = (np.arange(number) + rng.random(number)) / number * ends[-1]
    face = np.minimum(np.searchsorted(ends, place, side="right"), len(sizes) - 1)
    u, v = rng.random((2, number))
    root = np.sqrt(u)
    return face, np.stack([1 - root, root * (1 - v), root * v], axis=1)  # Turk 1990


def _points(part: Part, sizes: np.ndarray, number: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Points of a part, even by area, with its materials."""
    chosen, weights = spread(sizes, number, rng)
    face = part.faces[chosen]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", weights, values[face])

    normal = mean(part.normals)
    uv = None if part.uv is None else mean(part.uv)
    color = _looked_up(part, "base_color", uv, 3) if part.base_color.ndim != 2 else mean(part.base_color)
    if part.tint is not None:
        color = color * mean(part.tint)
    found = {
        "position": mean(part.vertices),
        "normal": normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12),
        "base_color": np.clip(np.broadcast_to(color, (number, 3)), 0, 1),
    }
    if part.emission is not None:
        found["emission"] = np.broadcast_to(_looked_up(part, "emission", uv, 3), (number, 3))
    for name in ("roughness", "metallic"):
        found[name] = np.broadcast_to(np.clip(_looked_up(part, name, uv, 1), 0, 1), (number, 1))
    sound = np.linalg.norm(found["normal"], axis=1) > 0.5  # opposite corners cancel
    return {name: values[sound] for name, values in found.items()}


def _looked_up(part: Part, name: str, uv: np.ndarray | None, channels: int) -> np.ndarray:
    """(N, C) of an image at (N, 2) texture coordinates, bilinear, or (1, C) of what has no image."""
    values = np.asarray(getattr(part, name), np.float32)
    if values.ndim < 2 or uv is None:
        return values.reshape(-1, channels) if values.ndim < 2 else values.reshape(-1, channels).mean(0)[None]
    sampling = part.sampling.get(name, Sampling(np.eye(3), "repeat"))
    at = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.asarray(sampling.matrix).T
    image = values.reshape(*values.shape[:2], channels)
    rows = at[:, 1] * image.shape[0] - 0.5
    columns = at[:, 0] * image.shape[1] - 0.5
    given = {"order": 1, "mode": _MODES[sampling.wrap], "prefilter": False}
    return np.stack(
        [ndimage.map_coordinates(image[..., k], [rows, columns], **given) for k in range(channels)], axis=1
    )
