"""The tracing benchmark in words, tables, charts and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from eval.report.figures import row_cell
from eval.report.outcome import Outcome
from eval.results import Row
from eval.tracing.measured import Measured
from eval.tracing.page_bounce import bounce_section, equal_error_section
from eval.tracing.page_light import few_rays_section, irradiance_section, noise_section
from eval.tracing.page_rays import (
    camera_section,
    family,
    gradient_section,
    growth_section,
    inside_section,
    shadow_section,
)
from tron.report.page import Section, Table, Text

LEAD = (
    "TRON holds a captured scene as surfels: small flat disks whose opacity falls off like a Gaussian, with "
    "a normal and a material. To relight it, rays must pass through these half-transparent disks: camera "
    "rays, which need every disk on the way in order of distance, and shadow rays, which only need the "
    "product of what each lets through. To fit the disks to photographs, the camera rays must be "
    "differentiated.",
    "This page measures TRON's tracer on one scene, a floor with spheres, a torus and a box covered by "
    "surfels, and on the same things with the camera among them, beside what a user of Mitsuba would pick "
    "instead. Everyone runs in turns, in one process, on the same machine; every figure is a median over the "
    "rounds (times.json beside this page has them all). "
    "TRON's preparations (lists of surfels for each tile of the image, the hierarchy for shadow rays) are "
    "counted in its times; the peers' hierarchies are not in theirs.",
)
HEADLINE = {
    "primary.ratio_to_volprim": "Camera rays: times as fast as Mitsuba's volprim",
    "shadow.ratio_to_embree_restart": "Shadow rays: times as fast as restarts on Embree",
    "gradient.ratio_to_volprim": "Gradient step: times as fast as Mitsuba's volprim",
    "irradiance.seconds_ratio_to_mitsuba_direct": "64-ray irradiance: times as long as Mitsuba's direct",
    "primary.max_error": "Camera rays: largest error against float64",
    "bounce.seconds_ratio_to_frame": "Bake of a light: times as long as a frame of guidance",
    "guidance.ratio_to_path_tracing": "A lit frame of tron-relight: time over path tracing's at equal error",
}


EXACTNESS = {
    "primary.max_error": "camera rays, the largest of all",
    "primary.max_error_rgb": "camera rays, radiance",
    "primary.max_error_opacity": "camera rays, opacity",
    "primary.max_error_depth": "camera rays, median depth, relative",
    "primary.rays_at_a_threshold": "camera rays left out: at a threshold",
    "primary.rays_off": "camera rays off by more than 1e-4, of all",
    "shadow.max_error": "shadow rays, transmittance",
    "shadow.rays_at_a_threshold": "shadow rays left out: at a threshold",
    "shadow.rays_off": "shadow rays off by more than 1e-4, of all",
}


def outcome(measured: Measured, output_dir: Path) -> Outcome:
    """Rows and sections of a run; pictures are also written below ``output_dir/pictures``."""
    settings, rows = measured.settings, list(measured.rows())
    found = {row.metric: row for row in rows}
    sections = [
        *camera_section(measured, output_dir),
        *inside_section(measured, output_dir),
        *growth_section(measured),
        *shadow_section(measured, found),
        *gradient_section(measured),
        *irradiance_section(measured, output_dir),
        *noise_section(measured, output_dir),
        *few_rays_section(measured, output_dir),
        *bounce_section(measured),
        *equal_error_section(measured, found),
        *_exactness(found),
        *_memory(measured),
    ]
    targets = {target.metric for target in settings.targets}
    tiles = {
        metric: label
        for name, label in HEADLINE.items()
        if (metric := next((m for m in found if m in targets and family(m) == name), None))
    }
    return Outcome(
        rows=rows,
        title="The surfel tracer against what a user would pick instead",
        verdict=_verdict(found),
        lead=LEAD,
        sections=sections,
        headline=tiles,
        reproduce=[settings.command_line(output_dir)],
        inputs={"settings": settings.model_dump(exclude={"targets"})},
    )


def _verdict(found: Mapping[str, Row]) -> str:
    parts = []
    for name, text in (
        ("primary.ratio_to_volprim", "camera rays {} times"),
        ("gradient.ratio_to_volprim", "gradient steps {} times"),
        ("shadow.ratio_to_embree_restart", "shadow rays {} times"),
    ):
        values = [row.value for metric, row in found.items() if family(metric) == name]
        if values:
            low, high = f"{min(values):.1f}", f"{max(values):.1f}"
            parts.append(text.format(low if low == high else f"{low} to {high}"))
    if not parts:
        return "Only some parts were run."
    return f"Beside Mitsuba's own tools TRON traces {', '.join(parts)} as fast."


def _exactness(found: Mapping[str, Row]) -> list[Section]:
    rows = [
        [words, row_cell(row, "strong"), str(row.n)]
        for name, words in EXACTNESS.items()
        if (row := found.get(name))
    ]
    if not rows:
        return []
    intro = Text(
        "Held against a slow float64 tracer that shares no code with the fast one, on random rays of the "
        "same view. A ray whose float64 value stands within 0.00001 of a threshold (an opacity that just "
        "counts, the end of the ray, the median) may fall on either side of it and is left out, and so is "
        "one that meets two surfels within 0.000001 of one another, which float32 cannot order."
    )
    table = Table("Largest absolute errors.", ["What", "Measured", "Rays"], rows)
    return [Section("exactness", "Exactness", [intro, table])]


def _memory(measured: Measured) -> list[Section]:
    memory, settings = measured.memory, measured.settings
    if not memory:
        return []
    text = Text(
        f"A process of its own that holds {settings.memory_surfels:,} surfels, traces one frame of "
        f"{settings.pixels[-1]}² pixels and as many shadow rays reaches a resident set of "
        f"{memory['peak']:.0f} MB. Python, Mitsuba and LLVM alone hold {memory['base']:.0f} MB, and with the "
        f"surfels made, in NumPy, before tracing, it is {memory['scene']:.0f} MB. Transport and bake of a "
        f"light add {memory['bounce']:.0f} MB to what is resident after the frame."
    )
    return [Section("memory", "Memory", [text])]
