"""Pictures of a report as files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tron.images import write_image
from tron.report.page import Pictures


def write_strips(groups: Sequence[Pictures], names: Sequence[str], folder: Path) -> None:
    """Write each group of equally large pictures as one PNG, in the page's order and number of columns."""
    for group, name in zip(groups, names):
        images = [picture.image for picture in group.pictures]
        blank = np.zeros_like(images[0])
        images += [blank] * (-len(images) % group.columns)
        rows = [
            np.concatenate(images[i : i + group.columns], 1) for i in range(0, len(images), group.columns)
        ]
        write_image(folder / f"{name}.png", np.concatenate(rows, 0))
