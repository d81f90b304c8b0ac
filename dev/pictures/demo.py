"""README's picture of the demo: held-out scenes and lights, guidance to path tracer.

Run it here: ``python demo.py ../../outputs/demo ../../docs/images/demo.jpg``.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from renderer import find, side_by_side

from tron.io.images import write_image
from tron.neural.renderer import render_clip
from tron.neural.weights import load_renderer
from tron.runtime import set_torch_threads

CLIPS = (("test-000000-l1", 0), ("test-000001-l0", 2), ("test-000002-l2", 2))
"""Clip and frame."""
SIZE = 256
"""Side of each picture, pixels."""


def enlarged(image: np.ndarray) -> np.ndarray:
    """Display values as a square of SIZE, without smoothing."""
    shown = Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
    return np.asarray(shown.resize((SIZE, SIZE), Image.Resampling.NEAREST)) / 255.0


def main(demo: Path, out: Path) -> None:
    """Write a row a clip; ``demo`` is the demo's output folder."""
    set_torch_threads(1)
    networks = {
        "network of two buffers": load_renderer(demo / "train/unet_of_two/renderer.safetensors"),
        "network that starts from lit": load_renderer(demo / "train/unet/renderer.safetensors"),
    }
    rows = []
    for key, frame in CLIPS:
        clip = find(demo / "dataset", key)
        pictures = {
            "split-sum PBR": clip.displayed("pbr")[frame],
            "shadowed irradiance": clip.displayed("irradiance")[frame],
            "lit, no network": clip.displayed("lit")[frame],
        }
        for title, network in networks.items():
            given = {name: clip.displayed(name)[frame : frame + 1] for name in network.config.guidance}
            pictures[title] = render_clip(network, given)[0]
        pictures["path tracer"] = clip.displayed("rgb")[frame]
        rows.append(side_by_side([enlarged(image) for image in pictures.values()], 1))
        titles = list(pictures)
    head = Image.new("RGB", (rows[0].shape[1], 16), "white")
    for column, title in enumerate(titles):
        ImageDraw.Draw(head).text((column * rows[0].shape[1] // len(titles) + 3, 2), title, fill=0)
    write_image(out, np.concatenate([np.asarray(head) / 255.0, side_by_side(rows, 0)]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
