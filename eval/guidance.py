"""How good the surfels and their irradiance are, before any network: measured against the path tracer.

A tracer that leaks would make a network look good, so its errors are quoted beside the network's gain.
Irradiance is judged against Mitsuba's direct irradiance, never through the final image: leaks fake bounce
light.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np

from eval.results import Row
from eval.scores import PSNR_CAP
from eval.shadows import MEMBERS as SHADOW_MEMBERS
from eval.shadows import (
    ShadowCounts,
    both_have_surface,
    count_shadow_errors,
    direct_light,
    same_depth,
    same_normal,
)
from tron import metrics
from tron.color import to_display
from tron.shards.schema import Clip

log = logging.getLogger("tron.eval")

JUDGED = {"": same_depth, "_same_normal": same_normal, "_with_silhouettes": both_have_surface}
"""Tail of a row's name -> which pixels of a frame shadows are judged on."""


@dataclass
class GuidanceScores:
    """Gathers the measurements of test clips; a clip without the reference members adds nothing."""

    irradiance_psnr: dict[str, list[float]] = field(default_factory=dict)
    shadows: dict[str, dict[str, list[ShadowCounts]]] = field(
        default_factory=lambda: {tail: {} for tail in JUDGED}
    )
    base_color_psnr: list[float] = field(default_factory=list)
    normal_error: list[float] = field(default_factory=list)
    _views: set[str] = field(default_factory=set)
    _told: bool = False

    def add(self, clip: Clip) -> None:
        """Measure every frame of a clip, on the ground-truth foreground.

        Geometry does not depend on the light: a view (scene and camera) seen under several lights counts
        once for base color and normals.
        """
        frames, meta = clip.frames, clip.meta
        for k, foreground in enumerate(frames["foreground"][..., 0] > 0.5):
            if not foreground.any():
                continue
            if "irr_ref" in frames:
                shown, truth = (to_display(frames[name][k], meta.exposure) for name in ("irr", "irr_ref"))
                psnr = min(metrics.psnr(shown, truth, foreground), PSNR_CAP)
                self.irradiance_psnr.setdefault(meta.light_family, []).append(psnr)
                self._count_shadows(clip, k)
            view = f"{meta.scene} {sorted(meta.cameras[k].items())}"
            if view in self._views:
                continue
            self._views.add(view)
            if {"base_color", "base_color_ref"} <= frames.keys():
                ours, truth = (np.clip(frames[name][k], 0, 1) for name in ("base_color", "base_color_ref"))
                self.base_color_psnr.append(min(metrics.psnr(ours, truth, foreground), PSNR_CAP))
            if {"normal", "normal_ref"} <= frames.keys():
                ours, truth = frames["normal"][k], frames["normal_ref"][k]
                lengths = np.minimum(*(np.linalg.norm(n, axis=-1) for n in (ours, truth)))
                both = foreground & (lengths > 0.5)
                if both.any():
                    self.normal_error.append(float(metrics.angular_error_deg(ours, truth, both)))

    def _count_shadows(self, clip: Clip, k: int) -> None:
        missing = [name for name in SHADOW_MEMBERS if name not in clip.frames]
        if missing:
            if not self._told:
                log.warning(
                    "no shadow figures: clips of this dataset lack %s; make it again with this tron-datagen",
                    ", ".join(missing),
                )
            self._told = True
            return
        frame = {name: images[k] for name, images in clip.frames.items()}
        for tail, judged in JUDGED.items():
            counts = count_shadow_errors(frame["irr"], direct_light(frame), judged(frame))
            self.shadows[tail].setdefault(clip.meta.light_family, []).append(counts)

    def rows(self) -> list[Row]:
        """``guidance.*`` (all lights, and ``.FAMILY``) and ``surfels.*``; what was not measured has no row.

        ``guidance.irradiance_psnr`` is the lowest of the light families' means over frames; the two
        fractions are taken over the pixels of all frames together, for a frame may hold hardly any shadow.
        They are judged where surfels and truth show the same surface by its distance; ``_same_normal`` goes
        by its normal, and ``_with_silhouettes`` also judges pixels where they show different surfaces.
        """
        rows: list[Row] = []
        if self.irradiance_psnr:
            means = {
                family: float(np.mean(values)) for family, values in sorted(self.irradiance_psnr.items())
            }
            lowest = min(means, key=lambda family: means[family])
            for name, family in (("", lowest), *((f".{family}", family) for family in means)):
                n = len(self.irradiance_psnr[family])
                rows.append(
                    Row(metric=f"guidance.irradiance_psnr{name}", value=means[family], unit="dB", n=n)
                )
            for tail, by_family in self.shadows.items():
                rows += _fractions(tail, [counts for family in by_family.values() for counts in family])
                for family in means:
                    rows += _fractions(f"{tail}.{family}", by_family.get(family, []))
        for metric, values, unit in (
            ("surfels.base_color_psnr", self.base_color_psnr, "dB"),
            ("surfels.normal_mae_deg", self.normal_error, "deg"),
        ):
            if values:
                rows.append(Row(metric=metric, value=float(np.mean(values)), unit=unit, n=len(values)))
        return rows


def _fractions(tail: str, counts: list[ShadowCounts]) -> list[Row]:
    rows = []
    for metric, bad, of in (
        ("guidance.shadow_leak", "leaking", "shadowed"),
        ("guidance.lit_darkened", "darkened", "lit"),
    ):
        total = sum(getattr(c, of) for c in counts)
        if total:
            value = sum(getattr(c, bad) for c in counts) / total
            rows.append(Row(metric=metric + tail, value=value, unit="fraction", n=len(counts)))
    return rows
