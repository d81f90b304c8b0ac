"""Blur and vignetting: no light is made or lost, spreads are as wide as they say, shakes as long."""

import numpy as np
import pytest
from scipy.special import erf

from datagen.lens import Blur, vignette
from tron.seeds import generator


@pytest.mark.parametrize("blur", [Blur(0.6), Blur(0.6, 2.0, 35.0), Blur(1.5, 0.5, 10.0)])
def test_kernels_have_the_covariance_of_spread_and_shake(blur):
    kernel = blur.kernel()
    assert kernel.sum() == pytest.approx(1)
    assert kernel.min() >= 0
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-15)
    offsets = np.arange(len(kernel)) - len(kernel) // 2
    rows, columns = np.meshgrid(offsets, offsets, indexing="ij")
    angle = np.radians(blur.motion_deg)
    along = np.array([np.cos(angle), np.sin(angle)])
    # A pixel's own width adds a twelfth; the mean over a straight way, a twelfth of its square.
    expected = (blur.spread**2 + 1 / 12) * np.eye(2) + blur.motion**2 / 12 * np.outer(along, along)
    found = [[(kernel * a * b).sum() for b in (columns, rows)] for a in (columns, rows)]
    np.testing.assert_allclose(found, expected, rtol=0.05, atol=0.01)


def test_a_narrow_spread_is_integrated_over_pixels():
    inside = erf(0.5 / (0.3 * np.sqrt(2)))  # of a Gaussian's weight, along each axis
    kernel = Blur(0.3).kernel()
    assert kernel[len(kernel) // 2, len(kernel) // 2] == pytest.approx(inside**2, rel=1e-3)


def test_without_spread_and_shake_nothing_changes():
    light = generator(0, "light").random((9, 7, 3)).astype(np.float32)
    np.testing.assert_array_equal(Blur().on(light), light)


def test_a_flat_wall_stays_flat_to_its_edge():
    light = np.full((12, 10, 3), 3.5, np.float32)
    np.testing.assert_allclose(Blur(1.0, 2.0, 20.0).on(light), light, rtol=1e-5)


def test_blur_of_a_bright_disc_makes_no_dark_rim():
    light = np.zeros((31, 31, 3), np.float32)
    light[15, 15] = 1e5
    blurred = Blur(0.4, 1.0, 45.0).on(light)
    assert blurred.min() >= 0
    assert blurred.sum() == pytest.approx(light.sum(), rel=1e-4)


def test_vignetting_darkens_the_corners_alone():
    share = vignette(40, 30, 0.3)[..., 0]
    assert share[14:16, 19:21] == pytest.approx(1, abs=2e-3)
    assert share[0, 0] == pytest.approx(0.7, abs=0.03)
    np.testing.assert_allclose(share, share[::-1, ::-1], atol=1e-6)
    assert share[0, 20] > share[0, 0]
