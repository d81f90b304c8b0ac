"""The tracing benchmark in words, tables, charts and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from eval.benchmarks import Outcome

if TYPE_CHECKING:
    from eval.benchmarks.tracing import Measured, Tracing


def outcome(settings: Tracing, measured: Measured, output_dir: Path) -> Outcome:
    """Rows and sections of a run."""
    from eval.benchmarks.tracing import rows

    return Outcome(
        rows=list(rows(measured, settings)),
        title="The surfel tracer against what a user would pick instead",
        verdict="",
        lead=(),
        sections=[],
    )
