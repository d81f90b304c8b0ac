"""Errors of the surfels' shadows: light that leaks into shadow, and lit surfaces that are darkened.

Definitions are in conventions.md, 10. The path tracer alone decides what is in shadow and what is lit, by its
irradiance with shadows over its irradiance without, so errors of the surfels' normals move no pixel to
another class. Pixels are judged where surfels and truth show the same surface. A surfel that overhangs a
silhouette by a pixel shows another surface with another light; that error counts in base color and in the
irradiance PSNR, which judge every pixel of the foreground. The surface is the same by distance or by normals,
and both are reported.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tron.color import luminance

SHADOWED_BELOW = 0.5
"""A pixel is in shadow where less than this share of the unshadowed irradiance arrives, in the reference."""
LIT_ABOVE = 0.9
"""A pixel is lit where more than this share arrives, in the reference."""
LEAK_OVER_MEAN = 0.15
"""A shadowed pixel leaks if it exceeds the reference by over this share of the frame's mean reference."""
DARKENED_BELOW = 0.75
"""A lit pixel is darkened if it keeps less than this share of the reference."""
SAME_DEPTH = 0.03
"""Surfels and truth show the same surface where their distances differ by less than this, world units: a
hundredth of a scene's width."""
SAME_NORMAL_DEG = 20.0
"""The same by normals: where they differ by less than this."""


class ShadowPixels(NamedTuple):
    """Pixels of one frame, (H, W) bool each.

    Attributes:
        shadowed: in shadow in the reference.
        leaking: shadowed pixels that the surfels show too bright.
        lit: lit in the reference.
        darkened: lit pixels that the surfels show too dark.
    """

    shadowed: np.ndarray
    leaking: np.ndarray
    lit: np.ndarray
    darkened: np.ndarray


def shadow_pixels(
    irradiance: np.ndarray, reference: np.ndarray, unshadowed: np.ndarray, judged: np.ndarray
) -> ShadowPixels:
    """Classify pixels and their errors by luminance, with the constants of this file.

    Args:
        irradiance: (H, W, 3) linear E / pi of the surfels, with shadows.
        reference: (H, W, 3) irradiance by the path tracer.
        unshadowed: (H, W, 3) irradiance by the path tracer without occlusion.
        judged: (H, W) bool, pixels where both see a surface; the mean reference is over these.
    """
    ours, truth, open_sky = (luminance(image) for image in (irradiance, reference, unshadowed))
    share = np.divide(truth, open_sky, out=np.ones_like(truth), where=open_sky > 0)
    shadowed, lit = judged & (share < SHADOWED_BELOW), judged & (share > LIT_ABOVE)
    mean = truth[judged].mean() if judged.any() else 0.0
    leaking = shadowed & (ours > truth + LEAK_OVER_MEAN * mean)
    return ShadowPixels(shadowed, leaking, lit, lit & (ours < DARKENED_BELOW * truth))


def frame_shadow_pixels(frame: dict[str, np.ndarray], judged: np.ndarray) -> ShadowPixels:
    """Return ShadowPixels of a frame with reference members, (H, W, C) each."""
    return shadow_pixels(frame["irradiance"], frame["irradiance_ref"], frame["unshadowed_ref"], judged)


def both_have_surface(frames: dict[str, np.ndarray]) -> np.ndarray:
    """Return pixels where truth and surfels have a surface: (..., H, W) bool."""
    return (frames["foreground"][..., 0] > 0.5) & (frames["mask"][..., 0] > 0.5)


def same_depth(frames: dict[str, np.ndarray]) -> np.ndarray:
    """Return pixels where both have the same surface by distance, from ``depth`` and ``depth_ref``."""
    apart = np.abs(frames["depth"] - frames["depth_ref"])[..., 0]
    return both_have_surface(frames) & (apart < SAME_DEPTH)


def same_normal(frames: dict[str, np.ndarray]) -> np.ndarray:
    """Return pixels where both have the same surface by normal, from ``normal`` and ``normal_ref``."""
    ours, truth = frames["normal"], frames["normal_ref"]
    cosine = (ours * truth).sum(-1)
    lengths = np.linalg.norm(ours, axis=-1) * np.linalg.norm(truth, axis=-1)
    return both_have_surface(frames) & (cosine > lengths * np.cos(np.radians(SAME_NORMAL_DEG)))
