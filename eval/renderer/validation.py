"""Gains over ``lit`` on validation scenes, from which tron-relight's ``checkpoint=auto`` chooses.

They are measured by size and quality, on scenes outside all other figures of the benchmark, and are copied
to :mod:`tron.neural.network_gains`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from eval.relighting.baselines import BASELINES, DENOISED
from eval.relighting.buffers import MEMBERS, Buffers, region_mask
from eval.relighting.fits import Show
from eval.relighting.networks import Network
from eval.renderer.identity import Identity
from eval.results import Row, mean_row
from tron import metrics
from tron.neural.network_gains import quality_of
from tron.shards.reader import read_clips
from tron.shards.schema import TARGET


def validation_rows(dataset: Path, split: str, network: Network, size: int, seed: int) -> Iterator[Row]:
    """Yield mean foreground gains over lit for each quality, dB, and identity errors.

    Rows are for a network (``QUALITY_gain_db``) and for each installed denoiser that needs only guidance
    (``QUALITY_oidn_gain_db``). checkpoint=auto uses the lower ends of their intervals. ``seed`` draws the
    scenes of the intervals.
    """
    ways: dict[str, Show] = {"": network.show}
    for name, each in DENOISED.items():
        if each in BASELINES and each.show is not None and each.needs is None:
            ways[f"{name}_"] = each.show
    found: dict[tuple[str, str], list[tuple[str, float]]] = defaultdict(list)
    kept: dict[str, Identity] = {}
    for clip in read_clips(dataset, split, MEMBERS):
        quality = quality_of(clip.meta.extra["sub_pixels"], clip.meta.spp.get("reflections", 0))
        buffers, truth = Buffers.of(clip), clip.displayed(TARGET)
        shown, masks = buffers.displayed("lit"), region_mask(clip, "foreground")
        for way, show in ways.items():
            for ours, lit, right, inside in zip(show(buffers), shown, truth, masks):
                if inside.any():
                    first, second = (metrics.capped_psnr(each, right, inside) for each in (ours, lit))
                    found[quality, way].append((clip.meta.scene, first - second))
        kept.setdefault(quality, Identity(network, lambda clip: clip.frames[TARGET])).add(clip)
    for (quality, way), gains in sorted(found.items()):
        yield mean_row(f"renderer.validation.{quality}_{way}gain_db.{size}", "dB", gains, seed)
    for quality, identity in sorted(kept.items()):
        yield from identity.rows(f"renderer.validation.{quality}_", f".{size}", seed)
