"""TRON: relighting captured and synthetic 3D worlds made of Gaussian surfels.

Importing the package is light on purpose: neither Mitsuba nor torch is loaded until a module that needs them is.
"""

__version__ = "0.1.0"
