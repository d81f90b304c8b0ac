"""Everything a run of the relighting benchmark found, before it is put into words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from eval.relighting.gallery import Example
from eval.relighting.guidance import GuidanceScores
from eval.relighting.scores import Scores
from eval.report.page import Chart
from eval.results import Row
from tron.shards.schema import ClipMeta


@dataclass(frozen=True)
class Measured:
    """Figures and pictures that the page is made of.

    Attributes:
        scores: of every method.
        guidance: quality of the surfels and their irradiance.
        rows: metric -> row, of both.
        clips: that were scored.
        examples: of them, from the one with the least gain to the one with the most.
        curves: of the trainings.
    """

    scores: Scores
    guidance: GuidanceScores
    rows: Mapping[str, Row]
    clips: Sequence[ClipMeta]
    examples: Sequence[Example]
    curves: Sequence[Chart]

    def count(self) -> tuple[int, int, int]:
        """Numbers of frames, scenes and lights."""
        scenes, lights = ({getattr(meta, name) for meta in self.clips} for name in ("scene", "light"))
        return sum(meta.frames for meta in self.clips), len(scenes), len(lights)
