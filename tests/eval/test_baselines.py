"""Each baseline's law, on images whose answer is known."""

from functools import partial

import numpy as np
import pytest

from eval.relighting import baselines
from eval.relighting.baselines import BASELINES, DENOISED, RATIO_FLOOR, show_denoised
from eval.relighting.bilateral import BilateralFit, bilateral
from eval.relighting.buffers import Buffers
from eval.relighting.fits import (
    DEVIATIONS,
    AffineFit,
    FilteredAffineFit,
    GaussianFit,
    ProductFit,
    PsnrAffineFit,
    Show,
    filtered,
    fitted_by_psnr,
    remodulated,
    show_product,
)
from tron.color import agx, to_display
from tron.denoising import DENOISERS, Denoiser, installed
from tron.seeds import generator


def images(*names: str, n: int = 4000, low: float = 0.01, high: float = 2.0) -> list[np.ndarray]:
    return [generator(1, "images", name).uniform(low, high, (n, 3)).astype(np.float32) for name in names]


def guided(
    pbr: np.ndarray,
    irradiance: np.ndarray,
    unshadowed: np.ndarray | None = None,
    opacity: np.ndarray | float = 1.0,
    exposure: float = 0.4,
) -> Buffers:
    """Buffers of n pixels; what is not given plays no part."""
    opacity = np.broadcast_to(opacity, (len(pbr), 1))
    unshadowed = irradiance if unshadowed is None else unshadowed
    images = {"pbr": pbr, "irradiance": irradiance, "unshadowed": unshadowed, "mask": opacity}
    return Buffers(images, exposure)


def shadow_ratio(pbr: np.ndarray, irradiance: np.ndarray, unshadowed: np.ndarray, exposure: float):
    return baselines.shadow_ratio(guided(pbr, irradiance, unshadowed, exposure=exposure))


def linear(name: str) -> Show:
    """An input of a blend that is taken as it is."""
    return lambda buffers: buffers[name]


FIRST, SECOND, THIRD = linear("pbr"), linear("irradiance"), linear("unshadowed")


def test_shadow_ratio_is_pbr_where_nothing_is_shadowed():
    pbr, light = images("pbr", "light")
    np.testing.assert_array_equal(shadow_ratio(pbr, light, light, exposure=0.4), pbr)


def test_shadow_ratio_is_the_share_of_light_per_channel():
    pbr, light = images("pbr", "light")
    share = np.array([0.25, 0.5, 0.0], np.float32)
    np.testing.assert_allclose(shadow_ratio(pbr, light * share, light, 0.4), pbr * share, rtol=1e-6)


def test_shadow_ratio_never_brightens_nor_divides_by_darkness():
    pbr, light = images("pbr", "light")
    np.testing.assert_array_equal(shadow_ratio(pbr, 3 * light, light, 0.4), pbr)
    dark = np.full_like(light, 0.5 * RATIO_FLOOR)
    np.testing.assert_array_equal(shadow_ratio(pbr, np.zeros_like(light), dark, 1.0), pbr)


def test_shadow_ratio_does_not_depend_on_the_unit_of_light():
    pbr, light, share = images("pbr", "light", "share", high=1.0)
    small = shadow_ratio(pbr, light * share, light, 0.4)
    large = shadow_ratio(1000 * pbr, 1000 * light * share, 1000 * light, 0.4 / 1000)
    np.testing.assert_allclose(large, 1000 * small, rtol=1e-5)


@pytest.mark.parametrize("scale", [0.03, 0.9, 7.5])
def test_the_fitted_scale_is_exact_on_data_made_with_it(scale: float):
    pbr, irradiance = images("pbr", "irradiance")
    buffers = guided(pbr, irradiance, opacity=np.linspace(0, 1, len(pbr))[:, None])
    fit = ProductFit()
    fit.add(buffers, show_product(buffers, scale))
    assert fit.solve().weights == pytest.approx(scale, rel=1e-3)


def test_the_fitted_scale_is_no_worse_than_any_other():
    pbr, irradiance, truth = images("pbr", "irradiance", "truth")
    buffers = guided(pbr, irradiance, exposure=1.0)
    fit = ProductFit()
    fit.add(buffers, agx(truth))
    fitted = np.mean((fit.solve().show(buffers) - agx(truth)) ** 2)
    for scale in np.geomspace(1e-3, 1e3, 200):
        assert fitted <= np.mean((show_product(buffers, scale) - agx(truth)) ** 2) * (1 + 1e-6)


