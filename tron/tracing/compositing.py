"""Front-to-back compositing of sorted hits: ``sum_i T_i alpha_i f_i``, ``T_i = prod_{j<i} (1 - alpha_j)``.

(Equation 3 of the TRON paper; conventions.md, 7.) Compositing ends at the first hit after which T is
below 0.001. The ids of the composited hits are written out in order, so that the adjoint replays the same
list.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.tracing.hits import LocalHits
from tron.tracing.kernel import FEATURE_PACKETS, MIN_ALPHA, SH_PACKETS, SurfelRecords, value_packets

STOP_TRANSMITTANCE = 1e-3
MEDIAN_TRANSMITTANCE = 0.5
BEGIN_TRANSMITTANCE = 0.9
"""Transmittance below which a surface has begun; in a scan with fog, that is well before its median."""
APART = 0.7
"""Least mean cosine between a hit's normal and those of the ray's first hits on the same face."""
NO_SURFEL = 0xFFFFFFFF
MOST_HITS = ceil(log(STOP_TRANSMITTANCE) / log(1 - MIN_ALPHA)) + 1
"""Most hits that a ray composites: 1764 of the faintest stop it, and one more allows for rounding."""
CHANNELS = 11
MATERIAL_PACKETS = 2
"""Packets of a feature record that are composited unchanged: normal, roughness | base color, metallic."""


@dataclass
class HitList:
    """The composited hits of some rays, which the adjoint replays.

    Attributes:
        ids: mi.UInt32, surfels, slot-major: slot ``s`` of list ``r`` lies at ``s * width(ray) + r``.
        count: mi.UInt32, composited hits of each list.
        ray: mi.UInt32, the ray that each list belongs to.
    """

    ids: mi.UInt32
    count: mi.UInt32
    ray: mi.UInt32

    @staticmethod
    def empty(ray: mi.UInt32, capacity: int) -> HitList:
        """Empty lists of up to ``capacity`` hits for the rays ``ray``.

        Raises:
            TronError: more than 32-bit indices can address.
        """
        rays = dr.width(ray)
        if capacity * rays >= 1 << 32:
            raise TronError(
                f"{rays} rays of up to {capacity} hits are too many to differentiate at once",
                mend="render the image in parts, or without gradients",
            )
        return HitList(dr.empty(mi.UInt32, capacity * rays), dr.zeros(mi.UInt32, rays), ray)

    @property
    def capacity(self) -> int:
        """Most hits of a list."""
        return dr.width(self.ids) // dr.width(self.ray)

    def rows(self) -> HitRows:
        """Memory that compositing writes the ids to."""
        lists, capacity = dr.width(self.ray), self.capacity
        return HitRows(
            self.ids, dr.arange(mi.UInt32, lists), dr.opaque(mi.UInt32, lists), dr.opaque(mi.UInt32, capacity)
        )


@dataclass
class HitRows:
    """The memory of a :class:`HitList` inside a kernel, with sizes as variables.

    Literals would compile a kernel for each image size.

    Attributes:
        ids: mi.UInt32. lane: mi.UInt32, 0, 1, .. one a list.
        lists, capacity: mi.UInt32, one number each.
    """

    ids: mi.UInt32
    lane: mi.UInt32
    lists: mi.UInt32
    capacity: mi.UInt32


@dataclass
class Composite:
    """Sums over the hits of each ray, unnormalised (Dr.Jit).

    Attributes:
        channels: 11 floats: normal, roughness, base color, metallic, rgb of SH radiance; then the records'
            values.
        front: 4 floats: sums of ``w n`` and ``w`` over the hits on the first hits' face (:data:`APART`).
        first, other: the first surfel, and the first of another face; ``NO_SURFEL`` if there is none.
        mean_depth: sum of ``w t``.
        transmittance: T after the last composited hit.
        median: the surfel after which T < 0.5 first; ``NO_SURFEL`` where T stays above.
        begin: the surfel after which T < 0.9 first; ``NO_SURFEL`` where T stays above.
        count: composited hits.
    """

    channels: list[mi.Float]
    front: list[mi.Float]
    mean_depth: mi.Float
    transmittance: mi.Float
    median: mi.UInt32
    begin: mi.UInt32
    first: mi.UInt32
    other: mi.UInt32
    count: mi.UInt32

    @staticmethod
    def start(values: int = 0) -> Composite:
        """Initial sums, nothing hit yet, for surfels with ``values`` further values."""
        channels, front = ([mi.Float(0) for _ in range(count)] for count in (CHANNELS + values, 4))
        none = [mi.UInt32(NO_SURFEL) for _ in range(4)]
        return Composite(channels, front, mi.Float(0), mi.Float(1), *none, mi.UInt32(0))


def harmonic_sums(
    records: SurfelRecords, index: mi.UInt32, basis: list[mi.Float], active: mi.Bool
) -> tuple[list[mi.Vector4f], list[mi.Float]]:
    """The used packets of an SH record, and ``SH(d) + 0.5`` for red, green and blue.

    ``basis`` is :func:`tron.gaussians.harmonics.sh_basis` of d.
    """
    packets, total = [], [mi.Float(0.5), mi.Float(0.5), mi.Float(0.5)]
    numbers = 3 * (records.sh_degree + 1) ** 2
    for packet in range(-(-numbers // 4)):
        values = dr.gather(mi.Vector4f, records.harmonics, index * SH_PACKETS + packet, active)
        packets.append(values)
        for lane in range(min(4, numbers - 4 * packet)):
            coefficient, channel = divmod(4 * packet + lane, 3)
            total[channel] = dr.fma(values[lane], basis[coefficient], total[channel])
    return packets, total


def radiance(
    records: SurfelRecords, index: mi.UInt32, basis: list[mi.Float], active: mi.Bool
) -> list[mi.Float]:
    """Display-space radiance ``max(0, SH(d) + 0.5)`` of one surfel: red, green, blue."""
    if records.sh_degree == 0:  # independent of direction: packing has evaluated it
        packed = dr.gather(mi.Vector4f, records.features, index * FEATURE_PACKETS + MATERIAL_PACKETS, active)
        return [packed[0], packed[1], packed[2]]
    _, total = harmonic_sums(records, index, basis, active)
    return [dr.select(value > 0, value, 0) for value in total]


def values_of(records: SurfelRecords, index: mi.UInt32, active: mi.Bool) -> list[mi.Vector4f]:
    """The packets of one surfel's values, the last one padded; empty if the records have no values."""
    packets = value_packets(records.value_count)
    return [
        dr.gather(mi.Vector4f, records.values, index * packets + packet, active) for packet in range(packets)
    ]


