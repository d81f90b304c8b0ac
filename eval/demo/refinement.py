"""What fitting a dataset's surfels to their G-buffers gained, as the data engine recorded it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eval.confidence import mean_interval
from eval.report.figures import with_interval
from eval.report.intervals import interval_note
from eval.report.page import Cell, Section, Table, Text
from eval.results import Row
from tron.errors import TronError

FIGURES = {
    "base_color_psnr": ("base color PSNR", "dB", "linear, scaled a view and channel by least squares"),
    "normal_mae_deg": ("normals, mean angular error", "deg", "on the subject"),
    "silhouette_error": ("silhouettes", "fraction", "mean of |opacity - mask|"),
}


def refinement(dataset: Path, seed: int) -> tuple[list[Row], list[Section]]:
    """Rows ``refinement.*`` and their table, over all scenes; empty where surfels were taken as made.

    ``seed`` draws the scenes of the intervals.

    Raises:
        TronError: a scene's record is not readable.
    """
    found = []
    for path in sorted(dataset.glob("scenes/*/record.json")):
        try:
            record = json.loads(path.read_text("utf-8")).get("refinement")
        except (OSError, ValueError, AttributeError) as error:
            raise TronError(f"not a scene's record: {error}", path) from error
        if record is not None:
            found.append(record)
    if not found:
        return [], []
    rows, table = [], []
    for name, (label, unit, how) in FIGURES.items():
        before, after = (_mean(found, when, name, unit, seed) for when in ("before", "after"))
        rows += [before, after]
        cells = [Cell(with_interval(before)), Cell(with_interval(after), "strong")]
        table.append([Cell(label), *cells, Cell(how, "faint")])
    caption = (
        f"Surfels before and after {found[0]['steps']} steps that fit them to their scene's G-buffers, at "
        f"cameras that they were not fitted to: means over {len(found)} scenes."
    )
    return rows, [
        Section(
            "refinement",
            "What fitting the surfels gained",
            [
                Table(caption, ["Figure", "as made", "fitted", "How"], table, words=[3]),
                Text(interval_note(len(found))),
            ],
        )
    ]


def _mean(records: Sequence[dict], when: str, name: str, unit: str, seed: int) -> Row:
    values = [record[when][name] for record in records]
    row = Row(metric=f"refinement.{name}.{when}", value=float(np.mean(values)), unit=unit, n=len(values))
    return row.within(mean_interval([str(k) for k in range(len(values))], values, seed))
