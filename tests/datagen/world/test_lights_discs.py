"""Small sources keep their light, their place and nothing else, whatever the map's resolution."""

from itertools import product

import numpy as np
import pytest

from datagen.world.lights.light import Disc, direction, lay
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")


def test_a_disc_gives_its_irradiance():
    """A small source of irradiance E lights a level plane with E sin(elevation), so E sin(elevation) / pi."""
    light = np.array([3.0, 2.0, 1.0])
    for rows, diameter, elevation in product((32, 101, 256), (0.1, 0.53, 3.0), (0.5, 40.0, 89.0)):
        disc = Disc(direction(70.0, elevation), diameter, light)
        environment = EnvironmentMap(lay(np.zeros((rows, 2 * rows, 3), np.float32), [disc]))
        np.testing.assert_allclose(environment.mean() * 4 * np.pi, light, rtol=1e-4)
        if elevation > 10.0:
            expected = light * np.sin(np.radians(elevation)) / np.pi
            np.testing.assert_allclose(environment.unoccluded_upward(), expected, rtol=0.03)


def test_a_wide_disc_has_the_radiance_of_its_solid_angle():
    """E = pi L sin^2 of half the diameter."""
    irradiance = np.pi * 5.0 * np.sin(np.radians(10.0)) ** 2
    disc = Disc(direction(200.0, 30.0), 20.0, np.full(3, irradiance))
    environment = EnvironmentMap(lay(np.zeros((256, 512, 3), np.float32), [disc]))
    assert environment.lookup(direction(200.0, 30.0))[0] == pytest.approx(5.0, rel=0.02)
    assert environment.lookup(direction(200.0, 37.0))[0] == pytest.approx(5.0, rel=0.02)
    assert environment.lookup(direction(200.0, 42.0))[0] == 0.0


def test_discs_are_added_to_what_is_there():
    image = generator(0, "image").random((64, 128, 3)).astype(np.float32)
    laid = lay(image, [Disc(direction(10.0, 20.0), 1.0, np.ones(3))])
    assert (laid >= image).all()
    assert (laid == image).mean() > 0.99
