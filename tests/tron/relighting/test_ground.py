"""The ground: the environment's own on a level plane, in the shadow of what stands there."""

import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.relighting import Relighter
from tron.relighting.ground import Footing, Ground
from tron.shading.environments.environment import EnvironmentMap

RADIUS, HEIGHT = 0.5, 1.0
"""Of the ball: its radius, and that of its middle above the ground at z = -1."""

VIEW = Camera.look_at((0, -4, 1), (0, 0, -0.5), fov_deg=60, width=64, height=64)


@pytest.fixture(scope="module")
def ball(dense_surfels) -> GaussianScene:
    return dense_surfels.scene(dense_surfels.sphere(0.06, RADIUS), spacing=0.06)


def patterned() -> EnvironmentMap:
    directions = EnvironmentMap.constant(1.0, 64).directions()
    return EnvironmentMap((1.2 + np.sin(3 * directions)).astype(np.float32))


def lit(scene: GaussianScene, light: EnvironmentMap, camera: Camera, ground: Ground | None) -> np.ndarray:
    relighter = Relighter(scene, Estimation(rays=256, bounces=0), ground=ground)
    return relighter.under(light).render(camera).lit


def test_below_a_ball_the_sky_is_hidden_as_its_closed_form_says(ball):
    """The ball hides a cap of half angle a, sin a = r / h: of a level plane's light that is sin^2 a."""
    ground = Ground(-HEIGHT, (0.0, 0.0, 3.0))
    image = lit(ball, EnvironmentMap.constant(1.0), VIEW, ground)
    pixels, _ = VIEW.project(np.array([[0.0, 0.0, -HEIGHT]]))
    x, y = pixels[0].astype(int)
    assert image[y, x] == pytest.approx(1 - (RADIUS / HEIGHT) ** 2, abs=0.02)


def test_from_where_it_is_projected_the_map_is_the_map(ball):
    camera = Camera.look_at((0, -4, 1), (0, 4, 0), fov_deg=70, width=48, height=48)
    ground = Ground(-HEIGHT, tuple(camera.position.tolist()))
    with_ground, without = (lit(ball, patterned(), camera, each) for each in (ground, None))
    open_sky = np.abs(with_ground - without).max(axis=-1) < 1e-3
    assert open_sky[:12].all()  # above the horizon and far away
    assert open_sky.mean() > 0.6  # the ball's shadow is elsewhere
    np.testing.assert_allclose(with_ground[open_sky], without[open_sky], rtol=1e-3, atol=1e-3)


def test_the_ground_keeps_its_place_when_the_camera_moves(ball):
    """A point of it is of one colour from everywhere, and the horizon stays at the map's."""
    ground, point = Ground(-HEIGHT, (0.0, 0.0, 1.0)), np.array([[1.5, -1.0, -HEIGHT]])
    seen = []
    for position in ((0, -5, 1), (3, -4, 2), (-2, -5, 0.5)):
        camera = Camera.look_at(position, (0.5, 0, -0.6), fov_deg=50, width=96, height=96)
        pixels, _ = camera.project(point)
        x, y = pixels[0].astype(int)
        seen.append(lit(ball, patterned(), camera, ground)[y, x])
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0], (3, 3)), atol=0.06)


def test_a_thing_stands_free_unless_it_has_a_floor_or_is_around_the_camera(ball, dense_surfels):
    outside, inside, below = (
        Camera.look_at(place, (0, 0.1, 0), fov_deg=40, width=8, height=8)
        for place in ((0, -4, 1), (0.1, 0, 0), (0, -4, -3))
    )
    assert Footing.of(ball).free([outside])
    assert not Footing.of(ball).free([outside, inside])
    assert not Footing.of(ball).free([below])
    floor = dense_surfels.plane(0.06, 1.5)
    on_floor = dense_surfels.scene(dense_surfels.sphere(0.06, 0.5, 0.5), floor, spacing=0.06)
    assert not Footing.of(on_floor).free([outside])


def test_the_plane_is_at_the_lowest_opaque_surfels(ball):
    assert Footing.of(ball).ground(VIEW).height == pytest.approx(-RADIUS, abs=0.02)
    assert Footing.of(ball).ground(VIEW, -2.0).eye == pytest.approx((0, 0, VIEW.position[2]), abs=0.03)
