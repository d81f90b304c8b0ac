"""What tron-relight's ``checkpoint=auto`` goes by: gains over ``lit`` on validation scenes.

They are measured by size and quality, on scenes by which no figure of the benchmark is judged, and stand in
:mod:`tron.neural.network_gains`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from eval.relighting.buffers import MEMBERS, Buffers, region_mask
from eval.relighting.networks import Network
from eval.results import Row, mean_row
from tron import metrics
from tron.neural.network_gains import quality_of
from tron.shards.reader import read_clips
from tron.shards.schema import TARGET


def validation_rows(dataset: Path, split: str, network: Network, size: int, seed: int) -> Iterator[Row]:
    """Mean gain of a network over lit of the clips of each quality, foreground, dB.

    checkpoint=auto goes by the lower end of its interval. ``seed`` draws the scenes of that.
    """
    found: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for clip in read_clips(dataset, split, MEMBERS):
        quality = quality_of(clip.meta.extra["sub_pixels"], clip.meta.spp.get("reflections", 0))
        buffers, truth = Buffers.of(clip), clip.displayed(TARGET)
        shown = network.show(buffers), buffers.displayed("lit")
        for number, inside in enumerate(region_mask(clip, "foreground")):
            if inside.any():
                ours, lit = (metrics.capped_psnr(each[number], truth[number], inside) for each in shown)
                found[quality].append((clip.meta.scene, ours - lit))
    for quality, gains in sorted(found.items()):
        yield mean_row(f"renderer.validation.{quality}_gain_db.{size}", "dB", gains, seed)
