"""The irradiance pass on the tracing benchmark's page: its time and its noise."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.report.page import Block, Cell, Picture, Pictures, Section, Table, Text
from eval.report.strips import write_strips
from tron.color import to_display

if TYPE_CHECKING:
    from eval.tracing.benchmark import Measured, Tracing
    from eval.tracing.irradiance import Noise


def irradiance_section(measured: Measured, output_dir: Path) -> list[Section]:
    """The pass against Mitsuba's direct integrator; nothing if it was not measured."""
    if not measured.direct:
        return []
    intro = Text(
        "64 shadow rays a pixel through the surfels, beside Mitsuba's direct integrator on a triangle mesh "
        "of the same surfaces, white and diffuse, with 32 light and 32 BSDF samples: as many rays, but each "
        "ends at the first opaque triangle. Mitsuba's faster setting counts (all samples from one camera "
        "ray, or 32 camera rays with two each). The ratio counts TRON's camera rays and the build of its "
        "hierarchy too, since Mitsuba's time holds camera rays."
    )
    rows = []
    groups: list[Pictures] = []
    for found in measured.direct:
        times = found.times
        rows.append(
            [
                Cell(found.light),
                Cell(f"{times['tron'].median:.2f}"),
                Cell(f"{times['gbuffer'].median + times['build'].median:.2f}"),
                Cell(f"{times['direct at once'].median:.2f}"),
                Cell(f"{times['direct by camera rays'].median:.2f}"),
                Cell(f"{found.ratio:.2f}", "strong"),
            ]
        )
        shown = {name: to_display(image, found.exposure) for name, image in found.images.items()}
        pictures = [
            Picture(shown["tron"], "TRON, 64 rays", f"irradiance of the surfels under {found.light}"),
            Picture(shown["direct"], "Mitsuba, mesh", f"irradiance of the mesh under {found.light}"),
        ]
        groups.append(Pictures(f"Light: {found.light}", pictures, columns=2))
        write_strips([groups[-1]], [f"direct-{found.light}"], output_dir / "pictures")
    headings = [
        "Light",
        "TRON",
        "camera rays, build",
        "direct, at once",
        "direct, by camera rays",
        "TRON takes × as long",
    ]
    table = Table("Seconds for one frame of irradiance.", headings, rows)
    return [Section("irradiance", "The irradiance pass against a mesh", [intro, table, *groups])]


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


def noise_section(settings: Tracing, measured: Measured, output_dir: Path) -> list[Section]:
    """Errors at 2 and 64 rays beside independent sampling; nothing if they were not measured."""
    if not measured.noise:
        return []
    intro = Text(
        f"Root mean square error of the irradiance buffer against {settings.reference_spp} rays a pixel, as "
        "a share of the light on an unshadowed upward plane. Independent sampling is the same estimator with "
        "random numbers that know nothing of one another. Speed must not be bought with structure: for pairs "
        "of pixels at one distance, errors must correlate no more within an aligned block than across its "
        "border; the excess is 0 for noise, 1 for a value shared by a block, and below 0 where the pixels of "
        "a block make up for one another, which is welcome."
    )
    lights = [noise.light for noise in measured.noise]
    error_rows = [
        [Cell(words), *(Cell(f"{100 * noise.rmse[name]:.3f}%") for noise in measured.noise)]
        for name, words in NOISE_WORDS.items()
    ]
    equal = ", ".join(f"{noise.equal_time_spp} under {noise.light}" for noise in measured.noise)
    caption = f"Error of irradiance. Independent rays in the time of TRON's 64: {equal}."
    block_rows = [
        [Cell(words), *(Cell(f"{noise.blocks[name]:+.4f}") for noise in measured.noise)]
        for name, words in BLOCK_WORDS.items()
    ]
    blocks: list[Block] = [
        intro,
        Table(caption, ["Sampling", *lights], error_rows),
        Table("Excess correlation of errors inside blocks, 64 rays.", ["Sampling", *lights], block_rows),
    ]
    for noise in measured.noise:
        blocks.append(_noise_pictures(noise))
        write_strips([_noise_pictures(noise)], [f"irradiance-{noise.light}"], output_dir / "pictures")
    return [Section("noise", "Noise of the irradiance", blocks)]


def _noise_pictures(noise: Noise) -> Pictures:
    words = {
        "tron 2": "TRON, 2 rays",
        "independent 2": "independent, 2 rays",
        "denoised 2": "TRON, 2 rays, denoised",
        "tron 64": "TRON, 64 rays",
        "independent 64": "independent, 64 rays",
        "reference": "reference",
    }
    pictures = [
        Picture(
            np.kron(to_display(noise.images[name], noise.exposure), np.ones((2, 2, 1), np.float32)),
            title,
            f"irradiance under {noise.light}: {title}",
            strong=name.startswith("tron"),
        )
        for name, title in words.items()
    ]
    return Pictures(f"Light: {noise.light}", pictures, "Pixels are shown twice as large.", columns=3)
