"""Pictures in which a person sees the difference: frames side by side, and an inset where it is largest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import uniform_filter

from eval.relighting.baselines import NEURAL, NEURAL_LIT
from eval.relighting.buffers import Buffers
from eval.relighting.gallery import Example
from eval.relighting.networks import Network
from tron.errors import TronError
from tron.report.page import Picture, Pictures
from tron.shards.schema import Clip

LEAST_WIDTH = 256
"""Pixels: smaller frames are enlarged by whole numbers, without smoothing."""
ZOOM = 4
"""An inset shows a square of a side that is this much smaller than the frame's, as large as the frame."""
KIND_TITLES = {"pair": "network of the paper's pair", "lit": "network that starts from lit"}
GAP = 4
SWEEP_WIDTH = 128
"""Least width of a picture of the sweep, pixels."""
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
    """Guidance, lit, its best Gaussian, the networks and the truth of one frame, each above its inset."""
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
    """Upper left corner (row, column) and side of the square in which two (H, W, 3) images differ most."""
    height, width = a.shape[:2]
    side = max(min(height, width) // ZOOM, 1)
    error = uniform_filter(((a - b) ** 2).sum(-1), side, mode="constant", origin=-(side // 2))
    inside = error[: height - side + 1, : width - side + 1]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return (int(row), int(column)), side


def with_inset(image: np.ndarray, corner: tuple[int, int], side: int) -> np.ndarray:
    """The image (H, W, 3) with the square marked, and the square enlarged to its width below it."""
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
    """Every pixel as a square of ``scale`` pixels; a copy."""
    return image.repeat(scale, 0).repeat(scale, 1)


def sweep_pictures(clip: Clip, pair: Network) -> Iterator[tuple[str, Pictures]]:
    """The first frame of a clip by the paper's pair under 5 x 5 weights of its latents, named by files.

    Raises:
        TronError: the network takes no weights, or not both buffers.
    """
    from tron.neural.renderer import NeuralRenderer
    from tron.neural.sweep import SWEEP, weight_sweep

    if not isinstance(pair.renderer, NeuralRenderer):
        raise TronError("only neural renderers weight their buffers", pair.path)
    buffers, where = Buffers.of(clip), f"scene {clip.meta.scene}, {clip.meta.light_family} light"
    displayed = {name: buffers.displayed(name)[:1] for name in pair.renderer.config.guidance}
    given = {name: image[0] for name, image in displayed.items()} | {"path tracer": clip.displayed("rgb")[0]}
    scale = -(-SWEEP_WIDTH // clip.meta.width)
    shown = [Picture(enlarge(each, scale), name, f"{name}, {where}") for name, each in given.items()]
    note = f"A colour over all is the light's: {where}."
    yield (
        "renderer-sweep-given",
        Pictures("What it is given, and the truth", shown, note, columns=len(SWEEP)),
    )
    images = weight_sweep(pair.renderer, displayed)
    shown = [
        Picture(
            enlarge(image, scale),
            f"w_pbr {of_pbr:g}, w_irr {of_irradiance:g}",
            f"latents weighted {of_pbr:g} and {of_irradiance:g}, {where}",
            strong=of_pbr == of_irradiance == 0.5,
        )
        for of_pbr, row in zip(SWEEP, images)
        for of_irradiance, image in zip(SWEEP, row)
    ]
    note = (
        "Framed: the weights of the paper and of the training. At 0, 0 the network sees nothing; what it "
        "draws is added to filtered pbr, whatever the weights."
    )
    yield "renderer-sweep", Pictures("Weights of the two latents", shown, note, columns=len(SWEEP))
