"""Large pictures in tiles: a network draws each with what lies around it, and memory stays small.

A pixel depends on those within the network's reach. Tiles begin at multiples of its stride and are given the
reach as margin, so that they draw what one pass over the whole draws; the shipped ones do within 1/255.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from tron.neural.protocols import Renderer

SIDE = 1024
"""Side of a tile without its margin, pixels."""


def drawn_in_tiles(
    renderer: Renderer,
    buffers: Mapping[str, Tensor],
    weights: Mapping[str, float] | None = None,
    side: int = SIDE,
) -> Tensor:
    """:meth:`Renderer.forward` of frames (B, 3, K, H, W), tile by tile where they are larger than one.

    Args:
        side: of a tile, pixels, brought up to the network's stride. Networks that look at the whole picture
            (``renderer.reach`` is None) draw it whole.
    """
    height, width = next(iter(buffers.values())).shape[-2:]
    reach, stride = renderer.reach, renderer.stride
    if reach is None or max(height, width) <= side + reach:
        return renderer(buffers, weights)
    side, margin = (-(-pixels // stride) * stride for pixels in (side, reach))
    drawn: list[Tensor] = []
    for rows, seen_rows in _spans(height, side, margin):
        across = []
        for columns, seen_columns in _spans(width, side, margin):
            seen = {name: buffer[..., seen_rows, seen_columns] for name, buffer in buffers.items()}
            top, left = rows.start - seen_rows.start, columns.start - seen_columns.start
            tall, wide = rows.stop - rows.start, columns.stop - columns.start
            across.append(renderer(seen, weights)[..., top : top + tall, left : left + wide])
        drawn.append(torch.cat(across, -1))
    return torch.cat(drawn, -2)


def _spans(length: int, side: int, margin: int) -> Iterator[tuple[slice, slice]]:
    """Of each tile along one axis: the pixels that it draws, and those that it sees."""
    for start in range(0, length, side):
        stop = min(start + side, length)
        yield slice(start, stop), slice(max(start - margin, 0), min(stop + margin, length))