def test_where_no_surfel_is_the_product_keeps_the_environment():
    pbr, irradiance = images("pbr", "irradiance")
    shown = show_product(guided(pbr, irradiance, opacity=0.0), 123.0)
    np.testing.assert_allclose(shown, agx(0.4 * pbr), rtol=1e-6)


def test_affine_recovers_a_known_affine_map_of_each_channel():
    first, second = images("first", "second", low=0.2, high=0.8)
    weights = np.array([[0.5, 0.3, 0.05], [0.7, -0.2, 0.2], [0.1, 0.6, 0.0]])
    truth = weights[:, 0] * first + weights[:, 1] * second + weights[:, 2]
    buffers = guided(first, second)
    fit = AffineFit(FIRST, SECOND)
    for part in range(4):  # as clips come, one after another
        rows = slice(part * 1000, (part + 1) * 1000)
        fit.add(buffers.at(rows), truth[rows])
    fitted = fit.solve()
    np.testing.assert_allclose(fitted.weights, weights, atol=1e-6)
    np.testing.assert_allclose(fitted.show(buffers), truth, atol=1e-6)


def test_affine_agrees_with_numpy_least_squares():
    first, second, truth = images("first", "second", "truth", high=1.0)
    fit = AffineFit(FIRST, SECOND)
    fit.add(guided(first, second), truth)
    for channel in range(3):
        columns = np.stack([first[:, channel], second[:, channel], np.ones(len(first))], 1).astype(float)
        expected = np.linalg.lstsq(columns, truth[:, channel].astype(float), rcond=None)[0]
        np.testing.assert_allclose(fit.solve().weights[channel], expected, atol=1e-7)


def test_affine_of_equal_inputs_still_has_a_solution():
    (image,) = images("first", high=1.0)
    fit = AffineFit(FIRST, SECOND)
    fit.add(guided(image, image), image)
    np.testing.assert_allclose(fit.solve().show(guided(image, image)), image, atol=1e-5)


def test_a_third_input_never_hurts_on_the_data_it_was_fitted_on():
    first, second, third, truth = images("a", "b", "c", "d", high=1.0)
    buffers = guided(first, second, third)
    errors = []
    for inputs in ((FIRST, SECOND, THIRD), (FIRST, SECOND)):
        fit = AffineFit(*inputs)
        fit.add(buffers, truth)
        errors.append(np.mean((fit.solve().show(buffers) - truth) ** 2))
    assert errors[0] <= errors[1]


def pictures(*names: str) -> Buffers:
    """Buffers of a clip of three frames."""
    shape = (3, 20, 24, 3)
    made = {
        name: generator(1, "pictures", name).uniform(0.2, 0.8, shape).astype(np.float32) for name in names
    }
    return Buffers(made, 1.0)


@pytest.mark.parametrize("deviation", [DEVIATIONS[0], DEVIATIONS[3], DEVIATIONS[-1]])
def test_the_gaussian_that_made_the_truth_is_found_from_some_of_the_pixels(deviation: float):
    buffers = pictures("pbr")
    truth = filtered(FIRST, deviation)(buffers)
    fit = GaussianFit(partial(filtered, FIRST))
    inside = np.nonzero(generator(1, "inside").random(truth.shape[:3]) < 0.4)
    broken = truth.copy()
    broken[np.setdiff1d(np.arange(3), inside[0])] = 9
    fit.add(buffers, broken, inside)
    fitted = fit.solve()
    assert fitted.weights == deviation
    np.testing.assert_array_equal(fitted.show(buffers), truth)


def test_a_gaussian_does_not_mix_frames_or_colours():
    buffers = pictures("pbr")
    image = filtered(FIRST, 1.0)(buffers)
    for frame, channel in ((0, 0), (2, 1)):
        alone = Buffers({"pbr": np.zeros_like(buffers["pbr"])}, 1.0)
        alone["pbr"][frame, ..., channel] = buffers["pbr"][frame, ..., channel]
        np.testing.assert_array_equal(
            filtered(FIRST, 1.0)(alone)[frame, ..., channel], image[frame, ..., channel]
        )


