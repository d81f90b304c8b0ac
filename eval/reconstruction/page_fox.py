"""The real capture: figures, curve, held-out photos beside the surfels, and the fox under other lights."""

from __future__ import annotations

from collections.abc import Mapping

from eval.reconstruction.measured import Fox, Measured
from eval.report.charts import line_chart
from eval.report.figures import row_cell
from eval.results import Row
from tron.images import read_image
from tron.report.page import Block, Picture, Pictures, Section, Table, Text

WORDS = {
    "fox.test_psnr": "PSNR of held-out photos",
    "fox.ssim": "SSIM of held-out photos",
    "fox.lpips": "LPIPS of held-out photos",
    "fox.train_psnr": "PSNR of training photos",
    "fox.surfels": "surfels",
    "fox.seconds": "whole command",
    "fox.surfels_seconds": "of that, surfels and materials",
    "fox.light_seconds": "of that, the light",
    "fox.relight_seconds": "relighting, all the lights together",
}

RELIT = (
    "Made by tron-relight of the same scene.ply, as are those below: shadows, reflections and light that "
    "bounces between the surfels, no neural renderer; the environment is seen where there are no surfels."
)


def fox_section(measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Everything about the fox, or why there is nothing."""
    fox = measured.fox
    if fox is None:
        if not measured.no_fox:
            return []
        reason = Text(f"The real capture was not reconstructed: {measured.no_fox}. Its figures are absent.")
        return [Section("fox", "The fox", [reason])]
    capture, curve = fox.run.report.capture, fox.run.curve()
    skipped = f" Photos that its poses name and that are absent: {len(capture.skipped)}."
    intro = Text(
        f"{capture.views} photos of a stuffed fox, taken with a phone whose lens distorts, "
        f"{len(capture.held_out)} of them held out.{skipped if capture.skipped else ''} No mask tells the "
        "fox from the room behind it, and no prior knows its materials: they come from the classical "
        "decomposition, which needs no weights."
    )
    rows = [[text, row_cell(row, "strong")] for metric, text in WORDS.items() if (row := found.get(metric))]
    blocks: list[Block] = [intro, Table("What was measured.", ["Figure", "Measured"], rows)]
    if len(curve) > 1:
        axes = "seconds of training", "held-out PSNR in dB"
        caption = "Held-out PSNR of the fox while its surfels are learnt."
        target = measured.settings.target("fox.test_psnr", "target")
        blocks.append(line_chart({"fox": curve}, *axes, caption, target))
    blocks += [*_held_out(fox), *_relit(fox), *_sheet(fox)]
    return [Section("fox", "The fox", blocks)]


def _held_out(fox: Fox) -> list[Pictures]:
    blocks = []
    for name, photo in fox.photos.items():
        figures = fox.run.report.views.get(name, {})
        pictures = [Picture(photo, "photo", f"held-out photo {name} of the fox")]
        for channel, image in fox.rendered[name].items():
            figure = f"{figures['psnr']:.1f} dB" if channel == "radiance" and "psnr" in figures else ""
            pictures.append(Picture(image, channel, f"{channel} of the surfels, view {name}", figure))
        blocks.append(Pictures(f"Held-out photo {name}", pictures, columns=4))
    return blocks


def _relit(fox: Fox) -> list[Pictures]:
    if not fox.relit:
        return []
    views = list(fox.photos)
    blocks = []
    if fox.light is not None:
        before = [Picture(fox.light, "fitted light", "environment map that was fitted to the photos")]
        before += [Picture(photo, f"photo {name}", f"photo {name}") for name, photo in fox.photos.items()]
        blocks.append(Pictures("As it was photographed", before, columns=len(before)))
    for light, (environment, *frames) in fox.relit.items():
        pictures = [Picture(environment, "light", f"environment map {light}")]
        pictures += [
            Picture(frame, f"view {name}", f"the fox from view {name}, lit by {light}")
            for name, frame in zip(views, frames, strict=True)
        ]
        note = RELIT if light == next(iter(fox.relit)) else ""
        blocks.append(Pictures(f"Under {light.replace('_', ' ')}", pictures, note, len(pictures)))
    return blocks


def _sheet(fox: Fox) -> list[Pictures]:
    path = fox.run.folder / "contact_sheet.png"
    if not path.is_file():
        return []
    picture = Picture(read_image(path), "contact sheet", "held-out photos and every channel of the surfels")
    return [Pictures("The command's own contact sheet", [picture], columns=1)]
