"""Camera rays, growth, shadow rays and gradient steps on the tracing benchmark's page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from eval.peers.contenders import PEERS
from eval.peers.timing import Times
from eval.report.charts import line_chart
from eval.report.strips import write_strips
from eval.results import Row
from eval.tracing.measured import BINNING, TRON, USUAL, CameraRays, Measured, SamePicture
from tron.report.page import Block, Cell, Chart, Picture, Pictures, Section, Table, Text
from tron.report.values import format_value

TITLES = {TRON: "TRON", **{peer.name: peer.title for peer in PEERS}}
VARIANTS = {
    "sh3": "harmonics of degree 3 on both sides",
    "from_gbuffers": "surfels as made from G-buffers: kernel degree 4",
}
WITHIN = {"room": "in a room", "ground": "on a ground"}
STOP = 0.001
ERROR_GAIN = 4


def family(metric: str) -> str:
    """A metric without its case."""
    return ".".join(metric.split(".")[:2])


def _range(times: Mapping[str, Times], peer: str) -> Cell:
    low, high = times[peer].range_over(times[TRON])
    return Cell(f"{low:.1f}–{high:.1f}", "faint")


def _ms(times: Times) -> str:
    return f"{1e3 * times.median:.{1 if times.median < 10 else 0}f}"


def camera_section(measured: Measured, output_dir: Path) -> list[Section]:
    """One frame against the peers, what they cannot do the same, and both pictures."""
    if measured.same_picture is None:
        return []
    settings = measured.settings
    title = TITLES["volprim"]
    frames = [
        frame
        for frame in measured.camera
        if frame.count in settings.surfels and frame.size in settings.pixels
    ]
    shapes = ", ".join(f"{name} {1e3 * times.median:.0f} ms" for name, times in measured.shapes.items())
    blocks: list[Block] = [
        Text(
            f"{_hits(measured)}The peer is the integrator that Mitsuba ships for such scenes, "
            f"{title}, on flat ellipsoids made of the same surfels, harmonics of degree "
            f"{settings.sh_degree} on both sides, one ray a pixel, box filter. As shipped it ends a ray at a "
            f"transmittance of 0.01; TRON ends at {STOP}. The column “{title}” is its source "
            f"with that one number changed to {STOP}, “as shipped” does less work than TRON."
        ),
        _camera_table(frames),
        Text(
            "What the peer cannot do the same. Its primitives are three-dimensional: ours are given a "
            "fiftieth of their width as thickness. They have no front side, so surfels seen from behind are "
            "composited too. It orders them by where the ray enters their hull, and starts again 0.0001 "
            "behind each hit, which skips those that nearly coincide. It gathers radiance alone, while TRON "
            "also gathers normal, base color, roughness, metallic, mean and median depth. A closest hit is "
            "one Embree query against a quad around each surfel: no opacity, no order, no colour; what any "
            "tracer of triangles spends at the least."
        ),
        Table(
            f"Other surfels, {measured.variants[0].count:,} on {measured.variants[0].size}² pixels.",
            ["Surfels", "TRON, Mrays/s", "times as fast as volprim"],
            [
                [
                    VARIANTS[frame.recipe],
                    Cell(f"{frame.mrays():.2f}", "strong"),
                    f"{frame.ratio('volprim'):.1f}×" if "volprim" in frame.times else "—",
                ]
                for frame in measured.variants
            ],
        ),
        Text(f"Mitsuba has two plugins for such primitives; the faster here was taken: {shapes}."),
        _same_picture(measured.same_picture, output_dir),
    ]
    return [Section("camera", "Camera rays", blocks)]


def inside_section(measured: Measured, output_dir: Path) -> list[Section]:
    """Frames of cameras within their scenes."""
    if not measured.inside:
        return []
    intro = (
        "Views so far look at the scene from outside. Here the camera stands in a room, and on a ground that "
        "goes on behind it: surfels lie on all sides, and many cross the plane through the camera, where "
        "projection has no bounds. The things are the same, and so are all rules of the comparison above."
    )
    blocks: list[Block] = [Text(intro), _camera_table(measured.inside)]
    for frame in measured.inside:
        if USUAL in frame.times:
            ours, usual = frame.times[TRON], frame.times[USUAL]
            low, high = ours.range_over(usual)
            blocks.append(
                Text(
                    f"In turns with the {frame.place} TRON renders the usual view of {frame.count:,} "
                    f"surfels: a ray from within takes {ours.over(usual):.2f} times as long as one from "
                    f"outside (rounds from {low:.2f} to {high:.2f})."
                )
            )
    pictures = [
        Picture(picture, WITHIN[place], f"radiance of a camera {WITHIN[place]}")
        for place, picture in measured.inside_pictures.items()
    ]
    group = Pictures("Views of the cameras", pictures, columns=2)
    write_strips([group], ["inside"], output_dir / "pictures")
    return [Section("inside", "From within", [*blocks, group])]


def _hits(measured: Measured) -> str:
    if measured.hits is None:
        return ""
    hit, front, effective = measured.hits
    return (
        f"A camera ray of the smallest scene hits {hit:.0f} surfels, {front:.0f} of them from the front, "
        f"and is opaque after {effective:.0f}. "
    )


def _camera_table(frames: Sequence[CameraRays]) -> Table:
    peers = [peer.name for peer in PEERS if any(peer.name in frame.times for frame in frames)]
    headings = ["Surfels, pixels", "ms", "of it binning", "Mrays/s"]
    headings += ["Mrays/s", "TRON is × as fast", "rounds from–to"] * len(peers)
    rows = []
    for frame in frames:
        times, place = frame.times, f"{frame.place}, " if frame.place else ""
        row = [f"{place}{frame.count:,} surfels, {frame.size}²", _ms(times[TRON]), _ms(times[BINNING])]
        row = [*row, Cell(f"{frame.mrays():.2f}", "strong")]
        for name in peers:
            if name in times:
                ratio = frame.ratio(name)
                as_fast = Cell(f"{ratio:.{1 if ratio > 2 else 2}f}", "strong")
                row += [f"{frame.mrays(name):.3g}", as_fast, _range(times, name)]
            else:
                row += ["—"] * 3
        rows.append(row)
    absent = "" if "gsplat" in peers else " gsplat's 2DGS is absent: it needs a GPU and the package."
    caption = "Camera rays. Ratios are of medians; below 1 the peer is faster." + absent
    return Table(caption, headings, rows, [("", 1), *((TITLES[name], 3) for name in (TRON, *peers))])


def _same_picture(same: SamePicture, output_dir: Path) -> Pictures:
    difference = np.clip(ERROR_GAIN * np.abs(same.tron - same.volprim), 0, 1)
    alt = f"absolute difference of the two, times {ERROR_GAIN}"
    pictures = [
        Picture(same.tron, "TRON", "the benchmark's scene by TRON", strong=True),
        Picture(
            same.volprim, TITLES["volprim"], "the same scene by Mitsuba's integrator", f"{same.psnr:.1f} dB"
        ),
        Picture(difference, f"difference ×{ERROR_GAIN}", alt),
    ]
    note = (
        "Radiance along the same rays, at the smallest scene's large surfels, where differences show best. "
        "They lie at silhouettes, where the peer also composites surfels seen from behind."
    )
    group = Pictures("The same picture", pictures, note, columns=3)
    write_strips([group], ["camera"], output_dir / "pictures")
    return group


def growth_section(measured: Measured) -> list[Section]:
    """Time over surfels and over pixels, one line a contestant."""
    charts: list[Chart] = []
    size, count = measured.settings.pixels[0], measured.settings.middle[0]
    by_surfels = {frame.count: frame.times for frame in measured.camera if frame.size == size}
    by_pixels = {frame.size**2: frame.times for frame in measured.camera if frame.count == count}
    for frames, axis, fixed in (
        (by_surfels, "surfels", f"{size} × {size} pixels"),
        (by_pixels, "pixels", f"{count:,} surfels"),
    ):
        lines = {
            title: [(x, times[name].median) for x, times in sorted(frames.items()) if name in times]
            for name, title in TITLES.items()
            if name != "volprim_as_shipped"
        }
        lines = {title: points for title, points in lines.items() if len(points) > 1}
        if lines:
            caption = f"Seconds a frame as {axis} grow, {fixed}."
            charts.append(line_chart(lines, axis, "seconds", caption, logarithmic=True))
    return [Section("growth", "Growth with surfels and pixels", charts)] if charts else []


SHADOW_GROUPS = {
    "random rays, Mrays/s": (
        "TRON", "restarts", "closest hit", "any hit", "× restarts", "× closest hit", "× any hit",
    ),
    "irradiance pass, Mrays/s": ("TRON", "closest hit", "any hit", "× closest hit", "× any hit"),
    "hierarchy, ms": ("build", "refit", "Embree's build"),
    "tracing, × time": ("after refit", "with strays"),
}  # fmt: skip
"""Headings of the rows of :class:`eval.tracing.measured.ShadowRays`, in their order."""


def shadow_section(measured: Measured, found: Mapping[str, Row]) -> list[Section]:
    """Both sets of shadow rays, and the hierarchy's build and refit."""
    if not measured.shadow:
        return []
    intro = Text(
        "Two sets of rays. Random rays leave visible points in directions of their own. The others are those "
        "of the irradiance pass in its own order, timed by running the pass with each tracer in turn; what "
        "the pass costs with nothing in the way is taken off both. The restarting peer is the way to all "
        "hits through Mitsuba's queries: closest hit on a quad around each surfel, again 0.0001 behind it, "
        "with TRON's rules for opacity and sides, until less than 1% is left. A closest hit and an any hit "
        "are one query each on the same quads, ignoring opacity and sides: most any hits end at the surface "
        "that their ray leaves. The build of TRON's hierarchy "
        "is in the ratios; the peers' builds are not. A refit keeps the hierarchy's order when surfels move: "
        "here a tenth of them, together, by five spacings. The last column is the time of random rays when "
        "20 surfels lie 10,000 units outside, as reconstructions leave them, over that without."
    )
    rows = [
        [f"{shadow.count:,}", *(_shadow_cell(row) for row in shadow.rows())] for shadow in measured.shadow
    ]
    headings = ["Surfels", *(heading for group in SHADOW_GROUPS.values() for heading in group)]
    groups = [("", 1), *((title, len(group)) for title, group in SHADOW_GROUPS.items())]
    caption = "Shadow rays; a ratio above 1 means that TRON is faster."
    blocks: list[Block] = [intro, Table(caption, headings, rows, groups)]
    wrong = found.get("shadow.embree_restart_wrong_rays")
    if wrong is not None:
        share, most = format_value(wrong.value, "fraction"), found["shadow.embree_restart_max_error"].value
        blocks.append(
            Text(
                f"Restarting is not exact: {share} of its rays are off by more than 0.001, by up to "
                f"{most:.2f}, because hits within 0.0001 of one another are skipped."
            )
        )
    return [Section("shadow", "Shadow rays", blocks)]


