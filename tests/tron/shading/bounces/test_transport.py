"""Laws of transport: it is irradiance, linear in the light, and finite differences confirm its gradients."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.reconstruction.light.fit_environment import Transport
from tron.seeds import generator
from tron.shading.direct.irradiance import irradiance
from tron.shading.environments.cubemap import CubemapLight
from tron.shading.environments.environment import EnvironmentLight


def rows(a: object) -> np.ndarray:
    return np.array(a).T.astype(np.float64)


def texels(resolution: int = 8, seed: int = 1) -> np.ndarray:
    return (generator(seed, "texels").random((6, resolution, resolution, 3)) ** 4 * 5).astype(np.float32)


def cubemap(values: np.ndarray) -> CubemapLight:
    return CubemapLight(mi.Float(values.ravel()), values.shape[1])


def test_the_wavefront_is_the_loop(variant: str, sphere_over_plane, camera, sun_map) -> None:
    tracer = sphere_over_plane()
    gbuffer = tracer.gbuffer(camera)
    for light in (EnvironmentLight(sun_map), cubemap(texels())):
        wavefront = Transport.trace(tracer, gbuffer, light, 8, 3).irradiance(light)
        loop = irradiance(tracer, gbuffer, light, 8, 3)
        assert (rows(loop[0]) < 0.9 * rows(loop[1])).any()
        for ours, theirs in zip(wavefront, loop):
            np.testing.assert_allclose(rows(ours), rows(theirs), rtol=1e-4, atol=1e-5)


def test_cubemap_and_map_light_a_scene_alike(
    variant: str, cubemap_of, sphere_over_plane, camera, sun_map
) -> None:
    tracer = sphere_over_plane()
    gbuffer = tracer.gbuffer(camera)
    light = cubemap_of(sun_map, 64)
    one, other = (
        np.mean([rows(irradiance(tracer, gbuffer, each, 64, seed)[0]) for seed in range(8)], 0)
        for each in (light, EnvironmentLight(sun_map))
    )
    assert abs(one.mean() / other.mean() - 1) < 0.02
    assert np.abs(one - other).mean() < 0.05 * other.mean()  # noise of 512 rays


def test_irradiance_is_linear_in_the_light_for_fixed_rays(variant: str, sphere_over_plane, camera) -> None:
    tracer = sphere_over_plane()
    a, b = texels(seed=1), texels(seed=2)
    transport = Transport.trace(tracer, tracer.gbuffer(camera), cubemap(a), 4, 0)
    seen_a, seen_b, seen = (rows(transport.irradiance(cubemap(t))[0]) for t in (a, b, 2 * a + 3 * b))
    np.testing.assert_allclose(seen, 2 * seen_a + 3 * seen_b, rtol=1e-4, atol=1e-4)


def test_gradients_of_texels_are_the_finite_differences(variant: str, sphere_over_plane, camera) -> None:
    tracer = sphere_over_plane()
    values = texels(6)
    transport = Transport.trace(tracer, tracer.gbuffer(camera), cubemap(values), 4, 0)
    pixels = camera.width * camera.height
    weight = generator(4, "weight").normal(size=(pixels, 3))

    parameter = mi.Float(values.ravel())
    dr.enable_grad(parameter)
    seen, _ = transport.irradiance(CubemapLight(parameter, 6))
    dr.backward(dr.sum(dr.dot(seen, mi.Color3f(np.ascontiguousarray(weight.T, np.float32)))))
    ours = np.array(dr.grad(parameter), np.float64).reshape(values.shape)
    assert (ours != 0).mean() > 0.9
    for seed in range(4):
        towards = generator(seed, "towards").normal(size=values.shape)
        ends = [
            (rows(transport.irradiance(cubemap((values + s * towards).astype(np.float32)))[0]) * weight).sum()
            for s in (1, -1)
        ]
        assert (ours * towards).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-3, abs=1e-2)


def test_light_that_an_occluder_hides_gets_no_gradient(
    variant: str, sphere_over_plane, points_gbuffer
) -> None:
    # From under the sphere, the zenith is hidden; from far away it is not.
    values = np.ones((6, 16, 16, 3), np.float32)
    for point, expected in (((0.0, 0, 0), False), ((2.9, 2.9, 0), True)):
        gbuffer = points_gbuffer(np.tile(point, (50, 1)), np.tile([0, 0, 1.0], (50, 1)))
        parameter = mi.Float(values.ravel())
        transport = Transport.trace(sphere_over_plane(), gbuffer, cubemap(values), 64, 0)
        dr.enable_grad(parameter)
        dr.backward(dr.sum(transport.irradiance(CubemapLight(parameter, 16))[0].x))
        gradient = np.array(dr.grad(parameter)).reshape(values.shape)
        assert (gradient[4, 7:9, 7:9, 0] > 0).all() == expected  # the middle of the face +z
        assert (gradient[5] == 0).all()  # nothing comes from below
