"""Figures of comparisons of methods, with their names in rows and tables."""

from __future__ import annotations

from typing import Literal, NamedTuple

from eval.relighting.scores import METRICS


class Measure(NamedTuple):
    """Name of a figure of relit pictures in rows and tables.

    Attributes:
        name, unit, title: as of :class:`eval.relighting.scores.Metric`.
        better: the good side.
    """

    name: str
    unit: str
    title: str
    better: Literal["more", "less"]


MEASURES = (
    *(Measure(each.name, each.unit, each.title, each.better) for each in METRICS),
    Measure("lpips", "1", "LPIPS ↓", "less"),
    Measure("hdr_flip", "1", "HDR-FLIP ↓", "less"),
)
MAP_MEASURES = (
    Measure("albedo_psnr", "dB", "albedo, a factor a view and channel (TRON) ↑", "more"),
    Measure("albedo_psnr_median", "dB", "albedo, a median ratio a scene and channel (TensoIR) ↑", "more"),
    Measure("albedo_psnr_unscaled", "dB", "albedo as it is ↑", "more"),
    Measure("albedo_ssim", "1", "albedo SSIM, a factor a view ↑", "more"),
    Measure("albedo_lpips", "1", "albedo LPIPS of sRGB, a factor a view ↓", "less"),
    Measure("normal_mae_deg", "deg", "normals, mean error ↓", "less"),
    Measure("normal_median_deg", "deg", "normals, median error ↓", "less"),
)
