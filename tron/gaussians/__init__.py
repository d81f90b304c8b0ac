"""Gaussian scenes: surfels, their spherical harmonics and files, and how to make them from G-buffers."""

from tron.gaussians.scene import GaussianScene

__all__ = ["GaussianScene"]
