"""The relighting benchmark in words, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from eval.relighting.baselines import BASELINES, DIRECT, METHODS, NETWORKS, NEURAL, ON_LIT, SIMPLE
from eval.relighting.buffers import Region
from eval.relighting.gallery import comparison, guidance
from eval.relighting.measured import Judged, Measured
from eval.relighting.scores import GROUPS, METRICS, REGIONS, Where
from eval.relighting.shadows import (
    DARKENED_BELOW,
    LEAK_OVER_MEAN,
    LIT_ABOVE,
    SAME_DEPTH,
    SAME_NORMAL_DEG,
    SHADOWED_BELOW,
)
from eval.report.figures import row_cell, with_interval
from eval.report.intervals import interval_note
from eval.report.strips import write_strips
from eval.results import Row
from tron.report.page import Block, Cell, Pictures, Section, Table, Text
from tron.report.values import MINUS

TITLES = {method.name: method.title for method in METHODS}
SIMPLE_TITLES = ", ".join(TITLES[name] for name in GROUPS[SIMPLE])
GROUP_WORDS = {
    SIMPLE: "best simple baseline",
    DIRECT: "best baseline of direct light",
    ON_LIT: "best fit on lit",
    "best_baseline": "best of all baselines",
}
REGION_WORDS: dict[Region, str] = {"foreground": "foreground", "frame": "full frame"}
HEADLINE = {
    "neural_lit.psnr": "Neural renderer, foreground PSNR",
    "neural_lit.gain_over_lit": "Gain over lit, the picture without a network",
    "neural_lit.gain_over_best_fit_on_lit": "Gain over the best fit on lit",
    "lit.psnr": "lit: no network, one ray a pixel",
    "lit.reflections.psnr": "lit with 2 × 2 sub-pixels and reflections",
    "neural.psnr": "Neural renderer of two buffers (the paper's)",
    "neural.gain_over_best_direct_baseline": "Its gain over the best baseline of direct light",
    "lit.gain_over_shadowed.ood": "Gain of lit over shadowed shading, real models",
    "neural_lit.gain_over_best_baseline.ood": "Gain of the neural renderer, real models",
    "guidance.irradiance_psnr": "Irradiance against path tracing, worst kind of light",
    "guidance.shadow_leak": "Shadow pixels of the surfels that leak light",
    "surfels.base_color_psnr": "Base color of the surfels",
    "surfels.normal_mae_deg": "Normals of the surfels, mean error",
}
LEAD = (
    "TRON relights captured 3D worlds. A scene becomes a cloud of small flat disks (surfels) with "
    "materials; under a new light, a ray tracer turns them into quick pictures: pbr, shading without "
    "shadows; irradiance, the light that arrives straight from the environment at each surface; and lit, "
    "the whole picture with shadows and light that bounced between the surfels. A neural renderer adds to "
    "lit what it still lacks.",
    "This page measures lit and that last step on scenes and lights that were not trained on, against a "
    f"path tracer's ground truth and against {len(BASELINES)} simpler ways of using the same pictures, the "
    "baselines, of which lit by itself is one. A renderer of two buffers sees pbr and irradiance alone, as "
    "the paper's does.",
)
PAIRED = (
    "A gain's interval is that of the differences on the same frames, not the difference of two intervals. "
    "No interval says how much another training of the same networks would differ."
)
GUIDANCE_ROWS = {
    "irradiance PSNR": "guidance.irradiance_psnr",
    "shadow pixels leaking": "guidance.shadow_leak",
    "shadow pixels leaking, same surface by normals": "guidance.shadow_leak_same_normal",
    "shadow pixels leaking, silhouettes included": "guidance.shadow_leak_with_silhouettes",
    "lit pixels darkened": "guidance.lit_darkened",
    "lit pixels darkened, same surface by normals": "guidance.lit_darkened_same_normal",
    "lit pixels darkened, silhouettes included": "guidance.lit_darkened_with_silhouettes",
}
SURFEL_ROWS = {
    "surfels.base_color_psnr": ("base color PSNR", "linear, on the foreground, averaged over views"),
    "surfels.normal_mae_deg": ("normals, mean angular error", "where both have a surface"),
}


def sections(measured: Measured, pictures: Path) -> list[Section]:
    """The body of the page; its pictures are also written as files into the folder ``pictures``."""
    judged = measured.judged
    found = [
        Section("results", "Every method, every held-out frame", _methods(measured)),
        Section("lights", "By kind of light", [_families(measured)]),
    ]
    if judged.scores.styles:
        found.append(Section("styles", "By style of scene", [_styles(measured)]))
    if judged.examples:
        intro = Text(
            "Middle frames of held-out clips, evenly spaced in the ranking by gain: the first is the clip "
            "on which the network gains least, the last the one on which it gains most. Decibels are of the"
            " picture shown, on the foreground; higher is better, and 1 dB is easy to see side by side."
        )
        title = "Held-out scenes under held-out lights"
        found.append(Section("pictures", title, [intro, *_pictures(judged, pictures, "")]))
    if measured.ood is not None:
        found.append(_ood_section(measured, measured.ood, pictures))
    found += _guidance_section(measured, pictures)
    if measured.curves:
        found.append(Section("training", "How the training went", measured.curves))
    return found


def verdict(measured: Measured) -> str:
    """The finding in one sentence."""
    scores, rows = measured.judged.scores, measured.rows
    frames, scenes, lights = measured.judged.count()
    text = f"On {frames} held-out frames ({scenes} scenes, {lights} lights)"
    if lit := rows.get("lit.psnr"):
        text += f" lit reaches {with_interval(lit)} on the foreground without a network"
    network = scores.network
    if network is None:
        return f"{text}; no neural renderer was given."
    text += f", the {network.title} {with_interval(rows[f'{network.name}.psnr'])}"
    best = scores.best(GROUPS["best_baseline"])
    for rival, words in (
        ("lit", "lit"),
        ("best_baseline", f"the best of all baselines ({TITLES.get(best or '')})"),
    ):
        if gain := rows.get(f"{network.name}.gain_over_{rival}"):
            text += f", {with_interval(gain, signed=True)} over {words}"
    if network is not NEURAL and (two := rows.get(f"{NEURAL.name}.psnr")):
        text += f"; the {NEURAL.title} reaches {with_interval(two)}"
    return text + "."


def _pictures(judged: Judged, folder: Path, prefix: str) -> list[Pictures]:
    comparisons = [comparison(example) for example in judged.examples]
    write_strips(comparisons, [f"{prefix}{example.meta.key}" for example in judged.examples], folder)
    return comparisons


def _table(measured: Measured, judged: Judged, where: Where) -> Table:
    """Every method with its metrics, and what the network gains over it."""
    scores, tail = judged.scores, f"{where.tail}{judged.scores.tail}"
    network = scores.network

    def gain(rival: str) -> Cell:
        name = f"{network.name}.gain_over_{rival}{tail}" if network else ""
        return _gain_cell(measured.rows.get(name))

    rows: list[Sequence[Cell | str]] = []
    for method in scores.methods:
        tone = "strong" if method in NETWORKS else "plain"
        names = [f"{method.name}.{metric.name}{tail}" for metric in METRICS]
        figures = [row_cell(measured.rows.get(name), tone, unit=False) for name in names]
        rows.append([Cell(method.title, tone), *figures, gain(method.name), Cell(method.what, "faint")])
    for group, names in GROUPS.items():
        best = scores.best(names, where)
        if best is not None:
            psnr = Cell(f"{scores.psnr(best, where):.2f}", "strong")
            blank = [""] * (len(METRICS) - 1)
            rows.append([Cell(GROUP_WORDS[group], "strong"), psnr, *blank, gain(group), TITLES[best]])
    caption = (
        f"{REGION_WORDS[where.region].capitalize()}: means over held-out frames, PSNR and gains in dB; "
        "an arrow points to the better side."
    )
    headings = ["Method", *(metric.title for metric in METRICS), "neural renderer gains ↑", "What it is"]
    return Table(caption, headings, rows, words=[len(headings) - 1])


def _methods(measured: Measured) -> list[Block]:
    frames, scenes, _ = measured.judged.count()
    notes = (
        f"{' '.join(metric.what for metric in METRICS)} Each is taken of every displayed frame (exposure, "
        "then the AgX tone curve; peak 1) and averaged over frames. The gain is the neural renderer's "
        "mean PSNR minus the method's. Foreground is where a ray through the pixel's centre meets true "
        f"geometry. Simple baselines: {SIMPLE_TITLES}. Baselines of direct light do not see lit; fits on lit "
        "are the blend and the per-pixel network that do. The forms of lit with sub-pixels and reflections "
        "cost more a frame and are given to no network, so they count as no baselines. Products are taken in "
        "linear light before the tone curve. Blends and factors are fitted on the foreground of the training "
        "split in float64. On full frames the blends and per-pixel networks are laid over pbr by opacity, "
        "because a blend that suits surfaces is wrong for the sky, which pbr shows as it is."
    )
    return [
        *(_table(measured, measured.judged, Where(region)) for region in REGIONS),
        Text(f"{interval_note(scenes, f'{frames} frames')} {PAIRED}"),
        Text(notes),
    ]


def _ood_section(measured: Measured, ood: Judged, pictures: Path) -> Section:
    """The same methods on data of another kind; nothing was trained or fitted on anything like it."""
    frames, scenes, lights = ood.count()
    intro = Text(
        f"{frames} frames of {scenes} scenes under {lights} lights of another kind than the training data: "
        "the same networks, and blends fitted on the same training split."
    )
    note = Text(interval_note(scenes, f"{frames} frames"))
    blocks = [intro, _table(measured, ood, Where()), note, *_pictures(ood, pictures, "ood-")]
    return Section("ood", "Out of distribution", blocks)


def _gain_cell(row: Row | None) -> Cell:
    if row is None:
        return Cell("")
    text = with_interval(row, signed=True).replace(" dB", "")
    if row.low is not None and row.high is not None and row.low <= 0 <= row.high:
        return Cell(text)  # other scenes may turn it round
    return Cell(text, "good" if text[0] == "+" else "bad" if text[0] == MINUS else "plain")


def _families(measured: Measured) -> Table:
    families = measured.judged.scores.families
    return _by_part(measured, "kind of light", families, lambda region, name: Where(region, name))


def _styles(measured: Measured) -> Table:
    styles = measured.judged.scores.styles
    return _by_part(measured, "style of scene", styles, lambda region, name: Where(region, style=name))


def _by_part(
    measured: Measured, what: str, names: Sequence[str], where_of: Callable[[Region, str], Where]
) -> Table:
    """PSNR of every method on each part of the frames, and the network's gains there."""
    scores = measured.judged.scores
    network = scores.network
    places = [where_of(region, name) for region in REGIONS for name in names]
    rows: list[Sequence[Cell | str]] = []
    for method in scores.methods:
        tone = "strong" if method in NETWORKS else "plain"
        means = [measured.rows.get(f"{method.name}.psnr{where.tail}") for where in places]
        rows.append([Cell(method.title, tone), *(row_cell(mean, tone, unit=False) for mean in means)])
    title = network.name if network else ""
    for group, words in GROUP_WORDS.items() if network else ():
        gains = [measured.rows.get(f"{title}.gain_over_{group}{where.tail}") for where in places]
        rows.append([f"gain over the {words}", *map(_gain_cell, gains)])
    counts = {name: len(scores.of("pbr", where_of("frame", name))) for name in names}
    frames = ", ".join(f"{name}: {count} frames" for name, count in counts.items())
    groups = [("", 1), *((REGION_WORDS[region], len(names)) for region in REGIONS)]
    return Table(f"PSNR in dB by {what} ({frames}).", ["Method", *names, *names], rows, groups)


