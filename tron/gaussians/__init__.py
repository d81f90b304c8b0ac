"""Gaussian scenes: surfels, their spherical harmonics and files, and how to make them from G-buffers."""

from typing import TYPE_CHECKING

from tron.lazily import lazily

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene

__all__ = ["GaussianScene"]

__getattr__ = lazily(__name__, {"scene": "GaussianScene"})
