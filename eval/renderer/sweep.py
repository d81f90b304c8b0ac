"""The 5 x 5 sweep of the pair's latent weights, as a sheet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.relighting.buffers import MEMBERS, Buffers
from eval.renderer.networks import Network
from eval.renderer.pictures import enlarge
from eval.report.strips import write_strips
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Picture, Pictures, Section
from tron.shards.reader import read_clips

WIDTH = 128
"""Least width of a picture on the page, pixels."""


@dataclass(frozen=True)
class Sweep:
    """Findings.

    Attributes:
        images: (5, 5, H, W, 3) displays, the weight of pbr down and that of irradiance across.
        values: the weights.
        given: the network's buffers and the truth, by what they are called: (H, W, 3) displays.
        clip: of which scene under which light.
    """

    images: np.ndarray
    values: tuple[float, ...]
    given: dict[str, np.ndarray]
    clip: str

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """None: it is looked at."""
        yield from ()

    def sections(self, pictures: Path) -> list[Section]:
        """The sheet."""
        count = len(self.values)
        scale = -(-WIDTH // self.images.shape[3])
        shown = [
            Picture(
                enlarge(self.images[i, j], scale),
                f"w_pbr {self.values[i]:g}, w_irr {self.values[j]:g}",
                f"latents weighted {self.values[i]:g} and {self.values[j]:g}, {self.clip}",
                strong=self.values[i] == self.values[j] == 0.5,
            )
            for i in range(count)
            for j in range(count)
        ]
        note = (
            "Framed: the weights of the paper and of the training. At 0, 0 the network sees nothing; what it "
            "draws is added to filtered pbr, whatever the weights."
        )
        beside = Pictures(
            "What it is given, and the truth",
            [
                Picture(enlarge(image, scale), name, f"{name}, {self.clip}")
                for name, image in self.given.items()
            ],
            f"A colour over all is the light's: {self.clip}.",
            columns=count,
        )
        group = Pictures("Weights of the two latents", shown, note, columns=count)
        write_strips([group], ["renderer-sweep"], pictures)
        return [Section("sweep", "Trading pbr against irradiance", [beside, group])]


def measure_sweep(dataset: Path, split: str, pair: Network) -> Sweep:
    """The first frame of the first clip under all weights.

    Raises:
        TronError: the network takes no weights, or not both buffers.
    """
    from tron.neural.renderer import NeuralRenderer
    from tron.neural.sweep import SWEEP, weight_sweep

    if not isinstance(pair.renderer, NeuralRenderer):
        raise TronError("only neural renderers weight their buffers", pair.path)
    clip = next(iter(read_clips(dataset, split, MEMBERS)))
    buffers = Buffers.of(clip)
    displayed = {name: buffers.displayed(name)[:1] for name in pair.renderer.config.guidance}
    given = {name: buffers.displayed(name)[0] for name in displayed} | {
        "path tracer": clip.displayed("rgb")[0]
    }
    described = f"scene {clip.meta.scene}, {clip.meta.light_family} light"
    return Sweep(weight_sweep(pair.renderer, displayed), SWEEP, given, described)
