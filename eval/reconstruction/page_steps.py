"""Cost of an optimisation step, beside Mitsuba's volprim, and as surfels and pixels grow."""

from __future__ import annotations

from eval.reconstruction.measured import SHIPPED, TRON, VOLPRIM, Measured
from eval.report.charts import line_chart
from tron.report.page import Block, Cell, Chart, Section, Table, Text
from tron.report.values import format_value


def steps_section(measured: Measured) -> list[Section]:
    """Ratios and growth, as far as they were measured."""
    blocks: list[Block] = [*(_beside_the_peer(measured) if measured.steps else []), *_growth(measured)]
    return [Section("steps", "An optimisation step", blocks)] if blocks else []


def _beside_the_peer(measured: Measured) -> list[Block]:
    shapes = " or ".join(dict.fromkeys(steps.shape for steps in measured.steps))
    intro = Text(
        "A step renders one view, compares it with the photo by 0.8 L1 + 0.2 (1 - SSIM), differentiates by "
        "positions, rotations, scales, opacities and harmonics up to degree 3, and updates them all by Adam. "
        "Both sides hold the same tensors in torch, under the same Adam and the same loss, on a scene "
        "that was reconstructed from photos; they differ in what renders and differentiates: TRON, or "
        f"Mitsuba's volprim_rf_basic on {shapes} (in each case the faster of its two plugins) through "
        "dr.wrap. Both draw the same kernel. That of degree 2 is the peer's own; the scene is the first of "
        f"those above, reconstructed once more with {' '.join(measured.settings.step_degree2)}. With degree "
        "4, the kernel of the scene above, the peer's line of density is replaced, and it takes longer: "
        "fewer surfels are faint. "
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
        milliseconds = (
            format_value(1e3 * times[name].median, "ms") if name in times else "—"
            for name in (TRON, VOLPRIM, SHIPPED)
        )
        table.append(
            [
                f"degree {steps.degree}",
                f"{steps.count:,}",
                f"{steps.size}²",
                *milliseconds,
                Cell(format_value(steps.ratio(), "x"), "strong"),
                Cell(f"{low:.1f}–{high:.1f}", "faint"),
                format_value(steps.ratio(SHIPPED), "x") if SHIPPED in times else "—",
                format_value(steps.agreement, "dB"),
            ]
        )
    caption = (
        "Time of one whole step, and how many times as long the peer's takes; the first ratio of each kernel "
        "is held to the target. The last column compares both sides' pictures before the first step."
    )
    groups = [("", 3), ("Time of a step", 3), ("volprim over TRON", 3), ("", 1)]
    return [intro, Table(caption, headings, table, groups)]


def _growth(measured: Measured) -> list[Chart]:
    surfels, pixels = measured.settings.growth_at
    charts = []
    for axis, fixed, points in (
        (
            "surfels",
            f"{pixels}² pixels, on the tracing benchmark's scene",
            [(found.count, found.seconds) for found in measured.growth if found.size == pixels],
        ),
        (
            "pixels",
            f"{surfels:,} surfels, on the same scene",
            [(found.size**2, found.seconds) for found in measured.growth if found.count == surfels],
        ),
    ):
        if len(points) > 1:
            caption = f"Seconds a step as {axis} grow, {fixed}."
            lines = {"a step": sorted(points)}
            charts.append(line_chart(lines, axis, "seconds", caption, logarithmic=True))
    return charts
