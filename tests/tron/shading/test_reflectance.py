"""Laws of reflectances: the metallic workflow's ends, and the albedo of a bounce against a white furnace."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.shading.environment import EnvironmentMap
from tron.shading.lighting import Lighting
from tron.shading.reflectance import (
    DIELECTRIC_F0,
    MOST_ALBEDO,
    bounce_albedo,
    diffuse_albedo,
    specular_f0,
)

pytestmark = pytest.mark.usefixtures("variant")


def material(base: float, roughness: float, metallic: float) -> SimpleNamespace:
    return SimpleNamespace(
        base_color=mi.Color3f(base, 0.5 * base, 0.0),
        roughness=mi.Float(roughness),
        metallic=mi.Float(metallic),
    )


def test_a_dielectric_has_a_diffuse_colour_and_a_metal_a_specular_one():
    plastic, metal = material(0.8, 0.5, 0.0), material(0.8, 0.5, 1.0)
    base = np.array([0.8, 0.4, 0.0])
    np.testing.assert_allclose(np.array(diffuse_albedo(plastic)).ravel(), base, atol=1e-7)
    np.testing.assert_allclose(np.array(specular_f0(plastic)).ravel(), DIELECTRIC_F0, atol=1e-7)
    np.testing.assert_allclose(np.array(diffuse_albedo(metal)).ravel(), 0, atol=1e-7)
    np.testing.assert_allclose(np.array(specular_f0(metal)).ravel(), base, atol=1e-7)


@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.77, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 0.4, 1.0])
def test_a_bounces_albedo_is_what_a_surface_sends_back_of_a_furnace(roughness: float, metallic: float):
    """Shaded from all sides under light 1 and averaged by the cosine: 2 x the integral over it."""
    count = 2000
    surface = material(0.6, roughness, metallic)
    cosine = (dr.arange(mi.Float, count) + 0.5) / count
    view = mi.Vector3f(dr.safe_sqrt(1 - cosine * cosine), 0, cosine)
    white = Lighting(EnvironmentMap.constant(1.0)).split_sum
    up = mi.Vector3f(0, 0, 1)
    sent = diffuse_albedo(surface) * white.diffuse(up)
    sent += white.specular(up, view, surface.roughness, specular_f0(surface))
    expected = [float(np.sum(2 * np.array(cosine * channel)) / count) for channel in sent]
    np.testing.assert_allclose(np.array(bounce_albedo(surface)).ravel(), expected, atol=2e-3)


def test_no_material_sends_out_as_much_as_it_gets():
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 21)] * 3), -1).reshape(-1, 3).astype(np.float32)
    base, roughness, metallic = (mi.Float(np.ascontiguousarray(column)) for column in grid.T)
    surface = SimpleNamespace(base_color=mi.Color3f(base), roughness=roughness, metallic=metallic)
    albedo = np.array(bounce_albedo(surface))
    assert albedo.min() >= 0
    assert albedo.max() == pytest.approx(MOST_ALBEDO)
    assert MOST_ALBEDO < 1
    brighter = grid[:, 0] > 0
    assert (albedo[0][brighter] > 0.02).all()
