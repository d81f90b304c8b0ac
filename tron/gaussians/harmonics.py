"""Real spherical harmonics up to degree 3, in the sign convention of 3D Gaussian Splatting.

Sixteen functions ordered l = 0..3, m = -l..l. They are sqrt(2) Im Y_l^|m| (m < 0), Y_l^0 and sqrt(2) Re Y_l^m
(m > 0) of the complex harmonics *with* the Condon-Shortley phase, which is where the minus signs come from;
orthonormal over the sphere. Same constants and order as the reference code of Kerbl et al. 2023, so its
coefficients can be used as they are. The direction is the one the light is seen along: from the camera to the
Gaussian.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

SH_COUNT = 16
SH_C0 = 0.5 / math.sqrt(math.pi)
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi))
_C20 = math.sqrt(5 / (16 * math.pi))
_C22 = math.sqrt(15 / (16 * math.pi))
_C33 = math.sqrt(35 / (32 * math.pi))
_C32 = math.sqrt(105 / (4 * math.pi))
_C31 = math.sqrt(21 / (32 * math.pi))
_C30 = math.sqrt(7 / (16 * math.pi))


def sh_basis(x: Any, y: Any, z: Any) -> list[Any]:
    """The 16 basis functions at unit directions (x, y, z), world.

    The coordinates are NumPy, torch or Dr.Jit arrays of one shape, or floats. Returns 16 of the same; the
    first is the float SH_C0, since it depends on nothing.
    """
    xx, yy, zz = x * x, y * y, z * z
    return [
        SH_C0,
        y * -_C1,
        z * _C1,
        x * -_C1,
        x * y * _C2,
        y * z * -_C2,
        (zz * 2 - xx - yy) * _C20,
        x * z * -_C2,
        (xx - yy) * _C22,
        y * (xx * 3 - yy) * -_C33,
        x * y * z * _C32,
        y * (zz * 4 - xx - yy) * -_C31,
        z * (zz * 2 - xx * 3 - yy * 3) * _C30,
        x * (zz * 4 - xx - yy) * -_C31,
        z * (xx - yy) * (_C32 / 2),
        x * (xx - yy * 3) * -_C33,
    ]


def sh_matrix(directions: np.ndarray) -> np.ndarray:
    """(..., 3) unit directions, world -> (..., 16) float64 values of the basis."""
    directions = np.asarray(directions, dtype=np.float64)
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack(np.broadcast_arrays(*sh_basis(x, y, z)), axis=-1)


def eval_sh(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colour of Gaussians seen along directions: max(0, SH + 0.5), the 3DGS rule.

    sh (..., 16, 3) coefficients; directions (..., 3) unit, world, camera to Gaussian. Returns (..., 3) in the
    space of the coefficients, which is display space throughout the house.
    """
    value = np.einsum("...k,...kc->...c", sh_matrix(directions), np.asarray(sh, dtype=np.float64))
    return np.maximum(value + 0.5, 0.0)


def rgb_to_dc(rgb: np.ndarray) -> np.ndarray:
    """Colour (display space) -> the degree-0 coefficient that shows it from every direction. Same shape."""
    return (np.asarray(rgb) - 0.5) / SH_C0


def dc_to_rgb(dc: np.ndarray) -> np.ndarray:
    """Degree-0 coefficient -> its mean colour (display space), not clipped. Same shape."""
    return np.asarray(dc) * SH_C0 + 0.5


def rotate_sh(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Coefficients of the radiance field turned with its Gaussian by (..., 3, 3) rotations.

    sh (..., 16, 3) -> the same shape; eval_sh(rotate_sh(sh, R), R d) = eval_sh(sh, d). Each degree is closed
    under rotation, so a projection through more directions than functions is exact up to rounding.
    """
    directions = spread_directions(64)
    before = sh_matrix(directions @ np.asarray(rotation, np.float64))  # rows are R^T d
    # Columns: coefficients, in the turned frame, of each basis function.
    turn = np.linalg.pinv(sh_matrix(directions)) @ before
    return (turn @ sh).astype(np.asarray(sh).dtype)


def spread_directions(count: int) -> np.ndarray:
    """(count, 3) unit directions of a Fibonacci spiral: even over the sphere, without a random number."""
    z = 1 - (2 * np.arange(count) + 1) / count
    azimuth = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
