"""The relighting benchmark in words, tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.baselines import SEVEN, THREE
from eval.benchmarks import Outcome
from eval.guidance import GuidanceScores
from eval.predictions import Region
from eval.report.figures import MINUS, written
from eval.report.gallery import Shown, comparison, guidance, write_strips
from eval.report.page import Block, Cell, Chart, Section, Table, Text
from eval.results import Row
from eval.scores import GROUPS, REGIONS, Scores
from eval.shadows import DARKENED_BELOW, LEAK_OVER_MEAN, LIT_ABOVE, SAME_SURFACE_DEG, SHADOWED_BELOW
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
) -> Outcome:
    """Rows and sections of an evaluation; the pictures are also written below ``output_dir/pictures``."""
    sections = [
        Section("results", "Every method, every held-out frame", [*_methods(scores)]),
        Section("lights", "By kind of light", [_families(scores)]),
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
    sections += _guidance_section(guidance_scores, shown, output_dir)
    if curves:
        sections.append(Section("training", "How the training went", curves))
    return Outcome(
        rows=[*scores.rows(), *guidance_scores.rows()],
        title="Relighting held-out scenes under held-out lights",
        verdict=_verdict(scores, clips),
        lead=LEAD,
        sections=sections,
        headline=HEADLINE,
        reproduce=reproduce,
        inputs=inputs,
    )


def _verdict(scores: Scores, clips: Sequence[ClipMeta]) -> str:
    n_frames = sum(meta.frames for meta in clips)
    n_scenes, n_lights = len({meta.scene for meta in clips}), len({meta.light for meta in clips})
    where = f"On {n_frames} held-out frames ({n_scenes} scenes, {n_lights} lights)"
    neural, best = scores.mean("neural"), scores.best(SEVEN, "foreground")
    gain_three, gain_seven = scores.gain(THREE, "foreground"), scores.gain(SEVEN, "foreground")
    if neural is None:
        pbr = scores.mean("pbr")
        return (
            f"{where} pbr alone reaches {pbr[0]:.2f} dB; no neural renderer was given."
            if pbr
            else f"{where}."
        )
    text = f"{where} the neural renderer reaches {neural[0]:.2f} dB on the foreground"
    if gain_three:
        text += f", {_more(gain_three[0])} the best of pbr, shadow_ratio and affine"
    if gain_seven and best:
        text += f" and {_more(gain_seven[0])} the best of all seven baselines ({best[0]})"
    return text + "."


def _more(gain: float) -> str:
    return f"{abs(gain):.2f} dB {'more' if gain >= 0 else 'less'} than"


def _methods(scores: Scores) -> list[Block]:
    headings = ["Method", "What it is", *(["PSNR", "SSIM", "neural gains"] * len(REGIONS))]
    groups = [("", 2), *((REGION_WORDS[region], 3) for region in REGIONS)]
    rows = []
    for method in scores.methods:
        tone = "strong" if method == "neural" else "plain"
        row = [Cell(method, tone), Cell(WHAT[method], "faint")]
        for region in REGIONS:
            psnr, ssim = scores.mean(method, region), scores.mean(method, region, metric="ssim")
            gain = None if method == "neural" else scores.gain((method,), region)
            row += [
                Cell(f"{psnr[0]:.2f}" if psnr else "—", tone),
                Cell(written(ssim[0], "1") if ssim else "—", tone),
                _gain_cell(gain),
            ]
        rows.append(row)
    for group, methods in GROUPS.items():
        row = [Cell(group.replace("_", " "), "strong"), Cell("", "faint")]
        for region in REGIONS:
            best = scores.best(methods, region)
            row += [
                Cell(f"{best[1]:.2f}" if best else "—", "strong"),
                Cell(best[0] if best else "—", "faint"),
                _gain_cell(scores.gain(methods, region)),
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
    return [Table(caption, headings, rows, groups, words=[1]), Text(notes)]


def _gain_cell(gain: tuple[float, int] | None) -> Cell:
    if gain is None:
        return Cell("")
    text = written(gain[0], "dB", signed=True).removesuffix(" dB")
    return Cell(text, "good" if text[0] == "+" else "bad" if text[0] == MINUS else "plain")


def _families(scores: Scores) -> Table:
    families = scores.families
    headings = ["Method", *families, *families]
    groups = [("", 1), *((REGION_WORDS[region], len(families)) for region in REGIONS)]
    places: list[tuple[Region, str]] = [(region, family) for region in REGIONS for family in families]
    rows = []
    for method in scores.methods:
        tone = "strong" if method == "neural" else "plain"
        means = [scores.mean(method, region, family) for region, family in places]
        rows.append([Cell(method, tone), *(Cell(f"{m[0]:.2f}" if m else "—", tone) for m in means)])
    for group, methods in GROUPS.items():
        gains = [scores.gain(methods, region, family) for region, family in places]
        rows.append([Cell(f"gain over {group.replace('_', ' ')}"), *map(_gain_cell, gains)])
    counts = [
        f"{family}: {mean[1]} frames" for family in families if (mean := scores.mean("pbr", "frame", family))
    ]
    return Table(f"PSNR in dB by kind of light ({', '.join(counts)}).", headings, rows, groups)


def _guidance_section(scores: GuidanceScores, shown: Sequence[Shown], output_dir: Path) -> list[Section]:
    """The surfels' own quality; no section where the test clips carry no reference buffers."""
    rows = {row.metric: row for row in scores.rows()}
    if not rows:
        return []
    intro = Text(
        "What the network is given decides what it can do. Irradiance of the surfels is compared with the "
        "path tracer's direct irradiance of the true scene, displayed through the same tone curve, on the "
        f"foreground. A pixel is in shadow where under {SHADOWED_BELOW:.0%} of the unshadowed light arrives "
        f"in the reference, and leaks if it is brighter than the reference by more than {LEAK_OVER_MEAN:.0%}"
        f" of the frame's mean; it is lit where over {LIT_ABOVE:.0%} arrives, and darkened if it keeps less "
        f"than {DARKENED_BELOW:.0%} of it. Both are judged where surfels and truth show the same surface "
        f"(normals within {SAME_SURFACE_DEG:.0f}°): at silhouettes surfels overhang by a pixel and show "
        "another one. Pictures called shadow errors show leaking pixels in orange, darkened ones in blue."
    )
    blocks: list[Block] = [intro]
    families = sorted(scores.irradiance_psnr)
    if families:
        metrics = {
            "irradiance PSNR": "guidance.irradiance_psnr",
            "shadow pixels leaking": "guidance.shadow_leak",
            "shadow pixels leaking, silhouettes included": "guidance.shadow_leak_with_silhouettes",
            "lit pixels darkened": "guidance.lit_darkened",
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


def _value(row: Row | None, tone: str = "plain") -> Cell:
    return Cell(written(row.value, row.unit) if row else "—", "strong" if tone == "strong" else "plain")
