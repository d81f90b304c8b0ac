"""Errors of the surfels' shadows: light that leaks into shadow, and lit surfaces that are darkened.

The definitions are those of the study in the design notes (guidance). What is in shadow and what is lit is
the path tracer's to say: its irradiance with shadows over its own without, so that an error of the surfels'
normals moves no pixel from one class to another. Pixels are judged where surfels and truth show the same
surface. A surfel that overhangs a silhouette by a pixel shows another surface, with that one's light; the
error is counted where it belongs, in base color and the irradiance PSNR, which judge every pixel of the
foreground. Same surface is said by distance, as in the study, or by normals, and both are reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tron.color import luminance

SHADOWED_BELOW = 0.5
"""A pixel is in shadow where less than this share of the unshadowed irradiance arrives, in the reference."""
LIT_ABOVE = 0.9
"""A pixel is lit where more than this share arrives, in the reference."""
LEAK_OVER_MEAN = 0.15
"""A shadowed pixel leaks if it exceeds the reference by more than this share of the frame's mean reference.
"""
DARKENED_BELOW = 0.75
"""A lit pixel is darkened if it keeps less than this share of the reference."""
SAME_DEPTH = 0.03
"""Surfels and truth show the same surface where their distances differ by less than this, world units: a
hundredth of a scene's width, the study's value."""
SAME_NORMAL_DEG = 20.0
"""The same by normals: where they differ by less than this."""


@dataclass(frozen=True)
class ShadowCounts:
    """Pixels of one frame: in shadow, leaking among them, lit, darkened among them."""

    shadowed: int
    leaking: int
    lit: int
    darkened: int


class DirectLight(NamedTuple):
    """The path tracer's direct irradiance / pi, linear, (H, W, 3) each: with shadows, and with nothing in the
    way.
    """

    shadowed: np.ndarray
    unshadowed: np.ndarray


def shadow_classes(reference: DirectLight, judged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels the reference has in shadow, and which it has lit: two (H, W) bool; see
    :func:`shadow_errors`.
    """
    arriving, open_sky = luminance(reference.shadowed), luminance(reference.unshadowed)
    share = np.divide(arriving, open_sky, out=np.ones_like(arriving), where=open_sky > 0)
    return judged & (share < SHADOWED_BELOW), judged & (share > LIT_ABOVE)


def shadow_errors(
    irradiance: np.ndarray, reference: DirectLight, judged: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels leak and which are darkened, by luminance, as the constants of this file define.

    Args:
        irradiance: (H, W, 3) linear E / pi of the surfels, with shadows.
        reference: the truth.
        judged: (H, W) bool, the pixels where both see a surface; the mean reference is taken over them.

    Returns:
        leaking, darkened: (H, W) bool.
    """
    shadowed, lit = shadow_classes(reference, judged)
    ours, truth = luminance(irradiance), luminance(reference.shadowed)
    mean = truth[judged].mean() if judged.any() else 0.0
    return shadowed & (ours > truth + LEAK_OVER_MEAN * mean), lit & (ours < DARKENED_BELOW * truth)


def count_shadow_errors(irradiance: np.ndarray, reference: DirectLight, judged: np.ndarray) -> ShadowCounts:
    """Count the pixels of :func:`shadow_classes` and :func:`shadow_errors`; arguments as there."""
    shadowed, lit = shadow_classes(reference, judged)
    leaking, darkened = shadow_errors(irradiance, reference, judged)
    return ShadowCounts(*(int(pixels.sum()) for pixels in (shadowed, leaking, lit, darkened)))


def direct_light(frames: dict[str, np.ndarray]) -> DirectLight:
    """The path tracer's, from ``irradiance_ref`` and ``unshadowed_ref``."""
    return DirectLight(frames["irradiance_ref"], frames["unshadowed_ref"])


def both_have_surface(frames: dict[str, np.ndarray]) -> np.ndarray:
    """Pixels where truth and surfels have a surface: (..., H, W) bool, from ``foreground`` and ``mask``."""
    return (frames["foreground"][..., 0] > 0.5) & (frames["mask"][..., 0] > 0.5)


def same_depth(frames: dict[str, np.ndarray]) -> np.ndarray:
    """Of those the ones where it is the same surface by its distance, from ``depth`` and ``depth_ref``."""
    apart = np.abs(frames["depth"] - frames["depth_ref"])[..., 0]
    return both_have_surface(frames) & (apart < SAME_DEPTH)


def same_normal(frames: dict[str, np.ndarray]) -> np.ndarray:
    """Of those the ones where it is the same surface by its normal, from ``normal`` and ``normal_ref``."""
    ours, truth = frames["normal"], frames["normal_ref"]
    cosine = (ours * truth).sum(-1)
    lengths = np.linalg.norm(ours, axis=-1) * np.linalg.norm(truth, axis=-1)
    return both_have_surface(frames) & (cosine > lengths * np.cos(np.radians(SAME_NORMAL_DEG)))
