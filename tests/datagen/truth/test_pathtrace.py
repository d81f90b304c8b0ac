"""G-buffers, frames and reference irradiance against closed forms."""

import mitsuba as mi
import numpy as np
import pytest

from datagen.truth.build import FIRST_ID, build
from datagen.truth.pathtrace import (
    GREY,
    MOST_STOPS,
    direct_irradiance,
    gbuffers,
    metered,
    near_product,
    render_frames,
)
from datagen.world.materials import Appearance, Material
from datagen.world.objects import ObjectSpec, Placement
from datagen.world.scene import draw_scene
from datagen.world.shapes import ShapeSpec
from tron.cameras import Camera
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")

RADIUS = 0.6


class Plain(Material):
    """The same everywhere, of roughness 0.3 and flat."""

    family: str = "plain"
    color: tuple[float, float, float]
    metallic: float = 0.0

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
        full = np.ones(len(points), np.float32)
        color = np.float32(self.color) * full[:, None]
        return Appearance(color, 0.3 * full, self.metallic * full, 0.0 * full)


@pytest.fixture(scope="module")
def spec():
    """A metal ball on a floor."""
    drawn = draw_scene(0, "test", 0, style="object", lights=["overcast"], frames=1, path_frames=4)
    ball = ObjectSpec(
        shape=ShapeSpec(kind="sphere", size=RADIUS, parameters=(0.5, 0.5, 0.5, 0.5)),
        size=RADIUS,
        placement=Placement(quaternion=(0.9, 0.1, 0.3, 0.2), position=(0.2, -0.1, RADIUS)),
    )
    floor = drawn.surroundings[0].model_copy(
        update={
            "shape": ShapeSpec(kind="floor", size=3.4, parameters=(0.5, 0.5, 0.5, 0.5)),
            "placement": Placement(quaternion=(1, 0, 0, 0), position=(0, 0, 0)),
            "materials": (Plain(color=(0.3, 0.4, 0.5)),),
        }
    )
    ball = ball.model_copy(update={"materials": (Plain(color=(0.9, 0.5, 0.1), metallic=1.0),)})
    return drawn.model_copy(update={"objects": (ball,), "surroundings": (floor,)})


@pytest.fixture(scope="module")
def geometry(spec, variant):
    return build(spec, edge=0.06)


@pytest.fixture(scope="module")
def camera():
    return Camera.look_at((3.0, -4.0, 2.5), (0, 0, 0.3), fov_deg=36, width=48, height=40)


@pytest.fixture(scope="module")
def view(geometry, camera):
    return gbuffers(geometry, [camera])[0]


def test_gbuffers_see_the_ball_and_the_floor_where_they_are(view, camera):
    ball = view.object_id == FIRST_ID + 1
    floor = view.object_id == FIRST_ID
    assert ball.sum() > 50
    np.testing.assert_array_equal(view.valid, ball | floor)
    radial = view.position[ball] - (0.2, -0.1, RADIUS)
    np.testing.assert_allclose(np.linalg.norm(radial, axis=1), RADIUS, atol=2e-3)
    cosine = (view.normal[ball] * radial).sum(axis=1) / np.linalg.norm(radial, axis=1)
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 1.5
    np.testing.assert_allclose(view.position[floor][:, 2], 0.0, atol=1e-5)
    np.testing.assert_allclose(
        view.normal[floor], np.broadcast_to((0, 0, 1), view.normal[floor].shape), atol=1e-6
    )
    away = view.position[view.valid] - camera.position
    np.testing.assert_allclose(
        away / np.linalg.norm(away, axis=1, keepdims=True), camera.rays()[view.valid], atol=1e-5
    )


def test_the_base_color_of_metal_is_its_own(view):
    ball = view.object_id == FIRST_ID + 1
    np.testing.assert_allclose(view.base_color[ball] / (0.9, 0.5, 0.1), 1.0, atol=1e-3)  # half precision
    np.testing.assert_allclose(view.metallic[ball], 1.0, atol=1e-6)
    np.testing.assert_allclose(view.roughness[ball], 0.3, atol=2e-4)


def test_views_do_not_depend_on_their_neighbours(geometry, camera, view):
    other = Camera.look_at((-3.0, 2.0, 3.0), (0, 0, 0.3), fov_deg=36, width=20, height=20)
    again = gbuffers(geometry, [other, camera])[1]
    np.testing.assert_array_equal(again.position, view.position)
    np.testing.assert_array_equal(again.base_color, view.base_color)


