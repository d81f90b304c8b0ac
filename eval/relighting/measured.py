"""Everything a run of the relighting benchmark found, before it is put into words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from eval.relighting.gallery import Example
from eval.relighting.guidance import GuidanceScores
from eval.relighting.scores import Scores
from eval.results import Row
from tron.report.page import Chart
from tron.shards.schema import ClipMeta


@dataclass(frozen=True)
class Judged:
    """Every method on the held-out clips of one data set.

    Attributes:
        scores: of every method.
        clips: that were scored.
        examples: of them, from the one with the least gain to the one with the most.
    """

    scores: Scores
    clips: Sequence[ClipMeta]
    examples: Sequence[Example]

    def count(self) -> tuple[int, int, int]:
        """Numbers of frames, scenes and lights."""
        scenes, lights = ({getattr(meta, name) for meta in self.clips} for name in ("scene", "light"))
        return sum(meta.frames for meta in self.clips), len(scenes), len(lights)


@dataclass(frozen=True)
class Measured:
    """Figures and pictures that the page is made of.

    Attributes:
        judged: the data set's held-out clips.
        ood: clips of another kind, where there are any.
        guidance: quality of the surfels and their irradiance.
        rows: metric -> row, of all.
        curves: of the trainings.
    """

    judged: Judged
    ood: Judged | None
    guidance: GuidanceScores
    rows: Mapping[str, Row]
    curves: Sequence[Chart]
