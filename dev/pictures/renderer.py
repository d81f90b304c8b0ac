"""README's pictures of the shipped networks: two frames with a detail each, and the change of a clip.

    cd dev/pictures; python renderer.py DATA ../../docs/images/renderer.jpg ../../docs/images/clips.jpg

DATA holds what `tron-eval benchmark=renderer` judges by: its synthetic_256, synthetic_128 and captures.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from eval.relighting.buffers import Buffers
from tron.io.images import write_image
from tron.neural.clips import averaged_frames
from tron.neural.renderer import render_clip
from tron.neural.shipped import shipped
from tron.neural.weights import load_renderer
from tron.runtime import set_torch_threads
from tron.shards.reader import read_clips
from tron.shards.schema import Clip

SIZE = 256
"""Side of each picture, pixels."""
GAP = 4
DETAILS = (
    ("synthetic_256", "test", "test-000002-l1", (140, 96, 64)),
    ("captures", "test_relit", "test-000001-l1-c0000", (40, 50, 32)),
)
"""Data set, split and clip, and the marked square: left, top, side."""
CLIP = ("synthetic_128", "test", "test-000006-l0", 4)
"""Data set, split, clip and frame."""
AVERAGED = 5
CHANGE = 4.0
"""Factor of the difference to the frame before."""


def find(data: Path, dataset: str, split: str, key: str) -> Clip:
    """The clip of a key."""
    return next(clip for clip in read_clips(data / dataset, split) if clip.meta.key == key)


def enlarged(image: np.ndarray) -> Image.Image:
    """Display values as a square of SIZE."""
    return Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8)).resize((SIZE, SIZE), 0)


def tile(name: str, image: np.ndarray, square: tuple[int, int, int]) -> np.ndarray:
    """A picture under its name, and the marked square below."""
    left, top, side = square
    scale = SIZE / image.shape[0]
    found = Image.new("RGB", (SIZE, 2 * SIZE + GAP + 16), "white")
    whole = enlarged(image)
    corners = [left * scale, top * scale, (left + side) * scale, (top + side) * scale]
    ImageDraw.Draw(whole).rectangle(corners, outline=(255, 60, 60))
    found.paste(whole, (0, 16))
    found.paste(enlarged(image[top : top + side, left : left + side]), (0, SIZE + GAP + 16))
    ImageDraw.Draw(found).text((3, 2), name, fill=0)
    return np.asarray(found) / 255.0


def side_by_side(images: list[np.ndarray], axis: int) -> np.ndarray:
    """Images with white between them, beside (axis 1) or below one another (axis 0)."""
    shape = list(images[0].shape)
    shape[axis] = GAP if axis else 2 * GAP
    between = np.ones(shape)
    return np.concatenate([part for image in images for part in (image, between)][:-1], axis=axis)


def main(data: Path, frames: Path, clips: Path) -> None:
    """Write both pictures."""
    set_torch_threads(1)
    networks = {name: load_renderer(shipped(name)) for name in ("paper", "surfaces")}
    rows = []
    for dataset, split, key, square in DETAILS:
        clip = find(data, dataset, split, key)
        shown = {
            name: clip.displayed(name)[:1]
            for name in ("pbr", "irradiance", "albedo", "lit", "surface", "rgb")
        }
        pictures = {name: shown[name][0] for name in ("pbr", "irradiance", "albedo", "lit")}
        for title, name in (("network of the pair", "paper"), ("network: lit and surfaces", "surfaces")):
            given = {each: shown[each] for each in networks[name].config.guidance}
            pictures[title] = render_clip(networks[name], given)[0]
        pictures["path tracer"] = shown["rgb"][0]
        rows.append(side_by_side([tile(name, image, square) for name, image in pictures.items()], axis=1))
    write_image(frames, side_by_side(rows, axis=0))

    dataset, split, key, frame = CLIP
    clip = find(data, dataset, split, key)
    given = {name: clip.displayed(name) for name in networks["surfaces"].config.guidance}
    single = render_clip(networks["surfaces"], given, 1)
    motion = Buffers.of(clip).motion
    assert motion is not None
    averaged = np.stack(list(averaged_frames(iter(single), len(single), AVERAGED, motion)))
    columns = []
    for name, film in (
        ("lit", given["lit"]),
        ("single frames", single),
        ("averaged", averaged),
        ("path tracer", clip.displayed("rgb")),
    ):
        change = 0.5 + CHANGE * (film[frame] - film[frame - 1])
        column = [np.asarray(enlarged(film[frame])) / 255.0, np.asarray(enlarged(change)) / 255.0]
        label = Image.new("RGB", (SIZE, 16), "white")
        ImageDraw.Draw(label).text((3, 2), name, fill=0)
        columns.append(np.concatenate([np.asarray(label) / 255.0, side_by_side(column, axis=0)]))
    write_image(clips, side_by_side(columns, axis=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))