def _guidance_section(measured: Measured, pictures: Path) -> list[Section]:
    """The surfels' own quality; no section where the test clips carry no reference buffers."""
    rows = measured.rows
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
    if families := sorted(measured.guidance.irradiance_psnr):
        table = [
            [name, row_cell(rows.get(metric), "strong")]
            + [row_cell(rows.get(f"{metric}.{family}")) for family in families]
            for name, metric in GUIDANCE_ROWS.items()
        ]
        caption = (
            "Irradiance; “overall” is the lowest PSNR of the kinds of light, and the fraction of all pixels."
        )
        blocks.append(Table(caption, ["Figure", "overall", *families], table))
    surfels = [
        [name, row_cell(rows[metric], "strong"), Cell(measured_by, "faint")]
        for metric, (name, measured_by) in SURFEL_ROWS.items()
        if metric in rows
    ]
    if surfels:
        headings = ["Figure", "Measured", "How"]
        blocks.append(Table("Surfels at held-out views.", headings, surfels, words=[2]))
    drawn = {each.meta.light_family: each for each in reversed(measured.judged.examples) if each.guidance}
    groups = [guidance(each) for each in drawn.values()]
    write_strips(groups, [f"{each.meta.key}-guidance" for each in drawn.values()], pictures)
    return [Section("guidance", "The surfels and their irradiance", [*blocks, *groups])]
