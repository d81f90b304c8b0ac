"""The relit picture: what a run of tron-relight is for, made of the buffers on disk.

With a checkpoint it is the neural picture, without one `lit` (shadows, reflections, and light that bounced
between the surfels), or `shadowed` where nothing is to bounce. What stands behind the surfels is chosen:

    environment  as the buffers have it: the light itself
    transparent  RGBA, straight alpha: alpha is the mask, colours are those of the surfels alone
    [r, g, b]    one colour, in display values as a picture on the screen has them (sRGB, 0 to 1)

A colour is composited after AgX, so that an empty pixel shows it exactly; it has the background's share of
tron.shading.composition, which is none behind opaque surfels. The buffer `share` holds it: the mean over a
pixel's sub-pixels, not the share of their mean opacity. A network draws surfels and sky as one: at the rim of
the surfels its colours hold some of the light's, whatever stands behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tron.apps.frame_folder import FrameFolder
from tron.color import Look, to_display
from tron.denoising import DENOISERS

Channel = Annotated[float, Field(ge=0, le=1)]
Background = Literal["environment", "transparent"] | tuple[Channel, Channel, Channel]


@dataclass(frozen=True)
class RelitPicture:
    """Recipe of a frame's relit picture.

    Attributes:
        background: behind the surfels: "environment", "transparent" or a display colour, see above.
        source: the picture of the surfels: a network's, or a buffer of guidance.
        look: of the picture (:data:`tron.color.LOOKS`).
        denoiser: that the buffer goes through, if any (:mod:`tron.denoising`).
    """

    background: Background
    source: Literal["neural", "lit", "shadowed"]
    look: Look = "none"
    denoiser: str | None = None

    @property
    def neural(self) -> bool:
        """Whether a network draws the surfels."""
        return self.source == "neural"

    @property
    def buffers(self) -> tuple[str, ...]:
        """Buffers that a frame must have on disk for it."""
        if self.background == "environment":
            return () if self.neural else (self.source,)
        surfels = () if self.neural else ("foreground",)
        return ("mask", *surfels) if self.background == "transparent" else ("mask", "share", *surfels)

    def describe(self) -> str:
        """One line for the log."""
        made = {
            "neural": "drawn by the neural renderer",
            "lit": "light with its bounces (lit; no checkpoint)",
            "shadowed": "direct light alone (shadowed; no checkpoint)",
        }[self.source]
        made += f", through {DENOISERS[self.denoiser].title}" if self.denoiser else ""
        behind = {"environment": "over the environment", "transparent": "with alpha"}
        shown = behind.get(str(self.background)) or f"over the colour {list(self.background)}"
        return f"relit pictures: {made}, {shown}"

    def display(
        self, folder: FrameFolder, index: int, exposure: float, neural: np.ndarray | None = None
    ) -> np.ndarray:
        """Display values of frame ``index``, (H, W, 3), or (H, W, 4) with straight alpha where transparent.

        Args:
            folder: frames with ``buffers``.
            exposure: factor before AgX.
            neural: radiance (H, W, 3) that the network's picture stands for, if it is the source.
        """
        linear = neural
        if linear is None:
            linear = folder.read(index, self.source if self.background == "environment" else "foreground")
        surfels = to_display(linear, exposure, look=self.look)
        if self.background == "environment":
            return surfels
        if self.background == "transparent":
            return np.concatenate([surfels, folder.read(index, "mask")[..., :1]], axis=2)
        return composite(surfels, self.background, folder.read(index, "share")[..., :1])

    def linear(self, folder: FrameFolder, index: int) -> np.ndarray:
        """Radiance of frame ``index`` before exposure.

        In front of the environment (H, W, 3). Otherwise (H, W, 4), multiplied by alpha, the mask, as OpenEXR
        has it; so too for a colour, which has no radiance.
        """
        if self.background == "environment":
            return folder.read(index, self.source)
        mask = folder.read(index, "mask")[..., :1]
        return np.concatenate([folder.read(index, "foreground") * mask, mask], axis=2)


def composite(surfels: np.ndarray, color: Sequence[float], share: np.ndarray) -> np.ndarray:
    """Display values (H, W, 3) of surfels over one colour, which has the weight ``share`` (H, W, 1)."""
    return (1 - share) * surfels + share * np.asarray(color, np.float32)


def surfels_alone(over_black: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Radiance (H, W, 3) of surfels without what is behind them, 0 where there are none.

    Args:
        over_black: their radiance in front of black.
        share: (H, W) weight of what is behind them.
    """
    weight = 1 - share[..., None]
    return np.divide(over_black, weight, out=np.zeros_like(over_black), where=weight > 0)
