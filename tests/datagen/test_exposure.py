"""A room is exposed as a camera would; what is bright enough keeps its light's exposure."""

import numpy as np
import pytest

from datagen.exposure import GREY, MOST_STOPS, metered

SEEN = np.ones((4, 4), bool)


@pytest.mark.parametrize("dark", [0.001, 0.004, 0.03])
def test_the_median_of_a_dark_frame_comes_within_a_third_of_a_stop_of_grey(dark):
    exposure = metered(np.full((4, 4, 3), dark), SEEN, 1.3)
    assert GREY * 2 ** (-1 / 3) - 1e-9 <= dark * exposure <= GREY + 1e-9


def test_a_bright_frame_is_left_alone_and_black_ones_are_not_raised_without_end():
    assert metered(np.full((4, 4, 3), 0.4), SEEN, 1.3) == 1.3
    assert metered(np.zeros((4, 4, 3)), SEEN, 1.3) == pytest.approx(1.3 * 2**MOST_STOPS)


def test_only_surfaces_count():
    frame = np.full((4, 4, 3), 0.01)
    seen = SEEN.copy()
    frame[:, 1:], seen[:, 1:] = 5.0, False
    assert metered(frame, seen, 1.0) > 2
    assert metered(frame, np.zeros((4, 4), bool), 1.0) == 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_pixel_that_is_not_finite_does_not_count(bad):
    frame = np.full((4, 4, 3), 0.01)
    expected = metered(frame, SEEN, 1.0)
    frame[1, 2] = bad
    assert metered(frame, SEEN, 1.0) == expected
    assert metered(np.full((4, 4, 3), bad), SEEN, 1.3) == 1.3
