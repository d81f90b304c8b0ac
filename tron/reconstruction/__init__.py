"""From captures to relightable scenes: surfels (stage 1), materials (stage 2) and light (stage 3)."""

from tron.reconstruction.light.fit_environment import EnvironmentFit, fit_environment
from tron.reconstruction.pipeline import Reconstruction, reconstruct
from tron.reconstruction.priors import GroundTruth, Joint, MapPrior, Precomputed, Prior, RgbX
from tron.reconstruction.settings import FitSettings, ReconstructionSettings

__all__ = [
    "EnvironmentFit",
    "FitSettings",
    "GroundTruth",
    "Joint",
    "MapPrior",
    "Precomputed",
    "Prior",
    "Reconstruction",
    "ReconstructionSettings",
    "RgbX",
    "fit_environment",
    "reconstruct",
]
