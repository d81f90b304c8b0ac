"""Surfel budget of a scene: numbers of surfels and views that suit the size of its frames.

What surfels blur is most of a large frame's error, not noise: with 20,000 of them no denoiser brings a frame
of 512 x 512 beyond 31.1 dB; with 60,000 it is 32.4 (a prototype on six scenes at b7bbe91). What this law
gains stands in dev/LOG.md, 2026-11-26.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

Auto = Literal["auto"]
AUTO: Auto = "auto"


class SurfelBudget(NamedTuple):
    """Surfels of a scene and the views that they are made from and fitted to; fields are named as settings.

    Attributes:
        surfels: approximate number of them.
        views: number of the views. view_width, view_height: of each, pixels.
        refine_steps: optimisation steps of the fit.
    """

    surfels: int
    views: int
    view_width: int
    view_height: int
    refine_steps: int

    @property
    def view_pixels(self) -> int:
        """Number of pixels of one view."""
        return self.view_width * self.view_height


LEAST_SIDE = 128
"""Side of frames; smaller ones have the surfels of these, for their scenes are as large."""
VIEWS = 32
COUNT = (20_000, 0.58)
"""Surfels of frames of LEAST_SIDE, and the power of the pixels that they grow with: 100,000 at 512 x 512."""
MOST = 200_000
SIDE = (192, 0.25)
"""Likewise the side of the views: 384 pixels at 512 x 512."""
STEPS = (100, 0.5)
"""Likewise the steps, each of which sees a window (``datagen.sources.refinement``): 400 at 512 x 512."""


def surfels_by_pixels(pixels: int) -> SurfelBudget:
    """Return the budget for frames of so many pixels.

    >>> surfels_by_pixels(512 * 512)
    SurfelBudget(surfels=100000, views=32, view_width=384, view_height=384, refine_steps=400)
    """
    larger = max(pixels / LEAST_SIDE**2, 1.0)
    count, side, steps = (first * larger**power for first, power in (COUNT, SIDE, STEPS))
    side = 8 * round(side / 8)
    return SurfelBudget(min(1000 * round(count / 1000), MOST), VIEWS, side, side, 10 * round(steps / 10))
