"""Irradiance on the tracing benchmark's page: its time, its noise, and few rays of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from eval.report.strips import write_strips
from eval.tracing.measured import TRON, LitImages, Measured
from tron.report.page import Block, Cell, Picture, Pictures, Section, Table, Text

NOISE_WORDS = {
    "rmse_2spp": "TRON, 2 rays",
    "independent_rmse_2spp": "independent, 2 rays",
    "rmse_2spp_denoised": "TRON, 2 rays, denoised",
    "rmse_64spp": "TRON, 64 rays",
    "independent_rmse_64spp": "independent, 64 rays",
    "independent_rmse_equal_time": "independent, in the time of TRON's 64",
}
BLOCK_WORDS = {
    "block_correlation_4x4": "TRON, 4 × 4 blocks",
    "independent_block_correlation_4x4": "independent, 4 × 4 blocks",
    "block_correlation_8x8": "TRON, 8 × 8 blocks",
    "independent_block_correlation_8x8": "independent, 8 × 8 blocks",
}
TWICE = "Pixels are shown twice as large."


def irradiance_section(measured: Measured, output_dir: Path) -> list[Section]:
    """The pass against Mitsuba's direct integrator; nothing if it was not measured."""
    if not measured.direct:
        return []
    intro = Text(
        "64 shadow rays per pixel through the surfels, beside Mitsuba's direct integrator on a triangle mesh "
        "of the same surfaces, white and diffuse, with 32 light and 32 BSDF samples: as many rays, but each "
        "ends at the first opaque triangle. Mitsuba's faster setting counts (all samples from one camera "
        "ray, or 32 camera rays with two each). The ratio counts TRON's camera rays and the build of its "
        "hierarchy too, since Mitsuba's time holds camera rays."
    )
    rows = []
    for found in measured.direct:
        seconds = {name: times.median for name, times in found.times.items()}
        shown = (
            seconds[TRON],
            seconds["gbuffer"] + seconds["build"],
            seconds["direct at once"],
            seconds["direct by camera rays"],
        )
        rows.append([found.lit.light, *(f"{s:.2f}" for s in shown), Cell(f"{found.ratio:.2f}", "strong")])
    headings = [
        "Light",
        "TRON",
        "camera rays, build",
        "direct, at once",
        "direct, by camera rays",
        "TRON takes × as long",
    ]
    titles = {"tron": "TRON, 64 rays", "direct": "Mitsuba, mesh"}
    groups = [_pictures(found.lit, titles, columns=2) for found in measured.direct]
    write_strips(groups, [f"direct-{found.lit.light}" for found in measured.direct], output_dir / "pictures")
    table = Table("Seconds for one frame of irradiance.", headings, rows)
    return [Section("irradiance", "The irradiance pass against a mesh", [intro, table, *groups])]


def noise_section(measured: Measured, output_dir: Path) -> list[Section]:
    """Errors at 2 and 64 rays beside independent sampling; nothing if they were not measured."""
    noises = measured.noise
    if not noises:
        return []
    intro = Text(
        f"Root mean square error of the irradiance buffer against {measured.settings.reference_spp} rays a "
        "pixel, as a share of the light on an unshadowed upward plane. Independent sampling is the same "
        "estimator with random numbers that know nothing of one another. Speed must not be bought with "
        "structure: for pairs of pixels at one distance, errors must correlate no more within an aligned "
        "block than across its border; the excess is 0 for noise, 1 for a value shared by a block, and below "
        "0 where the pixels of a block make up for one another, which is welcome."
    )
    lights = [noise.lit.light for noise in noises]
    equal = ", ".join(f"{noise.equal_time_spp} under {noise.lit.light}" for noise in noises)
    caption = f"Error of irradiance. Independent rays in the time of TRON's 64: {equal}."
    errors = [
        [words, *(f"{100 * noise.rmse[name]:.3f}%" for noise in noises)]
        for name, words in NOISE_WORDS.items()
    ]
    correlations = [
        [words, *(f"{noise.blocks[name]:+.4f}" for noise in noises)] for name, words in BLOCK_WORDS.items()
    ]
    titles = {name: words for name, words in NOISE_WORDS.items() if "time" not in name}
    titles["reference"] = "reference"
    groups = [_pictures(noise.lit, titles, TWICE, columns=3, enlarged=2, strong="TRON") for noise in noises]
    write_strips(groups, [f"irradiance-{light}" for light in lights], output_dir / "pictures")
    blocks: list[Block] = [
        intro,
        Table(caption, ["Sampling", *lights], errors),
        Table("Excess correlation of errors inside blocks, 64 rays.", ["Sampling", *lights], correlations),
        *groups,
    ]
    return [Section("noise", "Noise of the irradiance", blocks)]


def few_rays_section(measured: Measured, output_dir: Path) -> list[Section]:
    """Means in shadow and errors at 2, 4 and 8 rays; nothing if they were not measured."""
    found = measured.few_rays
    if not found:
        return []
    intro = Text(
        "Previews send 2 rays per pixel and filter what they find. Two figures say whether to trust that: "
        "the mean irradiance of the pixels in shadow (those that less than half of the unshadowed light "
        "reaches in the reference), over the reference's mean there, which is 1 if shadows are as dark as "
        "they should be; and the root mean square error of all pixels, as a share of the light on an "
        "unshadowed upward plane."
    )
    lights = [each.lit.light for each in found]
    ways = {way: f"{way.replace('.', ' rays, ')}{'' if '.' in way else ' rays'}" for way in found[0].mean}
    means = [
        [words, *(Cell(f"{each.mean[way]:.3f}", "strong") for each in found)] for way, words in ways.items()
    ]
    errors = [[words, *(f"{100 * each.rmse[way]:.2f}%" for each in found)] for way, words in ways.items()]
    titles = {way: words for way, words in ways.items() if words.startswith(("2 ", "8 "))}
    titles["reference"] = "reference"
    groups = [_pictures(each.lit, titles, TWICE, 5, enlarged=2, strong="filtered") for each in found]
    write_strips(groups, [f"few-rays-{light}" for light in lights], output_dir / "pictures")
    blocks: list[Block] = [
        intro,
        Table("Mean irradiance in shadow over the reference's.", ["", *lights], means),
        Table("Error of irradiance.", ["", *lights], errors),
        *groups,
    ]
    return [Section("few-rays", "Few rays", blocks)]


def _pictures(
    lit: LitImages,
    titles: Mapping[str, str],
    note: str = "",
    columns: int = 4,
    enlarged: int = 1,
    strong: str | None = None,
) -> Pictures:
    """Images under one light; pictures with the word ``strong`` in their title are.

    Args:
        titles: name of an image -> its title.
        enlarged: pixels of the page a side of a pixel.
    """
    pixel = np.ones((enlarged, enlarged, 1), np.float32)
    pictures = [
        Picture(
            np.kron(lit.displayed(name), pixel),
            title,
            f"irradiance under {lit.light}: {title}",
            strong=strong is not None and strong in title,
        )
        for name, title in titles.items()
    ]
    return Pictures(f"Light: {lit.light}", pictures, note, columns)
