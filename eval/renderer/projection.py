"""The 0.6B architecture on this machine: one frame with random weights, and what larger ones would take."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.report.figures import row_cell
from eval.results import Row
from tron.report.page import Cell, Section, Table


@dataclass(frozen=True)
class Projection:
    """Rows of :mod:`eval.renderer.cosmos_cost`."""

    measured: Sequence[Row]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """The rows as they came."""
        yield from self.measured

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """A table that says of each figure whether it was measured or projected."""
        rows: list[Sequence[Cell | str]] = [
            [
                row.metric.removeprefix("cosmos."),
                row_cell(row, "strong"),
                "projected" if ".projected." in row.metric else "measured",
            ]
            for row in self.measured
        ]
        caption = "Cosmos 0.6B with random weights on the CPU; projections are of small runs, not measured."
        table = Table(caption, ["Figure", "Value", ""], rows, words=[2])
        return [Section("cosmos", "The paper's architecture", [table])]


def measure_projection(sizes: Sequence[int], threads: int) -> Projection:
    """Measure a frame of 256 x 256, and project from square frames of these widths, multiples of 16."""
    from eval.renderer.cosmos_cost import measure_cosmos

    return Projection(list(measure_cosmos([(size, size, 1) for size in sizes], threads)))
