"""Few rays on the tracing benchmark's page: how dark shadows are, and how noisy, filtered and not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.report.page import Block, Cell, Picture, Pictures, Section, Table, Text
from eval.report.strips import write_strips
from tron.color import to_display

if TYPE_CHECKING:
    from eval.tracing.benchmark import Measured
    from eval.tracing.few_rays import FewRays, Way


def few_rays_section(measured: Measured, output_dir: Path) -> list[Section]:
    """Means in shadow and errors at 2, 4 and 8 rays; nothing if they were not measured."""
    if not measured.few_rays:
        return []
    intro = Text(
        "Previews send 2 rays a pixel and filter what they find. Two figures say whether to trust that: "
        "the mean irradiance of the pixels in shadow (those that less than half of the unshadowed light "
        "reaches in the reference), over the reference's mean there, which is 1 if shadows are as dark as "
        "they should be; and the root mean square error of all pixels, as a share of the light on an "
        "unshadowed upward plane."
    )
    lights = [found.light for found in measured.few_rays]
    ways = list(measured.few_rays[0].mean)
    means = [
        [Cell(_words(way)), *(Cell(f"{found.mean[way]:.3f}", "strong") for found in measured.few_rays)]
        for way in ways
    ]
    errors = [
        [Cell(_words(way)), *(Cell(f"{100 * found.rmse[way]:.2f}%") for found in measured.few_rays)]
        for way in ways
    ]
    blocks: list[Block] = [
        intro,
        Table("Mean irradiance in shadow over the reference's.", ["", *lights], means),
        Table("Error of irradiance.", ["", *lights], errors),
    ]
    for found in measured.few_rays:
        blocks.append(_pictures(found))
        write_strips([_pictures(found)], [f"few-rays-{found.light}"], output_dir / "pictures")
    return [Section("few-rays", "Few rays", blocks)]


def _words(way: Way) -> str:
    rays, filtered = way
    return f"{rays} rays, filtered" if filtered else f"{rays} rays"


def _pictures(found: FewRays) -> Pictures:
    shown = {_words(way): image for way, image in found.images.items() if way[0] in (2, 8)}
    shown["reference"] = found.reference
    pictures = [
        Picture(
            np.kron(to_display(image, found.exposure), np.ones((2, 2, 1), np.float32)),
            title,
            f"irradiance under {found.light}: {title}",
            strong="filtered" in title,
        )
        for title, image in shown.items()
    ]
    return Pictures(f"Light: {found.light}", pictures, columns=5)
