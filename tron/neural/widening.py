"""Weights of a network that is given some buffers, for one that is given more.

What is added begins at zero: columns of the first layer for the new buffers, and rows of the last for shares
of detail. So the wider network draws exactly what the other did, and learns from there what the new buffers
are worth.
"""

from __future__ import annotations

from torch import Tensor

from tron.neural.configs import RendererConfig, UNetConfig
from tron.neural.renderer import NeuralRenderer

FIRST, LAST = "backbone.embed.weight", ("backbone.out.weight", "backbone.out.bias")


def widened(state: dict[str, Tensor], narrow: RendererConfig, wide: NeuralRenderer) -> dict[str, Tensor]:
    """The state of a U-Net of configuration ``narrow`` as one of ``wide``.

    The same state where the two do not differ in their guidance alone, or in a ``skip_detail`` that is new.
    """
    config, shape = wide.config, wide.config.backbone
    added = {"guidance": narrow.guidance, "skip_detail": narrow.skip_detail, "window": narrow.window}
    if (
        not isinstance(shape, UNetConfig)
        or config.fusion != "concat"
        or config.model_copy(update=added).model_dump() != narrow.model_dump()
        or not set(narrow.guidance) < set(config.guidance)
        or narrow.skip_detail not in (None, config.skip_detail)
    ):
        return state
    channels, area = wide.codec.latent_channels, shape.patch**2
    columns, rows = area * len(narrow.guidance) * channels, wide.state_dict()
    whole = {FIRST, *LAST} <= state.keys() and state[FIRST].shape == (rows[FIRST].shape[0], columns)
    if not whole or any(state[name].shape[0] % area for name in LAST):
        return state  # damaged: whoever loads it says where
    # Columns and rows of each pixel of a patch lie together: of a column block for each buffer, in order.
    old = state[FIRST].unflatten(1, (area, len(narrow.guidance), channels))
    new = old.new_zeros(*old.shape[:2], len(config.guidance), channels)
    for place, name in enumerate(narrow.guidance):
        new[:, :, config.guidance.index(name)] = old[:, :, place]
    grown = {FIRST: new.flatten(1)}
    for name in LAST:
        old = state[name].unflatten(0, (area, -1))
        new = old.new_zeros(area, rows[name].shape[0] // area, *old.shape[2:])
        new[:, : old.shape[1]] = old
        grown[name] = new.flatten(0, 1)
    return state | grown
