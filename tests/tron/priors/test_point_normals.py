"""Normals of points: along the surface's own, on the side of the cameras."""

import numpy as np
import pytest

from tron.errors import TronError
from tron.priors import estimate_point_normals
from tron.seeds import generator


def test_a_sphere_seen_from_outside_has_its_radii_as_normals(ring) -> None:
    rng = generator(2, "priors")
    radii = rng.normal(size=(3000, 3))
    radii /= np.linalg.norm(radii, axis=1, keepdims=True)
    cameras = ring(8, elevation=0.8) + ring(8, elevation=-0.8)
    normals = estimate_point_normals(0.7 * radii, cameras)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    cosine = (normals * radii).sum(axis=1)
    assert np.median(cosine) > 0.99
    assert (cosine > 0).mean() > 0.97


def test_a_room_seen_from_inside_has_normals_that_face_in(ring) -> None:
    rng = generator(4, "priors")
    points = rng.uniform(-10, 10, (6000, 3))
    axis, side = rng.integers(0, 3, 6000), rng.choice([-10.0, 10.0], 6000)
    points[np.arange(6000), axis] = side
    inward = np.zeros((6000, 3))
    inward[np.arange(6000), axis] = -np.sign(side)
    normals = estimate_point_normals(points, ring(8))
    assert ((normals * inward).sum(axis=1) > 0.9).mean() > 0.9


def test_too_little_to_go_by_is_refused(ring) -> None:
    points = np.zeros((10, 3))
    with pytest.raises(TronError, match="cameras"):
        estimate_point_normals(points, [])
    with pytest.raises(TronError, match="no normals"):
        estimate_point_normals(points[:2], ring(1))
    with pytest.raises(TronError, match="finite"):
        estimate_point_normals(points * np.nan, ring(1))
