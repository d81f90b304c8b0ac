"""From captures to relightable scenes: surfels with materials (stages 1 and 2) and their light (stage 3)."""

from tron.reconstruction.environment import EnvironmentFit, fit_environment
from tron.reconstruction.pipeline import Reconstruction, reconstruct
from tron.reconstruction.settings import FitSettings, ReconstructionSettings

__all__ = [
    "EnvironmentFit",
    "FitSettings",
    "Reconstruction",
    "ReconstructionSettings",
    "fit_environment",
    "reconstruct",
]
