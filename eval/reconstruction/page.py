"""The reconstruction benchmark in words, tables, charts and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

from eval.reconstruction.measured import Measured, Part
from eval.reconstruction.page_fox import fox_section
from eval.reconstruction.page_relit import relit_section, splats_section
from eval.reconstruction.page_scenes import light_section, scenes_section, views_section
from eval.reconstruction.page_steps import steps_section
from eval.report.figures import with_interval
from eval.report.outcome import Outcome
from eval.report.stage_table import stage_section
from eval.results import Row
from tron.report.page import Section, Text

LEAD = (
    "A photo shows a thing in the light of that day. To show it in another light one must know what it is "
    "made of. TRON takes photos from several sides, finds small flat disks (surfels) that together look "
    "like the photos, asks a prior what the base color, roughness and metallic of their surfaces are, and "
    "finds the light that explains the photos.",
    "This page measures that on path-traced scenes, where the truth is known to the last pixel, and on a "
    "real fox photographed with a phone. Every reconstruction is a run of the command tron-reconstruct, as "
    "a user would type it; every eighth view is held out, and the figures are those of held-out views "
    "unless they say otherwise.",
)
STEP_RATIOS = ("step.ratio_to_volprim.degree2", "step.ratio_to_volprim.degree4")
HEADLINE = {
    "reconstruction.test_psnr": "Held-out views, from random points",
    "reconstruction.depth_init.test_psnr": "Held-out views, from depth maps",
    "reconstruction.base_color_psnr": "Base color, true prior",
    "reconstruction.normal_mae_deg": "Normals, true prior",
    "reconstruction.seconds": "Slowest path-traced scene",
    "reconstruction.photos.relight_psnr": "Photographs without a prior, relit",
    "reconstruction.relight_psnr": "True priors, relit: the ceiling",
    "reconstruction.photos.normal_mae_deg": "Photographs without a prior, normals",
    "reconstruction.photos.test_psnr": "Photographs without a prior, held-out views",
    "splats.relight_psnr": "A plain 3DGS file, relit",
    "fox.test_psnr": "The fox, held-out photos",
    "fox.seconds": "The fox, from photos to surfels and light",
    "step.ratio_to_volprim.degree2": "A step: times as fast as with Mitsuba's volprim, its own kernel",
    "step.ratio_to_volprim.degree4": "A step: times as fast as with Mitsuba's volprim, our kernel",
}


def outcome(measured: Measured, output_dir: Path) -> Outcome:
    """Rows and sections of a run."""
    settings, rows = measured.settings, list(measured.rows())
    found = {row.metric: row for row in rows}
    sections = [
        *scenes_section(measured, found),
        *views_section(measured),
        *light_section(measured),
        *relit_section(measured, found),
        *splats_section(measured, found),
        *fox_section(measured, found),
        *steps_section(measured),
        _limits(measured),
        *stage_section(measured.stages.records),
    ]
    return Outcome(
        rows=rows,
        title="Reconstruction: from photos to relightable surfels",
        verdict=_verdict(found),
        lead=LEAD,
        sections=sections,
        headline=HEADLINE,
        reproduce=[settings.command_line(output_dir)],
        inputs={"settings": settings.model_dump(mode="json", exclude={"targets"})},
    )


def _verdict(found: Mapping[str, Row]) -> str:
    texts = {metric: with_interval(row) for metric, row in found.items()}
    parts = []
    if "reconstruction.test_psnr" in found:
        parts.append(
            f"From random points, path-traced scenes reach {texts['reconstruction.test_psnr']} on held-out "
            f"views, in at most {texts['reconstruction.seconds']} a scene."
        )
    if "reconstruction.photos.relight_psnr" in found:
        parts.append(
            "Photographs with drift and noise, without any prior, become surfels that under two other lights "
            f"lie {texts['reconstruction.photos.relight_psnr']} from the path tracer."
        )
    if "fox.test_psnr" in found:
        parts.append(f"The photographed fox reaches {texts['fox.test_psnr']} after {texts['fox.seconds']}.")
    ratios = [found[name].value for name in STEP_RATIOS if name in found]
    if len(ratios) == len(STEP_RATIOS):
        parts.append(
            f"An optimisation step is {ratios[0]:.1f} times as fast as the same step with Mitsuba's volprim "
            f"where both have its kernel, and {ratios[1]:.1f} times where both have ours."
        )
    return " ".join(parts) or "Only some parts were run."


def _limits(measured: Measured) -> Section:
    texts = [
        "The path-traced scenes are small, made of a few procedural objects on a floor, with poses and masks "
        "that are exact and without blur; exposure, white balance and noise are those of a camera in the "
        "photographs alone. For all that real captures add, the fox stands alone.",
        "The true prior is a teacher that no photograph comes with: figures under it say what the method can "
        "do with perfect normals and materials, not what a user gets. The classical prior is what needs no "
        "weights; it guesses one roughness and metallic for everything and cannot tell paint from shade.",
        "Base color is scored after one factor a view and channel, as the TRON paper does, because photos "
        "alone do not tell bright paint in dim light from dim paint in bright light.",
        "The fox's materials, normals and light have no truth to be held against; its relit pictures are to "
        "be looked at, and show shading without the neural renderer.",
    ]
    if measured.steps:
        texts.append(
            "The peer of the steps composites radiance alone, of flat ellipsoids that it sees from both "
            "sides; TRON composites normals, materials and depth as well, and skips back faces, with which "
            "the surfels were trained. No settings of either make the work exactly equal; the two pictures' "
            "PSNR beside the times says how alike they are."
        )
    parts = measured.settings.parts
    if not all(part in parts for part in get_args(Part)):
        texts.append(f"Only these parts were run: {', '.join(parts)}.")
    return Section("limits", "What these figures do not say", [Text(text) for text in texts])
