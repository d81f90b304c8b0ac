"""report.html of a reconstruction: the scene in three lights, what was found, how sure each figure is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from tron.apps.lit_scene import LitScene
from tron.apps.reconstruct_film import showcase_films
from tron.apps.reconstruct_pictures import chosen_views, view_pictures
from tron.apps.reconstruct_settings import ReportSettings
from tron.apps.relight_settings import QUALITY
from tron.apps.showcase import ball_pictures
from tron.captures import Capture
from tron.color import to_display
from tron.gaussians.scene import GaussianScene
from tron.report.page import (
    Block,
    Cell,
    Code,
    Film,
    Films,
    Page,
    Picture,
    Pictures,
    Section,
    Table,
    Text,
    Tile,
)
from tron.report.render import write_report
from tron.report.values import format_value
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Lighting, render_guidance
from tron.tracing import SurfelTracer

LEAD = (
    "Photos show a thing in the light of that day. From them were found small flat disks (surfels) that "
    "look like the photos, what their surfaces are made of, and the light that explains both. This page "
    "shows what came out, and how far each part of it can be trusted."
)
VIEWS = (
    "Photo and surfels beside each other. Normals and depth are colours; base color, roughness and metallic "
    "are what the surface is made of. Lit by the light that was found, materials should give the photo "
    "again: where they do not, material, light or shadow is wrong."
)
NO_TRUTH = "no truth in this capture: look at the pictures"
TRUTH = ("normal", "base_color", "roughness", "metallic")
SMALLER_IS_BETTER = ("lpips", "roughness_mae", "metallic_mae")
LEVEL = 0.95
MAP_HEIGHT = 128
FIGURES = {
    "psnr": ("PSNR of the photos", "dB", "higher is better; photos that were not learnt from"),
    "psnr_subject": ("on the subject", "dB", "the same where the mask is"),
    "ssim": ("SSIM", "1", "1 is the photo itself"),
    "lpips": ("LPIPS", "1", "0 is the photo itself"),
    "normal_mae_deg": ("Normals, mean error", "deg", "against the capture's true normals"),
    "normal_median_deg": ("Normals, median error", "deg", "the same, less moved by edges"),
    "base_color_psnr": ("Base color", "dB", "after one factor a view and channel"),
    "roughness_mae": ("Roughness, mean error", "1", "against the capture's own"),
    "metallic_mae": ("Metallic, mean error", "1", "against the capture's own"),
}
"""Figure of metrics.json -> its title, its unit, what it says."""


def write_page(
    path: Path,
    settings: ReportSettings,
    report: Mapping[str, Any],
    scene: GaussianScene,
    capture: Capture,
    light: EnvironmentMap | None,
) -> None:
    """Write the page of a finished reconstruction.

    Args:
        path: of the file.
        settings: how much is shown.
        report: what metrics.json holds.
        scene: the surfels.
        capture: that they were found from.
        light: that the photos were taken in, where it was found.
    """
    sections = [
        *([_films(scene, capture, settings)] if settings.frames else []),
        _figures(report),
        _views(scene, capture, light, settings, report),
        *_light(light),
        _sureness(report, capture, light),
        *_skipped(report),
        _provenance(report),
    ]
    name, held_out = Path(report["capture"]["path"]).name, report["test"]
    quality = "No photo was held out, so nothing says how it looks from elsewhere."
    if held_out:
        quality = f"Held-out photos are met with {format_value(held_out['psnr'], 'dB')}."
    photos = f"{report['capture']['views'] - len(report['capture']['held_out'])} photos"
    page = Page(
        title=f"{name}: from photos to relightable surfels",
        verdict=f"{photos} became {report['surfels']:,} surfels in {_seconds(report)}. {quality}",
        lead=[LEAD],
        tiles=list(_tiles(report)),
        sections=sections,
        footer="All figures: metrics.json beside this page. scene.ply is for tron-relight and 3DGS viewers.",
        brand="reconstruction",
    )
    write_report(page, path)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Student's interval of the mean of views at LEVEL; None of fewer than two."""
    if len(values) < 2:
        return None
    spread = float(np.std(values, ddof=1)) / len(values) ** 0.5
    reach = float(scipy.stats.t.ppf(0.5 + LEVEL / 2, len(values) - 1)) * spread
    return float(np.mean(values)) - reach, float(np.mean(values)) + reach


