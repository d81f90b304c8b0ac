"""Gains of the checkpoints on one test distribution, at one or more sizes of its frames.

The paper's pair is held against the best baseline of direct light: those that see pbr and irradiance alone
and, harder, those that are also given irradiance without shadows and shading with them, from which the pair
was made. ``over_two_buffers`` is the gain over the former alone. The network that starts from lit is held
against lit and all fits on it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from eval.relighting.baselines import DIRECT, NEURAL, NEURAL_LIT, ON_LIT
from eval.relighting.buffers import REGIONS
from eval.relighting.scores import GROUPS, Scores, Where
from eval.results import Row

TWO_BUFFERS = ["pbr", "pbr_x_irradiance", "affine", "affine_filtered", "pixel_mlp"]
"""Baselines that see pbr and irradiance, and nothing else."""
PIXELWISE = ["lit", "affine_lit", "pixel_mlp_lit"]
"""Of the rivals of the network that starts from lit, those that see one pixel at a time."""
PAIR_RIVALS: dict[str, list[str]] = {
    "gain_db": GROUPS[DIRECT],
    "gain_over_two_buffers_db": TWO_BUFFERS,
    "gain_over_pbr_db": ["pbr"],
}
LIT_RIVALS: dict[str, list[str]] = {
    "gain_db": ["lit", *GROUPS[ON_LIT]],
    "gain_over_pixelwise_db": PIXELWISE,
    "gain_over_lit_db": ["lit"],
}
RIVALS = {NEURAL.name: ("renderer", PAIR_RIVALS), NEURAL_LIT.name: ("renderer.lit", LIT_RIVALS)}
"""Method -> beginning of its rows, and what its gains are over by the end of their names."""


def gain_rows(prefix: str, sizes: Mapping[int, Scores], seed: int) -> Iterator[Row]:
    """Gains and PSNRs, overall and by family and style, of the foreground and of full frames.

    Args:
        prefix: before the word gain in names of rows: "", "ood_" or "capture_".
        sizes: width of a frame -> scores; figures without a size are of the first.
        seed: draws the scenes of the intervals.
    """
    for size, scores in sizes.items():
        known = {each.name for each in scores.methods}  # per-pixel networks are not always trained
        for where in places(scores):
            tail = where.tail_after("" if size == next(iter(sizes)) else f".{size}")
            for method, (start, rivals) in RIVALS.items():
                for end, over in rivals.items():
                    name = f"{start}.{prefix}{end}{tail}"
                    there = [each for each in over if each in known]
                    if row := scores.gain_row(name, method, there, where, seed):
                        yield row
            for method in (each.name for each in scores.methods):
                name = f"renderer.{prefix}psnr.{method.replace('.', '_')}{tail}"
                if row := scores.psnr_row(name, method, where, seed):
                    yield row


def over_lit(scores: Scores, seed: int) -> list[Row]:
    """Gains over lit of the network that starts from it, by family or style, foreground."""
    parts = [each for each in places(scores) if each.region == "foreground"]
    kinds = [each for each in parts if each.family or each.style] or parts
    rows = (scores.gain_row("renderer.lit.any", NEURAL_LIT.name, ["lit"], where, seed) for where in kinds)
    return [row for row in rows if row is not None]


def places(scores: Scores) -> list[Where]:
    """Everything; each kind of light, where there are two or more; each style: of both regions."""
    families = scores.families if len(scores.families) > 1 else []
    kinds = [(family, None) for family in (None, *families)] + [(None, style) for style in scores.styles]
    return [Where(region, family, style=style) for family, style in kinds for region in REGIONS]
