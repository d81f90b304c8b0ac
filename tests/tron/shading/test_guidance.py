"""Laws of the guidance buffers, on the closed-form scene and on real surfels."""

import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import Estimation
from tron.shading.direct.irradiance import irradiance
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.shards.schema import light_members

BUFFERS = [name for name in Guidance.BUFFERS if name != "mask"]


def blurry_map() -> EnvironmentMap:
    image = np.linspace(0.2, 3.0, 32)[:, None, None] * np.array([1.0, 0.7, 0.4]) * np.ones((32, 64, 1))
    return EnvironmentMap(image.astype(np.float32))


def test_constant_light_with_nothing_in_the_way_is_returned_exactly(
    variant: str, sphere_over_plane, camera
) -> None:
    lighting = Lighting(EnvironmentMap.constant((0.5, 1.0, 2.0)))
    guidance = render_guidance(sphere_over_plane(sphere=False), camera, lighting, Estimation(rays=2))
    for name in ("irradiance", "unshadowed"):
        np.testing.assert_allclose(
            getattr(guidance, name), np.broadcast_to((0.5, 1, 2), (48, 48, 3)), rtol=1e-5, err_msg=name
        )


def test_buffers_are_finite_float32_images(variant: str, sphere_over_plane, camera, sun_map) -> None:
    guidance = render_guidance(sphere_over_plane(), camera, Lighting(sun_map), Estimation(rays=4))
    for name in BUFFERS:
        buffer = guidance[name]
        assert buffer.shape == (48, 48, 3)
        assert buffer.dtype == np.float32
        assert np.isfinite(buffer).all()
        assert buffer.min() >= 0
    assert set(BUFFERS) - {"indirect"} == set(light_members()), "the shards' schema names the others"
    assert guidance["mask"].shape == (48, 48, 1)
    np.testing.assert_array_equal(guidance["mask"][..., 0], guidance.mask)
    with pytest.raises(KeyError):
        guidance["gbuffer"]
    assert (guidance.irradiance <= guidance.unshadowed * (1 + 1e-5)).all()


def test_buffers_differ_by_the_diffuse_shadow_alone(variant: str, sphere_over_plane, camera, sun_map) -> None:
    tracer = sphere_over_plane(base_color=0.6, metallic=0.25)
    guidance = render_guidance(tracer, camera, Lighting(sun_map), Estimation(rays=16, brdf="lambert"))
    inside = guidance.mask == 1
    lost = 0.6 * 0.75 * (guidance.unshadowed - guidance.irradiance)
    assert lost[inside].max() > 0.1
    np.testing.assert_allclose(
        (guidance.pbr - guidance.shadowed)[inside], lost[inside], atol=1e-4 * guidance.pbr[inside].max()
    )


def test_metal_has_no_diffuse_and_keeps_its_reflection_in_shadow(
    variant: str, sphere_over_plane, camera, sun_map
) -> None:
    guidance = render_guidance(sphere_over_plane(metallic=1.0), camera, Lighting(sun_map), Estimation(rays=4))
    np.testing.assert_allclose(guidance.pbr, guidance.shadowed, rtol=1e-5)


def test_white_surfaces_in_a_white_furnace(variant: str, sphere_over_plane, camera) -> None:
    lighting = Lighting(EnvironmentMap.constant(1.0))
    metal = render_guidance(sphere_over_plane(metallic=1.0), camera, lighting, Estimation(rays=2)).pbr
    assert metal.min() > 0.8
    assert metal.max() <= 1 + 1e-4
    black = render_guidance(sphere_over_plane(base_color=0.0), camera, lighting, Estimation(rays=2))
    assert black.pbr[black.mask == 1].min() > 0.02  # a dielectric's own reflection


