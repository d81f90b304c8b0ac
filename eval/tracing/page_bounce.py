"""Light that bounces on the tracing benchmark's page: its cost, and frames at the path tracer's error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.results import Row
from eval.tracing.measured import EqualError, Measured
from tron.images import read_image
from tron.report.page import Block, Cell, Picture, Pictures, Section, Table, Text

WAY_WORDS = {
    "lit_preview": "lit, 2 shadow rays, denoised: tron-relight's default",
    "lit_64_rays": "lit, 64 shadow rays",
    "lit_16_rays": "lit, 16 shadow rays",
    "lit_supersampled": "lit, 64 rays over 2 × 2 sub-pixels",
    "lit_with_reflections": "the same, and 4 reflection rays",
}


def bounce_section(measured: Measured) -> list[Section]:
    """Transport, bake and a lit frame; nothing if they were not measured."""
    if not measured.bounce:
        return []
    intro = Text(
        "Where light can go between the surfels is traced once a scene (32 rays a surfel), what one light "
        "sends that way is baked once a light, and a frame composites what was baked with everything else. "
        "All are held against a frame of 64 shadow rays a pixel without any of it."
    )
    rows = []
    for found in measured.bounce:
        seconds = {name: times.median for name, times in found.times.items()}
        rows.append(
            [
                f"{found.count:,}",
                *(f"{seconds[name]:.2f}" for name in ("transport", "bake", "frame", "lit frame")),
                Cell(f"{seconds['bake'] / seconds['frame']:.2f}", "strong"),
                Cell(f"{seconds['lit frame'] / seconds['frame']:.3f}", "strong"),
            ]
        )
    headings = ["Surfels", "Transport", "Bake", "Frame", "Lit frame", "Bake / frame", "Lit / frame"]
    table = Table(f"Seconds; frames of {measured.bounce[0].size}² pixels.", headings, rows)
    return [Section("bounce", "Light that bounces", [intro, table])]


def equal_error_section(measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Times at equal error, scene by scene; nothing if they were not measured."""
    record = measured.equal_error
    if record is None:
        return []
    intro = Text(
        "How long Mitsuba's path tracer takes until its error is ours: root mean square of what is seen, "
        "after exposure and AgX, on the pixels that meet the scene, against the same path tracer converged. "
        "The mean ratio is over scenes; below 1 our frame is the faster way to that error. Beside it the "
        "ratio of one still picture, for which the light is baked as well. What is done once a scene and the "
        "prefiltered map are in neither."
    )
    means = []
    for way in record.ways:
        ratio, *others = (row_cell(found[metric]) for metric, _ in record.metrics(way).values())
        means.append([WAY_WORDS.get(way, way), Cell(ratio.text, "strong"), *others])
    headings = ["Frame", "Our time / theirs", "With the bake", "Error", "Our seconds", "Their paths a pixel"]
    scenes = len({case["scene"] for case in record.cases})
    blocks: list[Block] = [
        intro,
        Table("Means over all scenes and lights.", headings, means),
        Text(interval_note(scenes)),
        _cases(record),
        *_pictures(record),
    ]
    return [Section("equal-error", "Beside the path tracer, at the same error", blocks)]


def _cases(record: EqualError) -> Table:
    rows = [
        [
            f"{case['scene']}, {case['light']}",
            WAY_WORDS.get(way, way),
            *(f"{values[name]:.3g}" for name in ("error", "seconds", "paths", "path_seconds")),
            Cell(f"{values['ratio']:.2f}", "strong"),
        ]
        for case in record.cases
        for way, values in case["ways"].items()
    ]
    headings = ["Scene, light", "Frame", "Error", "Our seconds", "Their paths", "Their seconds", "Ratio"]
    return Table("Every case.", headings, rows)


def _pictures(record: EqualError) -> Sequence[Pictures]:
    shown = [
        Picture(read_image(path), path.stem, f"three pictures of {path.stem}") for path in record.pictures
    ]
    if not shown:
        return []
    title = "lit with reflections, the path tracer in no more than our time, the path tracer converged"
    return [Pictures(f"Left to right: {title}", shown, "", 1)]
