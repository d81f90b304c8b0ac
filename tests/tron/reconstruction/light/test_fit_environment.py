"""Laws of environment fitting: a known light is found again, and so is the scale of its photos."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from pydantic import ValidationError

from tron.captures import Capture
from tron.errors import TronError
from tron.estimation import Estimation
from tron.reconstruction import EnvironmentFit, FitSettings, fit_environment
from tron.reconstruction.light.fit_environment import LogPyramid, choose_photos, fit_scale
from tron.seeds import generator
from tron.shading import EnvironmentMap, Lighting, render_guidance

QUICK = FitSettings(resolution=16, steps=250, rays=16, pixels=512, scale_steps=100, split_sum_resolution=64)
SCALE = FitSettings(scale_pixels=10**6, scale_steps=150, scale_rays=32)


def cosine_integral(light: EnvironmentMap, normals: np.ndarray, height: int = 96) -> np.ndarray:
    """(N, 3) irradiance / pi by midpoints over directions in float64: the witness."""
    t, p = np.meshgrid(
        (np.arange(height) + 0.5) / height * np.pi,
        (np.arange(2 * height) + 0.5) / height * np.pi,
        indexing="ij",
    )
    d = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    weight = np.maximum(normals @ d.T, 0) * np.sin(t).ravel() * (np.pi / height) ** 2 / np.pi
    return weight @ light.lookup(d).astype(np.float64)


def irradiance_error(found: EnvironmentMap, truth: EnvironmentMap) -> float:
    """Relative error (L2) over all normals of the sphere."""
    normals = generator(0, "normals").normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a, b = cosine_integral(found, normals), cosine_integral(truth, normals)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


@pytest.fixture(scope="module")
def fit(tracer, captured, studio) -> EnvironmentFit:
    return fit_environment(captured(studio, prior_scale=0.4), tracer, QUICK)


def test_a_known_light_is_found_and_its_scale_corrected(fit: EnvironmentFit, studio: EnvironmentMap) -> None:
    # The prior is 0.4 of the truth: stage 3a finds that light, stage 3b the factor that the photos ask for.
    assert irradiance_error(EnvironmentMap(fit.environment.image / fit.scale.sigma), studio) > 0.5
    assert irradiance_error(fit.environment, studio) < 0.05
    assert fit.scale.sigma == pytest.approx(1 / 0.4, rel=0.02)


def test_the_losses_fall(fit: EnvironmentFit) -> None:
    assert len(fit.cubemap.loss) == QUICK.steps
    assert len(fit.scale.loss) == len(fit.scale.curve) == QUICK.scale_steps
    assert fit.cubemap.loss[-25:].mean() < 0.3 * fit.cubemap.loss[:5].mean()
    assert fit.scale.loss[-25:].mean() < 0.3 * fit.scale.loss[:5].mean()
    assert fit.scale.curve[0] == 1


def test_lights_are_where_they_were(fit: EnvironmentFit, studio: EnvironmentMap) -> None:
    truth = studio.resized(fit.environment.image.shape[0])
    found = fit.environment.image
    brightest = truth.image.sum(-1) > 10
    assert found[brightest].mean() > 5 * found[~brightest].mean()


def test_a_small_sun_is_found(tracer, captured) -> None:
    image = np.full((32, 64, 3), 0.3, np.float32)
    image[7:9, 20:22] = (300.0, 280.0, 240.0)
    sun = EnvironmentMap(image)
    settings = QUICK.model_copy(update={"steps": 250, "scale_steps": 0})
    found = fit_environment(captured(sun), tracer, settings)
    assert found.scale.sigma == 1
    assert irradiance_error(found.environment, sun) < 0.05


def test_sigma_is_a_known_scale_within_a_hundredth(tracer, captured, studio) -> None:
    capture = captured(studio)
    photos = choose_photos(capture.train_views, SCALE, capture.exposure)
    for scale in (0.3, 20.0):
        dimmed = Lighting(EnvironmentMap(studio.image / np.float32(scale)), 64)
        found = fit_scale(tracer, photos, dimmed, SCALE, capture.exposure)
        assert found.sigma == pytest.approx(scale, rel=0.01)


def test_linear_photos_ask_for_the_same_scale(tracer, captured, studio) -> None:
    capture, lighting = captured(studio, views=3), Lighting(studio, 64)
    linear = [
        replace(
            view,
            image=render_guidance(tracer, view.camera, lighting, Estimation(rays=64), 9).shadowed,
            space="linear",
        )
        for view in capture.views
    ]
    one, other = (choose_photos(views, SCALE, capture.exposure) for views in (capture.views, linear))
    for a, b in zip(one, other):
        np.testing.assert_allclose(a.shown, b.shown, atol=1e-5)


def test_the_sky_counts_in_neither_stage(tracer, captured, studio) -> None:
    capture = captured(studio, views=4)
    settings = QUICK.model_copy(update={"steps": 25, "scale_steps": 25})
    spoiled = []
    for view in capture.views:
        sky = np.zeros((32, 32), np.float32)
        sky[:10] = 1
        image, prior = view.read().copy(), view.read("irradiance").copy()
        image[:10], prior[:10] = generator(1, view.name).random((10, 32, 3)), 1000
        spoiled.append(replace(view, image=image, irradiance=prior, sky_mask=sky))
    masked = [replace(v, sky_mask=s.sky_mask) for v, s in zip(capture.views, spoiled)]
    one, other = (
        fit_environment(Capture(tuple(views), exposure=capture.exposure), tracer, settings)
        for views in (masked, spoiled)
    )
    # Threads sum gradients in any order, so the two differ by rounding that the steps amplify.
    np.testing.assert_allclose(one.cubemap.loss[:20], other.cubemap.loss[:20], rtol=1e-2)
    assert one.scale.sigma == pytest.approx(other.scale.sigma, rel=1e-2)


def test_texels_that_no_ray_met_keep_the_first_light(tracer, captured, studio) -> None:
    capture = captured(studio, views=1)
    few = {"resolution": 64, "coarsest": 64, "steps": 2, "rays": 2, "pixels": 16, "scale_steps": 0}
    found = fit_environment(capture, tracer, QUICK.model_copy(update={**few, "estimator": "plain"}))
    assert 0 < found.cubemap.has_gradient.mean() < 1
    assert np.ptp(found.cubemap.texels[~found.cubemap.has_gradient], axis=0).max() < 1e-5
    assert np.ptp(found.cubemap.texels[found.cubemap.has_gradient], axis=0).max() > 1e-3


def test_one_thread_repeats_bit_by_bit_and_seeds_differ(variant, tracer, captured, studio) -> None:
    capture, settings = captured(studio, views=2), QUICK.model_copy(update={"steps": 10, "scale_steps": 0})
    dr.set_thread_count(1)  # the fixture drjit_threads gives them back
    one, two = (fit_environment(capture, tracer, settings).cubemap.texels for _ in range(2))
    other = fit_environment(capture, tracer, settings.model_copy(update={"seed": 1})).cubemap.texels
    # A GPU adds in no fixed order, and ten steps make more of it.
    np.testing.assert_allclose(one, two, rtol=1e-4 if variant.startswith("cuda") else 0)
    assert np.abs(one / other - 1).max() > 1e-3


def test_what_is_wrong_is_said_before_the_work(tracer, captured, studio) -> None:
    capture = captured(studio, views=1)
    view = capture.views[0]
    with pytest.raises(TronError, match="no training view has an irradiance map"):
        fit_environment(Capture((replace(view, irradiance=None),)), tracer, QUICK)
    broken = replace(view, irradiance=partial(np.full, (32, 32, 3), np.nan))
    with pytest.raises(TronError, match="irradiance holds 3072 values that are NaN"):
        fit_environment(Capture((broken,)), tracer, QUICK)
    hidden = replace(view, sky_mask=np.ones((32, 32)))
    with pytest.raises(TronError, match="no view shows a surface"):
        fit_environment(Capture((hidden,)), tracer, QUICK)


def test_a_scene_without_fronts_is_refused(tracer, captured, studio) -> None:
    with pytest.raises(TronError, match="orientation"):
        fit_environment(captured(studio, views=1), replace(tracer.scene, oriented=False), QUICK)


@pytest.mark.parametrize(
    "change", [{"rays": 3}, {"steps": 0}, {"resolution": 1}, {"learning_rate": 0.0}, {"estimator": "best"}]
)
def test_settings_outside_their_range_are_refused(change: dict) -> None:
    with pytest.raises(ValidationError, match=next(iter(change))):
        FitSettings(**change)


@pytest.mark.long
@pytest.mark.parametrize("name", ["venice_sunset_1k.hdr", "empty_warehouse_01_1k.hdr"])
def test_a_real_light_is_found(tracer, captured, shared_data, name: str) -> None:
    truth = EnvironmentMap.load(shared_data / "hdri" / name).resized(256)
    found = fit_environment(captured(truth, prior_scale=0.5), tracer, FitSettings(scale_steps=100))
    # The witness sums points, so suns of a few texels are spread out first.
    assert irradiance_error(found.environment.resized(96), truth.resized(96)) < 0.05
    assert found.scale.sigma == pytest.approx(2, rel=0.04)


def test_levels_add_up_to_the_light_they_start_from_and_stay_smooth(variant: str) -> None:
    texels = (0.1 + generator(0, "texels").random((6, 16, 16, 3))).astype(np.float32)
    pyramid = LogPyramid(texels, 4)
    assert list(pyramid.levels) == ["level_4", "level_8", "level_16"]
    levels = dict(pyramid.levels)
    np.testing.assert_allclose(np.exp(np.array(pyramid.compose(levels))), texels.ravel(), rtol=1e-5)
    levels["level_4"] = dr.full(mi.Float, 0.5, 18 * 16)
    np.testing.assert_allclose(
        np.exp(np.array(pyramid.compose(levels))), texels.ravel() * np.exp(0.5), rtol=1e-5
    )
    assert pyramid.rate("level_4") == 1 > pyramid.rate("level_16")
    assert list(LogPyramid(texels, 16).levels) == ["level_16"]


def test_large_photos_are_reduced_by_averaging(captured, studio) -> None:
    view = captured(studio, views=1).views[0]
    (photo,) = choose_photos([view], FitSettings(scale_pixels=300), 1.0)
    assert photo.factor == 2
    assert photo.shown.shape == (16, 16, 3)
    np.testing.assert_allclose(photo.shown[3, 5], view.read()[6:8, 10:12].mean((0, 1)), rtol=1e-5)
    points = generator(0, "points").normal(size=(5, 3)) * 0.3
    np.testing.assert_allclose(photo.camera.project(points)[0], view.camera.project(points)[0] / 2, rtol=1e-9)
