"""Light a scene of surfels: one object owns tracers, sides and bounces, and updates them after a change."""

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
