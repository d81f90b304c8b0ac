"""Three parts of a dataset, each by a command of its own, merged and held against one run of the whole."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval.datagen.runs import differences, make, tree
from eval.results import Row
from tron.report.page import Cell, Section, Table

PARTS = 3


@dataclass(frozen=True)
class Merge:
    """Files of the whole, those of the merged folder that differ, and its shards that were copied."""

    files: int
    different: list[str]
    copied: int

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Share of the files that are the same bytes."""
        same = self.files - len(self.different)
        yield Row(metric="merge.identical", value=same / self.files, unit="fraction", n=self.files)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """The comparison in a table."""
        same = not self.different
        verdict = Cell("same bytes", "good") if same else Cell(f"{self.different[0]} differs", "bad")
        caption = (
            f"{PARTS} commands, shard=1/{PARTS} to {PARTS}/{PARTS}, each into a folder of its own; "
            "mode=merge links their files into one, which is held against one run of the whole, all files "
            "but logs."
        )
        rows = [[f"{self.files}", f"{self.copied}", verdict]]
        return [Section("merge", "Parts and the whole", [Table(caption, ["Files", "Copied", ""], rows)])]


def measure_merge(recipe: Sequence[str], folder: Path) -> Merge:
    """Make a recipe's dataset in parts and at once; one worker.

    Raises:
        StageFailed: a run failed.
    """
    home = folder / "merge"
    shutil.rmtree(home, ignore_errors=True)
    arguments = [*recipe, "workers=1"]
    make(arguments, home / "whole")
    truth = tree(home / "whole")
    parts = [home / f"part{number}" for number in range(1, PARTS + 1)]
    for number, part in enumerate(parts, start=1):
        make([*arguments, f"shard={number}/{PARTS}"], part)
    output = home / "merged"
    make([*arguments, "mode=merge", f"merge=[{','.join(map(str, parts))}]"], output)
    copied = sum(path.stat().st_nlink < 2 for path in output.glob("*.tar"))
    found = Merge(len(truth), differences(truth, tree(output)), copied)
    shutil.rmtree(home)
    return found
