"""Albedo and mean direction of GGX lobes, by roughness and n.v, integrated over all directions.

    A, B    of F0 A + B, the albedo of a GGX mirror with Schlick's Fresnel: the split sum (Karis 2013)
    G       albedo of the same mirror on glass of index 1.5, whose F0 is 0.04, with Fresnel's own equations
    E       A + B, the albedo of a perfect mirror, averaged over cosine-distributed n.v
    R, N    of F0 (R_A, N_A) + (R_B, N_B), the same integral of the directions: their components along the
            mirror's direction and along the normal. Divided by the albedo it is the lobe's mean direction,
            which is shorter for wider lobes. A smooth mirror's N is 0 at every angle

A lobe seen at a grazing angle is long and narrow. It is replaced by two round lobes with the same total mean;
``lobe_parts.npy`` holds their distance, fitted to the integral by ``dev/lobe_parts.py``.

Only single scattering is counted; :mod:`tron.brdf.reflectance` adds the rest. G exceeds 0.04 A + B by up to
0.02: Schlick's Fresnel is 0.07 at 60 degrees, where glass mirrors 0.09.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.interpolate import RectBivariateSpline

from tron.runtime import aligned

TABLE_SIZE = 256
GLASS_INDEX = 1.5
TABLE_FILE = Path(__file__).with_name("albedos.npy")
PARTS_FILE = Path(__file__).with_name("lobe_parts.npy")
PARTS_F0, PARTS_SMOOTHEST = 0.04, 0.2
"""The lower F0 of the file (the other is 1), and its least roughness, below which lobes are alike."""


@cache
def brdf_table() -> np.ndarray:
    """(roughness, n.v, 8) float32: A, B, G, E (the same for every n.v), R_A, N_A, R_B, N_B; read once.

    Entry (i, j) has roughness i / 255 and n.v = (j + 1/2) / 256, as integrated by ``dev/brdf_table.py``.
    """
    table = np.load(TABLE_FILE)
    whole = np.average(table[..., 0] + table[..., 1], axis=1, weights=_CENTRES)
    whole = np.broadcast_to(whole[:, None, None], (*table.shape[:2], 1))
    return np.concatenate([table[..., :3], whole, table[..., 3:]], -1, dtype=np.float32)


_CENTRES = (np.arange(TABLE_SIZE) + 0.5) / TABLE_SIZE


@cache
def parts_table() -> np.ndarray:
    """(2, roughness, n.v, 4) float32: w, x, y, 0 for F0 0.04 and F0 1; entries as in :func:`brdf_table`.

    w is the first part's share of the light. With the lobe's mean m, its unit vector u and s^2 = 1 - |m|^2,
    the first part's mean is m + d, d = x s (n - (n.u) u) + y s^2 u, and the second's m - w / (1 - w) d.
    """
    fitted = np.load(PARTS_FILE)
    rows, columns = fitted.shape[1:3]
    at = np.linspace(PARTS_SMOOTHEST, 1, rows), (np.arange(columns) + 0.5) / columns
    roughness = np.clip(np.arange(TABLE_SIZE) / (TABLE_SIZE - 1), *at[0][[0, -1]])
    cosine = np.clip(_CENTRES, *at[1][[0, -1]])
    table = np.zeros((2, TABLE_SIZE, TABLE_SIZE, 4), np.float32)
    for f0 in range(2):
        for k in range(3):
            table[f0, ..., k] = RectBivariateSpline(*at, fitted[f0, ..., k])(roughness, cosine)
    return table


@dataclass
class BrdfTable:
    """:func:`brdf_table` on the device.

    Attributes:
        texels: A, B, G and E, row-major.
        means: A, B, G and E of each roughness, averaged over cosine-distributed n.v.
        directions: R_A, N_A, R_B and N_B, row-major.
        glass_parts, mirror_parts: :func:`parts_table`, row-major.
    """

    texels: mi.Float
    means: mi.Float
    directions: mi.Float
    glass_parts: mi.Float
    mirror_parts: mi.Float

    @classmethod
    def load(cls) -> BrdfTable:
        """The table for the active variant, loaded once."""
        return _loaded(str(mi.variant()))

    def __call__(self, roughness: mi.Float, cosine: mi.Float | None = None) -> mi.Vector4f:
        """A, B, G and E, linear between entries; differentiable.

        Args:
            roughness: in [0, 1].
            cosine: n.v; None: the mean over cosine-distributed directions.
        """
        if cosine is not None:
            return _looked_up(self.texels, roughness, cosine)
        row, fy = _between(roughness * (TABLE_SIZE - 1))
        upper, lower = (dr.gather(mi.Vector4f, self.means, row + i) for i in (0, 1))
        return dr.lerp(upper, lower, fy)

    def lobe(self, roughness: mi.Float, cosine: mi.Float, f0: mi.Float) -> tuple[mi.Vector2f, mi.Vector3f]:
        """Mean direction and parts of a lobe.

        Args:
            roughness, cosine: as in :meth:`__call__`.
            f0: reflectance at the normal, above 0.

        Returns: the mean direction as factors on the mirror's direction and on the normal, both unit (1 and 0
        for a smooth mirror); and w, x and y of :func:`parts_table`, interpolated between its two F0 as
        Fresnel is.
        """
        scale, bias, _, _ = self(roughness, cosine)
        whole = dr.rcp(f0 * scale + bias)
        mirrored_a, up_a, mirrored_b, up_b = _looked_up(self.directions, roughness, cosine)
        mean = mi.Vector2f(f0 * mirrored_a + mirrored_b, f0 * up_a + up_b) * whole
        glass, mirror = (_looked_up(of, roughness, cosine) for of in (self.glass_parts, self.mirror_parts))
        of_glass = dr.clip((1 - f0) / (1 - PARTS_F0) * (PARTS_F0 * scale + bias) * whole, 0, 1)
        share, apart, longer, _ = dr.lerp(mirror, glass, of_glass)
        return mean, mi.Vector3f(share, apart, longer)


@cache
def _loaded(_variant: str) -> BrdfTable:
    table = brdf_table()
    albedos, directions = table[..., :4], table[..., 4:]
    means = np.average(albedos, axis=1, weights=_CENTRES)
    parts = (np.ascontiguousarray(part, np.float32) for part in (albedos, means, directions, *parts_table()))
    return BrdfTable(*(mi.Float(aligned(part.ravel())) for part in parts))


def _looked_up(texels: mi.Float, roughness: mi.Float, cosine: mi.Float) -> mi.Vector4f:
    row, fy = _between(roughness * (TABLE_SIZE - 1))
    column, fx = _between(cosine * TABLE_SIZE - 0.5)
    first = row * TABLE_SIZE + column

    def texel(index: mi.UInt32) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, texels, index)

    upper = dr.lerp(texel(first), texel(first + 1), fx)
    lower = dr.lerp(texel(first + TABLE_SIZE), texel(first + TABLE_SIZE + 1), fx)
    return dr.lerp(upper, lower, fy)


def _between(x: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The entry below ``x`` and the fraction beyond it; clamped at the ends."""
    x = dr.clip(x, 0, TABLE_SIZE - 1)
    entry = dr.minimum(mi.UInt32(x), TABLE_SIZE - 2)
    return entry, x - mi.Float(entry)
