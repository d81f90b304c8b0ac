"""Lights: what is drawn is what shines, whatever the resolution it is baked at."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from datagen.world.lights import (
    FAMILIES,
    HdriSpec,
    OvercastSpec,
    Panel,
    StudioSpec,
    SunSpec,
    classify,
)
from tron.color import luminance
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")


def sun(**changes):
    values = {
        "azimuth_deg": 30.0,
        "elevation_deg": 50.0,
        "turbidity": 3.0,
        "aperture_deg": 4.0,
        "ground": (0.2, 0.2, 0.2),
    }
    return SunSpec(**(values | changes))


def direction(azimuth_deg, elevation_deg):
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


DRAWN = [name for name in FAMILIES if name != "hdri"]
"""Families that need no files."""


@pytest.mark.parametrize("azimuth", [0.0, 100.0, 250.0])
def test_the_sun_stands_where_the_specification_says(azimuth):
    environment = sun(azimuth_deg=azimuth).bake(64)
    rng = generator(0, "directions")
    d = rng.normal(size=(200_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    light = np.asarray(luminance(environment.lookup(d)), np.float64)
    centre = (d * (light > 0.3 * light.max())[:, None]).sum(axis=0)
    centre /= np.linalg.norm(centre)
    assert np.degrees(np.arccos(centre @ direction(azimuth, 50.0))) < 3.0


def test_a_wider_sun_gives_the_same_light():
    narrow, wide = (sun(aperture_deg=a).bake(96).unoccluded_upward() for a in (2.5, 5.0))
    np.testing.assert_allclose(narrow, wide, rtol=0.05)


@pytest.mark.parametrize("family", DRAWN)
def test_a_light_does_not_depend_on_the_resolution_it_is_baked_at(family):
    light = FAMILIES[family].draw(generator(1, family), [])
    small, large = (light.bake(height).unoccluded_upward() for height in (64, 160))
    np.testing.assert_allclose(small, large, rtol=0.06)


@pytest.mark.parametrize("family", DRAWN)
def test_every_drawn_light_can_be_exposed_is_finite_and_is_the_same_read_back(family):
    for k in range(4):
        light = FAMILIES[family].draw(generator(k, family), [])
        environment = light.bake(32)
        assert np.isfinite(environment.image).all()
        assert environment.exposure() > 0
        assert environment.image[-1].min() > 0, "the ground is not black"
    again = FAMILIES[family].model_validate_json(light.to_json())
    assert again == light
    np.testing.assert_array_equal(again.bake(32).image, environment.image)


def test_suns_cast_shadows_and_clouds_do_not():
    for k in range(3):
        assert classify(FAMILIES["sun"].draw(generator(k, "s"), []).bake(64)) == "high"
        assert classify(FAMILIES["overcast"].draw(generator(k, "o"), []).bake(64)) == "low"


@pytest.mark.parametrize("family", DRAWN)
def test_mitsubas_plugin_shows_the_same_light(family):
    environment = FAMILIES[family].draw(generator(3, family), []).bake(48)
    d = generator(0, "seen").normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    emitter = mi.load_dict(environment.to_mitsuba())
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = -mi.Vector3f(np.ascontiguousarray(d.T, np.float32))
    top = float(environment.image.max())
    np.testing.assert_allclose(
        np.array(emitter.eval(si)).T, environment.lookup(d), rtol=1e-3, atol=1e-5 * top
    )


@pytest.mark.parametrize("family", ["clouds", "landscape", "interior", "night", "coloured"])
def test_places_have_detail_down_to_the_texel(family):
    """Neighbouring texels differ everywhere, unlike in a smooth gradient, yet far less than distant ones."""
    for k in range(3):
        image = FAMILIES[family].draw(generator(k, "detail", family), []).bake(128).image
        brightness = np.log(np.asarray(luminance(image), np.float64)[8:-8] + 1e-9)
        near = np.abs(np.diff(brightness, axis=1))
        far = np.abs(brightness - np.roll(brightness, 64, axis=1))
        assert np.median(near) > 2e-4
        assert np.mean(near) < 0.7 * np.mean(far)


def test_a_panel_shines_with_its_solid_angle():
    """A rectangle of half sizes a, b at unit distance fills 4 atan(a b / sqrt(1 + a^2 + b^2)) steradians."""
    panel = Panel(
        azimuth_deg=40,
        elevation_deg=30,
        roll_deg=0,
        half_width_deg=15,
        half_height_deg=10,
        softness_deg=0.2,
        radiance=(5.0, 5.0, 5.0),
    )
    environment = StudioSpec(panels=(panel,), floor=(0, 0, 0), ceiling=(0, 0, 0)).bake(256)
    # Half sizes are measured in the box's two planes, so its edges lie on tan a and tan b.
    a, b = np.tan(np.radians([15.0, 10.0]))
    solid_angle = 4 * np.arctan(a * b / np.sqrt(1 + a * a + b * b))
    assert environment.mean()[0] * 4 * np.pi == pytest.approx(5.0 * solid_angle, rel=0.02)


def test_an_overcast_zenith_outshines_the_horizon_as_the_cie_says():
    light = OvercastSpec(
        zenith=(1, 1, 1),
        horizon=(1 / 3, 1 / 3, 1 / 3),
        ground=(0.1, 0.1, 0.1),
        patch_azimuth_deg=0,
        patch_elevation_deg=45,
        patch_width_deg=30,
        patch=(0, 0, 0),
    )
    environment = light.bake(181)
    for elevation in (20.0, 45.0, 90.0):
        expected = (1 + 2 * np.sin(np.radians(elevation))) / 3
        assert environment.lookup(direction(70.0, elevation))[0] == pytest.approx(expected, abs=0.01)


def test_a_file_is_averaged_down_and_turned(tmp_path):
    image = np.full((32, 64, 3), 0.1, np.float32)
    image[12, 20] = 50.0
    EnvironmentMap(image).save(tmp_path / "lamp.exr")
    spec = HdriSpec(path="lamp.exr", sha256="", rotation_deg=90.0, contrast="high")
    turned = spec.bake(16, tmp_path)
    assert turned.image.shape == (16, 32, 3)
    plain = spec.model_copy(update={"rotation_deg": 0.0}).bake(16, tmp_path)
    d = direction(10.0, 20.0)
    np.testing.assert_allclose(turned.lookup(direction(100.0, 20.0)), plain.lookup(d), rtol=1e-5)
    np.testing.assert_allclose(plain.mean(), EnvironmentMap(image).mean(), rtol=1e-3)
