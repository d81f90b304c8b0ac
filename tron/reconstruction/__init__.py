"""From captures to relightable scenes: surfels (stage 1), materials (stage 2) and light (stage 3)."""

from typing import TYPE_CHECKING

from tron.lazily import lazily

if TYPE_CHECKING:
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

__getattr__ = lazily(
    __name__,
    {
        "light.fit_environment": "EnvironmentFit fit_environment",
        "pipeline": "Reconstruction reconstruct",
        "priors": "GroundTruth Joint MapPrior Precomputed Prior RgbX",
        "settings": "FitSettings ReconstructionSettings",
    },
)
