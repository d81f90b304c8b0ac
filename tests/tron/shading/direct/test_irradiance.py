"""Laws of shadowed irradiance, against quadrature in float64 and Mitsuba's own direct integrator."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.errors import TronError
from tron.seeds import generator
from tron.shading.direct.irradiance import irradiance
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap

CENTRE, RADIUS = np.array([0.0, 0.0, 0.8]), 0.5


def unit(n: int, seed: int = 0) -> np.ndarray:
    d = generator(seed, "directions").normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def columns(a: object) -> np.ndarray:
    return np.array(a).T.astype(np.float64)


def quadrature(
    environment: EnvironmentMap, point: np.ndarray, normal: np.ndarray, height: int = 360
) -> np.ndarray:
    """(2, 3): shadowed and unshadowed E / pi under the sphere, by midpoints over directions, float64."""
    theta, phi = (np.arange(height) + 0.5) / height * np.pi, (np.arange(2 * height) + 0.5) / height * np.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    weight = np.maximum(d @ normal, 0) * np.sin(t).ravel() * (np.pi / height) ** 2 / np.pi
    value = environment.lookup(d).astype(np.float64) * weight[:, None]
    to = point - CENTRE
    b = d @ to
    blocked = (b < 0) & (b * b > to @ to - RADIUS**2)
    return np.stack([value[~blocked].sum(0), value.sum(0)])


def test_shadow_of_a_sphere_is_the_quadrature(
    variant: str, sphere_over_plane, points_gbuffer, sun_map
) -> None:
    points = np.array(
        [[0, 0, 0], [0.3, 0.2, 0], [-0.5, -0.4, 0], [0.2, -0.9, 0], [1.5, 1, 0], [-0.7, 0.3, 0]], float
    )
    up = np.array([0.0, 0, 1])
    copies = 600
    gbuffer = points_gbuffer(np.repeat(points, copies, 0), np.tile(up, (len(points) * copies, 1)))
    ours = irradiance(sphere_over_plane(), gbuffer, EnvironmentLight(sun_map), 64, seed=1)
    means = np.stack([columns(e).reshape(len(points), copies, 3).mean(1) for e in ours], 1)
    truth = np.stack([quadrature(sun_map, p, up) for p in points])
    assert truth[:, 0].min() < 0.7 * truth[:, 1].min() < 1.0 * truth[:, 0].max()  # shadows and light both
    np.testing.assert_allclose(means, truth, rtol=0.015)


@pytest.mark.parametrize("spp", [2, 64])
def test_constant_light_with_nothing_in_the_way(
    variant: str, sphere_over_plane, points_gbuffer, spp: int
) -> None:
    normals = unit(20000)
    light = EnvironmentLight(EnvironmentMap.constant((0.5, 1.0, 2.0)))
    gbuffer = points_gbuffer(np.zeros((20000, 3)), normals)
    shadowed, unshadowed = irradiance(sphere_over_plane(sphere=False), gbuffer, light, spp, seed=3)
    np.testing.assert_array_equal(columns(shadowed), columns(unshadowed))
    np.testing.assert_allclose(columns(shadowed).mean(0), (0.5, 1, 2), rtol=0.01)


def test_strategies_agree_in_mean_and_both_together_vary_least_under_a_sun(
    variant: str, sphere_over_plane, points_gbuffer, sun_map
) -> None:
    # Normals all round: some face the sun, to some it is below the horizon and only the sky counts.
    gbuffer = points_gbuffer(np.tile([0.3, 0.2, 0.01], (40000, 1)), np.repeat(unit(200), 200, 0))
    light = EnvironmentLight(sun_map)
    mean, noise, relative = {}, {}, {}
    for strategy in ("mis", "cosine", "light"):
        value = columns(irradiance(sphere_over_plane(), gbuffer, light, 16, 5, strategy)[0])[:, 1]
        value = value.reshape(200, 200)
        mean[strategy] = value.mean()
        noise[strategy] = np.sqrt(value.var(1).mean() / value.size)
        relative[strategy] = (value.var(1) / value.mean(1) ** 2).mean()
    for strategy in ("cosine", "light"):
        assert abs(mean[strategy] - mean["mis"]) < 5 * np.hypot(noise[strategy], noise["mis"])
        assert relative["mis"] < 0.5 * relative[strategy]


def test_pictures_are_those_of_mitsubas_direct_integrator(
    variant: str, sphere_over_plane, camera, sun_map
) -> None:
    """Same rays, the real sphere and plane, white: outgoing radiance is E / pi."""
    tracer = sphere_over_plane()
    gbuffer = tracer.gbuffer(camera)
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    slab = mi.ScalarTransform4f().translate([0, 0, -0.001]).scale([3.0, 3.0, 0.001])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sphere": {"type": "sphere", "center": CENTRE.tolist(), "radius": RADIUS, "bsdf": white},
            # top at z = 0; no rectangle: where Mitsuba 3.9.1 merges those they leave scene.bbox()
            "plane": {"type": "cube", "to_world": slab, "bsdf": white},
            "light": sun_map.to_mitsuba(),
        }
    )
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 4, "bsdf_samples": 4})
    copies = 32
    direction = dr.gather(
        mi.Vector3f, dr.ravel(gbuffer.direction), dr.arange(mi.UInt32, 48 * 48 * copies) // copies
    )
    rays = mi.RayDifferential3f(mi.Point3f(*map(float, camera.position)), direction)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(7, 48 * 48 * copies)
    truth = columns(integrator.sample(scene, sampler, rays)[0]).reshape(-1, copies, 3).mean(1)
    light = EnvironmentLight(sun_map)
    ours = np.mean([columns(irradiance(tracer, gbuffer, light, 64, seed)[0]) for seed in range(4)], 0)
    surface = np.array(gbuffer.opacity) > 0
    error = np.abs(ours - truth)[surface]
    assert 0.5 < surface.mean() < 1
    assert (ours[~surface] == 0).all()
    assert np.abs(ours[surface].mean(0) / truth[surface].mean(0) - 1).max() < 0.01
    assert np.median(error) < 0.05 * truth[surface].mean()


def test_the_ratio_is_one_in_the_open_and_zero_in_the_umbra(
    variant: str, sphere_over_plane, points_gbuffer
) -> None:
    image = np.zeros((64, 128, 3), np.float32)
    image[0] = 50.0  # a light at the zenith only
    light = EnvironmentLight(EnvironmentMap(image))
    points = np.repeat([[0.0, 0, 0], [2.5, 2.5, 0]], 500, 0)
    shadowed, unshadowed = irradiance(
        sphere_over_plane(), points_gbuffer(points, np.tile([0, 0, 1.0], (1000, 1))), light, 8, seed=2
    )
    shadowed, unshadowed = columns(shadowed), columns(unshadowed)
    assert (unshadowed > 0).all()
    assert (shadowed[:500] == 0).all()
    np.testing.assert_array_equal(shadowed[500:], unshadowed[500:])


def test_seeds_are_reproducible_and_independent(variant: str, sphere_over_plane, points_gbuffer) -> None:
    light = EnvironmentLight(EnvironmentMap(generator(0, "map").random((16, 32, 3)).astype(np.float32)))
    n = 1 << 16
    gbuffer = points_gbuffer(np.zeros((n, 3)), np.tile([0, 0, 1.0], (n, 1)))
    gbuffer.width = gbuffer.height = 256
    one, two, again = (
        columns(irradiance(sphere_over_plane(), gbuffer, light, 2, seed)[1])[:, 0] for seed in (0, 1, 0)
    )
    np.testing.assert_array_equal(one, again)
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.02


@pytest.mark.parametrize("spp", [6, 100])
def test_no_number_of_rays_errs_over_the_whole_image(
    variant: str, sphere_over_plane, points_gbuffer, spp: int
) -> None:
    """The mean over 1024 pixels of a small light, over seeds: no worse than of independent pixels."""
    image = np.zeros((64, 128, 3), np.float32)
    image[20:23, 40:43] = 100.0
    light = EnvironmentLight(EnvironmentMap(image))
    gbuffer = points_gbuffer(np.zeros((1024, 3)), np.tile([0, 0, 1.0], (1024, 1)))
    gbuffer.width = gbuffer.height = 32
    tracer = sphere_over_plane(sphere=False)
    pixels = np.stack([columns(irradiance(tracer, gbuffer, light, spp, s)[1])[:, 0] for s in range(12)])
    truth = columns(irradiance(tracer, gbuffer, light, 1024, 99)[1])[:, 0].mean()
    shared = np.sqrt(np.mean((pixels.mean(1) / truth - 1) ** 2))
    independent = pixels.std() / truth / np.sqrt(1024)
    assert shared < 1.7 * independent  # 12 seeds know their own deviation to a fifth


def test_strata_beat_independent_rays(variant: str, sphere_over_plane, points_gbuffer) -> None:
    image = np.zeros((32, 64, 3), np.float32)
    image[:16, :40] = 1.0
    light = EnvironmentLight(EnvironmentMap(image))
    gbuffer = points_gbuffer(np.zeros((4000, 3)), np.tile([0, 0, 1.0], (4000, 1)))
    tracer = sphere_over_plane(sphere=False)
    spread = {spp: columns(irradiance(tracer, gbuffer, light, spp, 0)[0])[:, 0].std() for spp in (2, 64)}
    assert spread[64] < 0.7 * spread[2] / np.sqrt(32)


def test_seeds_ray_counts_and_lights_share_one_kernel(
    variant: str, sphere_over_plane, camera, sun_map, kernels_of
) -> None:
    tracer = sphere_over_plane()
    gbuffer = tracer.gbuffer(camera)
    sun, dimmer = EnvironmentLight(sun_map), EnvironmentLight(EnvironmentMap(sun_map.image * 0.5, 30.0))
    irradiance(tracer, gbuffer, sun, 2, 0)  # evaluates the witness's G-buffer as well
    first = kernels_of(lambda: irradiance(tracer, gbuffer, sun, 64, 0))
    assert first
    assert kernels_of(lambda: irradiance(tracer, gbuffer, dimmer, 128, 1)) <= first, "compiled anew"


@pytest.mark.parametrize("spp", [0, 1, 3, -2])
def test_an_odd_number_of_rays_is_refused(variant: str, spp: int) -> None:
    with pytest.raises(TronError, match="even"):
        irradiance(SimpleNamespace(), SimpleNamespace(width=1), SimpleNamespace(), spp, 0)  # type: ignore[arg-type]
