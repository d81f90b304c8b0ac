"""Rooms: what a ray meets, and the light that falls there, by closed form and by Mitsuba."""

import mitsuba as mi
import numpy as np
import pytest

from datagen.world.lights.room import (
    FEW,
    Box,
    Bulb,
    Hits,
    Rectangle,
    bounced,
    bulbs_light,
    cast,
    direct,
    glazed,
    sunlit,
)
from tron.seeds import generator

pytestmark = pytest.mark.usefixtures("variant")

SIZE = np.array([5.0, 4.0, 3.0])
BOXES = (
    Box(low=(0.5, 0.5, 0.0), high=(1.5, 2.0, 1.2), albedo=(0.3, 0.3, 0.3)),
    Box(low=(3.5, 2.8, 0.0), high=(4.8, 3.6, 0.7), albedo=(0.3, 0.3, 0.3)),
    Box(low=(3.0, 0.2, 0.9), high=(4.0, 0.9, 1.0), albedo=(0.3, 0.3, 0.3)),
)


def at(point, normal) -> Hits:
    return Hits(np.array([point], np.float32), np.array([normal], np.float32), np.array([4]))


def test_rays_end_where_mitsubas_do():
    d = generator(0, "rays").normal(size=(5000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    eye = np.array([2.4, 1.9, 1.4])
    transform = mi.ScalarTransform4f

    def cube(low, high, flip=False):
        centre, half = (np.add(low, high) / 2).tolist(), (np.subtract(high, low) / 2).tolist()
        to_world = transform().translate(centre).scale(half)
        return {"type": "cube", "to_world": to_world, "flip_normals": flip}

    scene = mi.load_dict(
        {"type": "scene", "room": cube((0, 0, 0), SIZE, True)}
        | {f"box{k}": cube(box.low, box.high) for k, box in enumerate(BOXES)}
    )
    ray = mi.Ray3f(mi.Point3f(*eye.tolist()), mi.Vector3f(np.ascontiguousarray(d.T, np.float32)))
    si = scene.ray_intersect(ray)
    hits = cast(SIZE, BOXES, eye, d)
    np.testing.assert_allclose(hits.points, np.array(si.p).T, atol=1e-4)
    np.testing.assert_allclose(hits.normals, np.array(si.n).T, atol=1e-4)
    assert set(hits.thing) == set(range(9))


def test_a_ceiling_panel_lights_the_floor_below_its_corner_by_the_form_factor():
    """Howell's C-11: a plane element under a corner of a parallel rectangle a x b at distance c."""
    panel = Rectangle(face=5, low=(2.0, 1.5), high=(2.6, 2.3), radiance=(2.0, 2.0, 2.0))
    a, b = 0.6 / 3.0, 0.8 / 3.0
    first = a / np.hypot(1, a) * np.arctan(b / np.hypot(1, a))
    factor = (first + b / np.hypot(1, b) * np.arctan(a / np.hypot(1, b))) / (2 * np.pi)
    found = direct(at((2.0, 1.5, 0.0), (0, 0, 1)), (panel,), SIZE)
    np.testing.assert_allclose(found[0], np.pi * 2.0 * factor, rtol=0.01)
    assert direct(at((2.0, 1.5, 0.0), (0, 0, -1)), (panel,), SIZE).max() == 0.0


def test_a_panel_does_not_light_the_point_in_its_middle():
    panel = Rectangle(face=5, low=(2.0, 1.0), high=(3.0, 2.0), radiance=(2.0, 2.0, 2.0))
    found = direct(at((2.5, 1.5, 3.0), (0, 0, -1)), (panel,) * (FEW + 1), SIZE)
    np.testing.assert_array_equal(found, 0.0)


def test_a_bulb_lights_by_the_inverse_square_and_the_cosine():
    bulb = Bulb(place=(1.0, 1.0, 2.0), radius=0.05, intensity=(3.0, 2.0, 1.0))
    found = bulbs_light(at((2.0, 1.0, 0.0), (0, 0, 1)), (bulb,))
    np.testing.assert_allclose(found[0], np.array([3.0, 2.0, 1.0]) * (2 / np.sqrt(5)) / 5.0, rtol=1e-5)


def test_bounced_light_is_the_sum_of_all_bounces():
    flux, albedo = np.array([7.0, 7.0, 7.0]), np.array([0.2, 0.5, 0.8])
    area = 2 * (5 * 4 + 4 * 3 + 3 * 5)
    series = sum(flux * albedo**k for k in range(1, 400)) / area
    np.testing.assert_allclose(bounced(flux, SIZE, albedo), series, rtol=1e-9)


def test_the_sun_falls_through_glass_alone():
    """Straight lines: a floor point is lit where the ray to the sun passes the pane, not the bar or a box."""
    window = Rectangle(face=1, low=(1.0, 1.0), high=(3.0, 2.0), radiance=(1.0, 1.0, 1.0))
    sun = np.array([1.0, 0.0, 0.5]) / np.hypot(1.0, 0.5)
    pane = (5.0 - 2 * 1.3, 1.5, 0.0)  # its ray meets x = 5 at z = 1.3
    wall = (5.0 - 2 * 2.5, 1.5, 0.0)
    bar = (5.0 - 2 * 1.3, 2.0, 0.0)
    for point, expected in ((pane, sun[2]), (wall, 0.0), (bar, 0.0)):
        assert sunlit(at(point, (0, 0, 1)), sun, (window,), SIZE, ())[0] == pytest.approx(expected, abs=1e-5)
    screen = Box(low=(3.0, 1.0, 0.0), high=(3.2, 2.0, 1.5), albedo=(0.5, 0.5, 0.5))
    assert sunlit(at(pane, (0, 0, 1)), sun, (window,), SIZE, (screen,))[0] == 0.0
    np.testing.assert_array_equal(glazed(np.array([[0.25, 0.25], [0.5, 0.25], [1.2, 0.5]])), [1.0, 0.0, 0.0])
