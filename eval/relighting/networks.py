"""Networks to judge, and their rendering of a clip."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.relighting.buffers import Buffers
from tron.cameras import Camera
from tron.errors import TronError
from tron.flow import surface_motion
from tron.neural.clips import Overlap
from tron.neural.shipped import SHIPPED, checkpoint_file
from tron.runtime import torch_device
from tron.shards.schema import displayed

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer
    from tron.relighting import Illumination


@dataclass(frozen=True)
class Network:
    """A network read from a file."""

    path: Path
    renderer: Renderer

    @property
    def sees_lit(self) -> bool:
        """Whether lit is among its guidance."""
        return "lit" in self.renderer.config.guidance

    def show(self, buffers: Buffers, window: int = 1, overlap: Overlap = "anchor") -> np.ndarray:
        """Render a clip, (K, H, W, 3) display float32 in [0, 1], by `render_clip`."""
        from tron.neural.renderer import render_clip

        displayed = {name: buffers.displayed(name) for name in self.renderer.config.guidance}
        return render_clip(self.renderer, displayed, window, overlap, motion=buffers.motion)


def find_weights(given: str | Path) -> Path:
    """Return the file of a path or a shipped name.

    Raises:
        TronError: there is no such file, and no shipped checkpoint of that name.
    """
    path = checkpoint_file(given)
    if not path.is_file():
        mend = f"give what tron-train wrote, or one of {', '.join(SHIPPED)}"
        raise TronError("weights not found", path, mend)
    return path.absolute()


def load_networks(kind: str, given: Iterable[str | Path], vae: Path | None = None) -> dict[str, Network]:
    """Read weights onto the device of the active Mitsuba variant; torch is imported here and not before.

    Args:
        kind: such as neural; its network with lit as guidance is called neural_lit.
        given: files or names, at most one with lit and one without.
        vae: file of the WAN 2.1 VAE, if a codec needs it.

    Raises:
        TronError: a file is missing or holds no renderer, or two are of one kind.
    """
    from tron.neural.weights import load_renderer

    networks: dict[str, Network] = {}
    for path in map(find_weights, given):
        network = Network(path, load_renderer(path, vae).to(torch_device()))
        name = f"{kind}_lit" if network.sees_lit else kind
        if name in networks:
            raise TronError(
                f"two weights of {name}, the other is {networks[name].path}", path, "give one of them"
            )
        networks[name] = network
    return networks


@dataclass(frozen=True)
class Guided:
    """Inputs of a network from a lit scene: (K, H, W, 3) display values by name, and distances (H, W)."""

    displayed: dict[str, np.ndarray]
    depths: list[np.ndarray]


def guided(
    network: Network, light: Illumination, cameras: Sequence[Camera], exposure: float, seed: int
) -> Guided:
    """Trace the inputs of a network for some frames."""
    names, depths, frames = network.renderer.config.guidance, [], []
    for camera in cameras:
        guidance = light.render(camera, seed)
        depths.append(guidance.gbuffer["depth"])
        made = dict(vars(guidance))
        if any(name not in made for name in names):
            made |= light.relighter.surface_maps(camera, light.estimation)[0]
        frames.append({name: displayed(name, made[name], exposure) for name in names})
    return Guided({name: np.stack([frame[name] for frame in frames]) for name in names}, depths)


def drawn(
    network: Network, light: Illumination, cameras: Sequence[Camera], exposure: float, seed: int
) -> np.ndarray:
    """Render a lit scene by a network, (K, H, W, 3) display values; several are averaged along motion."""
    from tron.neural.renderer import render_clip

    given = guided(network, light, cameras, exposure, seed)
    motion = surface_motion(cameras, given.depths.__getitem__) if len(cameras) > 1 else None
    return render_clip(network.renderer, given.displayed, len(cameras), motion=motion)
