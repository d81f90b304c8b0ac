"""Pictures for people: frames side by side, with an inset where they differ most."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from eval.relighting.baselines import NEURAL, NEURAL_LIT
from eval.relighting.gallery import Example
from tron.report.page import Picture, Pictures

LEAST_WIDTH = 256
"""Pixels: smaller frames are enlarged by whole numbers, without smoothing."""
ZOOM = 4
"""An inset shows a square of a side that is this much smaller than the frame's, as large as the frame."""
KIND_TITLES = {"pair": "network of the paper's pair", "lit": "network that starts from lit"}
GAP = 4
FRAME_COLOUR = (1.0, 0.85, 0.1)
COLUMNS = (
    ("pbr", "pbr (guidance)"),
    ("irradiance", "irradiance (guidance)"),
    (NEURAL.name, "network of pbr and irradiance"),
    ("lit", "lit (guidance)"),
    ("lit_filtered", "lit, best Gaussian"),
    (NEURAL_LIT.name, "network that starts from lit"),
)


def comparison(example: Example) -> Pictures:
    """Show guidance, lit, its best Gaussian, the networks and the truth of one frame, each with its inset."""
    where = f"scene {example.meta.scene} under light {example.meta.light}"
    images = {**example.methods, "irradiance": example.irradiance}
    shown = [(name, title) for name, title in COLUMNS if name in images]
    networks = [images[name] for name in (NEURAL_LIT.name, NEURAL.name) if name in images]
    start = "lit" if NEURAL_LIT.name in images else "pbr"
    corner, side = busiest_square(images[start], networks[0] if networks else example.truth)
    pictures = [
        Picture(
            with_inset(images[name], corner, side),
            title,
            f"{title}, {where}; below, the marked square",
            f"{example.psnr[name]:.1f} dB" if name in example.psnr else "",
            strong=name in (NEURAL.name, NEURAL_LIT.name),
        )
        for name, title in shown
    ]
    truth = with_inset(example.truth, corner, side)
    pictures.append(Picture(truth, "path-traced truth", f"path-traced truth, {where}; below, the square"))
    return Pictures(example.title, pictures, columns=len(pictures))


def busiest_square(a: np.ndarray, b: np.ndarray) -> tuple[tuple[int, int], int]:
    """Return corner (row, column) and side of the square in which two images (H, W, 3) differ most."""
    height, width = a.shape[:2]
    side = max(min(height, width) // ZOOM, 1)
    error = uniform_filter(((a - b) ** 2).sum(-1), side, mode="constant", origin=-(side // 2))
    inside = error[: height - side + 1, : width - side + 1]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return (int(row), int(column)), side


def with_inset(image: np.ndarray, corner: tuple[int, int], side: int) -> np.ndarray:
    """Return the image (H, W, 3) with the square marked, and the square enlarged below it."""
    row, column = corner
    scale = -(-LEAST_WIDTH // image.shape[1])
    marked = enlarge(image, scale)
    top, left, length = row * scale, column * scale, side * scale
    thick = max(1, marked.shape[1] // 256)
    for k in range(thick):
        marked[top + k, left : left + length] = marked[top + length - 1 - k, left : left + length] = (
            FRAME_COLOUR
        )
        marked[top : top + length, left + k] = marked[top : top + length, left + length - 1 - k] = (
            FRAME_COLOUR
        )
    square = enlarge(image[row : row + side, column : column + side], -(-marked.shape[1] // side))
    paper = np.ones((GAP, marked.shape[1], 3), marked.dtype)
    return np.concatenate([marked, paper, square[: marked.shape[1], : marked.shape[1]]])


def enlarge(image: np.ndarray, scale: int) -> np.ndarray:
    """Return a copy with every pixel as a square of ``scale`` x ``scale`` pixels."""
    return image.repeat(scale, 0).repeat(scale, 1)
