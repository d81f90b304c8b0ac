"""Maps onto a view's pixels, and normals into its world."""

from __future__ import annotations

from typing import Literal

import numpy as np

from tron.cameras import Camera

NormalFrame = Literal["camera_opengl", "camera_opencv", "world"]
"""Axes of a normal map: x right, y up, z towards the viewer (OpenGL); x right, y down, z away (OpenCV)."""

ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect ratios that rounding to whole pixels, or to multiples of 8, explains."""

_UNIT_RANGE = (0.5, 1.5)  # lengths of vectors that are normals, give or take what a network gets wrong


def world_normals(normals: np.ndarray, camera: Camera, frame: NormalFrame) -> np.ndarray:
    """Unit world normals (H, W, 3) float32 from signed ones of any frame, zero where there is none.

    Vectors far from unit length, such as a black or grey background decodes to, are no normals.
    """
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    low, high = _UNIT_RANGE
    unit = np.where((length > low) & (length < high), normals / np.maximum(length, 1e-12), 0.0)
    if frame == "camera_opengl":
        unit = unit * (1.0, -1.0, -1.0)
    if frame != "world":
        unit = unit @ camera.camera_to_world[:3, :3].T
    return unit.astype(np.float32)


def resized(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """(H, W) or (H, W, C) -> (height, width[, C]) float32: means of areas where it shrinks, else bilinear."""
    import cv2

    pixels = np.ascontiguousarray(pixels, np.float32)
    if pixels.shape[:2] == (height, width):
        return pixels
    shrinks = width <= pixels.shape[1] and height <= pixels.shape[0]
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def same_aspect(pixels: np.ndarray, camera: Camera) -> bool:
    """Whether a map has the proportions of the view; one pixel of rounding is allowed on small maps."""
    height, width = pixels.shape[:2]
    allowed = max(ASPECT_TOLERANCE, 1.0 / min(height, width, camera.height, camera.width))
    return abs(width * camera.height / (height * camera.width) - 1) <= allowed
