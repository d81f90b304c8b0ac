"""Camera paths around a subject keep the distance and the elevations that they are drawn for."""

import numpy as np
import pytest

from datagen.world.styles.cameras import POLE_DEG, around, from_all_sides
from tron.seeds import generator


@pytest.mark.parametrize("lowest", [4.0, 26.0])
def test_cameras_around_a_subject_keep_their_distance_and_their_elevations(lowest):
    rng = generator(0, "around")
    for _ in range(40):
        path = around(rng, (0.5, 0.0, 0.3), 1.5, (20.0, 55.0), lowest_deg=lowest)
        away = np.array([camera.position for camera in path.cameras(40, 64, 64)]) - path.target
        distance = np.linalg.norm(away, axis=1)
        np.testing.assert_allclose(distance * np.tan(np.radians(0.5 * path.fov_deg)), 1.5, rtol=1e-5)
        elevation = np.degrees(np.arcsin(away[:, 2] / distance))
        assert elevation.min() > lowest - 1e-6
        assert elevation.max() < POLE_DEG + 1e-6


def test_surfels_see_a_subject_from_grazing_to_pole():
    path = from_all_sides(generator(1, "s"), (0.0, 0.0, 0.0), 1.5, 34.0)
    away = np.array([camera.position for camera in path.cameras(60, 64, 64)])
    elevation = np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away, axis=1)))
    assert elevation.min() < 5
    assert elevation.max() > 79
