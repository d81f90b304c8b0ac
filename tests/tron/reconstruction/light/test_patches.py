"""Laws of patches: they keep what their points share, lose noise, and stop at edges of shape and paint."""

from __future__ import annotations

import numpy as np
import pytest

from tron.reconstruction.light.fit_pairs import Patches
from tron.seeds import generator

UP = np.array([0.0, 0.0, 1.0])


def grid(side: int = 20) -> np.ndarray:
    """(side^2, 3) points of a floor, a unit apart."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1).astype(float)


def test_a_constant_stays_and_noise_goes() -> None:
    place = grid()
    patches = Patches.of(place, np.tile(UP, (400, 1)), np.full((400, 3), 0.5), 1.5)
    np.testing.assert_allclose(patches.mean(np.full((400, 3), 2.0)), 2.0, rtol=1e-6)
    noise = generator(0, "tests", "patches").normal(size=400)
    # A Gaussian of standard deviation s over a unit grid keeps 1 / (4 pi s^2) of a variance.
    assert patches.mean(noise).var() / noise.var() == pytest.approx(1 / (4 * np.pi * 1.5**2), rel=0.35)


@pytest.mark.parametrize("edge", ["wall", "paint", "far"])
def test_they_stop_where_another_surface_begins(edge: str) -> None:
    place, normal, color = grid(), np.tile(UP, (400, 1)), np.full((400, 3), 0.5)
    beyond = place[:, 0] > 9.5
    if edge == "wall":
        normal[beyond] = (1, 0, 0)
    elif edge == "paint":
        color[beyond] = (0.5, 0.2, 0.2)
    else:
        place[beyond] += 50.0
    mixed = Patches.of(place, normal, color, 2.0).mean(beyond.astype(float))
    np.testing.assert_allclose(mixed, beyond, atol=1e-3)


def test_without_a_radius_each_point_is_alone() -> None:
    values = generator(1, "tests", "patches").normal(size=(400, 2))
    alone = Patches.of(grid(), np.tile(UP, (400, 1)), np.full((400, 3), 0.5), 0.0)
    np.testing.assert_allclose(alone.mean(values), values, rtol=1e-6)
