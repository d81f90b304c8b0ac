"""Gains of the checkpoints on one test distribution, at one or more sizes of its frames.

The paper's pair is held against the best baseline of direct light: those that see pbr and irradiance alone
and, harder, those that are also given irradiance without shadows and shading with them, from which the pair
was made. ``over_two_buffers`` is the gain over the former alone. The network that starts from lit is held
against lit and all fits on it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.relighting.baselines import BASELINES, DIRECT, NEURAL, NEURAL_LIT, ON_LIT
from eval.relighting.buffers import REGIONS
from eval.relighting.measured import Judged
from eval.relighting.scores import GROUPS, Scores, Where
from eval.renderer.networks import METHODS
from eval.renderer.networks import TITLES as NETWORK_TITLES
from eval.renderer.pictures import comparison
from eval.report.figures import row_cell, with_interval
from eval.report.intervals import interval_note
from eval.report.strips import write_strips
from eval.results import Row
from tron.report.page import Block, Cell, Section, Table, Text

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
TITLES = {method.name: method.title for method in BASELINES} | {
    METHODS[kind]: title for kind, title in NETWORK_TITLES.items()
}
GAIN_WORDS = {
    (NEURAL.name, "gain_db"): "pair: gain over the best of direct light",
    (NEURAL.name, "gain_over_two_buffers_db"): "pair: gain over the best of pbr and irradiance alone",
    (NEURAL.name, "gain_over_pbr_db"): "pair: gain over pbr",
    (NEURAL_LIT.name, "gain_db"): "lit's network: gain over lit and all fits on it",
    (
        NEURAL_LIT.name,
        "gain_over_pixelwise_db",
    ): "lit's network: gain over what sees single pixels",
    (NEURAL_LIT.name, "gain_over_lit_db"): "lit's network: gain over lit",
}


@dataclass(frozen=True)
class Gains:
    """Findings on one distribution.

    Attributes:
        name: of its section, such as "models".
        prefix: before the word gain in names of rows: "", "ood_" or "capture_".
        title: of the section.
        intro: what the distribution is.
        sizes: width of a frame -> scores and pictures; figures without a size are of the first.
    """

    name: str
    prefix: str
    title: str
    intro: str
    sizes: Mapping[int, Judged]

    def rows(self, seed: int) -> Iterator[Row]:
        """Gains and PSNRs, overall and by family and style, of the foreground and of full frames."""
        for size, judged in self.sizes.items():
            for where in places(judged.scores):
                tail = self._tail(size, where)
                for method, (start, rivals) in RIVALS.items():
                    for end, over in rivals.items():
                        name = f"{start}.{self.prefix}{end}{tail}"
                        yield from _known(gain_over(judged.scores, name, method, over, where, seed))
                for method in judged.scores.methods:
                    name = f"renderer.{self.prefix}psnr.{method.name.replace('.', '_')}{tail}"
                    yield from _known(judged.scores.psnr_row(name, method.name, where, seed))

    def worst_over_lit(self, seed: int) -> dict[str, Row]:
        """Family or style -> gain of the network that starts from lit over lit, foreground, first size."""
        scores = next(iter(self.sizes.values())).scores
        found = {}
        for where in (each for each in places(scores) if each.region == "foreground"):
            kind = where.family or where.style
            row = scores.gain_row(f"renderer.lit.{self.prefix}any", NEURAL_LIT.name, ["lit"], where, seed)
            if row is not None and (kind or len(places(scores)) == len(REGIONS)):
                found[f"{self.title}: {kind}" if kind else self.title] = row
        return found

    def sections(self, pictures: Path) -> list[Section]:
        """Every method, every kind of light and scene, and pictures."""
        first = next(iter(self.sizes.values()))
        frames, scenes, lights = first.count()
        counted = f"{frames} frames of {scenes} scenes under {lights} lights."
        blocks: list[Block] = [Text(f"{self.intro} {counted}"), self._methods()]
        blocks += [self._parts(size) for size in self.sizes]
        blocks.append(Text(interval_note(scenes, f"{frames} frames")))
        size, judged = max(self.sizes.items())
        shown = [comparison(example) for example in judged.examples]
        keys = [f"renderer-{self.name}-{size}-{example.meta.key}" for example in judged.examples]
        write_strips(shown, keys, pictures)
        return [Section(self.name, self.title, [*blocks, *shown])]

    def _tail(self, size: int, where: Where) -> str:
        return where.tail_after("" if size == next(iter(self.sizes)) else f".{size}")

    def _methods(self) -> Table:
        """PSNR of every method, by size and region."""
        columns = [(size, judged, Where(region)) for size, judged in self.sizes.items() for region in REGIONS]
        methods = list(
            dict.fromkeys(each.name for judged in self.sizes.values() for each in judged.scores.methods)
        )
        rows: list[Sequence[Cell | str]] = []
        for method in methods:
            tone = "strong" if method in RIVALS else "plain"
            cells = [
                row_cell(judged.scores.psnr_row("a.b", method, where), tone, unit=False)
                for _, judged, where in columns
            ]
            rows.append([Cell(TITLES.get(method, method), tone), *cells])
        rows += self._gain_rows([(judged.scores, where) for _, judged, where in columns])
        headings = ["PSNR in dB", *(f"{size}², {where.region}" for size, _, where in columns)]
        return Table("Every method; means over frames.", headings, rows)

    def _parts(self, size: int) -> Table:
        """Gains by kind of light and by style of scene."""
        scores = self.sizes[size].scores
        found = [where for where in places(scores) if where.region == "foreground"]
        headings = ["Foreground", *(where.family or where.style or "all" for where in found)]
        rows = self._gain_rows([(scores, where) for where in found])
        for method in ("lit", *RIVALS):
            cells = [row_cell(scores.psnr_row("a.b", method, where), unit=False) for where in found]
            rows.append([f"PSNR of the {TITLES[method]}", *cells])
        return Table(f"{size} x {size} pixels, by kind of light and style of scene, dB.", headings, rows)

    def _gain_rows(self, places: Sequence[tuple[Scores, Where]]) -> list[Sequence[Cell | str]]:
        rows: list[Sequence[Cell | str]] = []
        for method, (_, rivals) in RIVALS.items():
            for end, over in rivals.items():
                cells = [gain_cell(gain_over(scores, "a.b", method, over, where)) for scores, where in places]
                if any(cell.text for cell in cells):
                    rows.append([Cell(GAIN_WORDS[method, end], "strong"), *cells])
        return rows


def places(scores: Scores) -> list[Where]:
    """Everything; each kind of light, where there are two or more; each style: of both regions."""
    families = scores.families if len(scores.families) > 1 else []
    kinds = [(family, None) for family in (None, *families)] + [(None, style) for style in scores.styles]
    return [Where(region, family, style=style) for family, style in kinds for region in REGIONS]


def gain_over(
    scores: Scores, metric: str, method: str, over: Sequence[str], where: Where, seed: int = 0
) -> Row | None:
    """Row of a gain over the best of those that were scored: per-pixel networks are not always trained."""
    there = {each.name for each in scores.methods}
    return scores.gain_row(metric, method, [name for name in over if name in there], where, seed)


def gain_cell(row: Row | None) -> Cell:
    """A gain in dB with its sign; good or bad where its interval says so."""
    if row is None:
        return Cell("")
    text = with_interval(row, signed=True).replace(" dB", "")
    if row.low is not None and row.high is not None and row.low <= 0 <= row.high:
        return Cell(text)
    return Cell(text, "good" if row.value > 0 else "bad" if row.value < 0 else "plain")


def _known(row: Row | None) -> Iterator[Row]:
    if row is not None:
        yield row
