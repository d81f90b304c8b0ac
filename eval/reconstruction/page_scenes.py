"""The path-traced scenes: figures of every way, curves, pictures beside the truth, lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from eval.reconstruction.measured import Compared, Measured
from eval.reconstruction.runs import Run
from eval.report.charts import line_chart
from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.results import Row
from tron.report.page import Block, Cell, Chart, Picture, Pictures, Section, Table, Text
from tron.report.values import format_value

WAYS = {
    "random": "random points, true prior",
    "depth_init": "depth maps, true prior",
    "classical": "random points, classical prior",
    "photos": "photographs, no prior",
}
COLUMNS = {
    "test_psnr": "Held-out PSNR",
    "test_psnr_subject": "on the subject",
    "test_ssim": "SSIM",
    "train_psnr": "Training PSNR",
    "normal_mae_deg": "Normals, mean",
    "normal_median_deg": "median",
    "base_color_psnr": "Base color",
    "roughness_mae": "Roughness",
    "metallic_mae": "Metallic",
    "surfels": "Surfels",
    "seconds": "Time",
}
CHANNEL_ALTS = {
    "radiance": "a held-out view",
    "normal": "surface normals as colours",
    "base color": "base color",
    "light": "the environment map",
}


def way_title(way: str) -> str:
    """A way in words; its name where it is not one of the shipped ones."""
    return WAYS.get(way, way)


def scenes_section(measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Tables and curves of the path-traced scenes, if they were reconstructed."""
    if not measured.runs:
        return []
    first = next(iter(measured.runs.values()))
    intro = Text(
        f"{len(first)} {'scenes' if len(first) > 1 else 'scene'} of {first[0].report.capture.views} "
        "path-traced views each, reconstructed "
        "in each of these ways. From random points nothing is known but the cameras and the pictures' "
        "masks; from depth maps surfels begin on the true surfaces. The true prior gives normals, base "
        "color, roughness, metallic and irradiance of the training views; the classical one computes "
        "what it can from the photos. Normals are off by a mean angle; base color is PSNR on linear "
        "values after one factor a view and channel; roughness and metallic are mean absolute errors. "
        "Photographs are the same views, each with its own exposure, white balance and noise; held-out views "
        "are true renders in every way, so no exposure of theirs has to be guessed."
    )
    means = [[way_title(way), *_figures(found, measured.prefix(way) + ".{}")] for way in measured.runs]
    caption = "Means over the scenes; surfels and time (the whole command) are of the scene with the most."
    blocks: list[Block] = [
        intro,
        Table(caption, ["Begun from", *COLUMNS.values()], means),
        Text(interval_note(len(first))),
        *_curves(measured),
    ]
    for way, runs in measured.runs.items():
        rows = [
            [run.name, *_figures(found, f"{measured.prefix(way)}.{{}}.{run.name.replace('-', '_')}")]
            for run in runs
        ]
        blocks.append(Table(f"Each scene: {way_title(way)}.", ["Scene", *COLUMNS.values()], rows))
    return [Section("scenes", "Path-traced scenes", blocks)]


def _figures(found: Mapping[str, Row], metric: str) -> list[Cell]:
    """Cells of all columns; ``metric`` has {} in place of the column's name."""
    rows = {name: found.get(metric.format(name)) for name in COLUMNS}
    return [
        Cell(f"{row.value:,.0f}") if name == "surfels" and row else row_cell(row)
        for name, row in rows.items()
    ]


def _curves(measured: Measured) -> list[Chart]:
    charts, axes = [], ("seconds of training", "held-out PSNR in dB")
    bound = measured.settings.target("reconstruction.test_psnr", "target from random points")
    means = {way_title(way): mean for way, runs in measured.runs.items() if (mean := _mean_curve(runs))}
    if means:
        caption = "Held-out PSNR while surfels are learnt, mean over the scenes."
        charts.append(line_chart(means, *axes, caption, bound))
    way, runs = next(iter(measured.runs.items()))
    lines = {run.name: run.curve() for run in runs if len(run.curve()) > 1}
    if lines:
        charts.append(line_chart(lines, *axes, f"The same for each scene: {way_title(way)}.", bound))
    return charts


def _mean_curve(runs: Sequence[Run]) -> list[tuple[float, float]]:
    """Mean (seconds, dB) over the scenes at the steps that all of them scored."""
    by_step = [{point.step: point for point in run.report.curve} for run in runs]
    steps = sorted(set.intersection(*(set(points) for points in by_step)))
    if len(steps) < 2:
        return []
    return [
        (
            float(np.mean([points[step].seconds for points in by_step])),
            float(np.mean([points[step].test_psnr for points in by_step])),
        )
        for step in steps
    ]


def views_section(measured: Measured) -> list[Section]:
    """A held-out view of each scene beside the truth, in every way."""
    if not measured.compared:
        return []
    blocks: list[Block] = [
        Text(
            "The middle held-out view of each scene: what the surfels show, their normals and base color "
            "(scaled as its figure is), and the light that was found, all lights by the true one's exposure. "
            "The first row is the truth."
        )
    ]
    blocks += [_gallery(compared) for compared in measured.compared]
    return [Section("views", "Held-out views beside the truth", blocks)]


def _gallery(compared: Compared) -> Pictures:
    pictures = [
        Picture(
            image, f"true {channel}" if channel != "radiance" else "photo", _alt(channel, compared, "truth")
        )
        for channel, image in compared.truth.items()
    ]
    columns = len(pictures)
    for way, images in compared.ways.items():
        pictures += [
            Picture(
                images[channel],
                f"{way}: {channel}",
                _alt(channel, compared, way_title(way)),
                compared.figures[way].get(channel, ""),
            )
            for channel in compared.truth
            if channel in images
        ]
    note = f"View {compared.view}. " + "; ".join(f"{way}: {way_title(way)}" for way in compared.ways) + "."
    light = f" · {compared.family}" if compared.family else ""
    return Pictures(f"Scene {compared.scene}{light}", pictures, note, columns)


def _alt(channel: str, compared: Compared, who: str) -> str:
    return f"{CHANNEL_ALTS[channel]} of scene {compared.scene}, {who}"


def light_section(measured: Measured) -> list[Section]:
    """Errors of the fitted lights."""
    table = [
        [
            run.name,
            run.family or "—",
            way_title(way),
            Cell(format_value(run.light["irradiance_error"], "fraction"), "strong"),
            format_value(run.light["scaled_error"], "fraction"),
            format_value(run.light["sun_direction_deg"], "deg") if "sun_direction_deg" in run.light else "—",
        ]
        for way, runs in measured.runs.items()
        for run in runs
        if run.light
    ]
    if not table:
        return []
    intro = Text(
        "The light that each run found, held against the one that the scene was path-traced under: the "
        "relative difference (L2) of the irradiance that either gives to unoccluded surfaces of all normals. "
        "The second figure is after one factor on the whole light, which leaves errors of colour and "
        "direction. The sun's direction is that of the brightest spot."
    )
    headings = ["Scene", "True light", "Begun from", "Irradiance off by", "after one factor", "Sun off by"]
    return [Section("light", "The light", [intro, Table("Fitted lights.", headings, table, words=[1, 2])])]
