"""Laws of the denoiser, on pictures whose truth is known; Intel's own library, where it is installed."""

import sys

import numpy as np
import pytest

from tron.denoising import LEAST_SIDE, require
from tron.denoising import denoised as by_name
from tron.errors import TronError
from tron.seeds import generator


@pytest.fixture
def oidn() -> None:
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")


def denoised(radiance: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    return by_name("oidn", radiance, {"albedo": albedo})


def shaded(height: int = 64, width: int = 96) -> np.ndarray:
    """(H, W, 3) linear: light that falls off smoothly."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    return np.stack([0.2 + 0.5 * x, 0.3 + 0.2 * y, 0.6 - 0.3 * x * y], -1).astype(np.float32)


def noisy(truth: np.ndarray, *path: str | int) -> np.ndarray:
    """Each value times a random factor of mean 1."""
    return truth * generator(71901, *path).uniform(0.4, 1.6, truth.shape).astype(np.float32)


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.square(a - b).mean()))


GREY = np.full((64, 96, 3), 0.5, np.float32)


def test_noise_falls_and_a_clean_picture_is_left_alone(oidn):
    truth = shaded()
    assert rms(denoised(noisy(truth, "falls"), GREY), truth) < 0.2 * rms(noisy(truth, "falls"), truth)
    assert rms(denoised(truth, GREY), truth) < 0.01 * float(truth.mean())


def test_edges_of_albedo_stay(oidn):
    """Stripes of two colours, one pixel each, below noise that hides them."""
    albedo = np.where(np.arange(96)[None, :, None] % 2, 0.6, 0.4) * np.ones_like(GREY)
    truth = shaded() * albedo.astype(np.float32)
    given = noisy(truth, "stripes")
    assert rms(denoised(given, albedo), truth) < 0.6 * rms(denoised(given, GREY), truth)


def test_the_same_each_time_and_in_any_unit(oidn):
    given = noisy(shaded(), "unit")
    first = denoised(given, GREY)
    np.testing.assert_array_equal(denoised(given, GREY), first)
    for unit in (1e-4, 1e4):
        np.testing.assert_allclose(denoised(given * np.float32(unit), GREY) / unit, first, atol=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (9, 2), (5, 200), (LEAST_SIDE, LEAST_SIDE - 1), (67, 33)])
def test_pictures_of_any_size_keep_their_brightness(oidn, size):
    means = []
    for draw in range(8):
        given = np.full((*size, 3), 0.4, np.float32) * generator(71901, "sizes", *size, draw).uniform(
            0.9, 1.1
        )
        shown = denoised(given.astype(np.float32), np.full_like(given, 0.5))
        assert shown.shape == given.shape
        means.append(shown.mean() / given.mean())
    assert np.mean(means) == pytest.approx(1, abs=0.02)


def test_a_value_that_is_no_number_is_one_pixel_and_is_told_of(oidn, caplog):
    given = noisy(shaded(), "hole")
    whole = denoised(given, GREY)
    assert not caplog.records
    for value in (np.nan, np.inf):
        caplog.clear()
        damaged = given.copy()
        damaged[20, 30, 1] = value
        shown = denoised(damaged, GREY)
        assert "1 values of a picture are NaN or infinite: the denoiser is given 0" in caplog.text
        far = np.hypot(*(np.mgrid[:64, :96] - np.array([20, 30])[:, None, None])) > 16
        assert np.isfinite(shown).all()
        assert np.abs(shown - whole)[far].max() < 0.01


def test_without_the_library_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(TronError) as told:
        require("oidn", "denoise=oidn")
    assert str(told.value) == "denoise=oidn needs pyoidn: pip install 'tron-relight[oidn]'"
