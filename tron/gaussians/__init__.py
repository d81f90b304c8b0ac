"""Gaussian scenes: the surfels, their harmonics, their files, and how they are made from G-buffers."""

from tron.gaussians.scene import GaussianScene

__all__ = ["GaussianScene"]
