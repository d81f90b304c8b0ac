"""The adjoint once more: Dr.Jit differentiates each hit where it is replayed, as Mitsuba's prb does.

Slower than :mod:`tron.tracing.adjoint`, and nobody derived it: the witness that the formulas there are those
of the kernel.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.gaussians.harmonics import sh_basis
from tron.tracing.adjoint import attach
from tron.tracing.compositing import MATERIAL_PACKETS, Composite, HitList, radiance
from tron.tracing.gbuffer import tile_rays, trace_tiles
from tron.tracing.kernel import FEATURE_PACKETS, SurfelRecords, intersect
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiled.tiles import build_tiles

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera.look_at((2.0, 0.7, 0.5), (0, 0, 0), fov_deg=50, width=21, height=14)


def accumulate_gradients(
    records: SurfelRecords, sums: Composite, outer: Composite, hits: HitList,
    origin: mi.Point3f, direction: mi.Vector3f, basis: list[mi.Float],
) -> None:  # fmt: skip
    """Add the gradients of the sums' dot product with ``outer`` to records whose gradients are enabled."""
    rest = outer.transmittance * sums.transmittance + outer.mean_depth * sums.mean_depth
    for gradient, value in zip(outer.channels, sums.channels, strict=True):
        rest += gradient * value
    dr.eval(rest)
    with dr.suspend_grad():
        dr.eval(_loop(records, outer, hits, origin, direction, basis, mi.Float(rest)))


@dr.syntax
def _loop(
    records: SurfelRecords, outer: Composite, hits: HitList, origin: mi.Point3f, direction: mi.Vector3f,
    basis: list[mi.Float], rest: mi.Float,
) -> mi.Float:  # fmt: skip
    lane, lists = dr.arange(mi.UInt32, dr.width(hits.ray)), dr.opaque(mi.UInt32, dr.width(hits.ray))
    remaining, slot = mi.Float(1), mi.UInt32(0)
    active = slot < hits.count
    while active:
        index = dr.gather(mi.UInt32, hits.ids, slot * lists + lane, active)
        with dr.resume_grad():
            met = intersect(records.geometry, dr.select(active, index, 0), origin, direction, records.degree)
            projected = outer.mean_depth * met.t
            for packet in range(MATERIAL_PACKETS):
                at = index * FEATURE_PACKETS + packet
                feature = dr.gather(mi.Vector4f, records.features, at, active)
                for k in range(4):
                    projected += outer.channels[4 * packet + k] * feature[k]
            color = radiance(records, index, basis, active)
            for k in range(3):
                projected += outer.channels[8 + k] * color[k]
            alpha, value = dr.detach(met.alpha), dr.detach(projected)
            behind = rest - remaining * alpha * value
            by_alpha = remaining * value - behind / (1 - alpha)
            dr.backward_from(dr.select(active, by_alpha * met.alpha + remaining * alpha * projected, 0))
        rest = dr.detach(behind)
        remaining *= 1 - alpha
        slot += 1
        active &= slot < hits.count
    return rest


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_hand_written_adjoint_is_what_local_differentiation_gives(random_scene, degree, sh_degree):
    records = pack(SurfelParameters.from_scene(random_scene(120, degree=degree, sh_degree=sh_degree)))
    lists = build_tiles(records, CAMERA)
    rays = tile_rays(CAMERA)
    sums, hits = trace_tiles(records, lists, rays, keep_hits=True)
    rng = seeds.generator(0, "tests", "outer")
    outer = [mi.Float(rng.normal(size=dr.width(sums.count)).astype(np.float32)) for _ in range(13)]
    buffers = ("geometry", "features", "harmonics")

    def gradients() -> list[np.ndarray]:
        return [np.array(dr.grad(getattr(records, name))) for name in buffers]

    def restart() -> None:
        for name in buffers:
            setattr(records, name, dr.detach(getattr(records, name)))
            dr.enable_grad(getattr(records, name))

    restart()
    attached = attach(sums, records, rays.origin, rays.direction, hits)
    values = [*attached.channels, attached.mean_depth, attached.transmittance]
    dr.backward(dr.sum(sum((a * b for a, b in zip(outer, values, strict=True)), start=mi.Float(0))))
    by_hand = gradients()
    restart()
    direction = rays.direction
    basis = sh_basis(direction.x, direction.y, direction.z)
    weights = replace(type(sums).start(), channels=outer[:11], mean_depth=outer[11], transmittance=outer[12])
    (kept,) = hits[0]
    accumulate_gradients(records, sums, weights, kept, rays.origin, direction, basis)
    for name, hand, local in zip(buffers, by_hand, gradients(), strict=True):
        if name == "harmonics" and sh_degree == 0:
            continue
        assert np.abs(local).max() > 0
        np.testing.assert_allclose(hand, local, atol=1e-4 * np.abs(local).max(), err_msg=name)
