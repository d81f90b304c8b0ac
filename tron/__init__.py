"""TRON: relighting captured and synthetic 3D worlds made of Gaussian surfels.

Importing the package is light on purpose: it loads neither Mitsuba nor torch.
"""

__version__ = "0.1.0"
