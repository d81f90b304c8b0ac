"""Open sky in an outdoor photo: smooth, bright or blue, and reaching down from the upper edge.

Told from one upright photo, without a network. A white ceiling would pass for it, hence only who says that
the photos were taken outdoors has them looked at. A sunset redder than the scene is bright, and a night's
sky is neither bright nor blue: it stays what it is, a surface.
"""

from __future__ import annotations

import numpy as np

from tron.color import luminance, srgb_to_linear

_BLUE = 1.1  # blue over red
_DARK = 0.02  # linear; darker pixels have no colour to speak of
_SMOOTH = 0.03  # display values from a pixel to the next
_ALIKE = 0.08  # the same, from the sky near by, at its rim
_RIM = 2
_NEAR = 15  # pixels a side over which the sky's colour is taken
_LEAST = 0.005


def sky_coloured(light: np.ndarray) -> np.ndarray:
    """(H, W) bool: brighter than half the picture, or blue, as skies are.

    Args:
        light: (H, W, 3) linear.
    """
    brightness = luminance(light)
    bright = brightness > np.median(brightness)
    blue = (light[..., 2] > _BLUE * light[..., 0]) & (light[..., 2] >= light[..., 1])
    return (bright | blue) & (brightness > _DARK)


def open_sky(image: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that show nothing but the sky.

    Regions of sky-coloured pixels without edges are sky where they touch the upper edge and cover at least
    half a percent of the photo; they grow by two pixels over what has the colour of the sky near by, since
    windows that tell smoothness end before the skyline.

    Args:
        image: (H, W, 3) display values in [0, 1], upright.
    """
    import cv2

    grey = cv2.blur(np.ascontiguousarray(image.mean(2), np.float32), (3, 3))
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    coloured = sky_coloured(srgb_to_linear(image))
    labels = cv2.connectedComponents((coloured & (slope < _SMOOTH)).astype(np.uint8), connectivity=4)[1]
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0  # of what is no candidate
    at_edge = np.unique(labels[0])
    sky = np.isin(labels, at_edge[sizes[at_edge] >= _LEAST * labels.size])
    if not sky.any():
        return sky
    share = cv2.blur(sky.astype(np.float32), (_NEAR, _NEAR))
    near = cv2.blur(image.astype(np.float32) * sky[..., None], (_NEAR, _NEAR)) / share[..., None].clip(1e-3)
    alike = (np.abs(image - near).max(2) < _ALIKE) & coloured
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(_RIM):
        sky |= (cv2.dilate(sky.astype(np.uint8), cross) > 0) & alike
    return sky
