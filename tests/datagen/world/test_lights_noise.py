"""Noise: the same numbers everywhere, spread as it says."""

import numpy as np
import pytest

from datagen.world.lights.noise import LATTICE, Fractal
from tron.seeds import generator


def points(count: int = 200_000) -> np.ndarray:
    return generator(0, "points").uniform(-100, 100, (count, 2))


def test_values_follow_from_the_seed_and_the_name():
    d = points(50)
    np.testing.assert_array_equal(Fractal(5, "a")(d), Fractal(5, "a")(d))
    assert (Fractal(5, "a")(d) != Fractal(6, "a")(d)).all()
    assert (Fractal(5, "a")(d) != Fractal(5, "b")(d)).all()


def test_values_lie_between_0_and_1_around_one_half():
    values = Fractal(1, "x")(points())
    assert values.min() >= 0
    assert values.max() <= 1
    assert values.mean() == pytest.approx(0.5, abs=0.01)
    assert values.std() > 0.08


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_share_of_the_plane_lies_above_the_threshold(share):
    noise = Fractal(2, "clouds")
    assert (noise(points()) > noise.threshold(share)).mean() == pytest.approx(share, abs=0.05)


def test_it_is_continuous_and_repeats_after_its_lattice():
    noise = Fractal(3, "x")
    d = points(5000)
    assert np.abs(noise(d + 1e-3, 1) - noise(d, 1)).max() < 5e-3
    np.testing.assert_allclose(noise(d + LATTICE, 1), noise(d, 1), atol=2e-4)


def test_octaves_add_detail_down_to_their_wavelength():
    """Differences over a short step grow with the octaves."""
    noise, d = Fractal(4, "x"), points(20_000)
    steps = [np.abs(noise(d + 0.02, n, 0.8) - noise(d, n, 0.8)).mean() for n in (1, 3, 6)]
    assert steps == sorted(steps)
    assert steps[2] > 1.5 * steps[0]
