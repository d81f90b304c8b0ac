"""Contrast of a light, a measure of how hard its shadows are, and three classes of it."""

from __future__ import annotations

from typing import Literal

from tron.shading.environments.environment import EnvironmentMap

Contrast = Literal["high", "medium", "low"]

HIGH_CONTRAST = 0.3
"""Share above which a map casts distinct shadows."""

LOW_CONTRAST = 0.12
"""Share up to which a map hardly casts any shadows."""

CONTRAST_ROWS = 64
"""Rows to which a map is reduced for measuring, so that its class does not depend on its resolution."""

INTERVALS: dict[Contrast, tuple[float, float]] = {
    "high": (HIGH_CONTRAST, 1.0),
    "medium": (LOW_CONTRAST, HIGH_CONTRAST),
    "low": (0.0, LOW_CONTRAST),
}
"""Class -> interval of shares, above the first number and up to the second.

The share is 0.01 for a constant, near 1 for a bare lamp. Of 80 lights of each of our eight families (seeds 0
to 79), 28 % lie below LOW_CONTRAST, in the valley between covered skies and the rest, and 56 % above
HIGH_CONTRAST.
"""


def contrast_share(environment: EnvironmentMap) -> float:
    """Share of the light from the brightest hundredth of the sphere, rounded to four decimals."""
    rows = min(environment.image.shape[0], CONTRAST_ROWS)
    return round(environment.resized(rows).contrast(), 4)


def classify(environment: EnvironmentMap) -> Contrast:
    """Class of a map's contrast."""
    share = contrast_share(environment)
    return "high" if share > HIGH_CONTRAST else "medium" if share > LOW_CONTRAST else "low"
