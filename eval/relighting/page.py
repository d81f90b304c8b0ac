"""The relighting benchmark in words, tables and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.relighting.baselines import SEVEN, THREE
from eval.relighting.gallery import Shown, comparison, guidance
from eval.relighting.guidance import GuidanceScores
from eval.relighting.predictions import Region
from eval.relighting.scores import GROUPS, REGIONS, SUFFIX, Scores
from eval.relighting.shadows import (
    DARKENED_BELOW,
    LEAK_OVER_MEAN,
    LIT_ABOVE,
    SAME_DEPTH,
    SAME_NORMAL_DEG,
    SHADOWED_BELOW,
)
from eval.report.figures import MINUS, with_interval
from eval.report.intervals import interval_note
from eval.report.outcome import Outcome
from eval.report.page import Block, Cell, Chart, Section, Table, Text, Tone
from eval.report.strips import write_strips
from eval.results import Row
from tron.shards.schema import ClipMeta

WHAT = {
    "neural": "the neural renderer: a small transformer over pbr and irradiance",
    "pbr": "split-sum shading of the surfels, no shadows",
    "pbr_x_irradiance": "pbr times irradiance times one fitted number",
    "shadow_ratio": "pbr times the share of light that arrives",
    "shadowed": "shadowed diffuse light plus split-sum specular",
    "affine": "fitted blend of pbr, irradiance and a constant",
    "affine_ratio": "the same with shadow_ratio as a third input",
    "pixel_mlp": "a network that sees one pixel at a time, trained as long",
}
REGION_WORDS: dict[Region, str] = {"foreground": "foreground", "frame": "full frame"}
HEADLINE = {
    "neural.psnr": "Neural renderer, foreground PSNR",
    "neural.gain_over_best_of_three": "Gain over the best of pbr, shadow_ratio and affine",
    "neural.gain_over_best_of_seven": "Gain over the best of all seven baselines",
    "neural.psnr_full": "Neural renderer, full-frame PSNR",
    "guidance.irradiance_psnr": "Irradiance against path tracing, worst kind of light",
    "guidance.shadow_leak": "Shadow pixels of the surfels that leak light",
    "surfels.base_color_psnr": "Base color of the surfels",
    "surfels.normal_mae_deg": "Normals of the surfels, mean error",
}
PAIRED = (
    "A gain's interval is that of the differences on the same frames, not the difference of two intervals. "
    "No interval says how much another training of the same networks would differ."
)
LEAD = (
    "TRON relights captured 3D worlds. A scene becomes a cloud of small flat disks (surfels) with "
    "materials; under a new light, a ray tracer turns them into two quick pictures: pbr, shading without "
    "shadows, and irradiance, the light that arrives at each surface. A neural renderer turns the two into"
    " a photograph-like image.",
    "This page measures that last step on scenes and lights that were not trained on, against a path "
    "tracer's ground truth and against seven simpler ways of using the same two pictures.",
)


def outcome(
    scores: Scores,
    guidance_scores: GuidanceScores,
    clips: Sequence[ClipMeta],
    shown: Sequence[Shown],
    curves: Sequence[Chart],
    inputs: dict[str, Any],
    output_dir: Path,
    reproduce: Sequence[str],
    seed: int,
) -> Outcome:
    """Rows and sections of an evaluation; the pictures are also written below ``output_dir/pictures``.

    ``seed`` draws the scenes of the intervals.
    """
    rows = [*scores.rows(seed), *guidance_scores.rows(seed)]
    found = {row.metric: row for row in rows}
    sections = [
        Section("results", "Every method, every held-out frame", [*_methods(scores, clips, found)]),
        Section("lights", "By kind of light", [_families(scores, found)]),
    ]
    if shown:
        comparisons = [comparison(each) for each in shown]
        write_strips(comparisons, [each.meta.key for each in shown], output_dir / "pictures")
        intro = Text(
            "Middle frames of held-out clips, evenly spaced in the ranking by gain: the first is the clip "
            "on which the network gains least, the last the one on which it gains most. Decibels are of the"
            " picture shown, on the foreground; higher is better, and 1 dB is easy to see side by side."
        )
        sections.append(Section("pictures", "Held-out scenes under held-out lights", [intro, *comparisons]))
    sections += _guidance_section(guidance_scores, found, shown, output_dir)
    if curves:
        sections.append(Section("training", "How the training went", curves))
    return Outcome(
        rows=rows,
        title="Relighting held-out scenes under held-out lights",
        verdict=_verdict(scores, clips, found),
        lead=LEAD,
        sections=sections,
        headline=HEADLINE,
        reproduce=reproduce,
        inputs=inputs,
    )


def _verdict(scores: Scores, clips: Sequence[ClipMeta], found: Mapping[str, Row]) -> str:
    n_frames = sum(meta.frames for meta in clips)
    n_scenes, n_lights = len({meta.scene for meta in clips}), len({meta.light for meta in clips})
    where = f"On {n_frames} held-out frames ({n_scenes} scenes, {n_lights} lights)"
    neural, pbr = found.get("neural.psnr"), found.get("pbr.psnr")
    if neural is None:
        if pbr is None:
            return f"{where}."
        return f"{where} pbr alone reaches {with_interval(pbr)}; no neural renderer was given."
    text = f"{where} the neural renderer reaches {with_interval(neural)} on the foreground"
    gain_three, gain_seven = (found.get(f"neural.gain_over_{group}") for group in GROUPS)
    best = scores.best(SEVEN, "foreground")
    if gain_three:
        text += f", {with_interval(gain_three, signed=True)} over the best of pbr, shadow_ratio and affine"
    if gain_seven and best:
        text += f", {with_interval(gain_seven, signed=True)} over the best of all seven baselines ({best[0]})"
    return text + "."


def _methods(scores: Scores, clips: Sequence[ClipMeta], found: Mapping[str, Row]) -> list[Block]:
    headings = ["Method", "What it is", *(["PSNR", "SSIM", "neural gains"] * len(REGIONS))]
    groups = [("", 2), *((REGION_WORDS[region], 3) for region in REGIONS)]
    rows = []
    for method in scores.methods:
        tone = "strong" if method == "neural" else "plain"
        row = [Cell(method, tone), Cell(WHAT[method], "faint")]
        for region in REGIONS:
            suffix = SUFFIX[region]
            row += [
                _cell(found.get(f"{method}.psnr{suffix}"), tone),
                _cell(found.get(f"{method}.ssim{suffix}"), tone),
                _gain_cell(found.get(f"neural.gain_over_{method}{suffix}")),
            ]
        rows.append(row)
    for group, methods in GROUPS.items():
        row = [Cell(group.replace("_", " "), "strong"), Cell("", "faint")]
        for region in REGIONS:
            best = scores.best(methods, region)
            row += [
                Cell(f"{best[1]:.2f}" if best else "—", "strong"),
                Cell(best[0] if best else "—", "faint"),
                _gain_cell(found.get(f"neural.gain_over_{group}{SUFFIX[region]}")),
            ]
        rows.append(row)
    notes = (
        "PSNR says how close a picture is to the truth, in decibels: 20 dB is a typical error of 10% of full "
        "brightness, 30 dB of 3%, and 6 dB more halve it. SSIM compares structure; 1 is identical. "
        "PSNR is taken of each displayed frame (exposure, then the AgX tone curve; peak 1) and averaged "
        "over frames; SSIM likewise. “Neural gains” is the neural renderer's mean PSNR minus the method's. "
        "Foreground is where a ray through the pixel's centre meets true geometry. Best of three: "
        f"{', '.join(THREE)}. Products are taken in linear light before the tone curve. Blends and factors "
        "are fitted on the foreground of the training split in float64. On full frames the blends and the "
        "per-pixel network are laid over pbr by the surfels' opacity, because a blend that suits surfaces is "
        "wrong for the sky, which pbr shows as it is."
    )
    caption = "PSNR and gains in dB; higher is better everywhere."
    scenes = len({meta.scene for meta in clips})
    frames = sum(meta.frames for meta in clips)
    return [
        Table(caption, headings, rows, groups, words=[1]),
        Text(f"{interval_note(scenes, f'{frames} frames')} {PAIRED}"),
        Text(notes),
    ]


def _cell(row: Row | None, tone: Tone = "plain") -> Cell:
    return Cell("—" if row is None else with_interval(row).replace(" dB", ""), tone)


def _gain_cell(row: Row | None) -> Cell:
    if row is None:
        return Cell("")
    text = with_interval(row, signed=True).replace(" dB", "")
    if row.low is not None and row.high is not None and row.low <= 0 <= row.high:
        return Cell(text)  # other scenes may turn it round
    return Cell(text, "good" if text[0] == "+" else "bad" if text[0] == MINUS else "plain")


def _families(scores: Scores, found: Mapping[str, Row]) -> Table:
    families = scores.families
    headings = ["Method", *families, *families]
    groups = [("", 1), *((REGION_WORDS[region], len(families)) for region in REGIONS)]
    places: list[tuple[Region, str]] = [(region, family) for region in REGIONS for family in families]
    rows = []
    for method in scores.methods:
        tone = "strong" if method == "neural" else "plain"
        means = [found.get(f"{method}.psnr{SUFFIX[region]}.{family}") for region, family in places]
        rows.append([Cell(method, tone), *(_cell(mean, tone) for mean in means)])
    for group in GROUPS:
        gains = [found.get(f"neural.gain_over_{group}{SUFFIX[region]}.{family}") for region, family in places]
        rows.append([Cell(f"gain over {group.replace('_', ' ')}"), *map(_gain_cell, gains)])
    counts = [
        f"{family}: {mean[1]} frames" for family in families if (mean := scores.mean("pbr", "frame", family))
    ]
    return Table(f"PSNR in dB by kind of light ({', '.join(counts)}).", headings, rows, groups)


def _guidance_section(
    scores: GuidanceScores, rows: Mapping[str, Row], shown: Sequence[Shown], output_dir: Path
) -> list[Section]:
    """The surfels' own quality; no section where the test clips carry no reference buffers."""
    if not any(name.startswith(("guidance.", "surfels.")) for name in rows):
        return []
    intro = Text(
        "What the network is given decides what it can do. Irradiance of the surfels is compared with the "
        "path tracer's direct irradiance of the true scene, displayed through the same tone curve, on the "
        f"foreground. A pixel is in shadow where under {SHADOWED_BELOW:.0%} of the path tracer's own "
        "unshadowed light arrives in the reference, and leaks if it is brighter than the reference by more "
        f"than {LEAK_OVER_MEAN:.0%} of the frame's mean; it is lit where over {LIT_ABOVE:.0%} arrives, and "
        f"darkened if it keeps less than {DARKENED_BELOW:.0%} of it. Both are judged where surfels and truth "
        f"show the same surface (distances within {SAME_DEPTH:g} units, or normals within "
        f"{SAME_NORMAL_DEG:.0f}°): at silhouettes surfels overhang by a pixel and show another one. Pictures "
        "called shadow errors show leaking pixels in orange, darkened ones in blue."
    )
    blocks: list[Block] = [intro]
    families = sorted(scores.irradiance_psnr)
    if families:
        metrics = {
            "irradiance PSNR": "guidance.irradiance_psnr",
            "shadow pixels leaking": "guidance.shadow_leak",
            "shadow pixels leaking, same surface by normals": "guidance.shadow_leak_same_normal",
            "shadow pixels leaking, silhouettes included": "guidance.shadow_leak_with_silhouettes",
            "lit pixels darkened": "guidance.lit_darkened",
            "lit pixels darkened, same surface by normals": "guidance.lit_darkened_same_normal",
            "lit pixels darkened, silhouettes included": "guidance.lit_darkened_with_silhouettes",
        }
        table_rows = [
            [Cell(name), _value(rows.get(metric), "strong")]
            + [_value(rows.get(f"{metric}.{family}")) for family in families]
            for name, metric in metrics.items()
        ]
        caption = (
            "Irradiance; “overall” is the lowest PSNR of the kinds of light, and the fraction of all pixels."
        )
        blocks.append(Table(caption, ["Figure", "overall", *families], table_rows))
    surfels = [
        [Cell(name), _value(rows.get(metric), "strong"), Cell(note, "faint")]
        for name, metric, note in (
            ("base color PSNR", "surfels.base_color_psnr", "linear, on the foreground, averaged over views"),
            ("normals, mean angular error", "surfels.normal_mae_deg", "where both have a surface"),
        )
        if metric in rows
    ]
    if surfels:
        blocks.append(Table("Surfels at held-out views.", ["Figure", "Measured", "How"], surfels, words=[2]))
    drawn = list({each.meta.light_family: each for each in reversed(shown) if each.guidance}.values())
    groups = [guidance(each) for each in drawn]
    write_strips(groups, [f"{each.meta.key}-guidance" for each in drawn], output_dir / "pictures")
    return [Section("guidance", "The guidance itself", [*blocks, *groups])]


def _value(row: Row | None, tone: Tone = "plain") -> Cell:
    return Cell(with_interval(row) if row else "—", tone)
