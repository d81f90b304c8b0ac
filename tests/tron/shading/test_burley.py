"""Burley's diffuse factor of the light that arrives, against Mitsuba's material and a sun by itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import Estimation
from tron.seeds import generator
from tron.shading.brdf_table import BrdfTable
from tron.shading.burley import burley_factor, burley_terms, even_terms, terms_of_mean, weighed_mean
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Lighting, render_guidance


def upper(count: int, name: str) -> mi.Vector3f:
    directions = generator(0, "tests", name).normal(size=(3, count))
    directions[2] = np.abs(directions[2]) + 0.05
    return mi.Vector3f((directions / np.linalg.norm(directions, axis=0)).astype(np.float32))


@pytest.mark.parametrize("roughness", [0.1, 0.6, 1.0])
def test_the_factor_is_the_diffuse_part_of_mitsubas_principled(variant: str, roughness: float) -> None:
    """Its colour is what a base color of 0.8 adds to black: the lobe above does not depend on it."""
    view, light = upper(500, "view"), upper(500, "light")
    seen = dr.zeros(mi.SurfaceInteraction3f, 500)
    seen.wi = view
    values = []
    for base in (0.8, 0.0):
        material = {"type": "principled", "roughness": roughness, "specular": 0.5, "metallic": 0.0}
        bsdf = mi.load_dict({**material, "base_color": {"type": "rgb", "value": base}})
        values.append(np.array(bsdf.eval(mi.BSDFContext(), seen, light))[0])
    terms = burley_terms(mi.Vector3f(0, 0, 1), -view, light)
    ours = np.array(burley_factor(terms, mi.Float(roughness), mi.Float(0))) * 0.8 / np.pi * np.array(light.z)
    np.testing.assert_allclose(ours, values[0] - values[1], rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("estimation", [Estimation(rays=64), Estimation(rays=2, filtered=True)])
@pytest.mark.parametrize("behind", [True, False])
def test_a_floor_under_a_low_sun_has_the_factor_of_its_direction(
    variant: str, sphere_over_plane, behind: bool, estimation: Estimation
) -> None:
    """The mean over all directions of light was 1.3 times and 0.6 times of it."""
    image = np.zeros((128, 256, 3), np.float32)
    image[55, 126:130] = 1000.0  # 12 degrees up, along -y
    tracer, lighting = sphere_over_plane(sphere=False, base_color=0.5), Lighting(EnvironmentMap(image))
    eye = (0.0, -6.0 if behind else 6.0, 2.0)
    view = Camera.look_at(eye, (0, 0, 0), fov_deg=4, width=16, height=16)
    found = render_guidance(tracer, view, lighting, estimation)
    polar = 55 / 127 * np.pi
    light = mi.Vector3f(0, -float(np.sin(polar)), float(np.cos(polar)))
    along = mi.Vector3f(*(-np.array(eye) / np.linalg.norm(eye)).tolist())
    roughness = mi.Float(float(found.gbuffer["roughness"].mean()))
    factor = np.array(burley_factor(burley_terms(mi.Vector3f(0, 0, 1), along, light), roughness, mi.Float(0)))
    other = render_guidance(sphere_over_plane(sphere=False, base_color=0.0), view, lighting, estimation)
    diffuse = (found.shadowed - other.shadowed)[..., 0] / (0.5 * found.irradiance[..., 0])
    np.testing.assert_allclose(np.median(diffuse), factor[0], rtol=0.03)


def test_terms_of_even_light_are_means_of_those_of_single_directions(variant: str) -> None:
    count, up = 1 << 18, mi.Vector3f(0, 0, 1)
    square = generator(0, "tests", "even").random((2, count), np.float32)
    light = mi.warp.square_to_cosine_hemisphere(mi.Point2f(square))
    for cosine in (0.05, 0.3, 0.9):
        along = mi.Vector3f(0, float(np.sqrt(1 - cosine**2)), -cosine)
        means = np.array(burley_terms(up, along, light)).mean(axis=1)
        found = even_terms(up, along)
        np.testing.assert_allclose(np.array(found).ravel(), means, rtol=0.01, atol=1e-4)
        for roughness in (0.2, 1.0):  # the table is of Mitsuba's material
            _, _, factor, _ = BrdfTable.load()(mi.Float(roughness), mi.Float(cosine))
            ours = burley_factor(found, mi.Float(roughness), mi.Float(0))
            np.testing.assert_allclose(np.array(ours), np.array(factor), rtol=0.01)


def test_terms_of_a_mean_direction_are_exact_for_one_direction_and_for_even_light(variant: str) -> None:
    light, view, up = upper(200, "light"), upper(200, "view"), mi.Vector3f(0, 0, 1)
    even, single = even_terms(up, -view), burley_terms(up, -view, light)
    for found, expected in (
        (terms_of_mean(up, -view, light), single),
        (terms_of_mean(up, -view, dr.zeros(mi.Vector3f, 200) + up * (2 / 3)), even),
        (terms_of_mean(up, -view, 0.5 * light + up / 3), 0.5 * single + 0.5 * even),
    ):
        np.testing.assert_allclose(np.array(found), np.array(expected), atol=2e-4)
    nothing = terms_of_mean(up, -view, dr.zeros(mi.Vector3f, 200))
    assert np.isfinite(np.array(nothing)).all()


def test_light_that_hardly_arrives_has_terms_that_are_numbers(variant: str) -> None:
    """Behind many surfels a ray's share is a denormal number, whose inverse is infinite: NaN in previews."""
    for weight in (0.0, 1e-45, 1e-42, 1e-39, 1e-30, 1e-20, 1.0):
        mean = weighed_mean(
            mi.Vector3f(*(mi.Float(part * weight) for part in (0.5, 0.2, -0.3))), mi.Float(weight)
        )
        terms = terms_of_mean(mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0.6, -0.8), mean)
        assert np.isfinite(np.array(terms)).all(), weight
        assert np.linalg.norm(np.array(mean)) <= 1
    np.testing.assert_allclose(np.array(mean).ravel(), [0.5, 0.2, -0.3], rtol=1e-6)
