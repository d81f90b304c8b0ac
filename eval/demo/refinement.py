"""Quality of a dataset's surfels before and after fitting to G-buffers, from the data engine's records."""

from __future__ import annotations

import json
from pathlib import Path

from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.results import Row, mean_row
from tron.errors import TronError
from tron.report.page import Cell, Section, Table, Text

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
            found.append((path.parent.name, record))
    if not found:
        return [], []
    rows, table = [], []
    for name, (label, unit, measured_by) in FIGURES.items():
        before, after = (
            mean_row(
                f"refinement.{name}.{when}", unit, [(scene, each[when][name]) for scene, each in found], seed
            )
            for when in ("before", "after")
        )
        rows += [before, after]
        table.append([label, row_cell(before), row_cell(after, "strong"), Cell(measured_by, "faint")])
    caption = (
        f"Surfels before and after {found[0][1]['steps']} steps that fit them to their scene's G-buffers, at "
        f"cameras that they were not fitted to: means over {len(found)} scenes."
    )
    headings = ["Figure", "as made", "fitted", "Measured"]
    blocks = [Table(caption, headings, table, words=[3]), Text(interval_note(len(found)))]
    return rows, [Section("refinement", "What fitting the surfels gained", blocks)]
