"""From captures to relightable scenes: so far their light (stage 3, the environment map)."""

from tron.reconstruction.environment import EnvironmentFit, FitSettings, fit_environment

__all__ = ["EnvironmentFit", "FitSettings", "fit_environment"]
