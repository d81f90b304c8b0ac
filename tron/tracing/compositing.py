"""Front-to-back compositing of sorted hits: ``sum_i T_i alpha_i f_i``, ``T_i = prod_{j<i} (1 - alpha_j)``.

(Equation 3 of the TRON paper.)  Compositing ends at the first hit after which T < 0.001.  The ids of the
composited hits are written out in order, so that an adjoint can replay exactly this list.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.gaussians.harmonics import sh_basis
from tron.tracing.hits import MAX_HITS, LocalHits
from tron.tracing.kernel import FEATURE_PACKETS, SH_PACKETS, SurfelRecords

STOP_TRANSMITTANCE = 1e-3
MEDIAN_TRANSMITTANCE = 0.5
CHANNELS = 4 * FEATURE_PACKETS


@dataclass
class HitList:
    """The composited hits of P rays, as the adjoint will replay them.

    Attributes:
        ids: mi.UInt32, slot-major: hit ``s`` of ray ``r`` lies at ``s * rays + r``.
        count: mi.UInt32 (P,), composited hits a ray.
        rays: P.
    """

    ids: mi.UInt32
    count: mi.UInt32
    rays: int

    @staticmethod
    def empty(rays: int) -> HitList:
        """Room for ``rays`` lists."""
        return HitList(dr.zeros(mi.UInt32, MAX_HITS * rays), dr.zeros(mi.UInt32, rays), rays)


@dataclass
class Composite:
    """Sums over the hits of each ray, unnormalised (Dr.Jit).

    Attributes:
        channels: 12 floats: normal, roughness | base color, metallic | rgb of SH radiance, unused.
        mean_depth: sum of ``w t``.
        transmittance: T after the last composited hit.
        median_depth: t of the first hit after which T < 0.5; 0 where T stays above.
        count: composited hits.
    """

    channels: list[mi.Float]
    mean_depth: mi.Float
    transmittance: mi.Float
    median_depth: mi.Float
    count: mi.UInt32


def radiance(records: SurfelRecords, index: mi.UInt32, basis: list[mi.Float]) -> mi.Color3f:
    """Display-space radiance ``max(0, SH(d) + 0.5)`` of one surfel; gathers only the degrees in use."""
    total = [mi.Float(0.5), mi.Float(0.5), mi.Float(0.5)]
    numbers = 3 * (records.sh_degree + 1) ** 2
    for packet in range(-(-numbers // 4)):
        values = dr.gather(mi.Vector4f, records.harmonics, index * SH_PACKETS + packet)
        for lane in range(min(4, numbers - 4 * packet)):
            coefficient, channel = divmod(4 * packet + lane, 3)
            total[channel] = dr.fma(values[lane], basis[coefficient], total[channel])
    return mi.Color3f(*[dr.select(value > 0, value, 0) for value in total])


@dr.syntax
def composite(records: SurfelRecords, hits: LocalHits, direction: mi.Vector3f, out: HitList) -> Composite:
    """Composite the sorted ``hits`` of each lane and write their ids to ``out`` (the caller evaluates both).

    Args:
        records: the surfels.
        hits: sorted local hits, in the same kernel.
        direction: unit ray direction, at which SH radiance is evaluated (3DGRT's choice).
        out: receives the ids; lane r writes list r.
    """
    channels = [mi.Float(0) for _ in range(CHANNELS)]
    mean_depth, median_depth, remaining = mi.Float(0), mi.Float(0), mi.Float(1)
    lane, slot = dr.arange(mi.UInt32, out.rays), mi.UInt32(0)
    stride = dr.opaque(mi.UInt32, out.rays)  # a literal would compile a kernel for each image size
    basis = sh_basis(direction.x, direction.y, direction.z)
    active = slot < hits.count
    while active:
        alpha, index, t = hits.alpha[slot], hits.index[slot], hits.t[slot]
        dr.scatter(out.ids, index, slot * stride + lane, active)
        weight = remaining * alpha
        for packet in range(FEATURE_PACKETS):
            feature = dr.gather(mi.Vector4f, records.features, index * FEATURE_PACKETS + packet)
            for k in range(4):
                channels[4 * packet + k] = dr.fma(weight, feature[k], channels[4 * packet + k])
        if dr.hint(records.sh_degree > 0, mode="scalar"):
            extra = radiance(records, index, basis)
            base = dr.gather(mi.Vector4f, records.features, index * FEATURE_PACKETS + 2)
            for k in range(3):
                channels[8 + k] = dr.fma(weight, extra[k] - base[k], channels[8 + k])
        mean_depth = dr.fma(weight, t, mean_depth)
        after = remaining * (1 - alpha)
        crossed = (remaining >= MEDIAN_TRANSMITTANCE) & (after < MEDIAN_TRANSMITTANCE)
        median_depth = dr.select(crossed, t, median_depth)
        remaining = after
        slot += 1
        active &= (slot < hits.count) & (remaining >= STOP_TRANSMITTANCE)
    return Composite(channels, mean_depth, remaining, median_depth, slot)
