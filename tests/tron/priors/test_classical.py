"""Photos taken apart: exact where the assumptions hold, and never worse than not trying."""

import numpy as np
import pytest
from pydantic import ValidationError

from tron.captures import Capture, View
from tron.color import agx, srgb_to_linear
from tron.errors import TronError
from tron.metrics import scale_albedo
from tron.priors import Classical, apply_prior
from tron.priors.linear_light import inverse_agx
from tron.priors.retinex import residual_shading
from tron.priors.shading_fit import fit_shading
from tron.seeds import generator


def sun_and_sky(normal: np.ndarray) -> np.ndarray:
    """Irradiance / pi of a soft light from one side and an even sky; (..., 3) -> (...)."""
    direction = np.array([0.6, -0.3, 0.74])
    return 0.25 + 0.35 * np.maximum(0, 0.4 + 0.6 * normal @ direction)


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b)[mask] ** 2).mean()))


def test_shading_is_taken_out_of_base_color(lambertian) -> None:
    capture, geometry, truth = lambertian(sun_and_sky)
    out = apply_prior(capture, Classical(), gbuffers=lambda view: geometry[view.name])
    gains, correlations = [], []
    for photo, view in zip(capture.views, out.views):
        true = truth[view.name]
        surface, base = true["surface"], true["base_color"].astype(np.float32)
        found = psnr(scale_albedo(view.read("base_color"), base, surface), base, surface)
        naive = psnr(scale_albedo(srgb_to_linear(photo.read()), base, surface), base, surface)
        gains.append(found - naive)
        irradiance = view.read("irradiance")[..., 0]
        correlations.append(np.corrcoef(irradiance[surface], true["irradiance"][surface])[0, 1])
    assert np.mean(gains) > 5
    assert np.mean(correlations) > 0.9


def test_base_color_times_irradiance_is_the_photo(lambertian) -> None:
    capture, geometry, truth = lambertian(sun_and_sky)
    exposed = Capture(capture.views, exposure=2.5)
    out = apply_prior(exposed, Classical(), gbuffers=lambda view: geometry[view.name])
    for photo, view in zip(capture.views, out.views):
        base, irradiance = view.read("base_color"), view.read("irradiance")
        whole = truth[view.name]["surface"] & (base.max(-1) < 0.99)
        np.testing.assert_allclose(
            2.5 * (base * irradiance)[whole], srgb_to_linear(photo.read())[whole], rtol=5e-3, atol=1e-4
        )
        assert not base[~truth[view.name]["surface"]].any()


def test_even_light_leaves_the_photo_as_base_color(lambertian) -> None:
    capture, geometry, truth = lambertian(lambda normal: np.full(normal.shape[:-1], 0.7))
    out = apply_prior(capture, Classical(), gbuffers=lambda view: geometry[view.name])
    for view in out.views:
        surface = truth[view.name]["surface"]
        shading = view.read("irradiance")[..., 0][surface]
        assert shading.std() / shading.mean() < 0.02


def test_normals_are_the_geometry_s_and_equal_from_every_view(lambertian) -> None:
    capture, geometry, _ = lambertian(sun_and_sky)
    out = apply_prior(capture, Classical(), ("normal",), gbuffers=lambda view: geometry[view.name])
    for view in out.views:
        np.testing.assert_allclose(view.read("normal"), geometry[view.name]["normal"], atol=1e-3)


def test_the_light_s_direction_is_found_whatever_the_albedos() -> None:
    rng = generator(3, "priors")
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    material = (normals[:, 2] > 0).astype(int)  # dark above, bright below: against the light
    albedo = np.array([[0.7, 0.5, 0.3], [0.05, 0.08, 0.1]])[material]
    chroma = np.log(albedo[:, (0, 2)]) - np.log(albedo[:, 1:2])
    true = np.log(1.2 + normals[:, 2])
    fit = fit_shading(chroma, normals, np.log(albedo[:, 1]) + true, groups=2, seed=0)
    assert np.corrcoef(fit.log(normals), true)[0, 1] > 0.98
    naive = np.log(albedo[:, 1]) + true
    assert np.corrcoef(naive, true)[0, 1] < 0


def test_a_grey_ramp_is_light_and_a_coloured_step_is_not() -> None:
    height, width = 24, 64
    normals = np.broadcast_to([0.0, 0.0, 1.0], (height, width, 3))
    ramp = np.broadcast_to(np.linspace(-0.8, 0.8, width), (height, width))
    step = (np.arange(width) >= width // 2) * np.ones((height, 1))
    chroma = np.stack([0.8 * step, -0.5 * step], axis=-1)
    surface = np.ones((height, width), bool)
    kind = {"edge": 0.3, "chroma_edge": 0.2, "guess": np.zeros((height, width)), "screening": 1e-6}
    shading = residual_shading(ramp + 1.5 * step, chroma, normals, surface, **kind)
    np.testing.assert_allclose(shading - shading.mean(), ramp, atol=0.05)


def test_agx_is_undone_where_it_does_not_clip() -> None:
    rng = generator(5, "priors")
    linear = rng.uniform(0.02, 2, (200, 3))
    np.testing.assert_allclose(inverse_agx(agx(linear)), linear, rtol=2e-3, atol=1e-4)


def test_sky_is_above_the_horizon_far_and_bright(ring) -> None:
    camera = ring(2, 32, 32, elevation=0.05)
    rises = camera[0].rays()[..., 2] > 0
    image = np.where(rises[..., None], (0.5, 0.7, 0.95), (0.3, 0.25, 0.2)).astype(np.float32)
    capture = Capture(tuple(View(f"{i}", c, image, "display") for i, c in enumerate(camera)))
    opacity = np.zeros((32, 32), np.float32)
    opacity[:, :16] = 1
    depth = np.zeros((32, 32), np.float32)
    depth[:, :8], depth[:, 8:16] = 3.0, 1000.0  # an object before the sky; a sky made of surfels
    geometry = {"opacity": opacity, "depth": depth, "normal": np.zeros((32, 32, 3), np.float32)}
    view = apply_prior(capture, Classical(), ("sky_mask",), gbuffers=lambda _: geometry).views[0]
    sky = view.read("sky_mask") > 0.5
    assert not sky[:, :8].any()
    np.testing.assert_array_equal(sky[:, 8:], rises[:, 8:])


def test_a_capture_without_surfaces_is_refused(ring) -> None:
    image = np.full((32, 32, 3), 0.5)
    capture = Capture(tuple(View(f"{i}", c, image, "display") for i, c in enumerate(ring(2, 32, 32))))
    empty = {name: np.zeros((32, 32)) for name in ("opacity", "depth")} | {"normal": np.zeros((32, 32, 3))}
    with pytest.raises(TronError, match="shows a surface"):
        apply_prior(capture, Classical(), gbuffers=lambda _: empty)


@pytest.mark.parametrize("change", [{"roughness": 2}, {"tone_curve": "gamma"}, {"samples": 0}])
def test_wrong_settings_are_refused(change: dict) -> None:
    with pytest.raises((ValidationError, TronError), match=next(iter(change))):
        Classical(**change)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_photos_of_one_colour_are_taken_apart_too(lambertian, level: float) -> None:
    capture, geometry, truth = lambertian(sun_and_sky)
    views = tuple(View(v.name, v.camera, np.full((64, 64, 3), level), "display") for v in capture.views)
    out = apply_prior(Capture(views), Classical(), gbuffers=lambda view: geometry[view.name])
    for view in out.views:
        assert view.read("irradiance")[truth[view.name]["surface"]].min() > 0
