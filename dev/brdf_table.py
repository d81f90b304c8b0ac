"""Integrals of the material's mirror over all directions, ``tron/brdf/albedos.npy``.

    python dev/brdf_table.py tron/brdf/albedos.npy

They took 3 processor seconds of every process that shaded anything.
"""

from __future__ import annotations

import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.runtime import activate

activate()

from tron.brdf.microfacets import unhidden, visible_normal  # noqa: E402
from tron.brdf.table import GLASS_INDEX, TABLE_SIZE  # noqa: E402

TABLE_SAMPLES = 32
"""Quadrature points along each of the two dimensions of the visible normals."""


def integrals() -> np.ndarray:
    """(roughness, n.v, 7) float32: A, B, G, R_A, N_A, R_B, N_B of :func:`tron.brdf.table.brdf_table`.

    By midpoint quadrature over the visible normals (Heitz 2018, "Sampling the GGX Distribution of Visible
    Normals").
    """
    lane = dr.arange(mi.UInt32, TABLE_SIZE * TABLE_SIZE)
    cosine = (mi.Float(lane % TABLE_SIZE) + 0.5) / TABLE_SIZE
    roughness = mi.Float(lane // TABLE_SIZE) / (TABLE_SIZE - 1)
    lobes = _directional_albedo(cosine, dr.square(roughness))
    return np.stack([np.array(lobe).reshape(TABLE_SIZE, TABLE_SIZE) for lobe in lobes], -1)


@dr.syntax
def _directional_albedo(cosine: mi.Float, alpha: mi.Float) -> tuple[mi.Float, ...]:
    view = mi.Vector3f(dr.safe_sqrt(1 - cosine * cosine), 0, cosine)
    scale, bias, glass, total = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0)
    mean_scale, mean_bias = mi.Vector3f(0), mi.Vector3f(0)
    i = mi.UInt32(0)
    while i < TABLE_SAMPLES * TABLE_SAMPLES:
        # The rim of the disk is the lobe's long tail: points crowd there, by radius^2 = 1 - x^3.
        x = (mi.Float(i % TABLE_SAMPLES) + 0.5) / TABLE_SAMPLES
        share = 3 * x * x
        # Mirror symmetry about the plane of incidence: half a turn is enough.
        turn = (mi.Float(i // TABLE_SAMPLES) + 0.5) / (2 * TABLE_SAMPLES)
        half = visible_normal(view, alpha, mi.Point2f(1 - x * x * x, turn - 0.25))
        facing = dr.dot(view, half)
        out = 2 * facing * half - view
        weight = dr.select((out.z > 0) & (facing > 0), share * unhidden(cosine, out.z, alpha), 0)
        fresnel = (1 - facing) ** 5
        scale += weight * (1 - fresnel)
        bias += weight * fresnel
        mean_scale += weight * (1 - fresnel) * out
        mean_bias += weight * fresnel * out
        glass += weight * mi.fresnel(facing, GLASS_INDEX)[0]
        total += share
        i += 1
    mean_scale, mean_bias = mean_scale / total, mean_bias / total
    # Both parts are smooth where the surface is faced. Its tangent away from the view is not defined there.
    mirrored_a, mirrored_b = -mean_scale.x / view.x, -mean_bias.x / view.x
    means = (mirrored_a, mean_scale.z - cosine * mirrored_a, mirrored_b, mean_bias.z - cosine * mirrored_b)
    return scale / total, bias / total, glass / total, *means


if __name__ == "__main__":
    np.save(Path(sys.argv[1]), integrals())
