"""Contrast of a light: high, medium or low, by one measure."""

from __future__ import annotations

from typing import Literal

from tron.shading.environment import EnvironmentMap

Contrast = Literal["high", "medium", "low"]

HIGH_CONTRAST = 0.3
"""Share of the light from the brightest hundredth of the sphere above which a map casts distinct shadows."""


def classify(environment: EnvironmentMap) -> Contrast:
    """High contrast if the brightest hundredth of the sphere gives more than HIGH_CONTRAST of the light."""
    return "high" if environment.contrast() > HIGH_CONTRAST else "low"
