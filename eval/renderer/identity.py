"""Identity error of a network: its PSNR when its input is the truth in place of ``lit``.

A truth of few samples has noise, and a network that removes it scores lower: of 64 samples at 128 x 128, Open
Image Denoise keeps 40 dB, 33 to 35 in the noisiest scene. The mean of several renders has less noise.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from eval.relighting.buffers import Buffers, region_mask
from eval.relighting.networks import Network
from eval.results import Row, mean_row
from tron import metrics
from tron.shards.schema import Clip

NAME = "identity_psnr"
_JUDGED = re.compile(rf"renderer\.([a-z]+_)+{NAME}\.\d+")


@dataclass
class Identity:
    """Foreground PSNR of a network's output for the truth as input.

    Attributes:
        network: network that starts from lit.
        truth: function of a clip that returns its truth, (K, H, W, 3) linear.
    """

    network: Network
    truth: Callable[[Clip], np.ndarray]
    found: list[tuple[str, float]] = field(default_factory=list, init=False)

    def add(self, clip: Clip) -> None:
        """Judge the frames of a clip; the other buffers are unchanged."""
        buffers = Buffers({**clip.frames, "lit": self.truth(clip)}, clip.meta.exposure)
        shown, right = self.network.show(buffers), buffers.displayed("lit")
        for image, truth, inside in zip(shown, right, region_mask(clip, "foreground")):
            if inside.any():
                self.found.append((clip.meta.scene, metrics.capped_psnr(image, truth, inside)))

    def rows(self, start: str, tail: str, seed: int) -> list[Row]:
        """Return rows of the mean over frames, dB; none if nothing was judged.

        ``start`` is the prefix of the figure's name, ``tail`` the suffix; ``seed`` draws the intervals'
        scenes.
        """
        return [mean_row(f"{start}{NAME}{tail}", "dB", self.found, seed)] if self.found else []


def least_identity(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield the least figure over all sizes and qualities: ``renderer.identity_psnr``.

    Validation is left out: its truths are single renders.
    """
    found = [row for row in rows if _JUDGED.fullmatch(row.metric)]
    if found:
        least = min(found, key=lambda row: row.value)
        yield least.model_copy(update={"metric": f"renderer.{NAME}"})