@dr.syntax
def composite(
    records: SurfelRecords, hits: LocalHits, basis: list[mi.Float], sums: Composite, out: HitRows | None
) -> Composite:
    """Composite the sorted ``hits`` of each lane behind those already in ``sums``.

    Args:
        records: the surfels.
        hits: sorted local hits, in the same kernel; all of them lie behind those in ``sums``.
        basis: spherical harmonics at the unit ray direction (3DGRT evaluates SH there).
        sums: the sums so far; :meth:`Composite.start` at first.
        out: receives the ids, list r from lane r, as many as fit; the caller evaluates it.
    """
    slot = mi.UInt32(0)
    active = (slot < hits.count) & (sums.transmittance >= STOP_TRANSMITTANCE)
    while active:
        alpha, index, t = hits.alpha[slot], hits.index[slot], hits.t[slot]
        if dr.hint(out is not None, mode="scalar"):
            place = sums.count * out.lists + out.lane
            dr.scatter(out.ids, index, place, active & (sums.count < out.capacity))
        weight = sums.transmittance * alpha
        channels = []
        for packet in range(MATERIAL_PACKETS):
            feature = dr.gather(mi.Vector4f, records.features, index * FEATURE_PACKETS + packet, active)
            channels += [feature[k] for k in range(4)]
        channels += radiance(records, index, basis, active)
        for packet in values_of(records, index, active):
            channels += [packet[k] for k in range(4)]
        for k in range(len(sums.channels)):
            sums.channels[k] = dr.fma(weight, channels[k], sums.channels[k])
        facing = -APART * sums.front[3]
        for k in range(3):
            facing = dr.fma(channels[k], sums.front[k], facing)
        alike = facing >= 0  # so is the first
        added = dr.select(alike, weight, 0)
        for k in range(3):
            sums.front[k] = dr.fma(added, channels[k], sums.front[k])
        sums.front[3] += added
        sums.mean_depth = dr.fma(weight, t, sums.mean_depth)
        after = sums.transmittance * (1 - alpha)
        crossed = (sums.transmittance >= MEDIAN_TRANSMITTANCE) & (after < MEDIAN_TRANSMITTANCE)
        sums.median = dr.select(crossed, index, sums.median)
        begun = (sums.transmittance >= BEGIN_TRANSMITTANCE) & (after < BEGIN_TRANSMITTANCE)
        sums.begin = dr.select(begun, index, sums.begin)
        sums.transmittance = after
        sums.first = dr.select(sums.count == 0, index, sums.first)
        sums.other = dr.select(alike | (sums.other != NO_SURFEL), sums.other, index)
        sums.count += 1
        slot += 1
        active &= (slot < hits.count) & (after >= STOP_TRANSMITTANCE)
    return sums