def test_a_filtered_blend_finds_weights_and_deviation():
    buffers = pictures("pbr", "irradiance")
    truth = 0.3 * filtered(FIRST, 0.7)(buffers) + 0.6 * filtered(SECOND, 0.7)(buffers) + 0.05
    fit = FilteredAffineFit(FIRST, SECOND)
    fit.add(buffers, truth, np.nonzero(np.ones(truth.shape[:3])))
    fitted = fit.solve()
    np.testing.assert_allclose(fitted.weights, [[0.3, 0.6, 0.05]] * 3, atol=1e-5)
    np.testing.assert_allclose(fitted.show(buffers), truth, atol=1e-5)


def test_the_error_of_a_blend_is_that_of_its_picture():
    first, second, truth = images("first", "second", "truth", high=0.5)
    fit = AffineFit(FIRST, SECOND)
    buffers = guided(first, second)
    fit.add(buffers, truth)
    assert fit.error() == pytest.approx(np.sum((fit.solve().show(buffers) - truth) ** 2), rel=1e-4)


def test_light_on_a_texture_is_filtered_and_the_texture_stays():
    """Noise of the light goes, a checkerboard does not; a plain Gaussian has to choose."""
    buffers = pictures("lit", "albedo")
    texture = np.where(np.indices((20, 24)).sum(0) % 2, 0.9, 0.1)[..., None] * np.ones(3)
    buffers["albedo"][:] = texture
    buffers["lit"][:] = texture * (1 + 0.5 * (buffers["lit"] - 0.5))
    truth = to_display(np.broadcast_to(texture, buffers["lit"].shape), 1.0)
    errors = {}
    for name, fit in (
        ("plain", GaussianFit(partial(filtered, lambda given: given.displayed("lit")))),
        ("remodulated", GaussianFit(remodulated)),
    ):
        fit.add(buffers, truth)
        errors[name] = np.mean((fit.solve().show(buffers) - truth) ** 2)
    assert errors["remodulated"] < 0.1 * errors["plain"]
    assert GaussianFit(remodulated).solve().weights == DEVIATIONS[0], "nothing added: the first"


def test_a_filtered_blend_takes_detail_from_a_sharp_input():
    buffers = pictures("pbr", "irradiance")
    smooth = filtered(FIRST, 0.7)(buffers)
    truth = 0.8 * smooth + 0.4 * (SECOND(buffers) - filtered(SECOND, 0.7)(buffers)) + 0.1
    fit = FilteredAffineFit(FIRST, sharp=[SECOND])
    fit.add(buffers, truth, np.nonzero(np.ones(truth.shape[:3])))
    np.testing.assert_allclose(fit.solve().weights, [[0.8, -0.4, 0.4, 0.1]] * 3, atol=1e-5)


def clip_of(lit: np.ndarray, **others: np.ndarray) -> Buffers:
    """Whole frames (K, H, W, 3) of lit, and other buffers beside it; exposure 1."""
    plain = {name: np.full_like(lit, 0.5) for name in ("albedo", "surface", "pbr", "irradiance")}
    return Buffers({"lit": lit, **plain, **others}, 1.0)


def everywhere(images: np.ndarray) -> tuple[np.ndarray, ...]:
    return np.nonzero(np.ones(images.shape[:3], bool))


def test_the_bilateral_filter_is_a_gaussian_where_nothing_leads_it():
    lit = generator(0, "bilateral").uniform(0.1, 1, (1, 12, 14, 3)).astype(np.float32)
    (shown,) = bilateral(clip_of(lit), np.array([[1.0, 1e9]]))
    show = filtered(lambda buffers: buffers.displayed("lit"), 1.0)
    inner = np.s_[:, 4:-4, 4:-4]
    np.testing.assert_allclose(
        shown[inner], show(clip_of(lit))[inner], atol=2e-3
    )  # cut at 3 pixels, not at 4


