"""Result of a part of the datagen benchmark: figures, and its own sections of the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

from eval.results import Row
from tron.report.page import Section


class Found(Protocol):
    """Findings of one part."""

    def rows(self, seed: int) -> Iterable[Row]:
        """Figures; ``seed`` draws the scenes of intervals."""
        ...

    def sections(self, pictures: Path) -> Sequence[Section]:
        """Sections of the page; pictures are also written into the folder."""
        ...
