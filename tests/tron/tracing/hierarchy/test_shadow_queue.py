"""Fans in line give what a lane for each fan gives, to the bit, whatever their number and form."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.tracing import SurfelTracer
from tron.tracing.hierarchy.transmittance import BackFaces, Fans, transmittance

pytestmark = pytest.mark.usefixtures("variant")


def fans(random_rays, count: int, rays: int) -> tuple[mi.Point3f, list[mi.Vector3f]]:
    origins, directions = random_rays(count * rays)
    along = directions.reshape(rays, count, 3)
    return mi.Point3f(np.ascontiguousarray(origins[:count].T)), [
        mi.Vector3f(np.ascontiguousarray(d.T)) for d in along
    ]


@pytest.mark.parametrize("rays", [1, 4])
@pytest.mark.parametrize("count", [1, 37, 5000])
def test_the_line_changes_no_bit(random_scene, random_rays, count: int, rays: int):
    scene = random_scene(300)
    tracer = SurfelTracer(scene)
    origin, directions = fans(random_rays, count, rays)
    active = [dr.arange(mi.UInt32, count) % 3 != ray for ray in range(rays)]
    back_faces = BackFaces.of(tracer.records, scene.spacing)
    alone = transmittance(tracer.bvh, Fans(origin, directions, active), back_faces)
    found = tracer.transmittances(Fans(origin, directions, active))
    np.testing.assert_array_equal(np.array(found), np.array(alone))
    if count == 5000:
        assert 0.05 < (np.array(found) < 1).mean() < 0.95


def test_one_origin_serves_all_directions_and_one_direction_all_origins(random_scene, random_rays):
    tracer = SurfelTracer(random_scene(300))
    origin, (direction,) = fans(random_rays, 50, 1)
    whole = [np.array(v) for v in (origin, direction)]
    first = [v[:, :1].repeat(50, 1) for v in whole]
    one = mi.Point3f(*map(float, whole[0][:, 0])), mi.Vector3f(*map(float, whole[1][:, 0]))
    np.testing.assert_array_equal(
        np.array(tracer.transmittance(one[0], direction)),
        np.array(tracer.transmittance(mi.Point3f(first[0]), direction)),
    )
    np.testing.assert_array_equal(
        np.array(tracer.transmittance(origin, one[1])),
        np.array(tracer.transmittance(origin, mi.Vector3f(first[1]))),
    )


@dr.syntax
def mean_of_copies(tracer: SurfelTracer, origin: mi.Point3f, direction: mi.Vector3f) -> mi.Float:
    """A recorded loop around shadow rays, as an integrator's is."""
    total, k = mi.Float(0), mi.UInt32(0)
    while k < 3:
        total += tracer.transmittance(origin, direction)
        k += 1
    return total / 3


def test_shadow_rays_go_within_recorded_loops(random_scene, random_rays):
    tracer = SurfelTracer(random_scene(300))
    origin, (direction,) = fans(random_rays, 500, 1)
    within = np.array(mean_of_copies(tracer, origin, direction))
    np.testing.assert_allclose(within, np.array(tracer.transmittance(origin, direction)), rtol=1e-6)


def test_other_numbers_of_rays_compile_nothing(random_scene, random_rays):
    tracer = SurfelTracer(random_scene(300))
    for count in (100, 1000):
        dr.eval(tracer.transmittances(Fans(*fans(random_rays, count, 4), [mi.Bool(True)] * 4)))
    origin, directions = fans(random_rays, 777, 4)
    dr.eval(origin, directions)  # copying from NumPy is a kernel for each size
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(tracer.transmittances(Fans(origin, directions, [mi.Bool(True)] * 4)))
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(k["cache_hit"] for k in kernels)
