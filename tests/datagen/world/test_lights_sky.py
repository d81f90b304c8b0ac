"""Skies: Mitsuba's own where they are clear, and less sun the more cloud there is before it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from datagen.world.lights.clouds import CloudsSpec
from datagen.world.lights.light import direction
from datagen.world.lights.weather import Above, Ground, Sky, Weather
from tron.color import luminance
from tron.seeds import generator

pytestmark = pytest.mark.usefixtures("variant")

CLEAR = {
    "azimuth_deg": 30.0,
    "elevation_deg": 40.0,
    "turbidity": 3.0,
    "aperture_deg": 2.0,
    "cover": 0.0,
    "size": 1.0,
    "depth": 5.0,
    "edge": 0.1,
    "wisps": 0.0,
    "seed": 3,
}


def weather(changes: dict) -> Weather:
    return Weather.model_validate(CLEAR | changes)


def directions_around(centre: np.ndarray, spread: float, count: int) -> np.ndarray:
    d = centre + spread * generator(0, "around").normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return d[d[:, 2] > 0.01]


def by_mitsuba(sun: np.ndarray, turbidity: float, albedo: float, directions: np.ndarray, **options: float):
    emitter = mi.load_dict(
        {"type": "sunsky", "sun_direction": sun.tolist(), "turbidity": turbidity, "albedo": albedo, **options}
    )
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(np.ascontiguousarray(directions.T, np.float32))
    return np.array(emitter.eval(si)).T


@pytest.mark.parametrize("aperture", [0.7, 2.5, 4.9])
def test_sun_and_sky_are_mitsubas_sunsky(aperture):
    sun = direction(30.0, 25.0)
    d = directions_around(sun, 0.05, 20_000)
    # At the very rim a last bit decides.
    angle = np.degrees(np.arccos(np.clip(d @ sun, -1, 1)))
    d = d[np.abs(angle - aperture / 2) > 0.01]
    sky = Sky(sun, 3.0, 0.2)
    found = sky.dome(d) + sky.disc(d, aperture)
    expected = by_mitsuba(sun, 3.0, 0.2, d, sun_aperture=aperture)
    assert (luminance(expected) > 50 * np.median(luminance(expected))).any(), "some look into the sun"
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_a_clear_sky_is_mitsubas():
    above = Above(weather({}), 0.2)
    d = directions_around(np.array([0.0, 0.0, 1.0]), 1.0, 5000)
    expected = by_mitsuba(direction(30.0, 40.0), 3.0, 0.2, d, sun_scale=0.0)
    np.testing.assert_allclose(above.radiance(d), expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(above.sunlight_below, above.sunlight)


def test_the_suns_irradiance_is_what_mitsubas_disc_gives():
    sun = direction(30.0, 40.0)
    rng = generator(0, "cone")
    cosine = 1 - rng.random(200_000) * (1 - np.cos(np.radians(2.5)))
    angle, sine = rng.random(200_000) * 2 * np.pi, np.sqrt(1 - cosine**2)
    right = np.cross(sun, (0, 0, 1)) / np.linalg.norm(np.cross(sun, (0, 0, 1)))
    up = np.cross(right, sun)
    d = cosine[:, None] * sun + (sine * np.cos(angle))[:, None] * right + (sine * np.sin(angle))[:, None] * up
    disc = by_mitsuba(sun, 3.0, 0.2, d, sky_scale=0.0, sun_aperture=4.0)
    expected = disc.mean(axis=0) * 2 * np.pi * (1 - np.cos(np.radians(2.5)))
    np.testing.assert_allclose(Above(weather({}), 0.2).sunlight, expected, rtol=0.03)


def test_thicker_cloud_lets_less_sun_through():
    covered = {"cover": 1.0, "size": 3.0}
    through = [
        float(luminance(Above(weather(covered | {"depth": depth}), 0.2).sunlight_below))
        for depth in (0.0, 0.5, 2.0, 8.0, 30.0)
    ]
    assert through == sorted(through, reverse=True)
    assert through[0] == pytest.approx(float(luminance(Above(weather({}), 0.2).sunlight)))
    assert through[-1] < 1e-3 * through[0]


def test_cover_takes_contrast_and_hides_the_blue():
    ground = Ground(dark=(0.1, 0.1, 0.1), bright=(0.2, 0.2, 0.2), patch=2.0, seed=1)
    contrasts, blue = [], []
    for cover in (0.0, 0.5, 1.0):
        sky = weather({"cover": cover, "depth": 20.0, "edge": 0.06})
        environment = CloudsSpec(weather=sky, ground=ground).bake(64)
        upper = environment.image[4:28].reshape(-1, 3)
        contrasts.append(environment.contrast())
        blue.append(np.median(upper[:, 2] / upper[:, 0]))
    assert contrasts[0] > 0.4
    assert contrasts[2] < 0.1
    assert blue == sorted(blue, reverse=True)


@pytest.mark.parametrize("elevation", [2.5, 8.0, 75.0])
def test_a_low_sun_is_redder_and_weaker(elevation):
    sky = weather({"elevation_deg": elevation})
    noon = Above(weather({"elevation_deg": 80.0}), 0.2).sunlight
    light = Above(sky, 0.2).sunlight
    assert luminance(light) < luminance(noon)
    assert light[0] / light[2] > noon[0] / noon[2]


def test_open_ground_sends_back_what_falls_on_it():
    """Lambert: radiance is albedo times irradiance over pi, and the map is consistent with itself."""
    ground = Ground(dark=(0.3, 0.3, 0.3), bright=(0.3, 0.3, 0.3), patch=2.0, seed=1)
    environment = CloudsSpec(weather=weather({}), ground=ground).bake(128)
    at_feet = environment.image[-20:].mean(axis=(0, 1))
    grain = ground.albedo(-directions_around(np.array([0.0, 0.0, 1.0]), 0.2, 4000)).mean(axis=0)
    np.testing.assert_allclose(at_feet, grain * environment.unoccluded_upward(), rtol=0.1)
