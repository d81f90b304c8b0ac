"""Results on the terminal: figures on the foreground and the full frame, targets, and the report's path."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from eval.report.figures import bound, verdict, with_interval
from eval.results import Results, Target

_LISTED = re.compile(
    r"(demo|surfels|guidance|irradiance|fox|step|reconstruction(\.(classical|depth_init|photos|light))?|splats(\.raw)?)\.[a-z_]\w*"
)
"""Rows without a target that are listed all the same; rows of one scene end in another segment."""


def print_results(results: Results, targets: Sequence[Target], report: Path) -> None:
    """Print tables of the results and the absolute path of the report, to stdout.

    Metrics with a ``_full`` twin share a line; rows of one light family stay in results.json and the report.
    Brackets are intervals over scenes.
    """
    console = Console(width=None if Console().is_terminal else 120, highlight=False)
    name = Column("figure", overflow="fold")
    pairs = Table(name, "foreground", "full frame", box=None, pad_edge=False)
    others = Table(name.copy(), "measured", "target", "", box=None, pad_edge=False)
    by_metric = {target.metric: target for target in targets}
    for row in results.rows:
        full = results.find(f"{row.metric}_full")
        signed = ".gain" in row.metric
        if full is not None:
            values = [with_interval(each, signed) for each in (row, full)]
            pairs.add_row(row.metric, *values)
        target = by_metric.get(row.metric)
        if target is not None:
            words, tone = verdict(target, row.value, row.unit)
            style = "green" if tone == "good" else "red"
            value = with_interval(row, signed)
            others.add_row(row.metric, value, bound(target, row.unit), f"[{style}]{words}[/]")
        elif full is None and _LISTED.fullmatch(row.metric):
            others.add_row(row.metric, with_interval(row), "", "")
    for target in targets:
        if results.find(target.metric) is None:
            others.add_row(target.metric, "—", bound(target, ""), "[red]not measured[/]")
    for table in (pairs, others):
        if table.row_count:
            console.print(table)
            console.print()
    # print, not the console: a path must come out whole, on one line
    print(f"report: {report.absolute()}", flush=True)