def test_the_bilateral_filter_takes_noise_away_and_keeps_an_edge_of_albedo():
    rng = generator(1, "bilateral")
    truth = np.where(np.arange(24)[None, None, :, None] < 12, 0.2, 0.8) * np.ones((2, 24, 24, 3))
    albedo = truth.astype(np.float32)
    lit = np.clip(truth + 0.05 * rng.normal(size=truth.shape), 0.01, None).astype(np.float32)
    buffers = clip_of(lit, albedo=albedo)
    shown_truth = to_display(truth.astype(np.float32), 1.0)
    fit = BilateralFit()
    fit.add(buffers, shown_truth, everywhere(shown_truth))
    led = fit.solve()

    def psnr(image: np.ndarray) -> float:
        return float(-10 * np.log10(np.mean((image - shown_truth) ** 2)))

    gaussian = max(psnr(filtered(baselines.show_lit, s)(buffers)) for s in DEVIATIONS)
    assert psnr(led.show(buffers)) > gaussian + 3
    assert psnr(led.show(buffers)) > psnr(buffers.displayed("lit")) + 6


def test_a_blend_by_psnr_is_the_best_that_gradients_find():
    """Frames of unlike error: the fit beats squared error's by PSNR, and no weights beside it are better."""
    rng = generator(2, "psnr")
    lit = rng.uniform(0.1, 0.9, (4, 10, 10, 3)).astype(np.float32)
    noise = np.array([0.2, 0.02, 0.005, 0.002])[:, None, None, None]
    shift = np.array([0.3, 0.0, 0.02, -0.01])[:, None, None, None]
    inputs = (lambda buffers: buffers["lit"], lambda buffers: buffers["albedo"])
    buffers = clip_of(lit, albedo=rng.uniform(0, 1, lit.shape).astype(np.float32))
    truth = 0.6 * lit + 0.3 * buffers["albedo"] + shift + noise * rng.normal(size=lit.shape)
    by_error = AffineFit(*inputs)

    def mean_psnr(weights: np.ndarray) -> float:
        images = [show(buffers).astype(float) for show in inputs]
        blend = weights[:, -1] + sum(w * image for w, image in zip(weights.T, images))
        return float(np.mean(-10 * np.log10(np.square(blend - truth).mean((1, 2, 3)))))

    by_error.add(buffers, truth, everywhere(truth))
    frames = [AffineFit(*inputs) for _ in truth]
    for number, fit in enumerate(frames):
        fit.add(buffers, truth, tuple(axis[everywhere(truth)[0] == number] for axis in everywhere(truth)))
    weights, reached = fitted_by_psnr(frames, np.full(4, 100.0))
    assert reached == pytest.approx(mean_psnr(weights), abs=1e-6)
    assert reached > mean_psnr(by_error.weights()) + 1
    for _ in range(50):
        assert mean_psnr(weights + 1e-3 * rng.normal(size=weights.shape)) <= reached + 1e-6
    whole = PsnrAffineFit(*inputs, sharp=inputs)
    whole.add(buffers, truth, everywhere(truth))
    assert whole.solve().show(buffers).shape == truth.shape


def test_open_image_denoise_takes_noise_away_where_it_is_installed():
    pytest.importorskip("pyoidn")
    lit = generator(3, "oidn").uniform(0.2, 0.6, (1, 32, 32, 3)).astype(np.float32)
    shown = show_denoised(clip_of(lit), "oidn")
    assert shown.shape == lit.shape
    assert shown.std() < 0.5 * to_display(lit, 1.0).std()


def test_a_denoiser_is_a_row_of_the_table_and_a_baseline(monkeypatch: pytest.MonkeyPatch):
    assert DENOISED.keys() == DENOISERS.keys()
    assert {each.name for each in DENOISED.values() if each in BASELINES} == {f"lit_{n}" for n in installed()}
    halved = Denoiser(
        "Half", "half of it", ("albedo",), "numpy", "", lambda: lambda lit, albedo: lit * albedo
    )
    monkeypatch.setitem(DENOISERS, "half", halved)
    lit = generator(3, "half").uniform(0.2, 0.6, (2, 32, 32, 3)).astype(np.float32)
    buffers = clip_of(lit)
    expected = to_display(lit * buffers["albedo"], buffers.exposure)
    np.testing.assert_allclose(show_denoised(buffers, "half"), expected, atol=1e-6)
