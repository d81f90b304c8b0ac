"""The brackets behind a figure in plain sentences."""

from __future__ import annotations

from eval.confidence import LEVEL

FEW = 8
"""Scenes under which an interval is said to be wide; from so many on it holds nearly what it claims."""


def interval_note(scenes: int, observed: str = "") -> str:
    """A note on the brackets of means over so many scenes.

    ``observed`` names what else was averaged over, such as "60 frames".
    """
    if scenes < 2:
        return "One scene does not say how much another would differ: no interval is given."
    counted = f"{observed} are {scenes} independent scenes" if observed else f"There are {scenes} scenes"
    text = (
        f"Brackets are {LEVEL:.0%} bootstrap intervals over scenes: where the figure may lie for other "
        f"scenes of the same kind. {counted}"
    )
    if scenes >= FEW:
        return text + "."
    return (
        f"{text}, and so few make the intervals wide: of a mean over four they go from the worst scene to "
        "the best, and hold the truth about nine times in ten."
    )