def _shadow_cell(row: Row) -> Cell:
    digits = 1 if row.unit == "ms" else 2
    return Cell(f"{row.value:.{digits}f}", "strong" if "ratio" in row.metric else "plain")


def gradient_section(measured: Measured) -> list[Section]:
    """Forward and backward passes against the peer's."""
    if not measured.gradient:
        return []
    intro = Text(
        "One step of a fit: pack the parameters, bin, render, L2 against an image, and the gradient of every "
        "parameter. The peer's is dr.backward through mi.render, with the gradients of its centres, scales, "
        "rotations, opacities and harmonics; its hierarchy would have to be built anew after each step, "
        "which is not counted. The last column is the cosine between the two gradients by the harmonics: the "
        "same direction, up to the differences of the two pictures and to where in its pixel a ray falls."
    )
    rows = [
        [
            f"{step.count:,} surfels, {step.size}²",
            _ms(step.times[TRON]),
            _ms(step.times["volprim"]),
            Cell(f"{step.ratio:.1f}", "strong"),
            _range(step.times, "volprim"),
            f"{step.agreement:.3f}",
        ]
        for step in measured.gradient
    ]
    headings = ["Case", "TRON, ms", "volprim, ms", "TRON is × as fast", "rounds from–to", "cosine"]
    return [Section("gradient", "Gradient steps", [intro, Table("Forward and backward.", headings, rows)])]
