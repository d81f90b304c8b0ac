"""Reconstructions under other lights, and plain splats made relightable: figures and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from eval.reconstruction.measured import Measured
from eval.reconstruction.page_scenes import way_title
from eval.reconstruction.relighting import Relit
from eval.report.figures import row_cell
from eval.results import Row
from tron.report.page import Block, Cell, Picture, Pictures, Section, Table, Text
from tron.report.values import format_value

RELIT_INTRO = (
    "What surfels are for: the held-out views under two lights that no photo was taken in, as tron-relight's "
    "final quality draws them (shadows, reflections, light that bounces between the surfels; no network), "
    "against Mitsuba's path tracer with the true meshes and materials. PSNR of display values, where the "
    "true scene covers a pixel wholly; one factor on all light of a scene is allowed, because photos do not "
    "tell bright paint in dim light from dim paint in bright light. The true prior is the ceiling: what "
    "remains of its error is that of surfels and of sampling."
)
SPLATS_INTRO = (
    "A scene is learnt from its pictures alone, as 3DGS does it, and written as a plain 3DGS file, whose "
    "normals are the thinnest axes with signs at random and which has no materials. tron-relight takes such "
    "a file as it is; tron-reconstruct takes it as a capture: it films it from all sides with its depths and "
    "begins anew. Both are held against the true scene."
)
SCANS = {"raw": "the file as it is", "splats": "the file as a capture"}


def relit_section(measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Figures of every way that was relit, and the middle held-out view of each scene and light."""
    ways = {way: runs for way, runs in measured.runs.items() if any(run.relit for run in runs)}
    if not ways:
        return []
    lights = list(
        dict.fromkeys(
            name for runs in ways.values() for run in runs if run.relit for name in run.relit.lights
        )
    )
    rows = [
        [
            way_title(way),
            row_cell(found.get(f"{measured.prefix(way)}.relight_psnr"), "strong"),
            *(row_cell(found.get(f"{measured.prefix(way)}.relight_psnr_{light}")) for light in lights),
        ]
        for way in ways
    ]
    each = [
        [
            run.name,
            way_title(way),
            Cell(format_value(run.relit.psnr, "dB"), "strong"),
            *_lights(run.relit, lights),
        ]
        for way, runs in ways.items()
        for run in runs
        if run.relit is not None
    ]
    headings = ["all", *(f"under another {light}" for light in lights)]
    blocks: list[Block] = [
        Text(RELIT_INTRO),
        Table("Means over the scenes.", ["From", *headings], rows),
        Table(
            "Each scene; the factor is on the light of the surfels.",
            ["Scene", "From", *headings, "Factor"],
            each,
            words=[1],
        ),
    ]
    scenes = dict.fromkeys(run.name for runs in ways.values() for run in runs)
    for scene in scenes:
        relit = {
            way_title(way): run.relit
            for way, runs in ways.items()
            for run in runs
            if run.name == scene and run.relit
        }
        blocks.append(_pictures(f"Scene {scene}", relit))
    return [Section("relit", "Under other lights", blocks)]


def splats_section(measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Figures and pictures of plain splats as they are, and as tron-reconstruct makes them anew."""
    if not measured.scans:
        return []
    rows = []
    for way in measured.scans:
        prefix = "splats" if way == "splats" else f"splats.{way}"
        names = ("normal_mae_deg", "normal_median_deg", "relight_psnr", "seconds")
        rows.append([SCANS.get(way, way), *(row_cell(found.get(f"{prefix}.{name}")) for name in names)])
    headings = ["Surfels", "Normals, mean", "median", "Relit", "Time"]
    caption = "Held-out views of the true scene. Time of the raw file is that of learning it."
    blocks: list[Block] = [Text(SPLATS_INTRO), Table(caption, headings, rows)]
    first = next(iter(measured.scans.values()))
    for number, scan in enumerate(first):
        normals = [Picture(scan.views[0], "true normals", f"true normals of scene {scan.name}", strong=True)]
        normals += [
            Picture(
                scans[number].views[1],
                SCANS.get(way, way),
                f"normals of scene {scan.name}, {SCANS.get(way, way)}",
                format_value(scans[number].normals["normal_mae_deg"], "deg"),
            )
            for way, scans in measured.scans.items()
        ]
        blocks.append(Pictures(f"Normals of scene {scan.name}", normals, columns=len(normals)))
        relit = {SCANS.get(way, way): scans[number].relit for way, scans in measured.scans.items()}
        blocks.append(_pictures(f"Scene {scan.name} under other lights", relit))
    return [Section("splats", "Plain splats as a capture", blocks)]


def _lights(relit: Relit, lights: list[str]) -> Iterator[str]:
    for light in lights:
        yield format_value(relit.lights[light].psnr, "dB") if light in relit.lights else "—"
    yield format_value(relit.factor, "x")


def _pictures(title: str, relit: Mapping[str, Relit]) -> Pictures:
    """A row of pictures for each light: the truth, then every way."""
    first = next(iter(relit.values()))
    pictures = []
    for light, under in first.lights.items():
        pictures.append(
            Picture(under.truth, f"{light}: path-traced", f"{title}, {light}, path-traced", strong=True)
        )
        pictures += [
            Picture(
                each.lights[light].shown,
                name,
                f"{title}, {light}, {name}",
                f"{each.lights[light].psnr:.1f} dB",
            )
            for name, each in relit.items()
        ]
    note = "The middle held-out view; figures are of all held-out views under that light."
    return Pictures(title, pictures, note, columns=len(relit) + 1)
