"""From captures to relightable scenes: surfels (stage 1), materials (stage 2) and light (stage 3)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # torch, which a scan's materials are found without
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

_HOMES = {
    **dict.fromkeys(("EnvironmentFit", "fit_environment"), "light.fit_environment"),
    **dict.fromkeys(("Reconstruction", "reconstruct"), "pipeline"),
    **dict.fromkeys(("GroundTruth", "Joint", "MapPrior", "Precomputed", "Prior", "RgbX"), "priors"),
    **dict.fromkeys(("FitSettings", "ReconstructionSettings"), "settings"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