def _films(scene: GaussianScene, capture: Capture, settings: ReportSettings) -> Section:
    size = settings.side, settings.side
    films = [
        Film(video, size, name, f"a walk around the scene under a {name}")
        for name, video in showcase_films(scene, capture, settings.frames, settings.side).items()
    ]
    note = (
        "As tron-relight draws it in its quick quality: shadows, reflections and light that bounces between "
        "the surfels, no network. None of these lights was there when the photos were taken."
    )
    return Section("relit", "Under three other lights", [Films("A walk around it", films, note)])


def _figures(report: Mapping[str, Any]) -> Section:
    held_out = [report["views"][name] for name in report["capture"]["held_out"] if name in report["views"]]
    rows = []
    for key, (title, unit, words) in FIGURES.items():
        values = [figures[key] for figures in held_out if key in figures]
        if not values:
            continue
        around, ends = mean_interval(values), sorted(values)
        between = "—" if around is None else " to ".join(format_value(end, unit) for end in around)
        worst, best = ends[0], ends[-1]
        if unit == "deg" or key in SMALLER_IS_BETTER:
            worst, best = best, worst
        mean = Cell(format_value(float(np.mean(values)), unit), "strong")
        shown = [between, format_value(worst, unit), format_value(best, unit), str(len(values)), words]
        rows.append([title, mean, *shown])
    headings = ["Figure", "Mean", f"{LEVEL:.0%} of means", "Worst view", "Best view", "Views", "What it says"]
    caption = (
        "On held-out views, which nothing was learnt from. The range holds the mean over many more views of "
        "this scene, were they taken alike; it says nothing of another scene."
    )
    blocks: list[Block] = [Table(caption, headings, rows, words=[6])]
    if not rows:
        blocks = [Text("No view was held out: there is no figure that the training did not see.")]
    train = f"Training views, for comparison: {format_value(report['train']['psnr'], 'dB')}."
    return Section("figures", "Figures", [*blocks, Text(train)])


def _views(
    scene: GaussianScene,
    capture: Capture,
    light: EnvironmentMap | None,
    settings: ReportSettings,
    report: Mapping[str, Any],
) -> Section:
    """Some views with every channel, and what materials and light together make of them."""
    views = chosen_views(capture, settings.views)
    tracer, lit, estimation = SurfelTracer(scene), {}, QUALITY["preview"]
    if light is not None:
        shown, lighting = LitScene(scene, views[0].camera, estimation, 0), Lighting(light)
        bounced = shown.bake(lighting)
        for number, view in enumerate(views):
            guidance = render_guidance(
                tracer, view.camera, lighting, estimation, number, bounce=bounced(view.camera)
            )
            lit[view.name] = to_display(guidance.lit, capture.exposure)
    blocks: list[Block] = [Text(VIEWS)]
    for view in views:
        figures = report["views"].get(view.name, {})
        channels = view_pictures(tracer, view)
        if view.name in lit:
            channels["lit by the light found"] = lit[view.name]
        pictures = [
            Picture(
                np.broadcast_to(np.atleast_3d(image), (*image.shape[:2], 3)),
                name,
                f"{name} of view {view.name}",
                f"{figures['psnr']:.1f} dB" if name == "radiance" and "psnr" in figures else "",
                strong=name == "photo",
            )
            for name, image in channels.items()
            if name not in ("opacity", "position")
        ]
        kind = "Held-out" if view.name in capture.test else "Training"
        blocks.append(Pictures(f"{kind} view {view.name}", pictures, columns=5))
    return Section("views", "Photos and what was found behind them", blocks)


def _light(light: EnvironmentMap | None) -> list[Section]:
    if light is None:
        return []
    mirror, matt = ball_pictures(light)
    height = min(MAP_HEIGHT, light.image.shape[0])
    shown = to_display(light.baked().resized(height).image, light.exposure())
    pictures = [
        Picture(mirror, "a mirror ball in it", "the light in a mirror ball"),
        Picture(matt, "a matt ball in it", "the light on a matt grey ball"),
        Picture(shown, "all around: up is up, left and right meet", "the light as a lat-long map"),
    ]
    share = f"{light.contrast():.0%} of the light comes from the brightest hundredth of all directions."
    return [Section("light", "The light of the photos", [Pictures("As it was found", pictures, share, 3)])]


