"""Checkpoints that are judged, by kind, and how they show a clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.relighting.baselines import NEURAL, NEURAL_LIT
from eval.relighting.buffers import Buffers
from eval.relighting.fits import Show
from eval.renderer.settings import Kind
from tron.errors import TronError
from tron.neural.shipped import SHIPPED, checkpoint_file
from tron.neural.windows import Overlap

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer

METHODS: dict[Kind, str] = {"pair": NEURAL.name, "lit": NEURAL_LIT.name}
"""Kind of checkpoint -> its name among the methods of :mod:`eval.relighting.baselines`."""
TITLES: dict[Kind, str] = {"pair": "network of the paper's pair", "lit": "network that starts from lit"}


@dataclass(frozen=True)
class Network:
    """A checkpoint that was read.

    Attributes:
        kind: what it sees.
        path: its file.
        renderer: the network.
    """

    kind: Kind
    path: Path
    renderer: Renderer

    def clip(self, buffers: Buffers, window: int, overlap: Overlap = "anchor") -> np.ndarray:
        """Its pictures of a clip, (K, H, W, 3) display float32 in [0, 1], as `render_clip` gives them."""
        from tron.neural.renderer import render_clip

        displayed = {name: buffers.displayed(name) for name in self.renderer.config.guidance}
        return render_clip(self.renderer, displayed, window, overlap, motion=buffers.motion)

    def show(self, window: int) -> Show:
        """The network as a method that is given ``window`` frames a pass."""
        return lambda buffers: self.clip(buffers, window)


def find_weights(given: str) -> Path:
    """The file that a path or a shipped name stands for.

    Raises:
        TronError: there is no such file, and nothing of that name is shipped.
    """
    path = checkpoint_file(given)
    if not path.is_file():
        known = ", ".join(SHIPPED)
        raise TronError("weights not found", path, f"give a file that tron-train wrote, or one of {known}")
    return path.absolute()


def load_networks(weights: Mapping[Kind, Path]) -> dict[Kind, Network]:
    """Read checkpoints; torch is imported here and not before.

    Raises:
        TronError: a file holds no renderer, or one that does not see what its kind says.
    """
    from tron.neural.weights import load_renderer

    found: dict[Kind, Network] = {}
    for kind, path in weights.items():
        renderer = load_renderer(path)
        guidance = renderer.config.guidance
        if ("lit" in guidance) != (kind == "lit"):
            raise TronError(
                f"the checkpoint sees {', '.join(guidance)}",
                path,
                f"give it as benchmark.{'pair' if kind == 'lit' else 'lit'}",
            )
        found[kind] = Network(kind, path, renderer)
    return found