def test_constant_light_gives_its_radiance_to_an_open_surface_and_less_beside_the_ball(
    geometry, camera, view
):
    """A floor point at distance s from the foot of a ball on it loses the ball's form factor.

    The ball is wholly above the horizon, so it hides cos(angle) sin^2(half angle) = h r^2 / d^3 of the cosine
    integral, with h = r and d the distance to the ball's centre (Nusselt).
    """
    radiance = np.array([0.5, 1.0, 2.0])
    scene = geometry.lit(EnvironmentMap.constant(radiance))
    result = direct_irradiance(geometry, scene, camera, 512, seed=1)
    floor = view.object_id == FIRST_ID
    open_sky = result.unshadowed[floor] / radiance
    np.testing.assert_allclose(open_sky, 1.0, atol=0.03)
    assert open_sky.mean() == pytest.approx(1.0, abs=1e-3)
    distance = np.linalg.norm(view.position[floor] - (0.2, -0.1, RADIUS), axis=1)
    expected = 1.0 - RADIUS**3 / distance**3
    error = result.shadowed[floor].mean(axis=1) / radiance.mean() - expected
    assert expected.min() < 0.5
    assert np.abs(error).mean() < 0.01
    assert abs(error.mean()) < 0.003
    assert (result.shadowed[~view.valid] == 0).all()


def test_a_small_light_casts_its_shadow_away_from_itself(geometry, camera, view):
    image = np.zeros((64, 128, 3), np.float32)
    image[20, 32] = 100.0  # from +x, above the horizon
    environment = EnvironmentMap(image)
    result = direct_irradiance(geometry, geometry.lit(environment), camera, 32, seed=0)
    v = np.pi * 20 / 63
    toward = np.array([np.sin(v), 0.0, np.cos(v)])
    floor = view.object_id == FIRST_ID
    origin = view.position[floor] - (0.2, -0.1, RADIUS)
    along = origin @ toward
    miss = np.sqrt(np.maximum((origin**2).sum(axis=1) - along**2, 0))
    lit = result.shadowed[floor].sum(axis=1) > 0.5 * result.unshadowed[floor].sum(axis=1)
    clear = np.abs(miss - RADIUS) > 0.06
    np.testing.assert_array_equal(lit[clear], ((miss > RADIUS) | (along > 0))[clear])


def test_frames_show_the_environment_behind_and_repeat_bit_by_bit(geometry, camera, view):
    image = np.linspace(0.2, 2.0, 32 * 64 * 3, dtype=np.float32).reshape(32, 64, 3)
    environment = EnvironmentMap(np.abs(np.sin(image * 3)))
    scene = geometry.lit(environment)
    first, second = (render_frames(scene, [camera], 16, [seed])[0] for seed in (5, 5))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, render_frames(scene, [camera], 16, [6])[0])
    behind = ~view.valid
    behind &= np.roll(behind, 1, 0) & np.roll(behind, -1, 0) & np.roll(behind, 1, 1) & np.roll(behind, -1, 1)
    behind[[0, -1]] = behind[:, [0, -1]] = False
    assert behind.sum() > 20
    expected = environment.lookup(camera.rays())[behind]
    np.testing.assert_allclose(first[behind], expected, atol=0.05)


def test_many_passes_converge_to_the_same_frame(geometry, camera, monkeypatch):
    scene = geometry.lit(EnvironmentMap.constant(1.0))
    whole = render_frames(scene, [camera], 64, [1])[0]
    monkeypatch.setattr("datagen.truth.pathtrace.LANES", camera.width * camera.height * 20)
    parts = render_frames(scene, [camera], 64, [1])[0]
    other_seed = render_frames(scene, [camera], 64, [2])[0]
    assert np.abs(parts - whole).mean() < 1.2 * np.abs(other_seed - whole).mean()
    assert abs(parts.mean() / whole.mean() - 1) < 0.005


@pytest.mark.parametrize("count", [1, 2, 3, 7, 35, 46, 55, 64, 110, 132, 1000])
def test_counts_of_samples_are_what_multijitter_takes(count):
    sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
    assert near_product(count) == sampler.sample_count()
    assert near_product(near_product(count)) == near_product(count)


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
