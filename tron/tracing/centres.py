"""Surfels themselves as surfaces: what a ray sees that meets a surfel alone, at its centre."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from tron.tracing.kernel import FEATURE_PACKETS, GEOMETRY_PACKETS, SurfelRecords
from tron.tracing.surface import Surface


def centres(records: SurfelRecords, surfel: mi.UInt32, active: mi.Bool | bool = True) -> Surface:
    """Centres, unit normals and materials of ``surfel``, one lane each, differentiable in the records.

    Opacity is 1, also the surfels' own; 0 in inactive lanes. There is no ray: depth, direction and rgb are 0.
    """
    active = mi.Bool(active)

    def packet(values: mi.Float, index: mi.UInt32) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, values, index, active)

    centre = packet(records.geometry, surfel * GEOMETRY_PACKETS)
    normal, base = (packet(records.features, surfel * FEATURE_PACKETS + k) for k in range(2))
    return Surface(
        position=mi.Point3f(centre.x, centre.y, centre.z),
        depth=mi.Float(0),
        normal=mi.Normal3f(normal.x, normal.y, normal.z),
        normal_sum=mi.Normal3f(normal.x, normal.y, normal.z),
        base_color=mi.Color3f(base.x, base.y, base.z),
        roughness=normal.w,
        metallic=base.w,
        rgb=mi.Color3f(0),
        opacity=dr.select(active, mi.Float(1), 0),
        direction=mi.Vector3f(0),
        values=[],
    )
