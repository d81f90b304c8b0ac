"""Gains that tron-relight's checkpoint=auto goes by: of which clips, and how sure they are."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.relighting.baselines import DENOISED
from eval.relighting.buffers import Buffers
from eval.relighting.networks import Network
from eval.renderer import validation
from eval.renderer.validation import validation_rows
from tron.metrics import PSNR_CAP
from tron.shards.schema import Clip

CLOSER = {"s000000": 0.5, "s000001": 0.1, "s000002": 0.25}
"""Scene -> share of lit's error that the network leaves; half of it is 6 dB."""


def half_way(clip: Clip) -> np.ndarray:
    return (clip.displayed("rgb") + clip.displayed("lit")) / 2


def test_each_quality_is_judged_by_its_own_clips_over_lit(
    drawn_clip: Callable[..., Clip], monkeypatch: pytest.MonkeyPatch
):
    clips = []
    for seed in range(3):
        for quality in ("preview", "final"):
            clip = drawn_clip(seed=seed, frames=1)
            clip.meta.extra["sub_pixels"] = 2 if quality == "final" else 1
            clip.meta.spp["reflections"] = 4 if quality == "final" else 0
            clips.append(clip)
    by_lit = {id(clip.frames["pbr"]): clip for clip in clips}

    def show(self: Network, buffers: Buffers) -> np.ndarray:
        """lit, nearer to the truth in preview; lit itself in final."""
        clip, lit = by_lit[id(buffers["pbr"])], buffers.displayed("lit")
        left = 1.0 if clip.meta.extra["sub_pixels"] > 1 else CLOSER[clip.meta.scene]
        return clip.displayed("rgb") + left * (lit - clip.displayed("rgb"))

    monkeypatch.setattr(validation, "read_clips", lambda *_: iter(clips))
    monkeypatch.setattr(Network, "show", show)
    oidn = replace(DENOISED["oidn"], show=lambda buffers: half_way(by_lit[id(buffers["pbr"])]))
    monkeypatch.setattr(validation, "DENOISED", {"oidn": oidn})
    monkeypatch.setattr(validation, "BASELINES", (oidn,))
    network = Network(Path("none"), None)  # type: ignore[arg-type]
    rows = {row.metric: row for row in validation_rows(Path("none"), "test", network, 512, 0)}
    decibels = [-20 * np.log10(left) for left in CLOSER.values()]
    start = "renderer.validation"
    assert rows[f"{start}.preview_gain_db.512"].value == pytest.approx(np.mean(decibels), abs=1e-3)
    low = rows[f"{start}.preview_gain_db.512"].low
    assert low is not None
    assert min(decibels) - 1e-3 <= low < np.mean(decibels), "three scenes: hardly above the worst"
    assert rows[f"{start}.final_gain_db.512"].value == pytest.approx(0, abs=1e-6)
    for quality in ("preview", "final"):
        assert rows[f"{start}.{quality}_oidn_gain_db.512"].value == pytest.approx(20 * np.log10(2), abs=1e-3)
        assert rows[f"{start}.{quality}_identity_psnr.512"].value == PSNR_CAP, "what is right passes"
    assert all(row.n == 3 for row in rows.values()), "a clip is of one quality"
