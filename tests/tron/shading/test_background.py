"""Laws of what is seen through surfels: nothing through a solid, all through the thin, smoothly between."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.estimation import Estimation
from tron.seeds import generator
from tron.shading.composition import CLEAR_TRANSMITTANCE, background_share
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.tracing import SurfelTracer

BUFFERS = ("pbr", "irradiance", "unshadowed", "shadowed")
TOWARDS_SUN = np.array([0.48, 0.36, 0.8])
VIEW = Camera.look_at(-3 * TOWARDS_SUN, (0, 0, 0), fov_deg=20, width=48, height=48)


def low_sun(peak: float) -> EnvironmentMap:
    """A sky of radiance one, and a sun of five degrees that stands in the middle of ``VIEW``."""
    sky = EnvironmentMap.constant(1.0, height=128)
    v, u = np.meshgrid(np.linspace(0, np.pi, 128), (np.arange(256) + 0.5) / 256 * 2 * np.pi, indexing="ij")
    towards = np.stack([np.sin(v) * np.sin(u), np.sin(v) * np.cos(u), np.cos(v)], -1)
    image = np.where((towards @ TOWARDS_SUN > np.cos(np.radians(2.5)))[..., None], peak, sky.image)
    return EnvironmentMap(image.astype(np.float32))


def fitted_logits(count: int) -> np.ndarray:
    """Opacities' logits of surfels that leave the light that fitted ones do: (count,)."""
    return generator(0, "tests", "fitted opacities").normal(3.0, 1.2, count)


def rendered(scene, peak: float, **settings) -> Guidance:
    return render_guidance(
        SurfelTracer(scene),
        VIEW,
        Lighting(low_sun(peak), 64),
        Estimation(rays=2),
        **settings,
    )


def test_share_is_none_of_the_opaque_all_of_the_clear_and_rises_smoothly_between(variant: str) -> None:
    transmittance = np.linspace(0, 1, 100_001, dtype=np.float32)
    share = background_share(transmittance)
    assert (share[transmittance <= 0.01] == 0).all()
    clear = transmittance >= CLEAR_TRANSMITTANCE
    np.testing.assert_array_equal(share[clear], transmittance[clear])
    steps = np.diff(share.astype(np.float64)) / 1e-5
    assert steps.min() >= 0
    assert steps.max() < 2.1
    assert np.abs(np.diff(steps[::50])).max() < 0.05, "no kink"
    assert background_share(np.array([0.026]))[0] < 1e-7


def test_share_on_the_device_is_that_on_the_host_and_its_slope_that_of_differences(variant: str) -> None:
    transmittance = np.linspace(0, 1, 2001)
    on_device = mi.Float(transmittance.astype(np.float32))
    dr.enable_grad(on_device)
    share = background_share(on_device)
    np.testing.assert_allclose(np.array(share), background_share(transmittance), rtol=1e-4, atol=1e-7)
    dr.backward(share)
    slopes = (background_share(transmittance + 1e-6) - background_share(transmittance - 1e-6)) / 2e-6
    np.testing.assert_allclose(np.array(dr.grad(on_device)), slopes, atol=2e-3)


def test_a_sun_does_not_shine_through_a_solid(variant: str, dense_surfels) -> None:
    ball = dense_surfels.sphere(radius=0.8)
    scene = dense_surfels.scene(ball, opacity_logits=fitted_logits(len(ball.points)))
    environment = low_sun(5e4)
    behind = environment.lookup(VIEW.rays())[..., 0] > 1e3
    seen, alone = rendered(scene, 5e4), rendered(scene, 5e4, background=(0, 0, 0))
    opacity = np.percentile(seen.mask[behind], (0, 50))
    assert behind.sum() > 100
    assert 0.97 < opacity[0] < 0.98, "as much light as fitted surfels leave at most"
    assert 0.995 < opacity[1] < 0.997, "and as much as they mostly leave"
    for name in BUFFERS:
        through = np.abs(getattr(seen, name) - getattr(alone, name))[behind]
        assert through[seen.mask[behind] > 0.99].max() == 0
        assert environment.exposure() * through.max() < 1e-3
    np.testing.assert_array_equal(seen.mask, alone.mask)


def test_half_transparent_surfels_show_half_of_what_is_behind(variant: str, dense_surfels) -> None:
    pane = type(dense_surfels.sphere())(np.zeros((1, 3)), -TOWARDS_SUN[None], {})
    wide = {"log_scales": np.full((1, 2), 3.0), "opacity_logits": np.zeros(1)}
    scene = dense_surfels.scene(pane, **wide)
    behind = low_sun(2e4).lookup(VIEW.rays())
    seen, alone = rendered(scene, 2e4), rendered(scene, 2e4, background=(0, 0, 0))
    np.testing.assert_allclose(seen.mask, 0.5, atol=1e-3)
    for name in BUFFERS:
        shown = getattr(alone, name) + (1 - seen.mask[..., None]) * behind
        np.testing.assert_allclose(getattr(seen, name), shown, rtol=5e-3, err_msg=name)


def test_a_chosen_background_stands_behind_and_changes_nothing_opaque(variant: str, dense_surfels) -> None:
    scene = dense_surfels.scene(dense_surfels.sphere(radius=0.3))
    red, blue = (rendered(scene, 5e4, background=color) for color in ((3, 0, 0), (0, 0, 0.5)))
    opaque, empty = red.mask > 0.99, red.mask == 0
    assert opaque.sum() > 50
    assert empty.sum() > 50
    for name in BUFFERS:
        np.testing.assert_array_equal(getattr(red, name)[opaque], getattr(blue, name)[opaque])
        np.testing.assert_array_equal(getattr(red, name)[empty], np.broadcast_to((3, 0, 0), (empty.sum(), 3)))
