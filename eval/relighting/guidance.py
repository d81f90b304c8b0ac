"""Quality of the surfels and their irradiance, before any network: measured against the path tracer.

A tracer that leaks would make a network look good, so its errors are quoted beside the network's gain.
Irradiance is judged against Mitsuba's direct irradiance, never through the final image: leaks fake bounce
light.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from eval.confidence import interval, quotient, scene_sums
from eval.relighting.shadows import (
    ShadowCounts,
    both_have_surface,
    count_shadow_errors,
    direct_light,
    same_depth,
    same_normal,
)
from eval.results import Row, mean_row
from tron import metrics
from tron.color import to_display
from tron.shards.schema import Clip

JUDGED = {"": same_depth, "_same_normal": same_normal, "_with_silhouettes": both_have_surface}
"""Tail of a row's name -> which pixels of a frame shadows are judged on."""


@dataclass
class GuidanceScores:
    """Measurements of test clips; a clip without the reference members adds nothing.

    Attributes:
        irradiance_psnr: family of lights -> (scene, dB) of each frame.
        shadows: key of JUDGED -> family of lights -> (scene, pixels) of each frame.
        base_color_psnr: (scene, dB) of each view.
        normal_error: (scene, degrees) of each view.
    """

    irradiance_psnr: dict[str, list[tuple[str, float]]] = field(default_factory=dict)
    shadows: dict[str, dict[str, list[tuple[str, ShadowCounts]]]] = field(
        default_factory=lambda: {tail: {} for tail in JUDGED}
    )
    base_color_psnr: list[tuple[str, float]] = field(default_factory=list)
    normal_error: list[tuple[str, float]] = field(default_factory=list)
    _views: set[str] = field(default_factory=set)

    def add(self, clip: Clip) -> None:
        """Measure every frame of a clip, on the ground-truth foreground.

        Geometry does not depend on the light: a view (scene and camera) seen under several lights counts
        once for base color and normals.
        """
        if not clip.has_reference:
            return
        frames, meta = clip.frames, clip.meta
        for k, foreground in enumerate(frames["foreground"][..., 0] > 0.5):
            if not foreground.any():
                continue
            shown, truth = (
                to_display(frames[name][k], meta.exposure) for name in ("irradiance", "irradiance_ref")
            )
            psnr = metrics.capped_psnr(shown, truth, foreground)
            self.irradiance_psnr.setdefault(meta.light_family, []).append((meta.scene, psnr))
            self._count_shadows(clip, k)
            view = f"{meta.scene} {sorted(meta.cameras[k].items())}"
            if view in self._views:
                continue
            self._views.add(view)
            ours, truth = (np.clip(frames[name][k], 0, 1) for name in ("base_color", "base_color_ref"))
            psnr = metrics.capped_psnr(ours, truth, foreground)
            self.base_color_psnr.append((meta.scene, psnr))
            ours, truth = frames["normal"][k], frames["normal_ref"][k]
            lengths = np.minimum(*(np.linalg.norm(n, axis=-1) for n in (ours, truth)))
            both = foreground & (lengths > 0.5)
            if both.any():
                error = float(metrics.angular_error_deg(ours, truth, both))
                self.normal_error.append((meta.scene, error))

    def _count_shadows(self, clip: Clip, k: int) -> None:
        frame = {name: images[k] for name, images in clip.frames.items()}
        for tail, judged in JUDGED.items():
            counts = count_shadow_errors(frame["irradiance"], direct_light(frame), judged(frame))
            self.shadows[tail].setdefault(clip.meta.light_family, []).append((clip.meta.scene, counts))

    def rows(self, seed: int = 0) -> list[Row]:
        """``guidance.*`` (all lights, and ``.FAMILY``) and ``surfels.*``; what was not measured has no row.

        ``guidance.irradiance_psnr`` is the lowest of the light families' means over frames; the two
        fractions are taken over the pixels of all frames together, for a frame may hold hardly any shadow.
        They are judged where surfels and truth show the same surface by its distance; ``_same_normal`` goes
        by its normal, and ``_with_silhouettes`` also judges pixels where they show different surfaces.
        ``seed`` draws the scenes of the intervals.
        """
        rows: list[Row] = []
        if self.irradiance_psnr:
            by_family = {
                family: mean_row(f"guidance.irradiance_psnr.{family}", "dB", values, seed)
                for family, values in sorted(self.irradiance_psnr.items())
            }
            lowest = min(by_family.values(), key=lambda row: row.value)
            rows.append(lowest.model_copy(update={"metric": "guidance.irradiance_psnr"}))
            rows += by_family.values()
            for tail, counted in self.shadows.items():
                rows += _fractions(tail, [counts for family in counted.values() for counts in family], seed)
                for family in by_family:
                    rows += _fractions(f"{tail}.{family}", counted.get(family, []), seed)
        for metric, values, unit in (
            ("surfels.base_color_psnr", self.base_color_psnr, "dB"),
            ("surfels.normal_mae_deg", self.normal_error, "deg"),
        ):
            if values:
                rows.append(mean_row(metric, unit, values, seed))
        return rows


def _fractions(tail: str, counted: list[tuple[str, ShadowCounts]], seed: int) -> list[Row]:
    rows = []
    for metric, bad, of in (
        ("guidance.shadow_leak", "leaking", "shadowed"),
        ("guidance.lit_darkened", "darkened", "lit"),
    ):
        pixels = np.array([[getattr(counts, bad), getattr(counts, of)] for _, counts in counted], float)
        pixels = pixels.reshape(len(counted), 2)  # of no frames at all too
        per_scene = scene_sums([scene for scene, _ in counted], pixels)
        per_scene = per_scene[per_scene[:, 1] > 0]  # a scene without such pixels says nothing about them
        if len(per_scene):
            value = float(quotient(per_scene.sum(0)))
            row = Row(metric=metric + tail, value=value, unit="fraction", n=len(counted))
            rows.append(row.within(interval(per_scene, quotient, seed)))
    return rows
