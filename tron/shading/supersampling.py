"""Means over sub-pixels: pictures in linear light, and the surface that a pixel of them shows."""

from __future__ import annotations

import numpy as np


def averaged(image: np.ndarray, times: int) -> np.ndarray:
    """(H times, W times, ...) -> (H, W, ...): means of ``times`` x ``times`` sub-pixels."""
    height, width = (side // times for side in image.shape[:2])
    return image.reshape(height, times, width, times, *image.shape[2:]).mean((1, 3))


def averaged_surface(gbuffer: dict[str, np.ndarray], times: int) -> dict[str, np.ndarray]:
    """A G-buffer of sub-pixels -> of pixels, by what each field is.

    Opacity and the premultiplied ``rgb`` are means. Base color, roughness, metallic, position and other
    values are means by opacity, as compositing along one ray has them, and 0 where it is 0. Normal and
    direction are brought back to unit length. Depth is the mean by opacity of the sub-pixels that have one.

    Args:
        gbuffer: ``GBuffer.numpy()``, (H times, W times, ...) each.
        times: sub-pixels along a pixel's side.
    """
    opacity = gbuffer["opacity"]
    weights = dict.fromkeys(gbuffer, opacity)
    weights["depth"] = opacity * (gbuffer["depth"] > 0)
    weights |= {name: np.ones_like(opacity) for name in ("opacity", "rgb", "direction")}
    means = {name: _mean(image, weights[name], times) for name, image in gbuffer.items()}
    for name in ("normal", "direction"):
        length = np.linalg.norm(means[name], axis=-1, keepdims=True)
        means[name] = means[name] / np.where(length > 0, length, 1)
    return means


def _mean(image: np.ndarray, weight: np.ndarray, times: int) -> np.ndarray:
    weight = weight.reshape(*weight.shape, *(1,) * (image.ndim - 2))
    total = averaged(weight, times)
    return averaged(image * weight, times) / np.where(total > 0, total, 1)
