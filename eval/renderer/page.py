"""The renderer benchmark in words: the verdict, the lead, and tables over all parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eval.renderer.gains import gain_cell
from eval.report.figures import with_interval
from eval.results import Row
from tron.report.page import Cell, Section, Table

LEAD = (
    "TRON relights captured 3D worlds. A ray tracer turns surfels into quick pictures: pbr, shading without "
    "shadows; irradiance, the light that arrives; and lit, the whole picture with shadows and bounced light. "
    "A neural renderer makes the final picture of them: one checkpoint of the paper's two buffers, pbr and "
    "irradiance, and one that starts from lit, which is tron-relight's default.",
    "This page judges both on scenes, lights and models that neither was trained on, by a path tracer's "
    "truth, and holds them against the best picture without a network: filters, blends and factors fitted on "
    "the very distribution that judges. Rivals of lit may use base color too, as its network does; rivals of "
    "the pair are given light without shadows besides its two buffers, over which alone there are tiles of "
    "their own.",
)
HEADLINE = {
    "renderer.gain_db": "Pair: gain, held-out scenes",
    "renderer.gain_over_two_buffers_db": "Pair: gain over its two buffers",
    "renderer.lit.gain_db": "With lit: gain, held-out scenes",
    "renderer.ood_gain_db": "Pair: gain, real models",
    "renderer.lit.ood_gain_db": "With lit: gain, real models",
    "renderer.capture_gain_db": "Pair: gain, captures relit, albedo scaled",
    "renderer.lit.capture_gain_db": "With lit: gain, captures relit, albedo scaled",
    "renderer.lit.worst_family_gain_db": "With lit over lit, worst family",
    "renderer.warp_error_ratio": "Flicker of clips, K = 5 over K = 1",
    "renderer.shadow_correlation": "Shadows that move: correlation",
    "renderer.shadow_slope": "Shadows that move: slope",
    "renderer.frames_per_second.512": "Frames a second, 512²",
    "renderer.kill_identical": "Ended trainings with the same weights",
}
SAID = (
    ("renderer.lit.gain_db", "over lit and all fits on it on held-out scenes"),
    ("renderer.lit.ood_gain_db", "on real models"),
    ("renderer.lit.capture_gain_db", "on captures relit"),
)
SAID_OF_PAIR = (
    ("renderer.gain_db", "over the best baseline of direct light on held-out scenes"),
    ("renderer.ood_gain_db", "on real models"),
    ("renderer.capture_gain_db", "on captures relit"),
)


def verdict(rows: Mapping[str, Row]) -> str:
    """The finding in a sentence or two."""
    said = []
    for subject, figures in (
        ("The network that starts from lit", SAID),
        ("The network of the paper's pair", SAID_OF_PAIR),
    ):
        known = [
            f"{with_interval(rows[name], signed=True)} {words}" for name, words in figures if name in rows
        ]
        if known:
            said.append(f"{subject} gains {', '.join(known)}.")
    worst = rows.get("renderer.lit.worst_family_gain_db")
    if worst is not None:
        how = "on no family worse than lit" if worst.value >= 0 else "worse than lit on at least one family"
        said.append(f"The first is {how} (least gain {with_interval(worst, signed=True)}).")
    return " ".join(said) or "Only some parts were run."


def parts_section(what: Mapping[str, str]) -> list[Section]:
    """A table of the parts of this run and their questions."""
    rows: list[Sequence[Cell | str]] = [[part, words] for part, words in what.items()]
    table = Table("Parts of this run.", ["Part", "What it asks"], rows, words=[1])
    return [Section("parts", "What was asked", [table])]


def families_section(families: Mapping[str, Row]) -> list[Section]:
    """Gain of lit's network over lit on every family of lights, style and distribution."""
    if not families:
        return []
    rows: list[Sequence[Cell | str]] = [
        [name, gain_cell(row), f"{row.n} frames"] for name, row in families.items()
    ]
    caption = "The network that starts from lit, gain over lit in dB, foreground, single frames."
    table = Table(caption, ["Held-out family", "gain over lit", "of"], rows)
    return [Section("families", "Not worse than lit, family by family", [table])]
