"""The picture of the shipped network: validation scenes at 512 x 512, with a detail of each.

    cd dev/pictures; python renderer.py DATA/validation_512 ../../docs/images/renderer.jpg

DATA is what `tron-eval benchmark=renderer benchmark.parts=[validation]` has made.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from tron.io.images import write_image
from tron.neural.renderer import render_clip
from tron.neural.shipped import shipped
from tron.neural.weights import load_renderer
from tron.runtime import set_torch_threads
from tron.shards.reader import read_clips
from tron.shards.schema import TARGET, Clip

SIZE = 512
"""Side of each picture, pixels: those of the frames, and a detail enlarged beside them."""
GAP, LABEL = 4, 16
ROWS = (
    ("preview", "test-000001-l1", (130, 130, 160)),
    ("final", "test-000001-l0", (330, 190, 160)),
)
"""Quality, clip, and the square that is enlarged: left, top, side."""


def find(data: Path, key: str) -> Clip:
    """The clip of a key."""
    return next(clip for clip in read_clips(data, "test") if clip.meta.key == key)


def tile(name: str, image: np.ndarray, square: tuple[int, int, int]) -> np.ndarray:
    """Display values (512, 512, 3) under their name, and a square of them below."""
    left, top, side = square
    found = Image.new("RGB", (SIZE, LABEL + SIZE + GAP + SIZE // 2), "white")
    whole = Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
    detail = whole.crop((left, top + side // 4, left + side, top + side // 4 + side // 2))
    ImageDraw.Draw(whole).rectangle(
        [left, top + side // 4, left + side, top + 3 * side // 4], outline=(255, 60, 60)
    )
    found.paste(whole, (0, LABEL))
    found.paste(detail.resize((SIZE, SIZE // 2), 0), (0, LABEL + SIZE + GAP))
    ImageDraw.Draw(found).text((3, 2), name, fill=0)
    return np.asarray(found) / 255.0


def side_by_side(images: list[np.ndarray], axis: int) -> np.ndarray:
    """Images with white between them, beside (axis 1) or below one another (axis 0)."""
    shape = list(images[0].shape)
    shape[axis] = GAP
    parts = [part for image in images for part in (image, np.ones(shape))]
    return np.concatenate(parts[:-1], axis=axis)


def main(data: Path, output: Path) -> None:
    """Write the picture."""
    set_torch_threads(2)
    network = load_renderer(shipped("surfaces"))
    rows = []
    for quality, key, square in ROWS:
        clip = find(data, key)
        shown = {name: clip.displayed(name)[:1] for name in network.config.guidance}
        pictures = {
            f"lit, {quality}": shown["lit"][0],
            "the network": render_clip(network, shown)[0],
            "the path tracer": clip.displayed(TARGET)[0],
        }
        rows.append(side_by_side([tile(name, image, square) for name, image in pictures.items()], axis=1))
    write_image(output, side_by_side(rows, axis=0))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
