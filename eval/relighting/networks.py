"""Networks that are judged, and how they show a clip."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.relighting.buffers import Buffers
from tron.errors import TronError
from tron.neural.clips import Overlap
from tron.neural.shipped import SHIPPED, checkpoint_file

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer


@dataclass(frozen=True)
class Network:
    """A network that was read from a file."""

    path: Path
    renderer: Renderer

    @property
    def sees_lit(self) -> bool:
        """Whether lit is among its guidance."""
        return "lit" in self.renderer.config.guidance

    def show(self, buffers: Buffers, window: int = 1, overlap: Overlap = "anchor") -> np.ndarray:
        """Its pictures of a clip, (K, H, W, 3) display float32 in [0, 1], as `render_clip` gives them."""
        from tron.neural.renderer import render_clip

        displayed = {name: buffers.displayed(name) for name in self.renderer.config.guidance}
        return render_clip(self.renderer, displayed, window, overlap, motion=buffers.motion)


def find_weights(given: str | Path) -> Path:
    """The file that a path or a shipped name stands for.

    Raises:
        TronError: there is no such file, and nothing of that name is shipped.
    """
    path = checkpoint_file(given)
    if not path.is_file():
        mend = f"give what tron-train wrote, or one of {', '.join(SHIPPED)}"
        raise TronError("weights not found", path, mend)
    return path.absolute()


def load_networks(kind: str, given: Iterable[str | Path], vae: Path | None = None) -> dict[str, Network]:
    """Read weights; torch is imported here and not before.

    Args:
        kind: such as neural; its network that sees lit is called neural_lit.
        given: at most one of each.
        vae: the WAN 2.1 VAE, where a codec needs it.

    Raises:
        TronError: a file is missing or holds no renderer, or two are of one kind.
    """
    from tron.neural.weights import load_renderer

    networks: dict[str, Network] = {}
    for path in map(find_weights, given):
        network = Network(path, load_renderer(path, vae))
        name = f"{kind}_lit" if network.sees_lit else kind
        if name in networks:
            raise TronError(
                f"two weights of {name}, the other is {networks[name].path}", path, "give one of them"
            )
        networks[name] = network
    return networks