def test_the_environment_shows_where_surfels_do_not(variant: str, sphere_over_plane, camera, sun_map) -> None:
    class Faded(sphere_over_plane):
        opacity = 1.0

        def gbuffer(self, camera: Camera):
            gbuffer = super().gbuffer(camera)
            gbuffer.opacity *= self.opacity
            return gbuffer

    tracer, lighting = Faded(), Lighting(sun_map)
    behind = sun_map.lookup(camera.rays())
    full = render_guidance(tracer, camera, lighting, Estimation(rays=4))
    tracer.opacity = 0.25
    faded = render_guidance(tracer, camera, lighting, Estimation(rays=4))
    empty = full.mask == 0
    assert 0.05 < empty.mean() < 0.9
    for name in BUFFERS:
        np.testing.assert_allclose(getattr(full, name)[empty], behind[empty], rtol=1e-3, atol=1e-4)
        blended = 0.25 * getattr(full, name) + 0.75 * behind
        np.testing.assert_allclose(getattr(faded, name)[~empty], blended[~empty], rtol=1e-3, atol=1e-4)


def test_sharing_rays_makes_a_better_picture_than_either_estimate(
    variant: str, sphere_over_plane, camera, sun_map
) -> None:
    tracer, lighting = sphere_over_plane(), Lighting(sun_map)
    gbuffer = tracer.gbuffer(camera)
    surface = gbuffer.numpy()["opacity"] > 0
    plain = [
        gbuffer.image(irradiance(tracer, gbuffer, lighting.light, 64, seed)[0])[surface] for seed in range(33)
    ]
    truth = np.mean(plain[1:], axis=0)
    ours = render_guidance(tracer, camera, lighting, Estimation(rays=64), seed=0).irradiance[surface]

    def error(a: np.ndarray) -> float:
        return float(np.sqrt(np.mean((a - truth) ** 2)) / truth.mean())

    assert error(ours) < 0.6 * error(plain[0])
    assert ours.mean() == pytest.approx(truth.mean(), rel=0.01)


@pytest.mark.parametrize(("light", "rays", "most"), [("sun", 2, 0.5), ("soft", 64, 0.4)])
def test_the_filter_takes_noise_away_and_leaves_open_light_and_background_alone(
    variant: str, sphere_over_plane, camera, sun_map, light: str, rays: int, most: float
) -> None:
    camera = camera.resized(128, 128)
    even = EnvironmentMap(np.full((16, 32, 3), 0.7, np.float32))
    tracer, lighting = sphere_over_plane(), Lighting(sun_map if light == "sun" else even)
    truth, noisy, filtered = (
        render_guidance(tracer, camera, lighting, Estimation(rays=spp, filtered=denoise), seed=1)
        for spp, denoise in ((512, False), (rays, False), (rays, True))
    )

    def error(guidance: Guidance) -> float:
        return float(np.sqrt(np.mean((guidance.irradiance - truth.irradiance)[truth.mask > 0] ** 2)))

    assert error(filtered) < most * error(noisy)
    np.testing.assert_array_equal(filtered.irradiance[truth.mask == 0], noisy.irradiance[truth.mask == 0])
    still = render_guidance(
        sphere_over_plane(sphere=False), camera, lighting, Estimation(rays=rays, filtered=True)
    )
    np.testing.assert_allclose(still.irradiance, still.unshadowed, rtol=1e-5)


def test_the_plain_estimate_is_the_mean_over_the_rays(
    variant: str, sphere_over_plane, camera, sun_map
) -> None:
    tracer, lighting = sphere_over_plane(base_color=0.5), Lighting(sun_map)
    paper = Estimation(rays=16, estimator="plain", brdf="lambert")
    plain = render_guidance(tracer, camera, lighting, paper, seed=3)
    gbuffer, surface = tracer.gbuffer(camera), plain.mask > 0
    mean = gbuffer.image(irradiance(tracer, gbuffer, lighting.light, 16, 3)[0])
    np.testing.assert_allclose(plain.irradiance[surface], mean[surface], rtol=1e-4, atol=1e-5)
    lost = 0.5 * (plain.unshadowed - plain.irradiance)
    np.testing.assert_allclose((plain.pbr - plain.shadowed)[surface], lost[surface], atol=1e-3)
    assert (plain.irradiance > plain.unshadowed * 1.01).any(), "the noise of the light has been taken out"
