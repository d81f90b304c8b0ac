"""What an optimisation step costs: beside Mitsuba's volprim, and as surfels and pixels grow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from eval.report.charts import line_chart
from eval.report.figures import format_value
from eval.report.page import Block, Cell, Chart, Section, Table, Text
from eval.results import Row

if TYPE_CHECKING:
    from eval.reconstruction.benchmark import Measured, Reconstruction
    from eval.reconstruction.step import Steps


def steps_section(settings: Reconstruction, measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Ratios and growth, as far as they were measured."""
    blocks: list[Block] = []
    if measured.steps:
        blocks += _beside_the_peer(settings, measured, found)
    blocks += _growth(settings, measured)
    return [Section("steps", "An optimisation step", blocks)] if blocks else []


def _milliseconds(steps: Steps, name: str) -> Cell:
    return Cell(format_value(1e3 * steps.times[name].median, "ms") if name in steps.times else "—")


def _beside_the_peer(settings: Reconstruction, measured: Measured, found: Mapping[str, Row]) -> list[Block]:
    from eval.reconstruction.step import SHIPPED, TRON, VOLPRIM

    shapes = " or ".join(dict.fromkeys(steps.shape for steps in measured.steps))
    intro = Text(
        "A step renders one view, compares it with the photo by 0.8 L1 + 0.2 (1 - SSIM), differentiates by "
        "positions, rotations, scales, opacities and harmonics up to degree 3, and updates them all by Adam. "
        "Both sides hold the same tensors in torch, under the same Adam and the same loss, on a scene "
        "that was reconstructed from photos; they differ in what renders and differentiates: TRON, or "
        f"Mitsuba's volprim_rf_basic on {shapes} (in each case the faster of its two plugins) through "
        "dr.wrap. Both draw the same kernel. That of degree 2 is the peer's own; the scene is the first of "
        "those above, "
        f"reconstructed once more with {' '.join(settings.step_degree2)}. With degree 4, the kernel of the "
        "scene above, the peer's line of density is replaced, and it takes longer: fewer surfels are faint. "
        "The peer stops a ray where TRON does; its own limit, ten times as high, ends rays sooner and is "
        "shown beside it, with the kernel that it ships. "
        "What either must make anew for surfels that have moved, TRON's tile lists and Mitsuba's hierarchy, "
        "is counted. All take turns in one process; figures are medians."
    )
    headings = [
        "Kernel",
        "Surfels",
        "Pixels",
        "TRON",
        "volprim",
        "as shipped",
        "ratio",
        "range",
        "as shipped",
        "Pictures alike",
    ]
    table = []
    for steps in measured.steps:
        times = steps.times
        low, high = times[VOLPRIM].range_over(times[TRON])
        table.append(
            [
                Cell(f"degree {steps.degree}"),
                Cell(f"{steps.count:,}"),
                Cell(f"{steps.size}²"),
                *(_milliseconds(steps, name) for name in (TRON, VOLPRIM, SHIPPED)),
                Cell(format_value(steps.ratio(), "x"), "strong"),
                Cell(f"{low:.1f}–{high:.1f}", "faint"),
                Cell(format_value(steps.ratio(SHIPPED), "x") if SHIPPED in times else "—"),
                Cell(format_value(found[f"step.psnr_to_volprim.{steps.case}"].value, "dB")),
            ]
        )
    caption = (
        "Time of one whole step, and how many times as long the peer's takes; the first ratio of each kernel "
        "is held to the target. The last column compares both sides' pictures before the first step."
    )
    groups = [("", 3), ("Time of a step", 3), ("volprim over TRON", 3), ("", 1)]
    return [intro, Table(caption, headings, table, groups)]


def _growth(settings: Reconstruction, measured: Measured) -> list[Chart]:
    surfels, pixels = settings.growth_at
    by_count = sorted((n, t.median) for (n, size), t in measured.growth.items() if size == pixels)
    by_size = sorted(
        (float(size * size), t.median) for (n, size), t in measured.growth.items() if n == surfels
    )
    charts = []
    if len(by_count) > 1:
        caption = f"Seconds a step as surfels grow, {pixels}² pixels, on the tracing benchmark's scene."
        charts.append(line_chart({"a step": by_count}, "surfels", "seconds", caption, logarithmic=True))
    if len(by_size) > 1:
        caption = f"Seconds a step as pixels grow, {surfels:,} surfels, on the same scene."
        charts.append(line_chart({"a step": by_size}, "pixels", "seconds", caption, logarithmic=True))
    return charts