def _sureness(report: Mapping[str, Any], capture: Capture, light: EnvironmentMap | None) -> Section:
    """Table of where each result comes from, and how far it can be trusted."""
    truth = {field for view in capture.test_views for field in TRUTH if view.has(field)}
    learnt = set(report["materials_learnt"])
    rows = [["Radiance", "held-out photos", "as sure as its figures above"]]
    known = "held against the capture's own normals above" if "normal" in truth else NO_TRUTH
    begun = report.get("first_surfels", {})
    source = f"the photos, from {begun['source']}" if begun.get("source") else "the photos"
    if begun.get("stereo_confident") is not None:
        source += f"; {begun['stereo_confident']:.0%} of the pixels have a depth that other photos confirm"
    rows.append(["Normals and depth", source, known])
    said = report["light"] or {}
    evidence = "prior or photos"
    if "surfels_seen" in said:
        evidence = f"photos, which see {said['surfels_seen']:.0%} of the surfels"
    for name, title in (("base_color", "Base color"), ("roughness", "Roughness"), ("metallic", "Metallic")):
        if name not in learnt:
            rows.append([title, "nothing: it is what surfels begin with", "not to be relied on"])
            continue
        rows.append([title, evidence, "held against the truth above" if name in truth else NO_TRUTH])
    if "spread" in said:
        words = (
            f"a surfel's colour differs by a factor of {np.exp(said['spread']):.2f} between photos (median)"
        )
        rows.append(["Colours over the photos", "the photos", f"{words}: highlights, wrong depth and noise"])
    if light is None:
        rows.append(["Light", "—", "none was found"])
    else:
        rows.append(
            ["Light", _sun(said, report["capture"]["up"]), "up to one factor that base color may share"]
        )
    caption = "Where each result comes from, and how far it can be trusted."
    table = Table(caption, ["Result", "From", "How sure"], rows, words=[1, 2])
    return Section("sure", "How sure it is", [table])


def _sun(said: Mapping[str, Any], up: Sequence[float]) -> str:
    """Words on the sun that was found, if one was looked for."""
    if "sun" not in said:
        return "the photos"
    if said["sun"] is None:
        return "the photos; no sun explains their shadows"
    height = np.degrees(np.arcsin(np.clip(np.dot(said["sun"]["direction"], up), -1, 1)))
    return f"the photos; a sun {said['sun']['width_deg']:.1f}° wide stands {height:.0f}° high"


def _skipped(report: Mapping[str, Any]) -> list[Section]:
    skipped = report["capture"]["skipped"]
    if not skipped:
        return []
    caption = f"{len(skipped)} photos that the capture names and that were not used."
    table = Table(caption, ["Photo", "Why"], [[name, why] for name, why in skipped.items()], words=[1])
    return [Section("skipped", "What was skipped", [table])]


def _provenance(report: Mapping[str, Any]) -> Section:
    machine = {key.replace("_", " "): str(value) for key, value in report["machine"].items() if value}
    seconds = ", ".join(f"{name} {value:.0f} s" for name, value in report["seconds"].items())
    told = {"capture": report["capture"]["path"], "time": seconds, "version": report["version"], **machine}
    table = Table("Where and with what it was made.", ["Property", "Value"], list(told.items()), words=[1])
    relight = "tron-relight scene=scene.ply environment=ANY.hdr output_dir=relit"
    return Section(
        "made",
        "How it was made",
        [
            table,
            Text("config.yaml holds every setting. To relight it under a light of yours:"),
            Code(relight),
        ],
    )


def _tiles(report: Mapping[str, Any]) -> Iterator[Tile]:
    test = report["test"] or {}
    for key in ("psnr", "ssim", "normal_mae_deg", "base_color_psnr"):
        if key in test:
            title, unit, _ = FIGURES[key]
            yield Tile(f"{title}, held out", format_value(test[key], unit))
    yield Tile("Surfels", f"{report['surfels']:,}")
    yield Tile("Time", _seconds(report))


def _seconds(report: Mapping[str, Any]) -> str:
    return format_value(sum(report["seconds"].values()), "s")
