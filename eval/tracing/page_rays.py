"""Camera rays, growth, shadow rays and gradient steps on the tracing benchmark's page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eval.report.charts import line_chart
from eval.report.figures import format_value
from eval.report.page import Block, Cell, Chart, Picture, Pictures, Section, Table, Text
from eval.report.strips import write_strips
from eval.results import Row

if TYPE_CHECKING:
    from eval.tracing.benchmark import Measured, Tracing
    from eval.tracing.camera_rays import CameraRays

NAMES = {
    "tron": "TRON",
    "volprim": "volprim_rf_basic",
    "volprim_as_shipped": "volprim_rf_basic as shipped",
    "embree_closest_hit": "one closest hit",
    "gsplat": "gsplat 2DGS",
}


def family(metric: str) -> str:
    """A metric without its case."""
    return ".".join(metric.split(".")[:2])


def _range(frame: CameraRays, name: str) -> str:
    low, high = frame.times[name].range_over(frame.times["tron"])
    return f"{low:.1f}–{high:.1f}"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.1f}" if seconds < 10 else f"{1e3 * seconds:.0f}"


def camera_section(settings: Tracing, measured: Measured, output_dir: Path) -> list[Section]:
    """One frame against the peers, what they cannot do the same, and both pictures."""
    if not measured.pictures:
        return []
    frames = [measured.camera[key] for key in measured.camera if _is_main(settings, measured.camera[key])]
    stop = "0.001"
    text = [
        Text(
            f"{_hits(measured)}The peer is the integrator that Mitsuba ships for such scenes, "
            "volprim_rf_basic, on flat ellipsoids made of the same surfels, harmonics of degree "
            f"{settings.sh_degree} on both sides, one ray a pixel, box filter. As shipped it ends a ray at a "
            f"transmittance of 0.01; TRON ends at {stop}. The column “{NAMES['volprim']}” is its source "
            f"with that one number changed to {stop}, “as shipped” does less work than TRON."
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
    ]
    extras = [frame for frame in (measured.harmonics, measured.from_gbuffers) if frame is not None]
    blocks: list[Block] = [*text]
    if extras:
        labels = ["harmonics of degree 3 on both sides", "surfels as made from G-buffers: kernel degree 4"]
        rows = [
            [
                Cell(label),
                Cell(f"{frame.mrays('tron'):.2f}", "strong"),
                Cell(f"{frame.times['volprim'].over(frame.times['tron']):.1f}×" if _has(frame) else "—"),
            ]
            for label, frame in zip(labels, extras)
        ]
        caption = f"The same at {measured.harmonics.case if measured.harmonics else ''}, other surfels."
        headings = ["Surfels", "TRON, Mrays/s", "times as fast as volprim"]
        blocks.append(Table(caption, headings, rows))
    shapes = {name: f"{1e3 * times.median:.0f} ms" for name, times in measured.shapes.items()}
    if shapes:
        told = ", ".join(f"{name} {value}" for name, value in shapes.items())
        blocks.append(
            Text(f"Mitsuba has two plugins for such primitives; the faster here was taken: {told}.")
        )
    blocks.append(_same_picture(measured, output_dir))
    return [Section("camera", "Camera rays", blocks)]


def inside_section(measured: Measured, output_dir: Path) -> list[Section]:
    """Frames of cameras within their scenes."""
    if not measured.inside:
        return []
    from eval.tracing.camera_rays import USUAL

    intro = (
        "Views so far look at the scene from outside. Here the camera stands in a room, and on a ground that "
        "goes on behind it: surfels lie on all sides, and many cross the plane through the camera, where "
        "projection has no bounds. The things are the same, and so are all rules of the comparison above."
    )
    blocks: list[Block] = [Text(intro), _camera_table(measured.inside)]
    for frame in measured.inside:
        if USUAL in frame.times:
            ours, usual = frame.times["tron"], frame.times[USUAL]
            low, high = ours.range_over(usual)
            blocks.append(
                Text(
                    f"In turns with the {frame.place} TRON renders the usual view of {frame.count:,} "
                    f"surfels: a ray from within takes {ours.over(usual):.2f} times as long as one from "
                    f"outside (rounds from {low:.2f} to {high:.2f})."
                )
            )
    pictures = [
        Picture(picture, f"in a {place}", f"radiance from within a {place}")
        for place, picture in measured.inside_pictures.items()
    ]
    group = Pictures("What the cameras see", pictures, "", columns=2)
    write_strips([group], ["inside"], output_dir / "pictures")
    return [Section("inside", "From within", [*blocks, group])]


def _has(frame: CameraRays) -> bool:
    return "volprim" in frame.times


def _is_main(settings: Tracing, frame: CameraRays) -> bool:
    return frame.count in settings.surfels and frame.size in settings.pixels


def _hits(measured: Measured) -> str:
    if measured.hits is None:
        return ""
    met, front, effective = measured.hits
    return (
        f"A camera ray of the smallest scene meets {met:.0f} surfels, {front:.0f} of them from the front, "
        f"and is opaque after {effective:.0f}. "
    )


def _camera_table(frames: Sequence[CameraRays]) -> Table:
    peers = [name for name in NAMES if name != "tron" and any(name in frame.times for frame in frames)]
    headings = ["Surfels, pixels", "ms", "of it binning", "Mrays/s"]
    groups = [("", 1), ("TRON", 3)]
    for name in peers:
        headings += ["Mrays/s", "TRON is × as fast", "rounds from–to"]
        groups.append((NAMES[name], 3))
    rows = []
    for frame in frames:
        ours = frame.times["tron"]
        row = [
            Cell(f"{f'{frame.place}, ' if frame.place else ''}{frame.count:,} surfels, {frame.size}²"),
            Cell(_ms(ours.median)),
            Cell(_ms(frame.times["binning"].median)),
            Cell(f"{frame.mrays('tron'):.2f}", "strong"),
        ]
        for name in peers:
            if name in frame.times:
                ratio = frame.times[name].over(ours)
                digits = 1 if ratio > 2 else 2
                row += [Cell(f"{frame.mrays(name):.3g}"), Cell(f"{ratio:.{digits}f}", "strong")]
                row.append(Cell(_range(frame, name), "faint"))
            else:
                row += [Cell("—")] * 3
        rows.append(row)
    absent = "" if "gsplat" in peers else " gsplat's 2DGS is absent: it needs a GPU and the package."
    caption = "Camera rays. Ratios are of medians; below 1 the peer is faster." + absent
    return Table(caption, headings, rows, groups)


def _same_picture(measured: Measured, output_dir: Path) -> Pictures:
    pictures = [
        Picture(measured.pictures["tron"], "TRON", "the benchmark's scene by TRON", strong=True),
        Picture(
            measured.pictures["volprim"],
            "volprim_rf_basic",
            "the same scene by Mitsuba's integrator",
            f"{measured.pictures['psnr']:.1f} dB",
        ),
        Picture(measured.pictures["difference"], "difference ×4", "absolute difference of the two, times 4"),
    ]
    note = (
        "Radiance along the same rays, at the smallest scene's large surfels, where differences show best. "
        "They lie at silhouettes, where the peer also composites surfels seen from behind."
    )
    group = Pictures("The same picture", pictures, note, columns=3)
    write_strips([group], ["camera"], output_dir / "pictures")
    return group


def growth_section(settings: Tracing, measured: Measured) -> list[Section]:
    """Time over surfels and over pixels, one line a contestant."""
    charts: list[Chart] = []
    size, count = settings.pixels[0], settings.surfels[min(1, len(settings.surfels) - 1)]
    by_surfels = sorted((f for f in measured.camera.values() if f.size == size), key=lambda f: f.count)
    by_pixels = sorted((f for f in measured.camera.values() if f.count == count), key=lambda f: f.size)
    for frames, axis, where in (
        (by_surfels, "surfels", f"{size} × {size} pixels"),
        (by_pixels, "pixels", f"{count:,} surfels"),
    ):
        if len(frames) < 2:
            continue
        names = ("tron", "volprim", "embree_closest_hit", "gsplat")
        lines = {
            NAMES[name]: [
                (f.count if axis == "surfels" else f.size**2, f.times[name].median)
                for f in frames
                if name in f.times
            ]
            for name in names
        }
        caption = f"Seconds a frame as {axis} grow, {where}."
        lines = {name: points for name, points in lines.items() if len(points) > 1}
        charts.append(line_chart(lines, axis, "seconds", caption, logarithmic=True))
    return [Section("growth", "Growth with surfels and pixels", charts)] if charts else []


def shadow_section(measured: Measured, found: dict[str, Row]) -> list[Section]:
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
    headings = [
        "Surfels", "TRON", "restarts", "closest hit", "any hit", "× restarts", "× closest hit", "× any hit",
        "TRON", "closest hit", "any hit", "× closest hit", "× any hit",
        "build", "refit", "Embree's build", "after refit", "with strays",
    ]  # fmt: skip
    groups = [
        ("", 1),
        ("random rays, Mrays/s", 7),
        ("irradiance pass, Mrays/s", 5),
        ("hierarchy, ms", 3),
        ("tracing, × time", 2),
    ]
    columns = [
        "shadow.mrays_random",
        "shadow.embree_restart_mrays_random",
        "shadow.embree_closest_hit_mrays_random",
        "shadow.embree_any_hit_mrays_random",
        "shadow.ratio_to_embree_restart",
        "shadow.ratio_to_embree_closest_hit_random",
        "shadow.ratio_to_embree_any_hit_random",
        "shadow.mrays_irradiance",
        "shadow.embree_closest_hit_mrays_irradiance",
        "shadow.embree_any_hit_mrays_irradiance",
        "shadow.ratio_to_embree_closest_hit",
        "shadow.ratio_to_embree_any_hit",
        "bvh.build_ms",
        "bvh.refit_ms",
        "bvh.embree_build_ms",
        "bvh.trace_after_refit",
        "shadow.stray_slowdown",
    ]
    rows = []
    for shadow in measured.shadow:
        by_name = {family(row.metric): row.value for row in shadow.rows()}
        cells = [
            Cell(
                f"{by_name[name]:.{1 if name.endswith('_ms') else 2}f}",
                "strong" if "ratio" in name else "plain",
            )
            for name in columns
        ]
        rows.append([Cell(f"{shadow.count:,}"), *cells])
    caption = "Shadow rays; a ratio above 1 means that TRON is faster."
    blocks: list[Block] = [intro, Table(caption, headings, rows, groups)]
    wrong = found.get("shadow.embree_restart_wrong_rays")
    if wrong is not None:
        blocks.append(
            Text(
                f"Restarting is not exact: {format_value(wrong.value, 'fraction')} of its rays are off by "
                f"more than 0.001, by up to {found['shadow.embree_restart_max_error'].value:.2f}, because "
                "hits within 0.0001 of one another are skipped."
            )
        )
    return [Section("shadow", "Shadow rays", blocks)]


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
            Cell(f"{step.count:,} surfels, {step.size}²"),
            Cell(_ms(step.times["tron"].median)),
            Cell(_ms(step.times["volprim"].median)),
            Cell(f"{step.ratio:.1f}", "strong"),
            Cell("–".join(f"{v:.1f}" for v in step.times["volprim"].range_over(step.times["tron"])), "faint"),
            Cell(f"{step.agreement:.3f}"),
        ]
        for step in measured.gradient
    ]
    headings = ["Case", "TRON, ms", "volprim, ms", "TRON is × as fast", "rounds from–to", "cosine"]
    return [Section("gradient", "Gradient steps", [intro, Table("Forward and backward.", headings, rows)])]
