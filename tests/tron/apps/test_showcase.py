"""The showcase lights, and the balls that a light is shown by, against closed forms."""

import numpy as np
import pytest

from tron.apps.showcase import BALL, ball_pictures, showcase_lights
from tron.color import to_display
from tron.shading.environment import EnvironmentMap

MIDDLE = BALL // 2


def test_each_light_has_its_own_contrast(variant):
    contrast = {name: light.contrast() for name, light in showcase_lights().items()}
    assert contrast["low sun"] > 0.35
    assert 0.1 < contrast["soft boxes"] < 0.35
    assert contrast["cloudy sky"] < 0.05


def test_the_cloudy_sky_lights_a_plane_as_the_cie_sky_does(variant):
    # The integral of (1 + 2 sin e) / 3 against the cosine over the upper half is 7/9 of pi.
    found = showcase_lights()["cloudy sky"].unoccluded_upward()
    np.testing.assert_allclose(found, 7 / 9 * np.array([0.95, 1.0, 1.08]), rtol=0.02)


def test_in_even_light_a_mirror_ball_cannot_be_seen_and_a_matt_one_is_even(variant):
    mirror, matt = ball_pictures(EnvironmentMap.constant(0.6, 32), exposure=0.8)
    np.testing.assert_allclose(mirror, to_display(np.full((1, 1, 3), 0.6), 0.8) + 0 * mirror, atol=1e-5)
    grey = to_display(np.full((1, 1, 3), 0.5 * 0.6), 0.8)[0, 0]
    inside = matt[MIDDLE - 20 : MIDDLE + 20, MIDDLE - 20 : MIDDLE + 20]
    np.testing.assert_allclose(inside, grey + 0 * inside, atol=5e-3)


@pytest.mark.parametrize(
    "axis, sign, at", [(2, 1, "top"), (2, -1, "bottom"), (0, 1, "right"), (0, -1, "left")]
)
def test_balls_are_bright_on_the_side_that_light_comes_from(variant, axis, sign, at):
    empty = EnvironmentMap.constant(0.0, 32)
    half = (sign * empty.directions()[..., axis] > 0.3)[..., None] * np.ones(3)
    light = EnvironmentMap(half.astype(np.float32))
    edge = int(0.36 * BALL)
    pixel = {
        "top": (MIDDLE - edge, MIDDLE), "bottom": (MIDDLE + edge, MIDDLE),
        "right": (MIDDLE, MIDDLE + edge), "left": (MIDDLE, MIDDLE - edge),
    }  # fmt: skip
    opposite = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}[at]
    for ball in ball_pictures(light, exposure=1.0):
        assert ball[pixel[at]].mean() > ball[pixel[opposite]].mean() + 0.3


def test_a_mirror_ball_shows_behind_the_viewer_in_its_middle(variant):
    empty = EnvironmentMap.constant(0.0, 64)
    behind = (empty.directions()[..., 1] < -0.9)[..., None] * np.ones(3)
    mirror, _ = ball_pictures(EnvironmentMap(behind.astype(np.float32)), exposure=1.0)
    assert mirror[MIDDLE, MIDDLE].mean() > 0.5
    assert mirror[MIDDLE, MIDDLE + 40].mean() < 0.05
