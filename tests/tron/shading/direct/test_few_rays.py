"""Laws of irradiance from few rays: shadows as dark as of many, exact in the open and in the dark."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.color import luminance
from tron.estimation import Estimation
from tron.runtime import aligned, lanes
from tron.seeds import generator
from tron.shading.direct.irradiance import irradiance, visible_share
from tron.shading.direct.neighbours import neighbourhood_mean
from tron.shading.direct.visibility import (
    FILTER_REACH,
    RATIO_FROM_RAYS,
    atrous,
    reaching_share,
    regressed_share,
)
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap
from tron.shading.guidance import Lighting, render_guidance

VIEW = Camera.look_at((-3.0, -2.5, 2.5), (-0.4, 0, 0.1), fov_deg=26, width=96, height=96)


def windows() -> EnvironmentMap:
    """A dim room with one wide window."""
    image = np.full((32, 64, 3), 0.1, np.float32)
    image[4:12, 26:38] = (9.0, 8.0, 7.0)
    return EnvironmentMap(image)


@pytest.mark.parametrize("light", ["sun", "soft"])
def test_shadows_of_few_rays_are_as_dark_as_of_many(
    variant: str, sphere_over_plane, sun_map, light: str
) -> None:
    tracer, lighting = sphere_over_plane(), Lighting(sun_map if light == "sun" else windows())
    many = render_guidance(tracer, VIEW, lighting, Estimation(rays=256), seed=99)
    surface = many.mask > 0
    shadowed = surface & (luminance(many.irradiance) < 0.5 * luminance(many.unshadowed))
    assert shadowed.sum() > 150
    truth = luminance(many.irradiance[shadowed]).mean()
    for spp, denoise in ((2, False), (2, True), (4, True), (8, False)):
        few = [
            render_guidance(tracer, VIEW, lighting, Estimation(rays=spp, filtered=denoise), k).irradiance
            for k in range(2)
        ]
        mean = np.mean([luminance(image[shadowed]).mean() for image in few])
        assert 0.94 < mean / truth < 1.07, (spp, denoise)  # the ratio: from 1.2 to 1.8 at 2 rays


def test_the_regression_has_less_noise_than_the_ratio(variant: str, sphere_over_plane, sun_map) -> None:
    tracer, lighting = sphere_over_plane(), Lighting(sun_map)
    many = render_guidance(tracer, VIEW, lighting, Estimation(rays=256), seed=99)
    surface, gbuffer = many.mask > 0, tracer.gbuffer(VIEW)
    found = irradiance(tracer, gbuffer, lighting.light, 2, 0)
    shares = (
        reaching_share(*found, gbuffer, lighting, tracer.scene.spacing, Estimation(rays=2)),
        visible_share(*found),
    )
    ours, ratio = (np.std((gbuffer.image(s) * many.unshadowed - many.irradiance)[surface]) for s in shares)
    assert ours < 0.7 * ratio


def test_open_surfaces_keep_all_light_exactly(variant: str, sphere_over_plane, sun_map) -> None:
    tracer, lighting = sphere_over_plane(sphere=False), Lighting(sun_map)
    gbuffer = tracer.gbuffer(VIEW)
    for spp in (2, 4, 8):
        found = irradiance(tracer, gbuffer, lighting.light, spp, 0)
        share = reaching_share(*found, gbuffer, lighting, tracer.scene.spacing, Estimation(rays=spp))
        np.testing.assert_array_equal(gbuffer.image(share), 1)


def test_a_dark_umbra_stays_black(variant: str, sphere_over_plane) -> None:
    image = np.zeros((64, 128, 3), np.float32)
    image[0] = 50.0  # a light at the zenith only: right under the sphere nothing arrives
    tracer, lighting = sphere_over_plane(), Lighting(EnvironmentMap(image))
    gbuffer = tracer.gbuffer(VIEW)
    position, normal = gbuffer.numpy()["position"], gbuffer.numpy()["normal"]
    floor = (normal[..., 2] > 0.99) & (position[..., 2] < 0.01)
    umbra = floor & (np.hypot(position[..., 0], position[..., 1]) < 0.3)
    assert umbra.sum() > 20
    found = irradiance(tracer, gbuffer, lighting.light, 2, 0)
    for denoise, most in ((False, 1e-5), (True, 0.01)):
        share = reaching_share(
            *found, gbuffer, lighting, tracer.scene.spacing, Estimation(rays=2, filtered=denoise)
        )
        assert gbuffer.image(share)[umbra].max() < most


def test_a_pixel_without_neighbours_keeps_the_ratio(
    variant: str, sphere_over_plane, points_gbuffer, sun_map
) -> None:
    tracer, lighting = sphere_over_plane(), Lighting(sun_map)
    normals = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1]])
    gbuffer = points_gbuffer(np.zeros((4, 3)), normals)
    found = irradiance(tracer, gbuffer, lighting.light, 2, 0)
    known = lighting.split_sum.diffuse(gbuffer.normal)
    share = regressed_share(*found, known, gbuffer, tracer.scene.spacing)
    np.testing.assert_array_equal(np.array(share), np.array(visible_share(*found)))
    assert np.array(share).min() < 1


def test_from_sixteen_rays_the_share_is_the_ratio(variant: str, sphere_over_plane, camera, sun_map) -> None:
    tracer, lighting = sphere_over_plane(), Lighting(sun_map)
    gbuffer = tracer.gbuffer(camera)
    for spp, same in ((RATIO_FROM_RAYS - 2, False), (RATIO_FROM_RAYS, True), (64, True)):
        found = irradiance(tracer, gbuffer, EnvironmentLight(sun_map), spp, 0)
        share = reaching_share(*found, gbuffer, lighting, tracer.scene.spacing, Estimation(rays=spp))
        assert (np.array(share) == np.array(visible_share(*found))).all() == same


def test_pixels_that_agree_with_no_neighbour_are_averaged_with_those_near_them(
    variant: str, sphere_over_plane
) -> None:
    """As on leaves and fringes: normals all over, so that two pixels in a hundred face alike."""
    tracer, draw = sphere_over_plane(), generator(0, "tests", "fringes")
    gbuffer = tracer.gbuffer(VIEW)
    count = dr.width(gbuffer.opacity)
    normals = draw.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frayed = replace(gbuffer, normal=lanes(mi.Normal3f, normals.astype(np.float32)))
    noise = mi.Float(aligned(draw.uniform(size=count).astype(np.float32)))
    (mean,), _ = neighbourhood_mean([noise], frayed, tracer.scene.spacing)
    surface = np.array(gbuffer.opacity) > 0.99
    assert np.std(np.array(mean)[surface]) < 0.6 * np.std(np.array(noise)[surface])


def test_a_pixel_changes_none_beyond_the_reach_of_the_filter(variant: str, sphere_over_plane):
    """Windows of larger pictures are given that many pixels more on each side."""
    above = Camera.look_at((0, 0.01, 4), (0, 0, 0), fov_deg=40, width=96, height=96)
    tracer = sphere_over_plane(sphere=False)
    gbuffer = tracer.gbuffer(above)
    count = dr.width(gbuffer.opacity)
    order = gbuffer.images({"lane": mi.Float(dr.arange(mi.Float, count))})["lane"].astype(int)
    light = generator(0, "reach").uniform(0.4, 0.6, count).astype(np.float32)

    def filtered(values: np.ndarray) -> np.ndarray:
        share = mi.Float(aligned(values))
        shadowed, _ = atrous(mi.Color3f(share), mi.Color3f(1), share, gbuffer, tracer.scene.spacing)
        return np.array(shadowed[0])[order]

    other = light.copy()
    other[order[48, 48]] = 1
    rows, columns = np.nonzero(filtered(other) != filtered(light))
    farthest = max(np.abs(rows - 48).max(), np.abs(columns - 48).max())
    of_narrow_lights_and_terms = 2 * (1 + 1)
    assert 16 < farthest <= FILTER_REACH - of_narrow_lights_and_terms
