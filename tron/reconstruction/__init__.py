"""From captures to relightable scenes: surfels with materials (stages 1 and 2) and their light (stage 3)."""

from tron.reconstruction.environment import EnvironmentFit, fit_environment
from tron.reconstruction.explanation import Explanation, explain
from tron.reconstruction.joint import Joint
from tron.reconstruction.pipeline import Reconstruction, reconstruct
from tron.reconstruction.settings import FitSettings, ReconstructionSettings

__all__ = [
    "EnvironmentFit",
    "Explanation",
    "FitSettings",
    "Joint",
    "Reconstruction",
    "ReconstructionSettings",
    "explain",
    "fit_environment",
    "reconstruct",
]
