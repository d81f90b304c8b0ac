"""Errors of the surfels and their irradiance against the path tracer, before any network.

A leaking tracer would make a network look good, so its errors are reported beside the network's gain.
Irradiance is compared with Mitsuba's direct irradiance, never through the final image: leaks look like
bounced light.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from eval.confidence import interval, quotient, scene_sums
from eval.relighting.shadows import both_have_surface, frame_shadow_pixels, same_depth, same_normal
from eval.results import Row, mean_row
from tron import metrics
from tron.color import to_display
from tron.shards.schema import Clip

JUDGED = {"": same_depth, "_same_normal": same_normal, "_with_silhouettes": both_have_surface}
"""Tail of a row's name -> which pixels of a frame shadows are judged on."""
FRACTIONS = {"guidance.shadow_leak": (1, 0), "guidance.lit_darkened": (3, 2)}
"""Metric -> which of the counts of ShadowPixels stand above and below the line."""


@dataclass
class GuidanceScores:
    """Errors in test clips; clips without reference members are ignored.

    Attributes:
        irradiance_psnr: family of lights -> (scene, dB) of each frame.
        shadows: (key of JUDGED, family of lights) -> (scene, counts of ShadowPixels) per frame.
        base_color_psnr: (scene, dB) of each view.
        normal_error: (scene, degrees) of each view.
    """

    irradiance_psnr: defaultdict[str, list[tuple[str, float]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    shadows: defaultdict[tuple[str, str], list[tuple[str, np.ndarray]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    base_color_psnr: list[tuple[str, float]] = field(default_factory=list)
    normal_error: list[tuple[str, float]] = field(default_factory=list)
    _views: set[str] = field(default_factory=set)

    def add(self, clip: Clip) -> None:
        """Measure every frame of a clip, on the ground-truth foreground.

        Geometry does not depend on the light: a view (scene and camera) under several lights counts once for
        base color and normals.
        """
        if not clip.has_reference:
            return
        meta = clip.meta
        for k, foreground in enumerate(clip.frames["foreground"][..., 0] > 0.5):
            if not foreground.any():
                continue
            frame = {name: images[k] for name, images in clip.frames.items()}
            ours, truth = (to_display(frame[f"irradiance{of}"], meta.exposure) for of in ("", "_ref"))
            psnr = metrics.capped_psnr(ours, truth, foreground)
            self.irradiance_psnr[meta.light_family].append((meta.scene, psnr))
            for tail, judged in JUDGED.items():
                counts = np.array([pixels.sum() for pixels in frame_shadow_pixels(frame, judged(frame))])
                self.shadows[tail, meta.light_family].append((meta.scene, counts))
            view = f"{meta.scene} {sorted(meta.cameras[k].items())}"
            if view in self._views:
                continue
            self._views.add(view)
            ours, truth = (np.clip(frame[f"base_color{of}"], 0, 1) for of in ("", "_ref"))
            self.base_color_psnr.append((meta.scene, metrics.capped_psnr(ours, truth, foreground)))
            ours, truth = frame["normal"], frame["normal_ref"]
            both = foreground & (np.minimum(*(np.linalg.norm(n, axis=-1) for n in (ours, truth))) > 0.5)
            if both.any():
                self.normal_error.append((meta.scene, metrics.angular_error_deg(ours, truth, both)))

    def rows(self, seed: int = 0) -> list[Row]:
        """Return rows ``guidance.*`` (all lights, and ``.FAMILY``) and ``surfels.*`` of what was measured.

        ``guidance.irradiance_psnr`` is the lowest of the light families' means over frames. The two fractions
        are over the pixels of all frames together, because a frame may have hardly any shadow. Pixels are
        judged where surfels and truth show the same surface by distance; ``_same_normal`` decides by normals,
        and ``_with_silhouettes`` also judges pixels with different surfaces. ``seed`` draws the scenes of the
        intervals.
        """
        irradiance = [
            mean_row(f"guidance.irradiance_psnr.{family}", "dB", values, seed)
            for family, values in sorted(self.irradiance_psnr.items())
        ]
        rows = list(irradiance)
        if irradiance:
            lowest = min(irradiance, key=lambda row: row.value)
            rows.insert(0, lowest.model_copy(update={"metric": "guidance.irradiance_psnr"}))
        for tail in JUDGED:
            by_family = {family: self.shadows[tail, family] for family in sorted(self.irradiance_psnr)}
            rows += shadow_rows(tail, [each for counted in by_family.values() for each in counted], seed)
            for family, counted in by_family.items():
                rows += shadow_rows(f"{tail}.{family}", counted, seed)
        if self.base_color_psnr:
            rows.append(mean_row("surfels.base_color_psnr", "dB", self.base_color_psnr, seed))
        if self.normal_error:
            rows.append(mean_row("surfels.normal_mae_deg", "deg", self.normal_error, seed))
        return rows


def shadow_rows(tail: str, counted: Sequence[tuple[str, np.ndarray]], seed: int) -> Iterator[Row]:
    """Yield rows of the FRACTIONS of pixels; ``counted`` are (scene, counts of ShadowPixels) per frame."""
    counts = np.array([pixels for _, pixels in counted], float).reshape(len(counted), 4)
    of_scenes = scene_sums([scene for scene, _ in counted], counts)
    for metric, (bad, of) in FRACTIONS.items():
        per_scene = of_scenes[of_scenes[:, of] > 0][:, [bad, of]]  # without such pixels a scene says nothing
        if len(per_scene):
            value = float(quotient(per_scene.sum(0)))
            row = Row(metric=metric + tail, value=value, unit="fraction", n=len(counted))
            yield row.within(interval(per_scene, quotient, seed))
