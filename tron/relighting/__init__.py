"""Light a scene of surfels: one object that owns tracers, sides, bounces, and what to redo after a change."""

from tron.estimation import Estimation
from tron.relighting.baking import baked
from tron.relighting.relighter import Illumination, Relighter, TracedFrame, views_under
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance

__all__ = [
    "EnvironmentMap",
    "Estimation",
    "Guidance",
    "Illumination",
    "Relighter",
    "TracedFrame",
    "baked",
    "views_under",
]
