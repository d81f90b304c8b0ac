"""Stages of a long benchmark on its page: their wall time, the code that made them, and their commands."""

from __future__ import annotations

from collections.abc import Mapping

from eval.stages import StageRecord
from tron.report.page import Cell, Section, Table
from tron.report.values import format_value


def stage_section(
    records: Mapping[str, StageRecord], words: Mapping[str, str] | None = None
) -> list[Section]:
    """A table of the stages; no section without any.

    Args:
        records: stage name -> record, in the order in which they ran.
        words: stage name -> what it does, where the commands do not say it.
    """
    if not records:
        return []
    rows = [
        [
            f"{name}: {words[name]}" if words else name,
            Cell(format_value(record.seconds, "s"), "strong"),
            str(record.attempts),
            record.commit or "unknown",
            Cell("; ".join(" ".join(command) for command in record.commands), "faint"),
        ]
        for name, record in records.items()
    ]
    total = format_value(sum(record.seconds for record in records.values()), "s")
    caption = (
        f"Wall time of the commands, {total} in all. One that was interrupted counts all its attempts. "
        "What was finished before is not run again: the commit is that of the code that made it."
    )
    headings = ["Stage", "Time", "Attempts", "Commit", "Command"]
    return [Section("stages", "Where the time went", [Table(caption, headings, rows, words=[4])])]
