"""Parameters of a scene that can be optimised, and their packing into the records that the tracer reads.

Packing is Dr.Jit code, so gradients of the records flow back to means, quaternions, log-scales, logits,
harmonics and materials by ordinary automatic differentiation. The kernel's cut (``q_cut``, ``radius``)
decides what is visible and is not differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.gaussians.harmonics import SH_C0
from tron.runtime import aligned
from tron.tracing.kernel import SH_PACKETS, SurfelRecords, cut_radius_squared, value_packets

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene


@dataclass
class SurfelParameters:
    """M surfels as flat Dr.Jit arrays: the arrays of :class:`GaussianScene`, flattened row by row.

    Attributes:
        means: mi.Float (3M), world.
        quats: mi.Float (4M), (w, x, y, z) of any length but zero.
        log_scales: mi.Float (2M).
        opacity_logits: mi.Float (M).
        sh: mi.Float (48M), 16 coefficients of (red, green, blue) a surfel.
        base_color: mi.Float (3M), linear.
        roughness, metallic: mi.Float (M).
        count: M.
        kernel_degree: 2 or 4.
        sh_degree: highest SH degree that is evaluated, 0..3; higher coefficients are not read.
    """

    means: mi.Float
    quats: mi.Float
    log_scales: mi.Float
    opacity_logits: mi.Float
    sh: mi.Float
    base_color: mi.Float
    roughness: mi.Float
    metallic: mi.Float
    count: int
    kernel_degree: int
    sh_degree: int

    @staticmethod
    def from_scene(scene: GaussianScene, sh_degree: int | None = None) -> SurfelParameters:
        """Upload a scene, which may have no surfels.

        ``sh_degree`` defaults to the highest degree with a nonzero coefficient. Give it to learn harmonics
        that begin at zero: coefficients beyond the degree get no gradient.
        """
        degree = highest_sh_degree(scene) if sh_degree is None else sh_degree
        arrays = {name: mi.Float(aligned(getattr(scene, name).ravel())) for name in PARAMETERS}
        return SurfelParameters(
            **arrays, count=len(scene), kernel_degree=scene.kernel_degree, sh_degree=degree
        )

    def differentiable(self) -> bool:
        """Whether any parameter has gradients enabled."""
        return dr.grad_enabled(*[getattr(self, name) for name in PARAMETERS])


def highest_sh_degree(scene: GaussianScene) -> int:
    """Highest spherical-harmonics degree of the scene with a coefficient that is not zero."""
    used = np.any(scene.sh != 0.0, axis=0).any(axis=1) if len(scene) else np.zeros(16, bool)
    return math.isqrt(int(np.flatnonzero(used).max())) if used.any() else 0


def pack(parameters: SurfelParameters) -> SurfelRecords:
    """Lay surfels out for the tracer (layouts: :mod:`tron.tracing.kernel`), differentiably.

    Harmonics are not copied: the records hold ``parameters.sh`` itself. Without surfels there is one record
    that no ray meets, because Dr.Jit refuses empty arrays.
    """
    count = parameters.count
    if count == 0:
        return _nothing(parameters.kernel_degree)
    surfel = dr.arange(mi.UInt32, count)

    def rows(kind: type, values: mi.Float) -> mi.Float:
        width = dr.size_v(kind)
        return kind(*[_column(values, surfel * width + k) for k in range(width)])

    tangent_u, tangent_v, normal = _frame(rows(mi.Vector4f, parameters.quats))
    scales = dr.exp(rows(mi.Vector2f, parameters.log_scales))
    opacity = dr.rcp(1 + dr.exp(-parameters.opacity_logits))
    q_cut = cut_radius_squared(dr.detach(opacity), parameters.kernel_degree)
    larger = dr.detach(dr.select(scales.x > scales.y, scales.x, scales.y))
    radius = larger * dr.sqrt(dr.select(q_cut > 0, q_cut, 0))
    radiance = _constant_radiance(parameters.sh, surfel)
    centre, base = rows(mi.Vector3f, parameters.means), rows(mi.Vector3f, parameters.base_color)
    axis_u, axis_v = tangent_u / scales.x, tangent_v / scales.y
    records = SurfelRecords(
        geometry=interleave([*centre, opacity, *axis_u, radius, *axis_v, q_cut], count),
        features=interleave(
            [*normal, parameters.roughness, *base, parameters.metallic, *radiance, mi.Float(0)], count
        ),
        # Dr.Jit refuses empty arrays as loop state: an unused scalar stands in.
        harmonics=parameters.sh if parameters.sh_degree > 0 else dr.zeros(mi.Float, 1),
        count=count,
        degree=parameters.kernel_degree,
        sh_degree=parameters.sh_degree,
    )
    dr.eval(records.geometry, records.features, records.harmonics)
    return records


def pack_values(records: SurfelRecords, values: Sequence[mi.Float]) -> SurfelRecords:
    """The records with ``values`` to composite beside their materials, differentiably.

    Args:
        records: M surfels.
        values: each mi.Float of M numbers in the scene's order, or one number for all; may be empty.

    Raises:
        TronError: an array of another length.
    """
    if not values:
        return records
    for k, value in enumerate(values):
        if dr.width(value) not in (1, records.count):
            raise TronError(f"values[{k}] has {dr.width(value)} numbers", mend=f"give {records.count}")
    columns = [*values, *[mi.Float(0)] * (4 * value_packets(len(values)) - len(values))]
    packed = interleave(columns, records.count)
    dr.eval(packed)
    return replace(records, values=packed, value_count=len(values))


def _frame(quats: mi.Vector4f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
    """Columns of the rotation of (w, x, y, z) quaternions, normalised first: tangent u, tangent v, normal."""
    w, x, y, z = quats * dr.rsqrt(dr.squared_norm(quats))
    return (
        mi.Vector3f(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        mi.Vector3f(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        mi.Vector3f(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def _constant_radiance(sh: mi.Float, surfel: mi.UInt32) -> list[mi.Float]:
    """Display-space radiance of the constant harmonic, clipped at zero: red, green, blue."""
    radiance = [SH_C0 * _column(sh, surfel * (4 * SH_PACKETS) + k) + 0.5 for k in range(3)]
    return [dr.select(value > 0, value, 0) for value in radiance]


def _column(values: mi.Float, index: mi.UInt32) -> mi.Float:
    # Each number is read once, yet the gather must not declare that, nor any other mode: Dr.Jit 1.5 then
    # overwrites (Permute, Direct, Local, and NoConflicts in part) the gradients that other uses of the
    # parameters have added, such as a regulariser of the loss. By default it makes copies for each thread;
    # their kernel is compiled for each number of surfels.
    return dr.gather(mi.Float, values, index)


def interleave(columns: list[mi.Float], count: int) -> mi.Float:
    """Columns of ``count`` floats -> one array, record by record, written as packets of four."""
    packets = len(columns) // 4
    records = dr.zeros(mi.Float, count * len(columns))
    surfel = dr.arange(mi.UInt32, count)
    for packet in range(packets):
        value = mi.Vector4f(*columns[4 * packet : 4 * packet + 4])
        dr.scatter(records, value, surfel * packets + packet)
    return records


def _nothing(kernel_degree: int) -> SurfelRecords:
    """One record that no ray meets."""
    never = mi.Float([0.0] * 11 + [-1.0])
    return SurfelRecords(never, dr.zeros(mi.Float, 12), dr.zeros(mi.Float, 1), 1, kernel_degree, 0)
